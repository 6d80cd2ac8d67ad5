"""Distances between two clouds, Eq. (3) and (4), exact, with as few exact look-ups as they need.

The Hausdorff distance is a maximum of minima: a point whose distance is known to be below the maximum found so far
needs no exact search.  An upper bound from the grid of nearest indices, or any point found near enough, settles most.
"""

import numpy as np

from phytofit.kernels.compiling import kernel
from phytofit.kernels.nearest import Bins, bin_points, exact_nearest

__all__ = ["directed_hausdorff", "hausdorff", "hausdorff_within"]


@kernel
def _to_target2(points, target, bins, reached):
    """Squared h(P', P_ref), Eq. (4): points (3, n) float32 against the target's grid and bins.

    reached : (m,) bool, set for target points that turn out to have some source point within the result.
    """
    n = points.shape[1]
    bound2 = np.empty(n, np.float32)
    near = np.empty(n, np.int32)
    o0, o1, o2 = np.float32(target.origin[0]), np.float32(target.origin[1]), np.float32(target.origin[2])
    inverse = np.float32(target.inverse_cell)
    zero = np.float32(0.0)
    top0 = np.float32(target.dims[0] - 1)
    top1 = np.float32(target.dims[1] - 1)
    top2 = np.float32(target.dims[2] - 1)
    stride0 = np.int32(target.dims[1] * target.dims[2])
    stride1 = np.int32(target.dims[2])
    top = 0
    for i in range(n):
        x, y, z = points[0, i], points[1, i], points[2, i]
        u = min(max((x - o0) * inverse, zero), top0)
        v = min(max((y - o1) * inverse, zero), top1)
        w = min(max((z - o2) * inverse, zero), top2)
        k = target.nearest[np.int32(u) * stride0 + np.int32(v) * stride1 + np.int32(w)]
        dx = target.points[k, 0] - x
        dy = target.points[k, 1] - y
        dz = target.points[k, 2] - z
        near[i] = k
        bound2[i] = dx * dx + dy * dy + dz * dz
        if bound2[i] > bound2[top]:
            top = i
    h2 = 0.0
    for j in range(-1, n):
        i = top if j < 0 else j
        if bound2[i] > h2:
            x, y, z = np.float64(points[0, i]), np.float64(points[1, i]), np.float64(points[2, i])
            d, _ = exact_nearest(bins, x, y, z, np.inf, h2)
            h2 = max(h2, d)
    for i in range(n):
        if bound2[i] <= h2:
            reached[near[i]] = True
    return h2


@kernel
def _from_target2(target, source_bins, reached, h2, limit2):
    """Squared max(h, h(P_ref, P')), Eq. (4), given squared h; ends once it exceeds limit2.

    reached : (m,) bool, target points known to have a source point within h.
    """
    dims, low, start = source_bins.dims, source_bins.origin, source_bins.start
    inverse = 1.0 / source_bins.edge
    one_bin_is_near = 3.0 * source_bins.edge * source_bins.edge <= h2
    for i in range(target.points.shape[0]):
        if reached[i]:
            continue
        x = np.float64(target.points[i, 0])
        y = np.float64(target.points[i, 1])
        z = np.float64(target.points[i, 2])
        if one_bin_is_near:
            u, v, w = (x - low[0]) * inverse, (y - low[1]) * inverse, (z - low[2]) * inverse
            if 0.0 <= u < dims[0] and 0.0 <= v < dims[1] and 0.0 <= w < dims[2]:
                k = (np.int64(u) * dims[1] + np.int64(v)) * dims[2] + np.int64(w)
                if start[k + 1] > start[k]:
                    continue
        d, _ = exact_nearest(source_bins, x, y, z, np.inf, h2)
        if d > h2:
            h2 = d
            if h2 > limit2:
                break
    return h2


@kernel
def directed_hausdorff(points, target, bins):
    """Both directed distances of Eq. (4): h(P', P_ref) and h(P_ref, P').

    points : (3, n) float32, P'; target : NearestGrid and bins : Bins, both of P_ref.
    """
    reached = np.zeros(target.points.shape[0], np.bool_)
    forward = np.sqrt(_to_target2(points, target, bins, reached))
    reached[:] = False
    source_bins = Bins(*bin_points(points[0], points[1], points[2], bins.edge))
    return forward, np.sqrt(_from_target2(target, source_bins, reached, 0.0, np.inf))


@kernel
def hausdorff_within(points, target, bins, limit):
    """Hausdorff distance, Eq. (3), of points (3, n) float32 to the target; exact if it is at most `limit`.

    Otherwise the search ends as soon as the distance is known to exceed `limit`, and what is returned is a lower
    bound of it, above `limit`.
    """
    limit2 = limit * limit
    reached = np.zeros(target.points.shape[0], np.bool_)
    h2 = _to_target2(points, target, bins, reached)
    if h2 > limit2:
        return np.sqrt(h2)
    # two points in a bin of this edge are less than h apart: an occupied bin settles all target points in it
    edge = max(0.999 * np.sqrt(h2 / 3.0), 0.25 * bins.edge)
    source_bins = Bins(*bin_points(points[0], points[1], points[2], edge))
    return np.sqrt(_from_target2(target, source_bins, reached, h2, limit2))


@kernel
def hausdorff(points, target, bins):
    """Hausdorff distance, Eq. (3), of points (3, n) float32 to the target cloud."""
    return hausdorff_within(points, target, bins, np.inf)
