"""Nearest-neighbour search in a fixed cloud: a grid of nearest indices, and exact search in bins.

Two structures, each built once a fit:

- a *grid of nearest indices* answers "which point is nearest, about" with one memory access; the answer is the
  point nearest to the cell's centre, so its distance is an upper bound of the true one;
- *bins* (points sorted by cubic cell) answer exactly, searching outwards shell by shell.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phytofit.kernels.compiling import kernel

__all__ = [
    "Bins",
    "NearestGrid",
    "bin_points",
    "exact_nearest",
    "make_bins",
    "nearest_distances",
    "nearest_grid",
]

FloatArray = NDArray[np.float64]
MAX_CELLS = 2_000_000
MAX_BINS = 32_768


class NearestGrid(NamedTuple):
    """Index of (about) the nearest point for every cell of a box around a cloud.

    ``nearest`` (nx * ny * nz,) int32 in C order; ``dims`` (3,) int64 cells a side; ``origin`` (3,) the box's low
    corner; ``inverse_cell`` 1 / edge of a cell; ``points`` (m, 4) float32, the cloud, padded to one load a point.
    Positions outside the box take the answer of the nearest cell.
    """

    nearest: NDArray[np.int32]
    dims: NDArray[np.int64]
    origin: FloatArray
    inverse_cell: float
    points: NDArray[np.float32]


class Bins(NamedTuple):
    """Points sorted by cubic bin: those of bin b are ``order[start[b]:start[b + 1]]``.

    ``x, y, z`` (m,) float32 are the points in sorted order.
    """

    start: NDArray[np.int32]
    order: NDArray[np.int32]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    dims: NDArray[np.int64]
    origin: FloatArray
    edge: float


@kernel
def _fill_nearest(points, dims, origin, cell, index):
    """Nearest index per cell by two raster sweeps that hand candidates on to neighbouring cells.

    Source: Danielsson, Euclidean distance mapping, CGIP 14 (1980), in 3-D with distances to the points themselves.
    """
    nx, ny, nz = dims[0], dims[1], dims[2]
    best = np.full(index.shape[0], np.float32(np.inf), np.float32)
    index[:] = -1
    h = np.float32(cell)
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    half = np.float32(0.5)
    for k in range(points.shape[0]):
        i = min(max(int((points[k, 0] - ox) / h), 0), nx - 1)
        j = min(max(int((points[k, 1] - oy) / h), 0), ny - 1)
        m = min(max(int((points[k, 2] - oz) / h), 0), nz - 1)
        c = (i * ny + j) * nz + m
        dx = ox + (i + half) * h - points[k, 0]
        dy = oy + (j + half) * h - points[k, 1]
        dz = oz + (m + half) * h - points[k, 2]
        d = dx * dx + dy * dy + dz * dz
        if d < best[c]:
            best[c] = d
            index[c] = k
    offsets = np.empty((13, 3), np.int64)
    n = 0
    for a in range(-1, 1):
        for b in range(-1, 2):
            for e in range(-1, 2):
                if a < 0 or b < 0 or (b == 0 and e < 0):
                    offsets[n, 0], offsets[n, 1], offsets[n, 2] = a, b, e
                    n += 1
    for sweep in range(2):
        sign = 1 - 2 * sweep
        for ii in range(nx):
            i = ii if sweep == 0 else nx - 1 - ii
            x = ox + (i + half) * h
            for jj in range(ny):
                j = jj if sweep == 0 else ny - 1 - jj
                y = oy + (j + half) * h
                for mm in range(nz):
                    m = mm if sweep == 0 else nz - 1 - mm
                    z = oz + (m + half) * h
                    c = (i * ny + j) * nz + m
                    d_best = best[c]
                    k_best = index[c]
                    last = k_best
                    for o in range(13):
                        p, q, r = i + sign * offsets[o, 0], j + sign * offsets[o, 1], m + sign * offsets[o, 2]
                        if p < 0 or q < 0 or r < 0 or p >= nx or q >= ny or r >= nz:
                            continue
                        k = index[(p * ny + q) * nz + r]
                        if k < 0 or k == last:
                            continue
                        last = k
                        dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
                        d = dx * dx + dy * dy + dz * dz
                        if d < d_best:
                            d_best = d
                            k_best = k
                    best[c] = d_best
                    index[c] = k_best


def nearest_grid(points: FloatArray, cell: float | None = None, margin: float | None = None) -> NearestGrid:
    """Build the grid of nearest indices of a cloud.

    Parameters
    ----------
    points : (m, 3), m >= 1
    cell : edge of a cell; by default half the typical spacing of the points, or what keeps to `MAX_CELLS`.
    margin : how far the box reaches beyond the points; by default a tenth of the box's diagonal.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    margin = max(0.1 * diagonal, 1e-6) if margin is None else margin
    size = high - low + 2 * margin
    if cell is None:
        cell = 0.5 * diagonal / np.sqrt(len(points))
    cell = max(float(cell), float(np.prod(size) / MAX_CELLS) ** (1 / 3))
    dims = np.maximum(np.ceil(size / cell).astype(np.int64), 1)
    padded = np.zeros((len(points), 4), np.float32)
    padded[:, :3] = points
    index = np.empty(int(np.prod(dims)), np.int32)
    origin = low - margin
    _fill_nearest(padded, dims, origin, cell, index)
    return NearestGrid(index, dims, origin, 1.0 / cell, padded)


@kernel
def bin_points(x, y, z, least_edge):
    """Sort points into cubic bins of edge `least_edge`, or a larger one that keeps to `MAX_BINS` bins.

    x, y, z : (m,) float32, m >= 1.  Returns the fields of :class:`Bins`.
    """
    m = x.shape[0]
    low = np.array([np.float64(x.min()), np.float64(y.min()), np.float64(z.min())])
    high = np.array([np.float64(x.max()), np.float64(y.max()), np.float64(z.max())])
    edge = least_edge
    dims = np.empty(3, np.int64)
    while True:
        for a in range(3):
            dims[a] = np.int64((high[a] - low[a]) / edge) + 1
        if np.float64(dims[0]) * dims[1] * dims[2] <= MAX_BINS:  # the product of integers may overflow
            break
        edge *= 1.1
    start = np.zeros(dims[0] * dims[1] * dims[2] + 1, np.int32)
    bin_of = np.empty(m, np.int32)
    for i in range(m):
        a = min(np.int64((x[i] - low[0]) / edge), dims[0] - 1)
        b = min(np.int64((y[i] - low[1]) / edge), dims[1] - 1)
        c = min(np.int64((z[i] - low[2]) / edge), dims[2] - 1)
        k = (a * dims[1] + b) * dims[2] + c
        bin_of[i] = k
        start[k + 1] += 1
    for k in range(start.shape[0] - 1):
        start[k + 1] += start[k]
    fill = start.copy()
    order = np.empty(m, np.int32)
    sx, sy, sz = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    for i in range(m):
        j = fill[bin_of[i]]
        fill[bin_of[i]] += 1
        order[j] = i
        sx[j], sy[j], sz[j] = x[i], y[i], z[i]
    return start, order, sx, sy, sz, dims, low, edge


def make_bins(points: NDArray[np.floating[Any]]) -> Bins:
    """Bins of a cloud (m, 3), m >= 1, with about two points in an occupied bin of a surface."""
    p = np.asarray(points, np.float32)
    diagonal = float(np.linalg.norm(p.max(axis=0) - p.min(axis=0)))
    edge = max(diagonal / np.sqrt(len(p)), 1e-6)
    x, y, z = (np.ascontiguousarray(p[:, a]) for a in range(3))
    return Bins(*bin_points(x, y, z, edge))


@kernel
def exact_nearest(bins, x, y, z, within2, enough2):
    """Nearest point to (x, y, z): squared distance and position in sorted order.

    Only points nearer than sqrt(`within2`) are looked for (otherwise `within2` and -1 are returned), and the search
    ends at the first point found within sqrt(`enough2`) (0: never early).
    """
    nx, ny, nz = bins.dims[0], bins.dims[1], bins.dims[2]
    edge = bins.edge
    fx, fy, fz = (x - bins.origin[0]) / edge, (y - bins.origin[1]) / edge, (z - bins.origin[2]) / edge
    cx = min(max(np.int64(np.floor(fx)), 0), nx - 1)
    cy = min(max(np.int64(np.floor(fy)), 0), ny - 1)
    cz = min(max(np.int64(np.floor(fz)), 0), nz - 1)
    best = within2
    at = -1
    last = max(max(max(cx, nx - 1 - cx), max(cy, ny - 1 - cy)), max(cz, nz - 1 - cz))
    for shell in range(last + 1):
        # every point of a further shell is at least this far away, along the axis that is left first
        reach = np.inf
        if cx - shell >= 0:
            reach = min(reach, fx - (cx - shell + 1))
        if cx + shell < nx:
            reach = min(reach, (cx + shell) - fx)
        if cy - shell >= 0:
            reach = min(reach, fy - (cy - shell + 1))
        if cy + shell < ny:
            reach = min(reach, (cy + shell) - fy)
        if cz - shell >= 0:
            reach = min(reach, fz - (cz - shell + 1))
        if cz + shell < nz:
            reach = min(reach, (cz + shell) - fz)
        if shell > 0 and reach > 0 and (reach * edge) ** 2 > best:
            break
        for a in range(max(cx - shell, 0), min(cx + shell, nx - 1) + 1):
            x_face = abs(a - cx) == shell
            gap_x = max(max(a - fx, fx - a - 1), 0.0) * edge
            if gap_x * gap_x > best:
                continue
            for b in range(max(cy - shell, 0), min(cy + shell, ny - 1) + 1):
                face = x_face or abs(b - cy) == shell
                gap_y = max(max(b - fy, fy - b - 1), 0.0) * edge
                if gap_x * gap_x + gap_y * gap_y > best:
                    continue
                c = cz - shell
                while c <= cz + shell:
                    if 0 <= c < nz:
                        k = (a * ny + b) * nz + c
                        for j in range(bins.start[k], bins.start[k + 1]):
                            dx, dy, dz = bins.x[j] - x, bins.y[j] - y, bins.z[j] - z
                            d = dx * dx + dy * dy + dz * dz
                            if d < best:
                                best = d
                                at = j
                                if best <= enough2:
                                    return best, at
                    c += 1 if face or shell == 0 else 2 * shell
    return best, at


@kernel
def nearest_distances(bins, x, y, z):
    """Exact distance (n,) float64 and index (n,) of the nearest binned point for every query (n,) float32."""
    n = x.shape[0]
    distance = np.empty(n)
    index = np.empty(n, np.int64)
    for i in range(n):
        d, at = exact_nearest(bins, np.float64(x[i]), np.float64(y[i]), np.float64(z[i]), np.inf, 0.0)
        distance[i] = np.sqrt(d)
        index[i] = bins.order[at]
    return distance, index
