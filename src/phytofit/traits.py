"""Traits, measured on organs, fitted or true, so that truth and estimate always mean the same."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from phytofit.models import LEAF, STEM, Organ

__all__ = ["CHORD_CM", "Trait", "leaves_stem_at", "measure"]

FloatArray = NDArray[np.float64]
CHORD_CM = 8.0  # over which leaf_angle is taken
ROUNDING_CM = 1e-6  # within which a midrib that starts on the stem's surface does so
STEPS_PER_SEGMENT = 64  # a midrib is followed in steps of this share of a segment to where it leaves the stem


@dataclass(frozen=True)
class Trait:
    """One measured trait of one organ.

    ``rank`` counts leaves from the base, from 1; 0 for the stem.  ``low`` and ``high`` are the interval's ends, None
    where the method gives none; ``quality`` says how far to trust it: "good", "check" or "poor" (do not use), empty
    where nothing is known; ``flags`` are the codes of the remarks that touch it; ``method`` names how the value came
    about.
    """

    organ: str
    rank: int
    name: str
    value: float
    unit: str
    low: float | None = None
    high: float | None = None
    quality: str = ""
    flags: tuple[str, ...] = ()
    method: str = ""

    @property
    def interval(self) -> str:
        """The ends as they are shown, empty where there is none."""
        low, high = ("" if end is None else f"{end:.2f}" for end in (self.low, self.high))
        return f"{low} – {high}" if low or high else ""


def measure(organs: Sequence[Organ], *, chord_cm: float = CHORD_CM, method: str = "") -> list[Trait]:
    """The traits of a stem and its leaves.

    Parameters
    ----------
    organs : single organs (no leading dimension), the stem first, cm
    chord_cm : leaf_angle is that of the chord over this length of midrib, or a fifth of the leaf if that is shorter

    ======================== ====== ==============================================================================
    leaf_length              cm     along the midrib, from where it leaves the stem's surface to the tip
    leaf_angle               deg    stem axis to the chord from that point to the point 8 cm further; 0 is erect
    leaf_insertion_angle     deg    stem axis to the midrib's tangent at that point
    leaf_width               cm     widest, across the blade
    leaf_curvature           deg/cm mean turning of the midrib
    leaf_area                cm²    one side of the blade
    stem_diameter            cm     outer diameter, mean of the piece below its lowest leaf, whose sheath it includes
    stem_length              cm     of the piece in the cloud
    ======================== ====== ==============================================================================

    A midrib that never leaves the stem has length 0 and no angle (NaN).
    """
    stem, leaves = organs[0], organs[1:]
    assert stem.kind == STEM
    assert all(leaf.kind == LEAF for leaf in leaves)
    lengths = stem.segment_lengths
    traits = [
        Trait(STEM, 0, "stem_diameter", _diameter_below(stem, leaves), "cm", method=method),
        Trait(STEM, 0, "stem_length", float(lengths.sum()), "cm", method=method),
    ]
    for rank, leaf in enumerate(leaves, start=1):
        values = _leaf(stem, leaf, chord_cm)
        traits += [Trait(LEAF, rank, name, value, unit, method=method) for name, value, unit in values]
    return traits


def _diameter_below(stem: Organ, leaves: Sequence[Organ]) -> float:
    """Mean diameter of the stem below its lowest leaf; of all of it if it has none, or nothing below."""
    node_at = np.concatenate([[0.0], np.cumsum(stem.segment_lengths)])
    top = min((_nearest_on(stem, node_at, leaf.axis[0]) for leaf in leaves), default=0.0) or node_at[-1]
    at = np.append(node_at[node_at < top], top)
    width = 2.0 * np.interp(at, node_at, stem.half_width)
    return float(np.average(0.5 * (width[1:] + width[:-1]), weights=np.diff(at)))


def _nearest_on(stem: Organ, node_at: FloatArray, point: FloatArray) -> float:
    """Length along the stem's axis at which it is nearest to the point."""
    start, step = stem.axis[:-1], np.diff(stem.axis, axis=0)
    share = np.einsum("ja,ja->j", point - start, step) / np.maximum(np.einsum("ja,ja->j", step, step), 1e-300)
    share = np.clip(share, 0.0, 1.0)
    j = int(np.argmin(np.linalg.norm(start + share[:, np.newaxis] * step - point, axis=1)))
    return float(node_at[j] + share[j] * (node_at[j + 1] - node_at[j]))


def _leaf(stem: Organ, leaf: Organ, chord_cm: float) -> list[tuple[str, float, str]]:
    node_at = np.concatenate([[0.0], np.cumsum(leaf.segment_lengths)])
    start = leaves_stem_at(stem, leaf)
    length = float(node_at[-1] - start)
    width = float(2.0 * leaf.half_width.max())
    if length <= 0.0:
        angle = insertion = curvature = np.nan
        area = 0.0
    else:
        chord = min(chord_cm, length / 5.0)
        base, end = _at(leaf.axis, node_at, start), _at(leaf.axis, node_at, start + chord)
        segment = min(int(np.searchsorted(node_at, start, side="right")) - 1, len(node_at) - 2)
        up = _stem_direction(stem, base)
        angle = _angle(end - base, up)
        insertion = _angle(leaf.axis[segment + 1] - leaf.axis[segment], up)
        tangent = np.diff(leaf.axis[segment:], axis=0)
        turns = [_angle(a, b) for a, b in pairwise(tangent)]
        if turns:  # a leaf that was cut in the last piece has not turned all the way
            turns[-1] *= min(1.0, float(np.linalg.norm(tangent[-1]) / np.linalg.norm(tangent[-2])))
        turning = sum(turns)
        curvature = turning / length
        at = np.concatenate([[start], node_at[node_at > start]])
        half = np.interp(at, node_at, leaf.half_width)
        area = float(np.sum((half[1:] + half[:-1]) * np.diff(at)))
    return [
        ("leaf_length", length, "cm"),
        ("leaf_angle", angle, "deg"),
        ("leaf_insertion_angle", insertion, "deg"),
        ("leaf_width", width, "cm"),
        ("leaf_curvature", curvature, "deg/cm"),
        ("leaf_area", area, "cm²"),
    ]


def leaves_stem_at(stem: Organ, leaf: Organ) -> float:
    """Length along the midrib, cm, at which it first leaves the stem's surface; its whole length if it never does."""
    node_at = np.concatenate([[0.0], np.cumsum(leaf.segment_lengths)])
    at = np.linspace(0.0, node_at[-1], STEPS_PER_SEGMENT * (len(node_at) - 1) + 1)
    points = np.stack([np.interp(at, node_at, leaf.axis[:, a]) for a in range(3)], axis=1)
    depth = np.full(len(at), np.inf)  # distance to the stem's surface, negative inside
    for j in range(len(stem.axis) - 1):
        a, b = stem.axis[j], stem.axis[j + 1]
        share = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0.0, 1.0)
        radius = stem.half_width[j] + share * (stem.half_width[j + 1] - stem.half_width[j])
        depth = np.minimum(depth, np.linalg.norm(points - a - share[:, np.newaxis] * (b - a), axis=1) - radius)
    if depth[0] >= -ROUNDING_CM:
        return 0.0
    outside = np.flatnonzero(depth >= 0.0)
    if len(outside) == 0:
        return float(node_at[-1])
    i = int(outside[0])
    return float(at[i - 1] + (at[i] - at[i - 1]) * depth[i - 1] / (depth[i - 1] - depth[i]))


def _stem_direction(stem: Organ, point: FloatArray) -> FloatArray:
    """Direction of the stem's segment nearest to the point."""
    distance = np.linalg.norm(0.5 * (stem.axis[1:] + stem.axis[:-1]) - point, axis=1)
    j = int(np.argmin(np.where(stem.segment_lengths > 0.0, distance, np.inf)))
    direction: FloatArray = stem.axis[j + 1] - stem.axis[j]
    return direction


def _at(axis: FloatArray, node_at: FloatArray, s: float) -> FloatArray:
    return np.array([np.interp(s, node_at, axis[:, a]) for a in range(3)])


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Degrees between two vectors; exact near 0 and 180, where the arc cosine is not."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
