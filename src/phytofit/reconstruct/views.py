"""Depth images freed of flying pixels, and turned into points with normals."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.reconstruct.cameras import Camera

__all__ = ["drop_flying_pixels", "surface_normals", "view_points"]

FloatArray = NDArray[np.float64]


def drop_flying_pixels(
    depth: FloatArray, camera: Camera, *, steepest_deg: float = 80.0, noise_share: float = 0.004, n_linked: int = 4
) -> FloatArray:
    """The depth image (height, width) with 0 where a pixel hangs between two surfaces.

    Two neighbours are linked if their depths differ by no more than on a plane that is seen `steepest_deg` from its
    normal, plus noise of `noise_share` of the depth; a pixel stays if at least `n_linked` of its 8 neighbours, or two
    opposite ones, are linked.
    """
    pitch = np.tan(np.radians(steepest_deg)) / np.sqrt(camera.fx * camera.fy) + noise_share
    padded = np.pad(depth, 1)
    rows, columns = depth.shape
    linked = []
    for dv, du in ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)):
        other = padded[1 + dv : 1 + dv + rows, 1 + du : 1 + du + columns]
        nearer = np.minimum(depth, other)
        linked.append((other > 0) & (np.abs(other - depth) <= pitch * np.hypot(dv, du) * nearer))
    around = np.stack(linked)
    keep = (around.sum(axis=0) >= n_linked) | (around[:4] & around[4:]).any(axis=0)
    return np.where(keep, depth, 0.0)


def view_points(depth: FloatArray, rays: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Points (n, 3), cm, in the camera's frame, of the pixels of a mask (height, width), row by row."""
    z = depth[mask]
    return np.column_stack([rays[mask] * z[:, None], z])


def surface_normals(
    points: FloatArray, *, n_neighbors: int = 16, reach_cm: float = 1.5
) -> tuple[FloatArray, FloatArray]:
    """Unit normals (n, 3) towards the camera at the origin, and how flat (n,) each point's surroundings are.

    A normal is the direction of least spread of the at most `n_neighbors` nearest points within `reach_cm`; flatness
    is 1 for a plane and 0 for a line or a ball.  Points with fewer than 5 neighbours get flatness 0.
    """
    if len(points) < 5:
        return np.tile([0.0, 0.0, -1.0], (len(points), 1)), np.zeros(len(points))
    k = min(n_neighbors, len(points))
    distances, index = cKDTree(points).query(points, k=k, distance_upper_bound=reach_cm)
    near = np.isfinite(distances)
    around = points[np.where(near, index, 0)]
    weight = near[:, :, None] / near.sum(axis=1)[:, None, None]
    centred = (around - (around * weight).sum(axis=1, keepdims=True)) * np.sqrt(weight)
    values, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    normals = vectors[:, :, 0]
    normals = np.where((np.sum(normals * points, axis=1) > 0)[:, None], -normals, normals)
    flat = (values[:, 1] - values[:, 0]) / np.maximum(values[:, 2], 1e-12)
    return normals, np.where(near.sum(axis=1) >= 5, flat.clip(0.0, 1.0), 0.0)
