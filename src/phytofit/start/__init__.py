"""Before any fit: the cloud cleaned, its stem found, the target leaf told from others, and thinned."""

from phytofit.start.pose import StartPose, parts_of_stem, start_poses
from phytofit.start.prepare import DITHER_CM, Prepared, dithered, prepare
from phytofit.start.target_leaf import target_leaf_points

__all__ = [
    "DITHER_CM",
    "Prepared",
    "StartPose",
    "dithered",
    "parts_of_stem",
    "prepare",
    "start_poses",
    "target_leaf_points",
]
