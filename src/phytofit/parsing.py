"""Directions, places and numbers as they are given from outside."""

import math
from numbers import Integral, Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.errors import SettingError

__all__ = ["AXES", "checked_flag", "checked_number", "checked_whole", "parse_points", "parse_up"]

FloatArray = NDArray[np.float64]
MOST = 10_000_000  # of anything that is counted: more would fill the memory
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


def parse_up(up: str | ArrayLike | None) -> FloatArray | None:
    """A unit vector (3,) from ``"x" .. "-z"`` or three numbers; None stays None."""
    if up is None:
        return None
    if isinstance(up, str):
        if up not in AXES:
            raise SettingError(f"up: expected one of {', '.join(AXES)}, got {up!r}")
        return np.array(AXES[up], float)
    try:
        vector = np.asarray(up, float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.any(vector):
        raise SettingError(f"up: expected three numbers that are not all zero, got {up!r}")
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def parse_points(points: ArrayLike) -> FloatArray:
    """(k, 3) of one or more points."""
    try:
        rows = np.atleast_2d(np.asarray(points, float))
    except (TypeError, ValueError):
        rows = np.empty((0, 0))
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all():
        raise SettingError(f"seed_point: expected three finite numbers, or several times three, got {points!r}")
    return rows


def checked_whole(name: str, value: object, least: int, most: float = MOST) -> int:
    """A whole number from `least` to `most`; SettingError for anything else, true and false too."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Integral) or int(value) < least:
        raise SettingError(f"{name}: expected a whole number of {least} or more, got {value!r}")
    number = int(value)
    if number > most:
        raise SettingError(f"{name}: expected {most:,} at most, got {number:,}")
    return number


def checked_number(name: str, value: object, least: float = 0.0, most: float = math.inf) -> float:
    """A finite number from `least` to `most`; SettingError for anything else."""
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool | np.bool_) else math.nan
    if not least <= number < math.inf:
        raise SettingError(f"{name}: expected a number of {least:g} or more, got {value!r}")
    if number > most:
        raise SettingError(f"{name}: expected {most:g} at most, got {number:g}")
    return number


def checked_flag(name: str, value: object) -> bool:
    """True or False; SettingError for anything else."""
    if not isinstance(value, bool | np.bool_):
        raise SettingError(f"{name}: expected True or False, got {value!r}")
    return bool(value)
