"""The paper's evaluation, regenerated: ``python -m evaluation``, or ``make paper``.

It calls what the modules of phytofit offer only, and the peers and the baseline without a model of ``benchmarks/``.
"""
