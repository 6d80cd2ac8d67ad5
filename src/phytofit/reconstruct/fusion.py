"""From registered views to one cloud: noise averaged along the surface, duplicates merged, strays dropped."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.cloud import remove_outliers
from phytofit.reconstruct.cameras import Camera
from phytofit.reconstruct.plant import seen_through

__all__ = ["Fused", "fuse"]

FloatArray = NDArray[np.float64]
SAME_SIDE = 0.3  # least cosine between normals of points that are averaged: the two sides of an organ stay apart
N_NEIGHBORS = 32  # that are averaged, at most


@dataclass(frozen=True, eq=False)
class Fused:
    """Points (n, 3), cm, unit normals (n, 3) towards the cameras, the number (n,) of the view that each came from, and
    by how many views (n,) it was seen.

    ``contradicted`` is the share of all views' points that was dropped, since other views see through them.
    """

    points: FloatArray
    normals: FloatArray
    view: NDArray[np.int64]
    n_views: NDArray[np.int64]
    contradicted: float


def fuse(
    points: FloatArray,
    normals: FloatArray,
    view: NDArray[np.intp],
    poses: FloatArray,
    depths: Sequence[FloatArray],
    camera: Camera,
    *,
    spacing_cm: float,
    reach: float = 2.0,
    most_through: int = 2,
) -> Fused:
    """One cloud of the points of all views, about one point each `spacing_cm`.

    Dropped is what at least `most_through` views see through, unless more see it: flying pixels, and what moved.
    Each point is then moved along its normal to the mean of those on the same side within `reach` spacings, and of
    the points in a voxel the one nearest their mean is kept.

    Parameters
    ----------
    points, normals, view
        (n, 3), (n, 3) in the world's frame, cm, and the number (n,) of the view that each came from.
    poses, depths
        Camera to world, (k, 4, 4), and the depth images (height, width), cm, of the k views.
    """
    through, seen = seen_through(points, poses, depths, camera)
    keep = (through < most_through) | (seen > through)
    contradicted = 1.0 - float(keep.mean())
    points, normals, view = points[keep], normals[keep], view[keep]
    keep = remove_outliers(points)
    points, normals, view = points[keep], normals[keep], view[keep]
    distance, index = cKDTree(points).query(
        points, k=min(N_NEIGHBORS, len(points)), distance_upper_bound=reach * spacing_cm
    )
    near = np.isfinite(distance)
    index = np.where(near, index, np.arange(len(points))[:, None])
    near &= np.einsum("nkc,nc->nk", normals[index], normals) >= SAME_SIDE
    weight = np.where(near, np.exp(-2.0 * (np.where(near, distance, 0.0) / (reach * spacing_cm)) ** 2), 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    normal = np.einsum("nk,nkc->nc", weight, normals[index])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = np.einsum("nkc,nc->nk", points[index] - points[:, None], normal)
    moved = points + normal * np.sum(weight * offset, axis=1)[:, None]
    seen_by = np.zeros((len(points), len(poses)), bool)
    row = np.broadcast_to(np.arange(len(points))[:, None], index.shape)
    seen_by[row[near], view[index[near]]] = True
    first = _one_per_voxel(moved, spacing_cm)
    return Fused(moved[first], normal[first], view[first], seen_by.sum(axis=1)[first], contradicted)


def _one_per_voxel(points: FloatArray, edge: float) -> NDArray[np.intp]:
    """Sorted indices of the points nearest the mean of their voxel's."""
    _, voxel, count = np.unique(np.floor(points / edge).astype(int), axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.ravel()
    mean = np.stack([np.bincount(voxel, weights=c) for c in points.T], axis=1) / count[:, None]
    away = np.linalg.norm(points - mean[voxel], axis=1)
    order = np.lexsort((away, voxel))
    return np.sort(order[np.unique(voxel[order], return_index=True)[1]])
