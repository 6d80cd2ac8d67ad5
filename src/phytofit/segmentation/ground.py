"""Ground, turntable and pot: what is wide, even and flat at the lower end of the cloud, with a neck above it."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["find_ground", "find_grounds"]

FloatArray = NDArray[np.float64]
N_LAYERS = 80  # of the cloud's height
LOWEST = 4  # layers that have to be spread evenly in all directions: the bottom is flat
HIGHEST = 40  # layers: ground and pot are at most half of the cloud's height
N_CELLS = 24  # across the foot, in which area is counted
NECK = 0.15  # of the foot's area: what is just above ground is narrower
EVEN = 0.6  # thin over wide of the foot
N_SECTORS = 12
LEAST_SECTORS = 10
LEAST_RADIUS = 0.05  # of the cloud's height: a stem's own foot is narrower
LEAST_FOOT = 30  # points in the lowest layers
LEAST_SHARE = 0.05  # of the points, that are ground or pot at least
BESIDE = 1.2  # radii of the foot, within which it is removed
AXES = np.vstack([np.eye(3)[[2, 1, 0]], -np.eye(3)[[2, 1, 0]]])


def find_ground(points: FloatArray, up: FloatArray | None) -> tuple[NDArray[np.bool_], FloatArray | None]:
    """Which points (n, 3) are ground or pot, and the upward direction (3,) that it shows; none and `up` if none is.

    up : (3,) where it is known; else the six directions of the axes are tried, as scans are made with one upright
    """
    best, found = np.zeros(len(points), np.bool_), up
    for direction in AXES if up is None else up[np.newaxis]:
        ground = _ground_along(points, direction)
        if ground.sum() > best.sum():
            best, found = ground, direction
    return best, found


def find_grounds(points: FloatArray, up: FloatArray | None) -> tuple[NDArray[np.bool_], FloatArray | None]:
    """As `find_ground`, also where several pots stand in a row, apart or touching."""
    ground, found = find_ground(points, up)
    if ground.any():
        return ground, found
    for direction in AXES if up is None else up[np.newaxis]:
        several = np.zeros(len(points), np.bool_)
        for part in _along_row(points, direction):
            several[part] |= _ground_along(points[part], direction)
        if several.sum() > ground.sum():
            ground, found = several, direction
    return ground, found


def _along_row(points: FloatArray, up: FloatArray) -> list[NDArray[np.intp]]:
    """The points (n, 3) parted across the row in which what is lowest stands, by pots as long as wide."""
    height = points @ up
    low, high = np.quantile(height, [0.002, 0.998])
    flat = points @ np.linalg.svd(up[np.newaxis])[2][1:].T
    foot = flat[height < low + (high - low) * LOWEST / N_LAYERS]
    if len(foot) < LEAST_FOOT:
        return []
    rows = np.linalg.eigh(np.cov(foot.T))[1].T  # across the row, along it
    (left, right), (start, end) = (np.quantile(foot @ row, [0.002, 0.998]) for row in rows)
    n_pots = round(float((end - start) / max(right - left, 1e-9)))
    number = np.clip((flat @ rows[1] - start) / max(end - start, 1e-9) * n_pots, 0, n_pots - 1).astype(int)
    parts = [np.flatnonzero(number == i) for i in range(n_pots)]
    return [part for part in parts if len(part) >= LEAST_FOOT] if n_pots > 1 else []


def _ground_along(points: FloatArray, up: FloatArray) -> NDArray[np.bool_]:
    none = np.zeros(len(points), np.bool_)
    height = points @ up
    low, high = np.quantile(height, [0.002, 0.998])
    if not high > low:
        return none
    layer = np.clip(((height - low) / (high - low) * N_LAYERS).astype(int), 0, N_LAYERS - 1)
    side = np.linalg.svd(up[np.newaxis])[2][1:]
    flat = points @ side.T
    foot = flat[layer < LOWEST]
    if len(foot) < LEAST_FOOT:
        return none
    center = 0.5 * (np.quantile(foot, 0.02, axis=0) + np.quantile(foot, 0.98, axis=0))
    eigen = np.linalg.eigvalsh(np.cov(foot.T))
    radius = float(np.quantile(np.linalg.norm(foot - center, axis=1), 0.95))
    if radius < LEAST_RADIUS * (high - low):
        return none
    outer = foot[np.linalg.norm(foot - center, axis=1) > 0.5 * radius] - center
    sector = (np.arctan2(outer[:, 1], outer[:, 0]) / (2 * np.pi) * N_SECTORS).astype(int) % N_SECTORS
    if eigen[0] < EVEN**2 * eigen[1] or len(np.unique(sector)) < LEAST_SECTORS:
        return none
    beside = np.linalg.norm(flat - center, axis=1) < BESIDE * radius
    cell = np.clip(((flat - center) / (2 * BESIDE * radius) + 0.5) * N_CELLS, 0, N_CELLS - 1).astype(int)
    filled = np.pi * (0.5 * N_CELLS / BESIDE) ** 2
    area = np.zeros(HIGHEST)
    for i in range(HIGHEST):
        inside = beside & (layer == i)
        area[i] = len(np.unique(cell[inside] @ np.array([N_CELLS, 1])))
    for i in range(1, HIGHEST - 1):
        if 0 < area[i : i + 2].max() <= min(NECK * filled, 0.5 * np.median(area[:i])):
            ground = np.asarray(beside & (layer < i))
            return ground if ground.mean() >= LEAST_SHARE else none
    return none
