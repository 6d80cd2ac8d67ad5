"""The space around a leaf's base, where nothing was seen of stem and leaf."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.special import ndtr

from phytofit.models import Organ

__all__ = ["PARTS", "Void", "around_stem", "find_void"]

FloatArray = NDArray[np.float64]
PARTS = 3  # of a piece of the leaf, along it, in which a void is sampled
SPREAD = 0.25  # of its radius, by which a void may be smaller or larger
REACH_CM, STEP_CM = 4.0, 0.25  # from the leaf's base, so far is looked; between places on the organs' surfaces
N_ALONG, N_AROUND, N_ACROSS = 80, 12, 9  # places along the stem, around it, across the leaf
GRIDS = ((3.0, 7), (0.75, 4))  # cm to either side, places: of the balls' centres, then around the best of them
STRAY = 2  # points that a ball without points may hold
MISSING = 16.0  # points of the stem that are expected in it
WELL_INSIDE = 1.5  # noise levels, by which they come from within it


class Void(NamedTuple):
    """A ball of which nothing was seen, neither stem nor leaf: its centre (3,), and cm: its radius, and the standard
    deviation of its edge, which is blurred by the points' noise and for the steps in which organs are sampled."""

    center: FloatArray
    radius: float
    edge: float

    def at(self, places: FloatArray) -> FloatArray:
        """Share (...,) not seen of points from places (..., 3)."""
        share: FloatArray = ndtr((self.radius - np.linalg.norm(places - self.center, axis=-1)) / self.edge)
        return share

    def smaller(self) -> "Void":
        """As small as it may be."""
        return self._replace(radius=(1.0 - SPREAD) * self.radius)

    def larger(self) -> "Void":
        """As large as it may be."""
        return self._replace(radius=(1.0 + SPREAD) * self.radius)


def find_void(
    points: FloatArray, stem: Organ, leaf: Organ, *, n_stem: float, n_leaf: float, noise_cm: float
) -> Void | None:
    """The ball around the leaf's base that holds next to none of the points (n, 3), but would most of them as the
    organs have them, `n_stem` and `n_leaf` spread evenly; None where no such ball misses many of the stem's."""
    base, near = leaf.axis[0], 2.0 * REACH_CM
    those = points[np.linalg.norm(points - base, axis=1) < near]
    if len(those) <= STRAY:
        return None
    places, area = around_stem(
        Organ(stem.kind, stem.axis[np.newaxis], stem.frame[np.newaxis], stem.half_width[np.newaxis])
    )
    close = np.linalg.norm(places - base, axis=-1) < near
    on_stem, of_stem = places[close], area[close] / area.sum()
    on_leaf, of_leaf = _across_leaf(leaf)
    tree = cKDTree(those)
    center, radius, missing = base, 0.0, 0.0
    for reach, n in GRIDS:
        grid = np.linspace(-reach, reach, n)
        centers = center + np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1).reshape(-1, 3)
        radii = np.minimum(tree.query(centers, k=STRAY + 1)[0][:, -1], REACH_CM)
        inside = radii[:, np.newaxis] - WELL_INSIDE * noise_cm
        from_stem = n_stem * (cdist(centers, on_stem) < inside) @ of_stem
        both = from_stem + n_leaf * (cdist(centers, on_leaf) < inside) @ of_leaf
        best = int(np.argmax(both))
        center, radius, missing = centers[best], float(radii[best]), float(from_stem[best])
    if missing < MISSING:
        return None
    edge = np.hypot(noise_cm, 0.5 * leaf.segment_lengths.max() / PARTS)
    return Void(center, radius, float(edge))


def around_stem(stem: Organ) -> tuple[FloatArray, FloatArray]:
    """Places (c, 80, 12, 3) on the stems of a population, and the area (c, 80, 12) around each."""
    long = stem.segment_lengths
    before = np.concatenate([np.zeros((len(long), 1)), np.cumsum(long, axis=1)], axis=1)
    share = (np.arange(N_ALONG) + 0.5) / N_ALONG
    z = before[:, -1:] * share
    radius = np.stack([np.interp(*row) for row in zip(z, before, stem.half_width, strict=True)])
    tangent, across = stem.frame[:, 0, :, 0], stem.frame[:, 0, :, 1:]
    angle = 2.0 * np.pi * np.arange(N_AROUND) / N_AROUND
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ across.transpose(0, 2, 1)
    middle = stem.axis[:, :1] + z[..., np.newaxis] * tangent[:, np.newaxis]
    places = middle[:, :, np.newaxis] + radius[..., np.newaxis, np.newaxis] * ring[:, np.newaxis]
    area = 2.0 * np.pi / N_AROUND * radius * before[:, -1:] / N_ALONG
    return places, np.repeat(area[..., np.newaxis], N_AROUND, axis=2)


def _across_leaf(leaf: Organ) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) on the leaf near its base, and what share (n,) of it is around each."""
    long = leaf.segment_lengths
    before = np.append(0.0, np.cumsum(long))
    s = np.arange(0.0, min(2.0 * REACH_CM, before[-1]), STEP_CM)
    piece = np.minimum(np.searchsorted(before, s, side="right") - 1, len(long) - 1)
    half = np.interp(s, before, leaf.half_width)
    across = (2.0 * np.arange(N_ACROSS) + 1.0) / N_ACROSS - 1.0
    middle = leaf.axis[piece] + (s - before[piece])[:, np.newaxis] * leaf.frame[piece, :, 0]
    aside = (half[:, np.newaxis] * across)[..., np.newaxis] * leaf.frame[piece, :, 1][:, np.newaxis]
    whole = float(np.sum(long * (leaf.half_width[1:] + leaf.half_width[:-1])))
    return (middle[:, np.newaxis] + aside).reshape(-1, 3), np.repeat(2.0 * STEP_CM * half / whole / N_ACROSS, N_ACROSS)
