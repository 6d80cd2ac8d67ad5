"""Point clouds: arrays in centimetres, read from files, written, thinned."""

from phytofit.cloud.cloud import MIN_POINTS, PointCloud, from_points
from phytofit.cloud.read import READERS, as_cloud, read_cloud
from phytofit.cloud.thinning import remove_outliers, size_cm, thin
from phytofit.cloud.units import SCALE_CM
from phytofit.cloud.write import write_cloud

__all__ = [
    "MIN_POINTS",
    "READERS",
    "SCALE_CM",
    "PointCloud",
    "as_cloud",
    "from_points",
    "read_cloud",
    "remove_outliers",
    "size_cm",
    "thin",
    "write_cloud",
]
