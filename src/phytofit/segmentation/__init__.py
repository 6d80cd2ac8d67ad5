"""From a plant's cloud to its organs: stem, leaves by rank, phytomers for the fit."""

from phytofit.segmentation.derive import SegmentedLeaf
from phytofit.segmentation.plants import numbering, separate_plants
from phytofit.segmentation.whole import PLANT_CM, Segmentation, segment

__all__ = ["PLANT_CM", "Segmentation", "SegmentedLeaf", "numbering", "segment", "separate_plants"]
