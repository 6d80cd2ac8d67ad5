"""Optimisers: ask/tell on matrices; they never call the objective and have never heard of plants."""

from phytofit.optimize.cross_entropy import CrossEntropy, Generation

__all__ = ["CrossEntropy", "Generation"]
