"""Coordinates on an organ's surface: along it, across it, and off it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phytofit.models.organs import LEAF, Organ

__all__ = ["Coordinates", "Patches", "on_strip", "places_on_strip", "side_frames"]

FloatArray = NDArray[np.float64]


class Coordinates(NamedTuple):
    """Where points lie by a strip: the segment (n,) of its midrib that is nearest, how far (n,) along that, cm;
    ``across`` (n,) the blade along its surface, cm, to the side of the frame's second column; ``off`` (n,) the surface,
    cm, to that of the third; and ``frame`` (n, 3, 3), columns along, across and off the surface."""

    segment: NDArray[np.intp]
    along: FloatArray
    across: FloatArray
    off: FloatArray
    frame: FloatArray


def on_strip(leaf: Organ, points: FloatArray) -> Coordinates:
    """Coordinates of points (n, 3) by a leaf, on that side of its fold on which each lies."""
    segment, along = leaf.nearest(points)
    flat = leaf.frame[segment]
    offset = points - leaf.axis[segment]
    side = np.where(np.einsum("ni,ni->n", offset, flat[:, :, 1]) >= 0.0, 1.0, -1.0)
    angle = side * np.deg2rad(leaf.fold)
    cosine, sine = np.cos(angle)[:, np.newaxis], np.sin(angle)[:, np.newaxis]
    lateral = cosine * flat[:, :, 1] + sine * flat[:, :, 2]
    normal = cosine * flat[:, :, 2] - sine * flat[:, :, 1]
    across, off = np.einsum("ni,ni->n", offset, lateral), np.einsum("ni,ni->n", offset, normal)
    return Coordinates(segment, along, across, off, np.stack([flat[:, :, 0], lateral, normal], axis=-1))


def places_on_strip(leaf: Organ, segment: NDArray[np.intp], along: FloatArray, across: FloatArray) -> FloatArray:
    """Places (..., 3) on a leaf: on a segment, so far along it, and so far across the blade, cm, all (...)."""
    flat = leaf.frame[segment]
    angle = np.deg2rad(leaf.fold)
    up = np.abs(across) * np.sin(angle)
    places: FloatArray = (
        leaf.axis[segment]
        + along[..., np.newaxis] * flat[..., 0]
        + (np.cos(angle) * across)[..., np.newaxis] * flat[..., 1]
        + up[..., np.newaxis] * flat[..., 2]
    )
    return places


def side_frames(leaf: Organ, side: float) -> FloatArray:
    """Frames (..., m, 3, 3) of the surface of leaves on one side of the fold: 1 that of their frames' second column, -1
    the other.  Columns are along, across, to the same side for both, and off the surface."""
    angle = side * np.deg2rad(np.asarray(leaf.fold))[..., np.newaxis, np.newaxis]
    lateral, normal = leaf.frame[..., 1], leaf.frame[..., 2]
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([leaf.frame[..., 0], cosine * lateral + sine * normal, cosine * normal - sine * lateral], axis=-1)


class Patches(NamedTuple):
    """The same patches of equal area on every segment of an organ: where their middles lie.

    ``along`` (p,), a share of the segment's length; ``across`` (p, 2) and off it, shares of its half width, or radius,
    in its middle.
    """

    along: FloatArray
    across: FloatArray

    @classmethod
    def of_strip(cls, n_along: int, n_across: int) -> "Patches":
        """Rows from the right edge to the left, one after the other."""
        lateral = (2.0 * np.arange(n_across) + 1.0) / n_across - 1.0
        along = np.repeat((np.arange(n_along) + 0.5) / n_along, n_across)
        return cls(along, np.stack([np.tile(lateral, n_along), np.zeros(len(along))], axis=1))

    @classmethod
    def of_tube(cls, n_along: int, n_around: int) -> "Patches":
        """Rings, each beginning on the side of the frame's second column."""
        angle = np.tile(2.0 * np.pi * np.arange(n_around) / n_around, n_along)
        along = np.repeat((np.arange(n_along) + 0.5) / n_along, n_around)
        return cls(along, np.stack([np.cos(angle), np.sin(angle)], axis=1))

    @property
    def right(self) -> NDArray[np.bool_]:
        """Which patches (p,) lie on the side of the frame's second column."""
        return self.across[:, 0] >= 0.0

    def frames(self, organ: Organ) -> FloatArray:
        """(m, p, 3, 3), columns along, across and off: of a tube's segments, of either side of a strip's."""
        if organ.kind != LEAF:
            return np.broadcast_to(organ.frame[:, np.newaxis], (len(organ.frame), len(self.along), 3, 3))
        right, left = (side_frames(organ, side)[:, np.newaxis] for side in (1.0, -1.0))
        frames: FloatArray = np.where(self.right[:, np.newaxis, np.newaxis], right, left)
        return frames

    def places(self, organ: Organ, length: FloatArray, half: FloatArray) -> FloatArray:
        """Middles (m, p, 3) of the patches of one organ, of which each segment is taken as far as `length` (m,), with
        half widths (m + 1,) at the nodes."""
        middle = 0.5 * (half[1:] + half[:-1])
        own = np.stack([np.outer(length, self.along), *(np.outer(middle, it) for it in self.across.T)], axis=-1)
        places: FloatArray = organ.axis[:-1, np.newaxis] + np.einsum("mpij,mpj->mpi", self.frames(organ), own)
        return places

    def scale(self, organ: Organ) -> FloatArray:
        """Area (p,) of each patch, as a share of the length of its segment times the sum of its half widths."""
        return np.full(len(self.along), (1.0 if organ.kind == LEAF else np.pi) / len(self.along))
