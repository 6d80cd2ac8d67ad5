"""The noun of the pipeline's first stage: a point cloud in centimetres, and what cleans it.

Files are read by :mod:`phytofit.formats`; arrays that are already in memory by :func:`from_points`.
"""

import math
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from phytofit.errors import CloudError, SettingError, UnitError

__all__ = ["PointCloud", "from_points", "remove_outliers", "size_cm", "thin"]

SCALE_CM = {"cm": 1.0, "mm": 0.1, "m": 100.0, "none": 1.0}  # centimetres per unit
MIN_POINTS = 100  # fewer can't carry a stem and a leaf
FAR_CM = 1e6  # coordinates beyond 10 km are map coordinates: their offset is subtracted
TIE_TOLERANCE = 1e-9  # relative; distances this close differ by rounding only, no result may hang on it


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points and what is known of each; the arrays are read-only copies, CloudError if a shape is wrong."""

    points: NDArray[np.float64]  # (n, 3) cm
    labels: NDArray[np.int64] | None = None  # (n,) 0 unknown, 1 stem, 2.. leaves
    normals: NDArray[np.float64] | None = None  # (n, 3) components that are not known are 0
    colors: NDArray[np.uint8] | None = None  # (n, 3) red green blue
    name: str = "cloud"  # the file's stem
    source: Path | None = None
    unit: str = "cm"  # of the input: mm, cm, m or none
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))  # (3,) cm, was subtracted
    notes: tuple[str, ...] = ()  # plain-words remarks collected while reading

    def __post_init__(self) -> None:
        n = len(self.points)
        for key, dtype, shape in (
            ("points", np.float64, (n, 3)),
            ("labels", np.int64, (n,)),
            ("normals", np.float64, (n, 3)),
            ("colors", np.uint8, (n, 3)),
            ("offset", np.float64, (3,)),
        ):
            if getattr(self, key) is None:
                continue
            array = np.array(getattr(self, key), dtype=dtype)
            if array.shape != shape:
                raise CloudError(f"{self.name}: expected {key} of shape {shape}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: NDArray[np.bool_] | NDArray[np.integer]) -> "PointCloud":
        """Return the cloud of the points that `index` (boolean mask or integers) picks, in its order."""
        arrays: dict[str, Any] = {key: getattr(self, key) for key in ("points", "labels", "normals", "colors")}
        arrays |= {key: array[index] for key, array in arrays.items() if array is not None}
        return replace(self, **arrays)

    def to_input_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (m, 3), cm, in the unit and the frame that this cloud was read in."""
        shifted: NDArray[np.float64] = (points + self.offset) / SCALE_CM[self.unit]
        return shifted

    def from_input_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (m, 3) in the unit and the frame that this cloud was read in, as cm in its own."""
        shifted: NDArray[np.float64] = points * SCALE_CM[self.unit] - self.offset
        return shifted

    def with_note(self, text: str) -> "PointCloud":
        """Return the same cloud with one more remark."""
        return replace(self, notes=(*self.notes, text))


def from_points(
    points: ArrayLike,
    units: str | None,
    *,
    labels: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    name: str = "cloud",
    source: Path | None = None,
    plausible_cm: tuple[float, float] = (10.0, 250.0),
) -> PointCloud:
    """Make a cloud from arrays: check them, drop what is not finite, convert to centimetres.

    Parameters
    ----------
    points
        (n, 3), in `units`; rows that are not finite are dropped, with a note and one warning.
    units
        ``mm``, ``cm``, ``m``, or ``none`` for relative lengths (no conversion and no check of the size).
    labels, normals, colors
        (n,) whole numbers; (n, 3), what is not finite becomes 0; (n, 3) 0 to 255, fractions of 1, or 16 bit.
    name, source
        The cloud's name and the file it came from; messages call it by its file if there is one.
    plausible_cm
        The least and the greatest size (see :func:`size_cm`) that is believed, cm.

    Raises
    ------
    CloudError
        If the arrays don't fit each other, hold fewer than 100 finite points, or no extent.
    UnitError
        If the unit is missing, unknown, or gives a size outside `plausible_cm`.
    """
    called = source.name if source else name
    try:
        with np.errstate(invalid="ignore"):  # signalling NaNs
            xyz = np.array(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CloudError(f"{called}: expected points of shape (n, 3), got something else: {error}") from error
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        hint = "; is this a 2-D export?" if xyz.shape[1:] == (2,) else ""
        raise CloudError(f"{called}: expected points of shape (n, 3), got {xyz.shape}{hint}")
    finite = np.asarray(np.isfinite(xyz).all(axis=1))
    n_dropped = len(xyz) - int(finite.sum())
    if n_dropped == len(xyz) > 0:
        raise CloudError(f"{called}: none of its {len(xyz)} points is finite; was the scan empty?")
    xyz = xyz[finite]
    if len(xyz) < MIN_POINTS:
        raise CloudError(
            f"{called}: found {len(xyz)} points, at least {MIN_POINTS} are needed to fit; is this the whole cloud?"
        )
    if (xyz == xyz[0]).all():
        raise CloudError(f"{called}: all {len(xyz)} points are equal; was it exported with too few digits?")
    across = size_cm(xyz)
    if not math.isfinite(across):
        reach = f"{np.abs(xyz).max():.3g}"
        raise CloudError(f"{called}: coordinates reach {reach}, expected a plant's size; is the file damaged?")
    unit = _checked_unit(called, units, across, plausible_cm)
    xyz *= SCALE_CM[unit]
    offset = np.floor(xyz.min(axis=0)) if np.abs(xyz).max() > FAR_CM else np.zeros(3)
    cloud = PointCloud(
        points=xyz - offset,
        labels=None if labels is None else _whole_labels(called, _matching(called, "labels", labels, finite)),
        normals=None if normals is None else _known(_matching(called, "normals", normals, finite)),
        colors=None if colors is None else _uint8(_matching(called, "colors", colors, finite)),
        name=name,
        source=source,
        unit=unit,
        offset=offset,
    )
    if not n_dropped:
        return cloud
    note = f"{n_dropped} non-finite point{'s' if n_dropped > 1 else ''} dropped"
    warnings.warn(f"{called}: {note}", UserWarning, stacklevel=2)
    return cloud.with_note(note)


def remove_outliers(points: NDArray[np.float64], *, n_neighbors: int = 16, std_ratio: float = 4.0) -> NDArray[np.bool_]:
    """Return the mask (n,) of the points to keep: statistical outlier removal.

    A point of `points` (n, 3), in any unit, is an outlier if its mean distance to its `n_neighbors` nearest
    (to all others, if they are fewer) exceeds the cloud's mean of that distance by more than `std_ratio`
    standard deviations.  Rotation, translation and scale change nothing; a single point is kept.

    Raises
    ------
    SettingError
        If `n_neighbors` is less than 1, or `std_ratio` not positive.
    """
    if n_neighbors < 1 or not std_ratio > 0:
        raise SettingError(
            f"remove_outliers: expected n_neighbors >= 1 and std_ratio > 0, got {n_neighbors} and {std_ratio}"
        )
    if len(points) < 2:
        return np.ones(len(points), dtype=np.bool_)
    k = min(n_neighbors, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=k + 1)
    mean_distances: NDArray[np.float64] = distances[:, 1:].mean(axis=1)
    limit = mean_distances.mean() + std_ratio * mean_distances.std()
    keep: NDArray[np.bool_] = mean_distances <= limit * (1 + TIE_TOLERANCE)
    return keep


def thin(points: NDArray[np.float64], n_points: int = 5000) -> NDArray[np.intp]:
    """Return the sorted indices of about `n_points` points, spread evenly: one per occupied voxel.

    The voxel's edge is found by bisection so that the count is as near `n_points` as can be, within 5 %
    unless the cloud is a stack of copies or `n_points` is very small.  The point kept is the one nearest the
    mean of the voxel's points, the first of those that tie.

    Parameters
    ----------
    points
        (n, 3), any unit.  The grid is anchored at their origin: a rotated cloud is thinned to other points.
    n_points
        A cloud with no more points than this comes back whole.

    Raises
    ------
    SettingError
        If `n_points` is less than 1.
    """
    if n_points < 1:
        raise SettingError(f"thin: expected n_points >= 1, got {n_points}")
    if len(points) <= n_points:
        return np.arange(len(points))
    across = size_cm(points) or 1.0
    # Not finer than 2^-20 of the cloud: the three indices of a voxel have to fit one 63-bit key.
    low, high = math.log(across * 2.0**-20), math.log(across + 2 * np.abs(points).max())
    best_edge, best_miss = math.exp(low), math.inf
    for _ in range(60):
        middle = (low + high) / 2
        n_voxels = len(np.unique(_voxel_keys(points, math.exp(middle))))
        miss = n_voxels - n_points if n_voxels >= n_points else 1.5 * (n_points - n_voxels)  # above preferred
        if miss < best_miss:
            best_edge, best_miss = math.exp(middle), miss
        if best_miss <= 0.005 * n_points:
            break
        low, high = (middle, high) if n_voxels > n_points else (low, middle)
    _, voxel, n_inside = np.unique(_voxel_keys(points, best_edge), return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(voxel, weights=axis) for axis in points.T], axis=1) / n_inside[:, None]
    distances = np.linalg.norm(points - means[voxel], axis=1) / best_edge
    order = np.lexsort((np.rint(distances / TIE_TOLERANCE), voxel))
    _, first = np.unique(voxel[order], return_index=True)
    return np.sort(order[first])


def size_cm(points: NDArray[np.float64]) -> float:
    """Return twice the greatest distance from the centroid, in the points' unit; 0 for no points.

    Between one and two diameters of the cloud; rotation does not change it.
    """
    if len(points) == 0:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        return 2.0 * float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def _voxel_keys(points: NDArray[np.float64], edge: float) -> NDArray[np.int64]:
    cells = np.floor(points / edge)
    x, y, z = (cells - cells.min(axis=0)).astype(np.int64).T
    return np.asarray((x << 42) | (y << 21) | z)


def _checked_unit(called: str, units: str | None, across: float, plausible_cm: tuple[float, float]) -> str:
    sizes = {unit: across * SCALE_CM[unit] for unit in ("cm", "mm", "m")}
    ask = "say --units cm, mm or m (none: relative lengths)"
    if units is None:
        raise UnitError(
            f"{called}: no unit given; the cloud is {_length(sizes['cm'])} cm across if in cm, "
            f"{_length(sizes['mm'])} cm if in mm, {_length(sizes['m'])} cm if in m; {ask}"
        )
    if units not in SCALE_CM:
        raise UnitError(f"{called}: unknown unit {units!r}; {ask}")
    low, high = plausible_cm
    if units == "none" or low <= sizes[units] <= high:
        return units
    fits = [unit for unit, size in sizes.items() if low <= size <= high]
    advice = "; ".join(f"if in {unit} it is {_length(sizes[unit])} cm: say --units {unit}" for unit in fits)
    advice = advice or "no other unit fits either; is it one plant, without stray points?"
    raise UnitError(
        f"{called}: the cloud is {_length(sizes[units])} cm across if in {units}, "
        f"expected {low:g} to {high:g} cm; {advice} (none: relative lengths)"
    )


def _length(value: float) -> str:
    return f"{value:.1f}" if 1 <= value < 1000 else f"{value:.0f}" if 1000 <= value < 1e6 else f"{value:.3g}"


def _matching(called: str, what: str, array: ArrayLike, finite: NDArray[np.bool_]) -> NDArray[np.float64]:
    try:
        with np.errstate(invalid="ignore"):
            rows = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CloudError(f"{called}: expected numbers as {what}, got something else: {error}") from error
    if rows.shape[:1] != finite.shape:
        raise CloudError(f"{called}: expected {what} for {len(finite)} points, got shape {rows.shape}")
    return rows[finite]


def _whole_labels(called: str, labels: NDArray[np.float64]) -> NDArray[np.int64]:
    bad = labels[~((labels == np.rint(labels)) & (np.abs(labels) < 2**31))]
    if len(bad):
        expected = "whole numbers (0 unknown, 1 stem, 2.. leaves)"
        raise CloudError(f"{called}: found the label {bad[0]:g}, expected {expected}")
    return labels.astype(np.int64)


def _known(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(normals), normals, 0.0)


def _uint8(colors: NDArray[np.float64]) -> NDArray[np.uint8]:
    colors = np.nan_to_num(colors, nan=0.0)
    top = colors.max()
    if top <= 1 and (colors != np.rint(colors)).any():  # fractions
        colors = colors * 255
    elif top > 255:  # 16 bit
        colors = colors / 257
    return np.asarray(np.rint(colors.clip(0, 255)), dtype=np.uint8)
