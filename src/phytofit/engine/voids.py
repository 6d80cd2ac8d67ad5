"""The space around a leaf's base, where nothing was seen of stem and leaf."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.special import ndtr

from phytofit.models import Organ
from phytofit.models.surface import Patches, places_on_strip

__all__ = ["N_AROUND", "PARTS", "Void", "around_stem", "facing_share", "find_void"]

FloatArray = NDArray[np.float64]
PARTS = 3  # of a piece of the leaf, along it, in which a void is sampled
MOST = 0.98  # of what is in a void is not seen: some of an organ always is
SPREAD = 0.25  # of its radius, by which a void may be smaller or larger
REACH_CM, STEP_CM = 4.0, 0.25  # from the leaf's base, so far is looked; between places on the organs' surfaces
N_ALONG, N_AROUND, N_ACROSS = 80, 12, 9  # places along the stem, or more, around it, across the leaf
GRIDS = ((3.0, 7), (0.75, 4))  # cm to either side, places: of the balls' centres, then around the best of them
STRAY = 2  # points that a ball without points may hold
MISSING = 16.0  # points of the stem that are expected in it
WELL_INSIDE = 1.5  # noise levels, by which they come from within it


class Void(NamedTuple):
    """A ball of which nothing was seen, neither stem nor leaf: its centre (3,), and cm: its radius, and the standard
    deviation of its edge, which is blurred by the stem's noise and for the steps in which organs are sampled."""

    center: FloatArray
    radius: float
    edge: float

    def at(self, places: FloatArray) -> FloatArray:
        """Share (...,) not seen of points from places (..., 3)."""
        share: FloatArray = MOST * ndtr((self.radius - np.linalg.norm(places - self.center, axis=-1)) / self.edge)
        return share

    def smaller(self) -> "Void":
        """As small as it may be."""
        return self._replace(radius=(1.0 - SPREAD) * self.radius)

    def larger(self) -> "Void":
        """As large as it may be."""
        return self._replace(radius=(1.0 + SPREAD) * self.radius)


def find_void(
    points: FloatArray, on_stem: NDArray[np.bool_], stem: Organ, leaf: Organ, *, noise_cm: float
) -> Void | None:
    """The ball near the leaf's base that holds next to none of the points (n, 3), and would hold the most if both
    organs were seen evenly along their axes; None where no such ball misses many of the stem's, `on_stem` (n,).

    Around the stem points are expected as they are found: the back of one that was seen from one side is no void.
    """
    base, near = leaf.axis[0], REACH_CM + sum(reach for reach, _ in GRIDS) * np.sqrt(3.0)
    those = points[np.linalg.norm(points - base, axis=1) < near]
    if len(those) <= STRAY or not on_stem.any():
        return None
    _, places, area = around_stem(stem)
    from_axis = (points[on_stem] - stem.axis[0]) @ stem.frame[0, :, 1:]
    angle = np.arctan2(from_axis[:, 1], from_axis[:, 0]) / (2.0 * np.pi) * N_AROUND
    sector = np.bincount(np.round(angle).astype(int) % N_AROUND, minlength=N_AROUND)
    of_stem = area * np.tile(N_AROUND * sector, area.shape[1] // N_AROUND) / area.sum()
    close = np.linalg.norm(places - base, axis=-1) < near
    stem_places, of_stem = places[close], of_stem[close]
    leaf_places, of_leaf = _across_leaf(leaf)
    of_leaf = of_leaf * np.count_nonzero(~on_stem)
    tree = cKDTree(those)
    center, radius, missing = base, 0.0, 0.0
    for reach, n in GRIDS:
        grid = np.linspace(-reach, reach, n)
        offset = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1).reshape(-1, 3)
        centers = center + offset[np.linalg.norm(offset, axis=1) <= reach] @ stem.frame[0].T
        radii = np.minimum(tree.query(centers, k=STRAY + 1)[0][:, -1], REACH_CM)
        inside = radii[:, np.newaxis] - WELL_INSIDE * noise_cm
        from_stem = (cdist(centers, stem_places) < inside) @ of_stem
        best = int(np.argmax(from_stem + (cdist(centers, leaf_places) < inside) @ of_leaf))
        center, radius, missing = centers[best], float(radii[best]), float(from_stem[best])
    if missing < MISSING:
        return None
    length = float(stem.segment_lengths.sum())
    steps = leaf.segment_lengths.max() / PARTS, length / N_ALONG, 2.0 * np.pi * stem.half_width.max() / N_AROUND
    return Void(center, radius, float(np.hypot(noise_cm, 0.5 * max(steps))))


def around_stem(stem: Organ) -> tuple[Patches, FloatArray, FloatArray]:
    """Patches of a stem, twelve around it, and their places (m, p, 3) and areas (m, p)."""
    length, half = stem.segment_lengths, stem.half_width
    patches = Patches.of_tube(-(-N_ALONG // len(length)), N_AROUND)
    return patches, patches.places(stem, length, half), np.outer(length * (half[1:] + half[:-1]), patches.scale(stem))


def facing_share(facing: FloatArray) -> FloatArray:
    """Density (12,) of points around a stem, beside that of a stem seen from all sides: von Mises, with
    the concentration `facing` (2,) towards a side."""
    angle = 2.0 * np.pi * np.arange(N_AROUND) / N_AROUND
    density = np.exp(np.cos(angle) * facing[0] + np.sin(angle) * facing[1])
    share: FloatArray = density / density.mean()
    return share


def _across_leaf(leaf: Organ) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) on the leaf near its base, and what share (n,) of it is around each."""
    long = leaf.segment_lengths
    before = np.append(0.0, np.cumsum(long))
    s = np.arange(0.0, min(2.0 * REACH_CM, before[-1]), STEP_CM)
    piece = np.minimum(np.searchsorted(before, s, side="right") - 1, len(long) - 1)
    half = np.interp(s, before, leaf.half_width)
    across = (2.0 * np.arange(N_ACROSS) + 1.0) / N_ACROSS - 1.0
    shape = len(s), N_ACROSS
    segment, along = (np.broadcast_to(it[:, np.newaxis], shape) for it in (piece, s - before[piece]))
    places = places_on_strip(leaf, segment, along, half[:, np.newaxis] * across)
    whole = float(np.sum(long * (leaf.half_width[1:] + leaf.half_width[:-1])))
    return places.reshape(-1, 3), np.repeat(2.0 * STEP_CM * half / whole / N_ACROSS, N_ACROSS)
