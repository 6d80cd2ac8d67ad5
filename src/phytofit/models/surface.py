"""Coordinates on an organ's surface: along it, across it, and off it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phytofit.models.organs import Organ

__all__ = ["Coordinates", "on_strip", "places_on_strip", "side_frames"]

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
