"""Iterative closest point: the rigid motion that lays a source cloud on a fixed target cloud.

Point-to-point ICP of Besl and McKay (IEEE TPAMI 14, 1992): match every source point to its nearest target point,
move by the best rigid motion for these matches (Horn's unit quaternion, JOSA A 4, 1987: always a proper rotation),
repeat.  Besl and McKay already extrapolate the sequence of poses; here that is Anderson mixing of the last few
(Walker and Ni, SIAM J. Numer. Anal. 49, 2011), undone wherever it makes the mean squared distance grow, so that the
fixed points are those of plain ICP.  ``memory=0`` is plain ICP.

Matches come from the grid of nearest indices (`kernels/nearest.py`); a pose is a rotation about the source's
centroid and the centroid's place in the target's frame.
"""

import numpy as np

from phytofit.kernels.compiling import kernel

__all__ = ["best_rotation", "icp", "transform"]

BLOCK = 512  # points worked on at a time: their temporaries stay in the first-level cache
MAX_MEMORY = 8


@kernel
def best_rotation(cross):
    """Proper rotation R that maximises sum_i q_i . R p_i, given cross = sum_i p_i q_i^T (3, 3).

    The eigenvector of Horn's symmetric 4x4 matrix at its largest eigenvalue, by cyclic Jacobi rotations.
    """
    a = np.empty((4, 4))
    a[0, 0] = cross[0, 0] + cross[1, 1] + cross[2, 2]
    a[1, 1] = cross[0, 0] - cross[1, 1] - cross[2, 2]
    a[2, 2] = -cross[0, 0] + cross[1, 1] - cross[2, 2]
    a[3, 3] = -cross[0, 0] - cross[1, 1] + cross[2, 2]
    a[0, 1] = a[1, 0] = cross[1, 2] - cross[2, 1]
    a[0, 2] = a[2, 0] = cross[2, 0] - cross[0, 2]
    a[0, 3] = a[3, 0] = cross[0, 1] - cross[1, 0]
    a[1, 2] = a[2, 1] = cross[0, 1] + cross[1, 0]
    a[1, 3] = a[3, 1] = cross[2, 0] + cross[0, 2]
    a[2, 3] = a[3, 2] = cross[1, 2] + cross[2, 1]
    v = np.eye(4)
    scale = 0.0
    for i in range(4):
        for j in range(4):
            scale += a[i, j] * a[i, j]
    for _ in range(30):
        off = 0.0
        for i in range(3):
            for j in range(i + 1, 4):
                off += a[i, j] * a[i, j]
        if off <= 1e-30 * scale:
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if a[i, j] == 0.0:
                    continue
                theta = (a[j, j] - a[i, i]) / (2.0 * a[i, j])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    aki, akj = a[k, i], a[k, j]
                    a[k, i], a[k, j] = c * aki - s * akj, s * aki + c * akj
                for k in range(4):
                    aik, ajk = a[i, k], a[j, k]
                    a[i, k], a[j, k] = c * aik - s * ajk, s * aik + c * ajk
                for k in range(4):
                    vki, vkj = v[k, i], v[k, j]
                    v[k, i], v[k, j] = c * vki - s * vkj, s * vki + c * vkj
    top = 0
    for i in range(1, 4):
        if a[i, i] > a[top, top]:
            top = i
    w, x, y, z = v[0, top], v[1, top], v[2, top], v[3, top]
    norm = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z
    return r


@kernel
def _log_rotation(r, out):
    """Rotation vector of r into out[:3]."""
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    sine = 0.5 * np.sqrt(wx * wx + wy * wy + wz * wz)
    angle = np.arctan2(sine, 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0))
    factor = 0.5 if sine < 1e-9 else 0.5 * angle / sine
    out[0], out[1], out[2] = factor * wx, factor * wy, factor * wz


@kernel
def _rotate_by(vector, scale, base, out):
    """out = Exp(vector[:3] * scale) base (Rodrigues)."""
    x, y, z = vector[0] * scale, vector[1] * scale, vector[2] * scale
    angle2 = x * x + y * y + z * z
    angle = np.sqrt(angle2)
    s = 1.0 if angle < 1e-9 else np.sin(angle) / angle
    c = 0.5 if angle < 1e-5 else (1.0 - np.cos(angle)) / angle2
    for j in range(3):
        b0, b1, b2 = base[0, j], base[1, j], base[2, j]
        dot = x * b0 + y * b1 + z * b2
        out[0, j] = b0 + s * (y * b2 - z * b1) + c * (x * dot - angle2 * b0)
        out[1, j] = b1 + s * (z * b0 - x * b2) + c * (y * dot - angle2 * b1)
        out[2, j] = b2 + s * (x * b1 - y * b0) + c * (z * dot - angle2 * b2)


@kernel
def _match(source, r, t, target, sums, cell, qx, qy, qz):
    """One round of matching, in three passes over a block so that the first and last use vector units.

    sums (13,) becomes sum q (3), sum p q^T (9, row-major), sum |q|^2; p are source points about their centroid.
    """
    n = source.shape[1]
    r00, r01, r02 = np.float32(r[0, 0]), np.float32(r[0, 1]), np.float32(r[0, 2])
    r10, r11, r12 = np.float32(r[1, 0]), np.float32(r[1, 1]), np.float32(r[1, 2])
    r20, r21, r22 = np.float32(r[2, 0]), np.float32(r[2, 1]), np.float32(r[2, 2])
    t0 = np.float32(t[0] - target.origin[0])
    t1 = np.float32(t[1] - target.origin[1])
    t2 = np.float32(t[2] - target.origin[2])
    inverse = np.float32(target.inverse_cell)
    zero = np.float32(0.0)
    top0 = np.float32(target.dims[0] - 1)
    top1 = np.float32(target.dims[1] - 1)
    top2 = np.float32(target.dims[2] - 1)
    stride0 = np.int32(target.dims[1] * target.dims[2])
    stride1 = np.int32(target.dims[2])
    for s in range(13):
        sums[s] = 0.0
    for first in range(0, n, BLOCK):
        m = min(BLOCK, n - first)
        px = source[0, first : first + m]
        py = source[1, first : first + m]
        pz = source[2, first : first + m]
        for i in range(m):
            x, y, z = px[i], py[i], pz[i]
            u = (r00 * x + r01 * y + r02 * z + t0) * inverse
            v = (r10 * x + r11 * y + r12 * z + t1) * inverse
            w = (r20 * x + r21 * y + r22 * z + t2) * inverse
            u = min(max(u, zero), top0)
            v = min(max(v, zero), top1)
            w = min(max(w, zero), top2)
            cell[i] = np.int32(u) * stride0 + np.int32(v) * stride1 + np.int32(w)
        for i in range(m):
            k = target.nearest[cell[i]]
            qx[i] = target.points[k, 0]
            qy[i] = target.points[k, 1]
            qz[i] = target.points[k, 2]
        s0 = s1 = s2 = s3 = zero
        h00 = h01 = h02 = h10 = h11 = h12 = h20 = h21 = h22 = zero
        for i in range(m):
            x, y, z = px[i], py[i], pz[i]
            e, f, g = qx[i], qy[i], qz[i]
            s0 += e
            s1 += f
            s2 += g
            h00 += x * e
            h01 += x * f
            h02 += x * g
            h10 += y * e
            h11 += y * f
            h12 += y * g
            h20 += z * e
            h21 += z * f
            h22 += z * g
            s3 += e * e + f * f + g * g
        sums[0] += s0
        sums[1] += s1
        sums[2] += s2
        sums[3] += h00
        sums[4] += h01
        sums[5] += h02
        sums[6] += h10
        sums[7] += h11
        sums[8] += h12
        sums[9] += h20
        sums[10] += h21
        sums[11] += h22
        sums[12] += s3


@kernel
def _mixing_weights(differences, residual, n, weights):
    """Least squares weights of n residual differences (6 each, rows) for the residual: normal equations, Cholesky."""
    a = np.empty((MAX_MEMORY, MAX_MEMORY))
    trace = 0.0
    for i in range(n):
        for j in range(i + 1):
            dot = 0.0
            for k in range(6):
                dot += differences[i, k] * differences[j, k]
            a[i, j] = dot
        trace += a[i, i]
        dot = 0.0
        for k in range(6):
            dot += differences[i, k] * residual[k]
        weights[i] = dot
    ridge = 1e-8 * trace + 1e-300
    for i in range(n):
        for j in range(i + 1):
            value = a[i, j] + (ridge if i == j else 0.0)
            for k in range(j):
                value -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(max(value, 1e-300)) if i == j else value / a[j, j]
    for i in range(n):
        for k in range(i):
            weights[i] -= a[i, k] * weights[k]
        weights[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            weights[i] -= a[k, i] * weights[k]
        weights[i] /= a[i, i]


@kernel
def icp(source, target, r_start, t_start, max_iterations, tolerance, memory):
    """Register a source cloud to the target.

    Parameters
    ----------
    source : (3, n) float32, n >= 1, centred: its mean is zero.
    target : NearestGrid
    r_start, t_start : (3, 3), (3,) start pose: a source point p lies at ``r p + t``.
    max_iterations : rounds of matching at most.
    tolerance : converged when a round moves the pose by less than this (length; rotation times RMS radius).
    memory : poses mixed (0: plain ICP); no more than `MAX_MEMORY` are.

    Returns
    -------
    r (3, 3), t (3,), mse of the last matching, iterations, converged
    """
    memory = min(memory, MAX_MEMORY)
    n = source.shape[1]
    square = 0.0
    for a in range(3):
        for i in range(n):
            square += np.float64(source[a, i]) * np.float64(source[a, i])
    radius = max(np.sqrt(square / n), 1e-9)
    sums = np.empty(13)
    cell = np.empty(BLOCK, np.int32)
    qx, qy, qz = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    base = r_start.copy()
    r = r_start.copy()
    cross = np.empty((3, 3))
    relative = np.empty((3, 3))
    # a pose as a vector: rotation vector from `base` times radius, and translation
    x = np.zeros(6)
    x[3:] = t_start
    g = np.zeros(6)
    f = np.zeros(6)
    last_g = np.zeros(6)
    g_history = np.zeros((MAX_MEMORY + 1, 6))
    f_history = np.zeros((MAX_MEMORY + 1, 6))
    differences = np.empty((MAX_MEMORY, 6))
    weights = np.empty(MAX_MEMORY)
    kept = 0
    last_mse = np.inf
    mse = np.inf
    converged = False
    iterations = 0
    while iterations < max_iterations and not converged:
        iterations += 1
        _match(source, r, x[3:], target, sums, cell, qx, qy, qz)
        fit = 0.0
        for i in range(3):
            for j in range(3):
                cross[i, j] = sums[3 + 3 * i + j]
                fit += r[j, i] * cross[i, j]
        mse = (square + sums[12] - 2.0 * fit) / n
        for a in range(3):
            mse += x[3 + a] * (x[3 + a] - 2.0 * sums[a] / n)
        if kept > 1 and mse > last_mse * (1.0 + 1e-6):
            x[:] = last_g  # the mixed pose was worse: back to the plain step, with no memory
            mse = last_mse
            kept = 0
            last_mse = np.inf
            _rotate_by(x, 1.0 / radius, base, r)
            continue
        r_plain = best_rotation(cross)
        for i in range(3):
            for j in range(3):
                relative[i, j] = r_plain[i, 0] * base[j, 0] + r_plain[i, 1] * base[j, 1] + r_plain[i, 2] * base[j, 2]
        _log_rotation(relative, g)
        step = 0.0
        for a in range(3):
            g[a] *= radius
            g[3 + a] = sums[a] / n
        for a in range(6):
            f[a] = g[a] - x[a]
            step += f[a] * f[a]
        converged = np.sqrt(step) < tolerance
        last_mse = mse
        last_g[:] = g
        x[:] = g
        if memory > 0 and not converged and iterations < max_iterations:  # no mixed pose goes out unmatched
            if kept == memory + 1:
                for k in range(memory):
                    g_history[k] = g_history[k + 1]
                    f_history[k] = f_history[k + 1]
                kept = memory
            g_history[kept] = g
            f_history[kept] = f
            kept += 1
            if kept > 1:
                for k in range(kept - 1):
                    for a in range(6):
                        differences[k, a] = f[a] - f_history[k, a]
                _mixing_weights(differences, f, kept - 1, weights)
                for k in range(kept - 1):
                    for a in range(6):
                        x[a] -= weights[k] * (g[a] - g_history[k, a])
        _rotate_by(x, 1.0 / radius, base, r)
    return r, x[3:].copy(), max(mse, 0.0), iterations, converged


@kernel
def transform(source, r, t, out):
    """out = r source + t; source and out (3, n) float32."""
    for i in range(source.shape[1]):
        x, y, z = source[0, i], source[1, i], source[2, i]
        for a in range(3):
            out[a, i] = np.float32(r[a, 0] * x + r[a, 1] * y + r[a, 2] * z + t[a])
