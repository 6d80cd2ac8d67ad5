"""Optimisers: a search on matrices (ask/tell) and a refinement; they have never heard of plants."""

from phytofit.optimize.cross_entropy import CrossEntropy, Generation
from phytofit.optimize.refine import Refined, refine

__all__ = ["CrossEntropy", "Generation", "Refined", "refine"]
