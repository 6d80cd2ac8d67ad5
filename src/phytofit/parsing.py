"""Directions and places as they are given from outside."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.errors import SettingError

__all__ = ["AXES", "parse_points", "parse_up"]

FloatArray = NDArray[np.float64]
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


def parse_up(up: str | ArrayLike | None) -> FloatArray | None:
    """A unit vector (3,) from ``"x" .. "-z"`` or three numbers; None stays None."""
    if up is None:
        return None
    if isinstance(up, str):
        if up not in AXES:
            raise SettingError(f"up: expected one of {', '.join(AXES)}, got {up!r}")
        return np.array(AXES[up], float)
    vector = np.asarray(up, float)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.any(vector):
        raise SettingError(f"up: expected three numbers that are not all zero, got {up!r}")
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def parse_points(points: ArrayLike) -> FloatArray:
    """(k, 3) of one or more points."""
    try:
        rows = np.atleast_2d(np.asarray(points, float))
    except ValueError:
        rows = np.empty((0, 0))
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all():
        raise SettingError(f"seed_point: expected three numbers, or several times three, got {points!r}")
    return rows
