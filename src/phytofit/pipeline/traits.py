"""Traits of a plant beside those of its fitted leaves."""

import numpy as np
import pandas as pd

from phytofit.io import SEPARATOR
from phytofit.results import Remark, graded
from phytofit.results.remarks import of_codes, worst
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

    def trait(organ: str, rank: int, name: str, value: float, in_unit: str) -> Trait:
        return Trait(organ, rank, name, value, in_unit, method=OF_SEGMENTATION)

    traits = [
        trait("plant", 0, "plant_height", height, unit),
        trait("plant", 0, "leaf_count", float(len(found.leaves)), "1"),
    ]
    if between:
        traits.append(trait("plant", 0, "divergence_angle", float(np.median(between)), "deg"))
    below = None
    for i, leaf in enumerate(found.leaves):
        rank = leaf.rank
        mine = [trait("leaf", rank, "collar_height", leaf.collar_height, unit)]
        if below is not None:
            mine.append(trait("leaf", rank, "collar_distance", leaf.collar_distance - below.collar_distance, unit))
        mine.append(trait("leaf", rank, "leaf_azimuth", leaf.azimuth, "deg"))
        if below is not None:
            mine.append(trait("leaf", rank, "divergence_angle", between[i - 1], "deg"))
        traits += graded(mine, of_codes(leaf.flags))
        below = leaf
    return traits


def _apart(a: float, b: float) -> float:
    """Angle between two azimuths, 0 to 180 degrees."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def by_its_points(found: Segmentation, leaf: SegmentedLeaf, why: Remark) -> list[Trait]:
    """The length of a leaf that could not be fitted, along its points."""
    unit = "rel" if found.cloud.unit == "none" else "cm"
    return graded([Trait("leaf", leaf.rank, "leaf_length", leaf.length, unit, method=OF_SEGMENTATION)], [why])


def of_leaf(table: pd.DataFrame, name: str, plant: int, leaf: SegmentedLeaf) -> pd.DataFrame:
    """The traits of a phytomer as those of the plant's leaf, and of the internode that bears it; what its segmentation
    remarks touches them too."""
    kept = table[~table["trait"].isin(OF_THE_CUT)]
    kept = kept.assign(cloud=name, plant=plant, rank=leaf.rank, organ=kept["organ"].replace("stem", "internode"))
    kept = kept.assign(**{column: kept[column].astype(object).fillna("") for column in ("quality", "flags")})
    for one in of_codes(leaf.flags):
        touched = kept["trait"].isin(one.traits)
        quality, flags = (kept.loc[touched, column] for column in ("quality", "flags"))
        kept.loc[touched, "quality"] = [worst(filter(None, (grade, one.grade))) for grade in quality]
        kept.loc[touched, "flags"] = [SEPARATOR.join(filter(None, (codes, one.code))) for codes in flags]
    return kept
