"""Remarks on a fit in plain words: where its numbers rest on little, or on nothing."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from phytofit.engine.sighting import OFFSET, Sighting
from phytofit.parameters import ParameterSpace

__all__ = ["FEW_ON_STEM", "IMPLAUSIBLE", "NEAR_BOUND", "UNUSABLE", "flags_of"]

FloatArray = NDArray[np.float64]
FEW_FOR_SHAPE = 200.0  # points, fewer than which tell little of a leaf with a shape of its own
ROUND = 0.7  # share of them that must be seen
MANY_GAPS = 0.1  # share of the blade
FEW_ON_STEM = 60  # points
LITTLE_EXPLAINED = 0.1  # share of outliers that is worth a remark
MUCH_NOISE_CM = 1.0
BLURRED = 2.0  # stem noises in a stem's radius, below which a tube can't be told from a filled stem
EDGE_ON = 1.5  # leaf noises in a leaf's half width, below which the width is not resolved
UNUSABLE = "unusable: "  # with which a flag begins that says not to use the numbers
IMPLAUSIBLE = 4.0  # spreads of the prior
BOUNDED = ("stem_diameter", "leaf_angle", "leaf_length", "leaf_width", "stem_diameter_above")
NEAR_BOUND = 1e-6
TIP_DOUBTFUL = "the leaf's tip may be missing: leaf length and area may be larger. Look at the tip in fit.png"
BEYOND_TIP = "{:.0f} points lie beyond the fitted tip: the leaf may be longer. Look at the tip in fit.png"
CUT_BACK = (
    "no points on the last {:.0f} % of the fitted leaf, where {:.0f} are expected: leaf length ends where the points "
    "do. Check the tip in fit.png"
)
BLUNT = "the leaf ends bluntly, as if its tip were cut off: leaf length and area are those of the part that was seen"
ALONG_STEM = "the leaf hugs its stem: leaf length counts from where it leaves the stem, and may be {:.2g} {} more"
TIP_NOT_SEEN = "the leaf's tip is missing: leaf length and area may be larger. Scan the tip"


def flags_of(
    space: ParameterSpace,
    x: FloatArray,
    seen: Sighting,
    *,
    noise: FloatArray,
    outlier_share: float,
    midrib_seen: float,
    tip_seen: bool,
    blunt: bool,
    ends_at: float,
    scale: float = 1.0,
) -> Iterator[str]:
    """The remarks on a fit: parameters x (k,), noise (2,) or more on stem and leaf, share of outliers, share of the
    midrib that was seen, whether its tip clearly was, whether it ends bluntly, share of the midrib at which it does;
    `scale` input lengths make a cm."""
    if midrib_seen < 1.0:
        yield TIP_NOT_SEEN
    elif blunt:
        yield BLUNT
    if ends_at < 1.0:
        yield CUT_BACK.format(100.0 * (1.0 - ends_at), seen.short)
    elif midrib_seen == 1.0 and not blunt and not tip_seen:
        yield TIP_DOUBTFUL
    if seen.beyond:
        yield BEYOND_TIP.format(seen.beyond)
    yield from _of_what_was_seen(seen, OFFSET in space.names)
    if seen.along_stem:
        yield ALONG_STEM.format(seen.along_stem * scale, _length_unit(scale))
    if outlier_share >= LITTLE_EXPLAINED:
        yield (
            f"the model does not explain {100 * outlier_share:.0f} % of the points: another leaf or clutter may be in "
            "the cloud. Look at fit.png and cut the cloud more cleanly"
        )
    for name, std in zip(("stem", "leaf"), noise, strict=False):
        if std > MUCH_NOISE_CM:
            scatter = f"{std * scale:.3g} {_length_unit(scale)}"
            yield (
                f"the points scatter by {scatter} around the {name}, far more than expected: check the unit, and the "
                "fit in fit.png"
            )
    value = dict(zip(space.names, x.tolist(), strict=True))
    if 0.5 * value["stem_diameter"] < BLURRED * noise[0]:
        yield (
            "the stem's points scatter by half its radius or more: stem diameter is too small if the stem's section is "
            "filled with points"
        )
    if 0.5 * value["leaf_width"] < EDGE_ON * noise[1]:
        yield (
            "the leaf is hardly wider than its points scatter, as if seen edge-on: leaf width and area are uncertain. "
            "Scan across the blade"
        )
    yield from _against_the_prior(space, x, scale)


def _of_what_was_seen(seen: Sighting, own_shape: bool) -> Iterator[str]:
    if not seen.shows_base:
        yield (
            "the leaf's base is hidden: leaf angle and insertion angle follow from the rest of the leaf. Scan the base"
        )
    if seen.leaf < 0.5:
        yield (
            f"only {100 * seen.leaf:.0f} % of the leaf was seen: the rest of its length, width and area comes from the "
            "model. Scan from more sides"
        )
    elif seen.gaps >= MANY_GAPS:
        yield (
            f"{100 * seen.gaps:.0f} % of the blade has almost no points: leaf width and area come from the rest and "
            "may be off. Scan from more sides"
        )
    if seen.leaf_points < FEW_FOR_SHAPE and own_shape:
        yield (
            f"only {seen.leaf_points:.0f} points on the leaf: leaf length may be off by several cm. Scan more densely"
        )
    if seen.stem_points < FEW_ON_STEM:
        yield (
            f"only {seen.stem_points:.0f} points on the stem: stem diameter and leaf angle are uncertain. Keep a "
            "longer piece of stem"
        )
    elif seen.sectors < ROUND:
        yield (
            f"the stem was seen from one side ({360 * seen.sectors:.0f}° of its circumference): stem diameter may be "
            "off. Scan from more sides"
        )


def _against_the_prior(space: ParameterSpace, x: FloatArray, scale: float) -> Iterator[str]:
    for i, p in enumerate(space.parameters):
        value, unit = (x[i] * scale, _length_unit(scale)) if p.unit == "cm" else (x[i], p.unit)
        along_stem = p.name == "leaf_angle" and x[i] == p.lower and "leaf_base_bend" in space.names  # as leaves may be
        at_bound = min(x[i] - p.lower, p.upper - x[i]) < NEAR_BOUND and not along_stem
        if at_bound and (p.name in BOUNDED or p.unit == "deg"):  # a share may be 0 or 1; no angle is the greatest
            yield (
                f"{p.name} is at the limit of the species, {value:.3g} {unit}: check the unit, or widen the limit in a "
                "species file"
            )
        elif p.name in BOUNDED and abs(x[i] - p.mean) > IMPLAUSIBLE * p.std:
            yield (
                f"{p.name} of {value:.3g} {unit} is unusual for the species: check the unit, and in fit.png whether "
                "this is one leaf on its stem"
            )


def _length_unit(scale: float) -> str:
    return "cm" if scale == 1.0 else "(relative length)"
