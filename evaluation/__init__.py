"""The paper's evaluation, regenerated: ``python -m evaluation``, or ``make paper``.

It calls the public names of phytofit only, and the peers and the baseline without a model of ``benchmarks/``.
"""
