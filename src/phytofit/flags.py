"""Remarks on a fit in plain words: where its numbers rest on little, or on nothing."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from phytofit.likelihood import CloudLikelihood, State
from phytofit.models import LEAF, Organ, move
from phytofit.parameters import ParameterSpace
from phytofit.traits import measure
from phytofit.unexplained import on_something_else

__all__ = [
    "FEW_ON_STEM",
    "IMPLAUSIBLE",
    "NEAR_BOUND",
    "OFFSET",
    "UNUSABLE",
    "Sighting",
    "across_leaf",
    "along_stem",
    "clearly_lacking",
    "flags_of",
    "sighting",
    "strip_of",
]

FloatArray = NDArray[np.float64]
N_SECTIONS = 20  # of the leaf, of equal area
SEEN_DENSITY = 0.25  # of the leaf's typical density, from which a section counts as seen
TYPICAL = 0.75  # quantile of the numbers of points on parts of the leaf that counts as that where all was seen
CLEARLY = 4.0  # standard deviations of the number of points
NEAR_TIP, FEW_BEYOND, N_BEYOND = 0.15, 12, 4000  # of the leaf's length; points; points drawn around the tip
N_STRIPS = 3  # of the blade, in which gaps are counted
FEW_FOR_SHAPE = 200.0  # points, fewer than which tell little of a leaf with a shape of its own
N_SECTORS = 12  # around the stem
ROUND = 0.7  # share of them that must be seen
BASE_SECTIONS = 2  # the leaf's first tenth
HIDDEN_BASE = 0.5  # share of what is around a leaf's base that may not have been seen, from which that is hidden
END_SECTIONS = 3  # narrow: noise blurs them
GAP, EMPTY, MANY_GAPS = 0.4, 0.1, 0.1  # of the typical number of points, twice; share of the blade
FEW_ON_STEM = 60  # points
LITTLE_EXPLAINED = 0.1  # share of outliers that is worth a remark
MUCH_NOISE_CM = 1.0
BLURRED = 2.0  # stem noises in a stem's radius, below which a tube can't be told from a filled stem
EDGE_ON = 1.5  # leaf noises in a leaf's half width, below which the width is not resolved
UNUSABLE = "unusable: "  # with which a flag begins that says not to use the numbers
ONE_LEAF_ONLY = "measure a whole plant with phytofit.run, or give a seed point on the leaf you want"
OFFSET = "collar_offset"  # the parameter that says where a leaf starts, in the stem or at its surface
RISES = 0.02  # of a leaf's length, which the stem's surface hides and it may be longer, that is worth a remark
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


@dataclass(frozen=True)
class Sighting:
    """What of a phytomer the cloud shows.

    ``sections`` (20,) density of points on sections of the leaf, base to tip, in units of the typical one;
    ``stem_points`` number of points on the stem; ``sectors`` share of the stem's circumference with points;
    ``gaps`` share of the blade (in sections and three strips each, without its ends) that clearly has no points where
    other parts have; ``beyond`` number of points near the leaf's tip that are of no organ, 0 if there are not more than
    by chance; ``end`` share of the midrib at which the leaf's last point lies, and ``short`` how many more would be
    expected beyond it; ``along_stem`` cm of the midrib that lie inside the stem, but so near its surface that they may
    as well be outside; ``leaf_points`` number of points on the leaf; ``base`` whether its start, as fitted, lies in
    no void, however large that may be, and the prior of where that is did not count more often; ``elsewhere`` share of
    all points that are of no organ, and too crowded for outliers: they lie on something else.
    """

    sections: FloatArray
    stem_points: float
    sectors: float
    gaps: float
    beyond: float
    end: float
    short: float
    along_stem: float = 0.0
    leaf_points: float = np.inf
    base: bool = True
    elsewhere: float = 0.0

    @property
    def leaf(self) -> float:
        """Share of the leaf's area that was seen."""
        return float(np.mean(self.sections >= SEEN_DENSITY))

    @property
    def shows_base(self) -> bool:
        """Whether something was seen where the leaf starts."""
        return self.base and bool(np.any(self.sections[:BASE_SECTIONS] >= SEEN_DENSITY))


def sighting(likelihood: CloudLikelihood, state: State, scores: FloatArray) -> Sighting:
    """What of the phytomer the cloud shows; scores (n, k) of the points as `state` gives them."""
    on_stem, on_leaf, outlier = state.belongs(scores)
    pose = likelihood.pose_of(state)
    points = (likelihood.points - pose[:3, 3]) @ pose[:3, :3]  # in the model's frame
    leaf = likelihood.model.organs(state.x)[1].row(0)
    place = _area_share(leaf, points)
    gaps = _gaps(leaf, points[on_leaf > 0.5], place[on_leaf > 0.5])
    weight = np.where(on_leaf > 0.5, on_leaf, 0.0)
    found = np.bincount(np.minimum((place * N_SECTIONS).astype(int), N_SECTIONS - 1), weight, N_SECTIONS)
    typical = np.median(found[found > 0.0]) if np.any(found > 0.0) else 1.0
    stem_points = points[on_stem > 0.5]
    angle = np.arctan2(stem_points[:, 1], stem_points[:, 0])
    sector = np.bincount(((angle + np.pi) / (2 * np.pi) * N_SECTORS).astype(int) % N_SECTORS, minlength=N_SECTORS)
    shown = np.mean(sector > SEEN_DENSITY * np.quantile(sector, 0.75)) if len(stem_points) else 0.0
    beyond = _beyond_tip(likelihood, state, scores)
    end = float(across_leaf(likelihood, state)[0][on_leaf > 0.5].max(initial=0.0))
    short = float(on_leaf.sum() * (1.0 - place[on_leaf > 0.5].max(initial=0.0)))
    risen = along_stem(likelihood, state)
    void, start = likelihood.void, pose[:3, :3] @ leaf.axis[0] + pose[:3, 3]
    return Sighting(
        found / typical,
        float(on_stem.sum()),
        float(shown),
        gaps,
        float(beyond),
        end,
        short,
        risen,
        float(on_leaf.sum()),
        bool(likelihood.prior_weight.max() == 1.0) and (void is None or bool(void.larger().at(start) < HIDDEN_BASE)),
        np.count_nonzero(on_something_else(points[outlier > 0.5], likelihood.outlier_density)) / len(points),
    )


def along_stem(likelihood: CloudLikelihood, state: State) -> float:
    """How much of the midrib, cm, lies inside the stem where it starts nearer to the stem's surface than the leaf's
    points scatter, so that it may as well be outside; 0 if it is not worth a remark, or the model has no such leaf."""
    if OFFSET not in likelihood.space.names:
        return 0.0
    stem, leaf = (organ.row(0) for organ in likelihood.model.organs(state.x))
    whole = float(leaf.segment_lengths.sum())
    outside = next(trait.value for trait in measure((stem, leaf)) if trait.name == "leaf_length")
    surface = np.interp(leaf.axis[0, 2], stem.axis[:, 2], stem.half_width)
    near = surface - np.hypot(*leaf.axis[0, :2]) < state.noise[1]
    return whole - outside if near and 0.0 < outside < (1.0 - RISES) * whole else 0.0


def _gaps(leaf: Organ, points: FloatArray, place: FloatArray) -> float:
    """Share of the blade that has few points where other parts have many; `place` (n,) of the area before each."""
    section = np.minimum((place * N_SECTIONS).astype(int), N_SECTIONS - 1)
    found = np.bincount(section * N_STRIPS + strip_of(leaf, points, N_STRIPS), minlength=N_SECTIONS * N_STRIPS)
    found = found.reshape(N_SECTIONS, N_STRIPS)[BASE_SECTIONS:-END_SECTIONS]
    typical = float(np.quantile(found[found > 0], TYPICAL)) if found.any() else 0.0
    return float(clearly_lacking(found.astype(float), np.full(found.shape, typical)).mean())


def clearly_lacking(found: FloatArray, wanted: FloatArray) -> NDArray[np.bool_]:
    """Where next to none are found of the points that are wanted, or so few that neither chance nor the unevenness of
    the rest explains it."""
    share = found / np.maximum(wanted, 1e-9)
    spread = np.maximum(np.sqrt(wanted), _upper_spread(share) * wanted)
    few = (share < GAP) & (wanted - found > CLEARLY * spread)
    none = (share < EMPTY) & (wanted > CLEARLY**2)
    lacking: NDArray[np.bool_] = few | none
    return lacking


def _upper_spread(values: FloatArray) -> float:
    """Standard deviation of normal values, from those above the typical one: holes are below it."""
    typical, high = np.quantile(values, [TYPICAL, 0.95])
    return float((high - typical) / 0.9704)  # of the normal quantiles' difference


def strip_of(leaf: Organ, points: FloatArray, n_strips: int) -> NDArray[np.intp]:
    """Strip (n,) of the blade that is nearest to each point, from its right edge."""
    j, along = leaf.nearest(points)
    lateral = np.einsum("ni,ni->n", points - leaf.axis[j], leaf.frame[j][:, :, 1])
    slope = (leaf.half_width[j + 1] - leaf.half_width[j]) / leaf.segment_lengths[j]
    half = np.maximum(leaf.half_width[j] + slope * along, 1e-9)
    strip: NDArray[np.intp] = np.clip((lateral / half + 1.0) * n_strips / 2.0, 0, n_strips - 1).astype(np.intp)
    return strip


def _beyond_tip(likelihood: CloudLikelihood, state: State, scores: FloatArray) -> int:
    """Number of points near the leaf's tip that are of no organ, 0 if there are not more than outliers would be there
    by chance: the leaf may go on there, where the model does not."""
    outlier = state.belongs(scores)[2]
    leaf = move([likelihood.model.organs(state.x)[1].row(0)], likelihood.pose_of(state))[0]
    near = NEAR_TIP * leaf.segment_lengths.sum()
    there = likelihood.points[(outlier > 0.5) & (np.linalg.norm(likelihood.points - leaf.axis[-1], axis=1) < near)]
    if len(there) <= FEW_BEYOND:
        return 0
    offset = np.random.default_rng(0).uniform(-near, near, (N_BEYOND, 3))  # how much of the hull lies near the tip
    around = leaf.axis[-1] + offset[np.linalg.norm(offset, axis=1) < near]
    planes = ConvexHull(likelihood.points).equations
    inside = np.mean(np.all(around @ planes[:, :3].T + planes[:, 3] < 0.0, axis=1))
    expected = float(outlier.sum()) * inside * 4.0 / 3.0 * np.pi * near**3 * likelihood.outlier_density
    return len(there) if len(there) > expected + CLEARLY * np.sqrt(expected) else 0


def across_leaf(
    likelihood: CloudLikelihood, state: State, *, until: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Share (n,) of the midrib at which each point lies, and where (n, 2) across it: cm sideways, and off the blade.

    With `until`, a share of more than 1, the midrib goes straight on so far, and beyond that.
    """
    pose = likelihood.pose_of(state)
    points = (likelihood.points - pose[:3, 3]) @ pose[:3, :3]
    leaf = likelihood.model.organs(state.x)[1].row(0)
    whole = leaf.segment_lengths.sum()
    leaf = leaf if until is None else leaf.until(until)
    j, along = leaf.nearest(points)
    there = np.einsum("nib,ni->nb", leaf.frame[j], points - leaf.axis[j])
    if until is not None:
        along = np.where(j == len(leaf.frame) - 1, there[:, 0], along)
    place = (np.concatenate([[0.0], np.cumsum(leaf.segment_lengths)])[j] + along) / whole
    return place, there[:, 1:]


def _area_share(leaf: Organ, points: FloatArray) -> FloatArray:
    """Share (n,) of the leaf's area that lies nearer to its base than each point."""
    assert leaf.kind == LEAF
    j, along = leaf.nearest(points)
    area = leaf.segment_lengths * (leaf.half_width[1:] + leaf.half_width[:-1])
    before = np.concatenate([[0.0], np.cumsum(area)])
    passed = before[j] + along / leaf.segment_lengths[j] * area[j]
    share: FloatArray = passed / before[-1]
    return share


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
