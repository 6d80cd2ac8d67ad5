"""The method of Sodhi et al., IROS 2018, alone: distances, ICP, and the cross-entropy search."""

from phytofit.paper.cross_entropy import CrossEntropy, Generation
from phytofit.paper.distances import DISTANCES, Reference, chamfer, hausdorff, labelled_hausdorff, quantile_hausdorff
from phytofit.paper.objective import PaperObjective, Registration, minimise

__all__ = [
    "DISTANCES",
    "CrossEntropy",
    "Generation",
    "PaperObjective",
    "Reference",
    "Registration",
    "chamfer",
    "hausdorff",
    "labelled_hausdorff",
    "minimise",
    "quantile_hausdorff",
]
