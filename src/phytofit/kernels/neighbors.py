"""What is near: the points along a line, a point's nearest piece of a polyline, its neighbours' errors."""

import numpy as np

from phytofit.kernels.compiling import kernel

__all__ = ["near_line", "nearest_pieces", "sum_by_distance"]


@kernel
def near_line(points, center, axis, width, reach):
    """Numbers (k,) of the points (n, 3) that are nearer than `width` to the line through `center` (3,) along `axis`
    (3,), and along it nearer than `reach` to the center; nearer than `width` to the center, if the axis is zero."""
    found = np.empty(len(points), np.intp)
    n = 0
    for i in range(len(points)):
        x, y, z = points[i, 0] - center[0], points[i, 1] - center[1], points[i, 2] - center[2]
        along = x * axis[0] + y * axis[1] + z * axis[2]
        if x * x + y * y + z * z - along * along < width * width and abs(along) < reach:
            found[n] = i
            n += 1
    return found[:n]


@kernel
def nearest_pieces(points, origin, tangent, length, piece, along):
    """The piece of a polyline that is nearest to each point, the first of several, and how far along it.

    Parameters
    ----------
    points : (n, 3)
    origin (m, 3), tangent (m, 3) of unit length, length (m,) : the pieces
    piece : (n,), filled with the number of the nearest
    along : (n,), filled with the distance from its origin, within it, at which it is nearest
    """
    for i in range(points.shape[0]):
        least = np.inf
        for j in range(origin.shape[0]):
            x, y, z = points[i, 0] - origin[j, 0], points[i, 1] - origin[j, 1], points[i, 2] - origin[j, 2]
            s = min(max(x * tangent[j, 0] + y * tangent[j, 1] + z * tangent[j, 2], 0.0), length[j])
            x -= s * tangent[j, 0]
            y -= s * tangent[j, 1]
            z -= s * tangent[j, 2]
            square = x * x + y * y + z * z
            if square < least:
                least = square
                piece[i] = j
                along[i] = s


@kernel
def sum_by_distance(points, errors, probed, width, count, total):
    """Number of pairs of points, and sum of the products of their errors, by the distance between them.

    Parameters
    ----------
    points (n, 3), errors (n,)
    probed : (p,) numbers of the points that are paired, each with all others
    width : of a class of distances
    count, total : (m,), filled for each class; pairs that are farther apart do not count
    """
    count[:] = 0.0
    total[:] = 0.0
    farthest = (len(count) * width) ** 2
    for i in probed:
        for j in range(points.shape[0]):
            x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            square = x * x + y * y + z * z
            if square < farthest and j != i:
                lag = min(int(np.sqrt(square) / width), len(count) - 1)
                count[lag] += 1.0
                total[lag] += errors[i] * errors[j]
