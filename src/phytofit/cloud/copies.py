"""Points that share one place: copies, what sensors write where they saw nothing, and coordinates with few digits."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.cloud.thinning import size_cm

__all__ = ["Places", "is_single", "places_of", "unrounded"]

FloatArray = NDArray[np.float64]
MANY = 10  # times as many points as any place near it has, at one place: no surface was measured so
N_NEAR = 8  # places near it
COARSE = 1e-3  # of the cloud's size, in steps of which coordinates have lost digits: three are left
FILLED = 2.0  # steps between neighbouring places, within which it is the steps that part them


class Places(NamedTuple):
    """What the places say of n points: which to keep (n,), how many exact copies are not, the stacks that are not, in
    words, and the step (3,) of the coarse grid on which they lie, in their unit, 0 along an axis without one."""

    kept: NDArray[np.bool_]
    n_copies: int
    stacks: tuple[str, ...]
    step: FloatArray


def places_of(points: FloatArray) -> Places:
    """Find copies and stacks in points (n, 3), all finite, and the grid on which they lie.

    A stack, many more points at one place than anywhere near, is where a sensor saw nothing, often the origin: all of
    it goes.  Of exact copies one stays, unless coordinates with few digits put different points at one place.
    """
    first, place, count = _distinct(points)
    is_stack = _stacks(points[first], count)
    kept = ~is_stack[place]
    stacks = tuple(_stack_note(points[i], n) for i, n in zip(first[is_stack], count[is_stack], strict=True))
    distinct = first[~is_stack]
    step = _coarse_step(points[distinct])
    if step.any():
        return Places(kept, 0, stacks, step)
    n_copies = int(np.count_nonzero(kept)) - len(distinct)
    kept = np.zeros(len(points), dtype=np.bool_)
    kept[distinct] = True
    return Places(kept, n_copies, stacks, step)


def unrounded(points: FloatArray, step: FloatArray) -> FloatArray:
    """The points (n, 3), each moved by up to a quarter of `step` (3,), so that they no longer lie on a grid.

    That adds a quarter of the variance which rounding added.  Always drawn alike, whatever the order of the points.
    """
    order = np.lexsort(points.T)
    moved = points.copy()
    moved[order] += step * np.random.default_rng(0).uniform(-0.25, 0.25, points.shape)
    return moved


def is_single(values: FloatArray) -> bool:
    """Whether single precision holds all these numbers exactly."""
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float32) == values).all())


def _distinct(points: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """First point of each place, place of each point, and how many each place has; places in the first ones' order."""
    order = np.lexsort((np.arange(len(points)), *points.T))
    is_new = np.ones(len(points), dtype=np.bool_)
    is_new[1:] = (np.diff(points[order], axis=0) != 0).any(axis=1)
    number, first = np.cumsum(is_new) - 1, order[is_new]
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    place = np.empty(len(points), dtype=np.intp)
    place[order] = rank[number]
    return np.sort(first), place, np.bincount(place)


def _stacks(places: FloatArray, count: NDArray[np.intp]) -> NDArray[np.bool_]:
    is_stack = np.zeros(len(places), dtype=np.bool_)
    many = np.flatnonzero(count >= MANY)
    if len(many) and len(places) > 1:
        _, near = cKDTree(places).query(places[many], k=min(N_NEAR + 1, len(places)))
        is_stack[many] = count[many] >= MANY * count[near[:, 1:]].max(axis=1)
    return is_stack


def _stack_note(point: FloatArray, n: int) -> str:
    at = ", ".join(f"{value + 0.0:g}" for value in point)
    return f"{n} points stacked at ({at}) dropped: no surface, most likely places where the sensor saw nothing"


def _coarse_step(places: FloatArray) -> FloatArray:
    """Step (3,) of the grid on which distinct places lie, where it is coarse and sets them apart; else zeros."""
    if len(places) < 2:
        return np.zeros(3)
    step = np.array([_step(axis) for axis in places.T])
    step[step < COARSE * size_cm(places)] = 0.0
    if step.any():
        distance, _ = cKDTree(places).query(places, k=2)
        if float(np.median(distance[:, 1])) > FILLED * step.max():
            return np.zeros(3)
    return step


def _step(values: FloatArray) -> float:
    """The step of which all differences of coordinates (n,) are multiples, in the precision they have; 0 if none."""
    largest = np.abs(values).max()
    spacings = [float(np.spacing(largest))]
    if is_single(values):
        spacings.append(float(np.spacing(np.float32(largest))))
    all_gaps = np.diff(np.unique(values))
    for spacing in spacings:
        rounding = 4 * spacing
        gaps = all_gaps[all_gaps > rounding]
        if len(gaps):
            step = float(gaps.min())
            multiples = np.rint(gaps / step)
            if (np.abs(gaps - step * multiples) <= rounding * multiples).all():
                return step
    return 0.0
