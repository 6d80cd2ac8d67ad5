"""Traits of a plant beside those of its fitted leaves."""

import numpy as np
import pandas as pd

from phytofit.segmentation import Segmentation, SegmentedLeaf
from phytofit.traits import Trait

__all__ = ["by_its_points", "of_leaf", "plant_traits"]

OF_SEGMENTATION = "from the segmentation"
OF_THE_CUT = ("stem_length",)  # of a phytomer: where it was cut decides them


def plant_traits(found: Segmentation) -> list[Trait]:
    """What a segmentation tells of the plant: its height above the stem's base, how many leaves it has, and the median
    angle by which one diverges from the one below (phyllotaxy); and of each leaf: the height of its collar above the
    stem's base, the distance along the stem from the collar below, its azimuth, and that angle, 0 to 180 degrees."""
    unit = "rel" if found.cloud.unit == "none" else "cm"
    organs = found.cloud.points[found.labels > 0]
    height = float(((organs - found.stem_path[0]) @ found.up).max())
    between = [_apart(b.azimuth, a.azimuth) for a, b in zip(found.leaves, found.leaves[1:], strict=False)]

    def trait(organ: str, rank: int, name: str, value: float, in_unit: str, flags: tuple[str, ...] = ()) -> Trait:
        return Trait(organ, rank, name, value, in_unit, None, None, OF_SEGMENTATION, flags)

    traits = [
        trait("plant", 0, "plant_height", height, unit),
        trait("plant", 0, "leaf_count", float(len(found.leaves)), "1"),
    ]
    if between:
        traits.append(trait("plant", 0, "divergence_angle", float(np.median(between)), "deg"))
    below = None
    for i, leaf in enumerate(found.leaves):
        rank, flags = leaf.rank, leaf.flags
        traits.append(trait("leaf", rank, "collar_height", leaf.collar_height, unit, flags))
        if below is not None:
            apart = leaf.collar_distance - below.collar_distance
            traits.append(trait("leaf", rank, "collar_distance", apart, unit, flags))
        traits.append(trait("leaf", rank, "leaf_azimuth", leaf.azimuth, "deg", flags))
        if below is not None:
            traits.append(trait("leaf", rank, "divergence_angle", between[i - 1], "deg", flags))
        below = leaf
    return traits


def _apart(a: float, b: float) -> float:
    """Angle between two azimuths, 0 to 180 degrees."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def by_its_points(found: Segmentation, leaf: SegmentedLeaf, reason: str) -> Trait:
    """The length of a leaf that could not be fitted, along its points."""
    unit = "rel" if found.cloud.unit == "none" else "cm"
    flags = (f"not fitted: {reason}",)
    return Trait("leaf", leaf.rank, "leaf_length", leaf.length, unit, None, None, OF_SEGMENTATION, flags)


def of_leaf(table: pd.DataFrame, name: str, plant: int, rank: int) -> pd.DataFrame:
    """The traits of a phytomer as those of the plant's leaf of that rank, and of the internode that bears it."""
    kept = table[~table["trait"].isin(OF_THE_CUT)]
    return kept.assign(cloud=name, plant=plant, rank=rank, organ=kept["organ"].replace("stem", "internode"))
