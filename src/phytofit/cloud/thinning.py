"""Fewer points: outliers left out, and the others thinned evenly."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.errors import SettingError

__all__ = ["remove_outliers", "size_cm", "thin"]

TIE_TOLERANCE = 1e-9  # relative; distances this close differ by rounding only, no result may hang on it


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
