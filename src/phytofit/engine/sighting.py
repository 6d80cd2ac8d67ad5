"""What of a phytomer the cloud shows: its parts, its base, its tip, and what belongs to neither organ."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior
from phytofit.engine.unexplained import on_something_else
from phytofit.models import LEAF, Organ, move
from phytofit.models.surface import on_strip
from phytofit.traits import measure

__all__ = [
    "OFFSET",
    "Sighting",
    "across_leaf",
    "along_stem",
    "clearly_lacking",
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
N_SECTORS = 12  # around the stem
BASE_SECTIONS = 2  # the leaf's first tenth
HIDDEN_BASE = 0.5  # share of what is around a leaf's base that may not have been seen, from which that is hidden
END_SECTIONS = 3  # narrow: noise blurs them
GAP, EMPTY = 0.4, 0.1  # of the typical number of points, twice
OFFSET = "collar_offset"  # the parameter that says where a leaf starts, in the stem or at its surface
RISES = 0.02  # of a leaf's length, which the stem's surface hides and it may be longer, that is worth a remark


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
    all points that are of no organ, and too crowded for outliers: they lie on something else, and no label says so.
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


def sighting(posterior: Posterior, state: State, at: Evaluation) -> Sighting:
    """What of the phytomer the cloud shows; `at` is the state evaluated."""
    on_stem, on_leaf, outlier = at.responsibilities.T
    pose = posterior.pose_of(state)
    points = (posterior.points - pose[:3, 3]) @ pose[:3, :3]  # in the model's frame
    leaf = posterior.model.organs(state.x)[1].row(0)
    place = _area_share(leaf, points)
    gaps = _gaps(leaf, points[on_leaf > 0.5], place[on_leaf > 0.5])
    weight = np.where(on_leaf > 0.5, on_leaf, 0.0)
    found = np.bincount(np.minimum((place * N_SECTIONS).astype(int), N_SECTIONS - 1), weight, N_SECTIONS)
    typical = np.median(found[found > 0.0]) if np.any(found > 0.0) else 1.0
    stem_points = points[on_stem > 0.5]
    angle = np.arctan2(stem_points[:, 1], stem_points[:, 0])
    sector = np.bincount(((angle + np.pi) / (2 * np.pi) * N_SECTORS).astype(int) % N_SECTORS, minlength=N_SECTORS)
    shown = np.mean(sector > SEEN_DENSITY * np.quantile(sector, 0.75)) if len(stem_points) else 0.0
    beyond = _beyond_tip(posterior, state, at)
    end = float(across_leaf(posterior, state)[0][on_leaf > 0.5].max(initial=0.0))
    short = float(on_leaf.sum() * (1.0 - place[on_leaf > 0.5].max(initial=0.0)))
    risen = along_stem(posterior, state)
    labelled = posterior.organ >= 0
    left_over = (outlier > 0.5) & (labelled | ~labelled.any())  # points that are labelled as nothing may lie anywhere
    void, start = posterior.void, pose[:3, :3] @ leaf.axis[0] + pose[:3, 3]
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
        bool(posterior.prior.weight.max() == 1.0) and (void is None or bool(void.larger().at(start) < HIDDEN_BASE)),
        np.count_nonzero(on_something_else(points[left_over], posterior.outlier_density)) / len(points),
    )


def along_stem(posterior: Posterior, state: State) -> float:
    """How much of the midrib, cm, lies inside the stem where it starts nearer to the stem's surface than the leaf's
    points scatter, so that it may as well be outside; 0 if it is not worth a remark, or the model has no such leaf."""
    if OFFSET not in posterior.space.names:
        return 0.0
    stem, leaf = (organ.row(0) for organ in posterior.model.organs(state.x))
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
    by = on_strip(leaf, points)
    j = by.segment
    slope = (leaf.half_width[j + 1] - leaf.half_width[j]) / leaf.segment_lengths[j]
    half = np.maximum(leaf.half_width[j] + slope * by.along, 1e-9)
    strip: NDArray[np.intp] = np.clip((by.across / half + 1.0) * n_strips / 2.0, 0, n_strips - 1).astype(np.intp)
    return strip


def _beyond_tip(posterior: Posterior, state: State, at: Evaluation) -> int:
    """Number of points near the leaf's tip that are of no organ, 0 if there are not more than outliers would be there
    by chance: the leaf may go on there, where the model does not."""
    outlier = at.responsibilities[:, 2]
    leaf = move([posterior.model.organs(state.x)[1].row(0)], posterior.pose_of(state))[0]
    near = NEAR_TIP * leaf.segment_lengths.sum()
    there = posterior.points[(outlier > 0.5) & (np.linalg.norm(posterior.points - leaf.axis[-1], axis=1) < near)]
    if len(there) <= FEW_BEYOND:
        return 0
    offset = np.random.default_rng(0).uniform(-near, near, (N_BEYOND, 3))  # how much of the hull lies near the tip
    around = leaf.axis[-1] + offset[np.linalg.norm(offset, axis=1) < near]
    planes = ConvexHull(posterior.points).equations
    inside = np.mean(np.all(around @ planes[:, :3].T + planes[:, 3] < 0.0, axis=1))
    expected = float(outlier.sum()) * inside * 4.0 / 3.0 * np.pi * near**3 * posterior.outlier_density
    return len(there) if len(there) > expected + CLEARLY * np.sqrt(expected) else 0


def across_leaf(posterior: Posterior, state: State, *, until: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Share (n,) of the midrib at which each point lies, and where (n, 2) across it: cm sideways, and off the blade.

    With `until`, a share of more than 1, the midrib goes straight on so far, and beyond that.
    """
    pose = posterior.pose_of(state)
    points = (posterior.points - pose[:3, 3]) @ pose[:3, :3]
    leaf = posterior.model.organs(state.x)[1].row(0)
    whole = leaf.segment_lengths.sum()
    leaf = leaf if until is None else leaf.until(until)
    by = on_strip(leaf, points)
    along, j = by.along, by.segment
    if until is not None:
        straight = np.einsum("ni,ni->n", leaf.frame[j][:, :, 0], points - leaf.axis[j])
        along = np.where(j == len(leaf.frame) - 1, straight, along)
    place = (np.concatenate([[0.0], np.cumsum(leaf.segment_lengths)])[j] + along) / whole
    return place, np.stack([by.across, by.off], axis=1)


def _area_share(leaf: Organ, points: FloatArray) -> FloatArray:
    """Share (n,) of the leaf's area that lies nearer to its base than each point."""
    assert leaf.kind == LEAF
    j, along = leaf.nearest(points)
    area = leaf.segment_lengths * (leaf.half_width[1:] + leaf.half_width[:-1])
    before = np.concatenate([[0.0], np.cumsum(area)])
    passed = before[j] + along / leaf.segment_lengths[j] * area[j]
    share: FloatArray = passed / before[-1]
    return share
