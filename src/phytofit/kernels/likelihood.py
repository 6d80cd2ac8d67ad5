"""Density of points that lie on a phytomer's surface, with noise, and its derivatives."""

from math import erf

import numpy as np

from phytofit.kernels.compiling import kernel

__all__ = ["LEAF_COLUMNS", "STEM_COLUMNS", "log_density"]

REACH = 5.5  # noise levels from a surface at which its density counts as none: e^-15 of the greatest
LEAF_COLUMNS = 9  # of a leaf segment's change: translation (3), rotation (3), length, half widths at both ends
STEM_COLUMNS = 8  # of a stem segment's: translation (3), rotation (3), length, radius
EDGES = np.array([-1.0, -1.0 / 3.0, 1.0 / 3.0, 1.0])  # of the strips of a leaf's segment, in half widths
ROOT_TWO = np.sqrt(2.0)
ROOT_TWO_PI = np.sqrt(2.0 * np.pi)


@kernel
def _bessel(x):
    """exp(-x) I0(x) and I1(x) / I0(x), x >= 0, to about 1e-7 (Abramowitz and Stegun, 9.8.1 to 9.8.4)."""
    if x < 3.75:
        t = (x / 3.75) ** 2
        i0 = 1.0 + t * (
            3.5156229 + t * (3.0899424 + t * (1.2067492 + t * (0.2659732 + t * (0.0360768 + t * 0.0045813))))
        )
        i1 = x * (
            0.5
            + t
            * (0.87890594 + t * (0.51498869 + t * (0.15084934 + t * (0.02658733 + t * (0.00301532 + t * 0.00032411)))))
        )
        return np.exp(-x) * i0, i1 / i0
    t = 3.75 / x
    i0 = 0.39894228 + t * (
        0.01328592
        + t
        * (
            0.00225319
            + t
            * (
                -0.00157565
                + t * (0.00916281 + t * (-0.02057706 + t * (0.02635537 + t * (-0.01647633 + t * 0.00392377))))
            )
        )
    )
    i1 = 0.39894228 + t * (
        -0.03988024
        + t
        * (
            -0.00362018
            + t
            * (
                0.00163801
                + t * (-0.01031555 + t * (0.02282967 + t * (-0.02895312 + t * (0.01787654 - t * 0.00420059))))
            )
        )
    )
    return i0 / np.sqrt(x), i1 / i0


@kernel
def _normal(x, std):
    z = x / std
    return np.exp(-0.5 * z * z) / (ROOT_TWO_PI * std)


@kernel
def _between(low, high, std):
    """Probability that a normal number of zero mean lies between two limits."""
    return 0.5 * (erf(high / (ROOT_TWO * std)) - erf(low / (ROOT_TWO * std)))


@kernel
def _step(density, e):
    """By how much the density rises at an edge of the strips, from right to left; beyond the outer ones it is 0."""
    if e == 0:
        return density[0]
    if e == 3:
        return -density[2]
    return density[e] - density[e - 1]


@kernel
def log_density(
    points, organ,
    leaf_origin, leaf_frame, leaf_length, leaf_half, leaf_density, leaf_change, leaf_area_change,
    stem_origin, stem_frame, stem_length, stem_radius, stem_change, stem_area_change,
    noise, share, outlier_density,
    log_p, scores,
):  # fmt: skip
    """Log density of points, each from the stem's surface, the leaf's, or an outlier, and its derivatives.

    A point of an organ is uniform on its surface, displaced by isotropic normal noise.  For a flat patch its density
    is a normal density across it times differences of error functions along and across; for a tube, a ring blurred by
    noise (a Rice density: Bessel function I0) times such a difference along the axis.

    Parameters
    ----------
    points : (n, 3)
    organ : (n,) int8: 0 stem, 1 leaf; -1 unknown, may be of either
    leaf_origin (m, 3), leaf_frame (m, 3, 3) columns tangent, lateral, normal, leaf_length (m,), leaf_half (m + 1,) :
        the leaf's segments, and half widths at the nodes
    leaf_density (m, 3) : of points on three strips along each segment, from its right edge (negative lateral) to its
        left, relative to where all was seen
    stem_origin (s, 3), stem_frame (s, 3, 3) columns tangent and two across, stem_length (s,), stem_radius (s,) : the
        stem's segments
    leaf_change (m, k, 9), leaf_area_change (k,), stem_change (s, k, 8), stem_area_change (k,) : change of a segment,
        in its own frame, and of the logarithm of the organ's area, for a unit change of each
        of k parameters
    noise : (3,) standard deviation: on the stem; on the leaf; and what its thickness adds to that across the blade
    share : (3,) of the points: stem, leaf, outliers
    outlier_density : of an outlier, per volume
    log_p : (n,), filled with the log density
    scores : (n, k + 5), filled with its derivatives by the k parameters, by the logarithms of the three noises, and by
        the logits of the shares of stem and outliers (relative to the leaf's); or (0, 0): not wanted
    """
    n = points.shape[0]
    m = leaf_origin.shape[0]
    k = stem_change.shape[1]
    wanted = scores.shape[0] > 0
    stem_noise, leaf_noise, thickness = noise[0], noise[1], np.hypot(noise[1], noise[2])
    thin = (leaf_noise / thickness) ** 2
    reach = REACH * leaf_noise
    depth = REACH * thickness
    area = 0.0
    for j in range(m):
        mean = (leaf_density[j, 0] + leaf_density[j, 1] + leaf_density[j, 2]) / 3.0
        area += mean * leaf_length[j] * (leaf_half[j] + leaf_half[j + 1])
    stem_area = 0.0
    for j in range(len(stem_length)):
        stem_area += stem_length[j] * stem_radius[j]
    floor = share[2] * outlier_density
    for i in range(n):
        on_stem = 0.0
        on_leaf = 0.0
        if wanted:
            for c in range(k + 5):
                scores[i, c] = 0.0
        if organ[i] != 1:
            far = REACH * stem_noise
            square = stem_noise * stem_noise
            for j in range(len(stem_length)):
                x, y, z = (
                    points[i, 0] - stem_origin[j, 0],
                    points[i, 1] - stem_origin[j, 1],
                    points[i, 2] - stem_origin[j, 2],
                )
                u = stem_frame[j, 0, 0] * x + stem_frame[j, 1, 0] * y + stem_frame[j, 2, 0] * z
                length, radius = stem_length[j], stem_radius[j]
                if u < -far or u > length + far or length <= 0.0:
                    continue
                v = stem_frame[j, 0, 1] * x + stem_frame[j, 1, 1] * y + stem_frame[j, 2, 1] * z
                w = stem_frame[j, 0, 2] * x + stem_frame[j, 1, 2] * y + stem_frame[j, 2, 2] * z
                rho = np.sqrt(v * v + w * w)
                if rho > radius + far or rho < radius - far:
                    continue
                along = _between(u - length, u, stem_noise)
                if along <= 0.0:
                    continue
                bessel, ratio = _bessel(rho * radius / square)
                gap = rho - radius
                around = np.exp(-0.5 * gap * gap / square) * bessel / (2.0 * np.pi * square)
                density = share[0] * radius / stem_area * around * along
                if density <= 0.0:
                    continue
                on_stem += density
                if wanted:
                    at_foot, at_top = _normal(u, stem_noise), _normal(u - length, stem_noise)
                    by_u = (at_foot - at_top) / along
                    by_length = at_top / along
                    by_rho = (radius * ratio - rho) / square
                    by_radius = (rho * ratio - radius) / square + 1.0 / radius
                    by_noise = (
                        -2.0
                        + (rho * rho + radius * radius - 2.0 * rho * radius * ratio) / square
                        - (u * at_foot - (u - length) * at_top) / along
                    )
                    by_v = by_rho * v / rho if rho > 0.0 else 0.0
                    by_w = by_rho * w / rho if rho > 0.0 else 0.0
                    for c in range(k):
                        change = stem_change[j, c]
                        du = -change[0] - (change[4] * w - change[5] * v)
                        dv = -change[1] - (change[5] * u - change[3] * w)
                        dw = -change[2] - (change[3] * v - change[4] * u)
                        scores[i, c] += density * (
                            by_u * du + by_v * dv + by_w * dw + by_length * change[6] + by_radius * change[7]
                        )
                    scores[i, k] += density * by_noise
        if organ[i] != 0:
            weight = share[1] / area
            for j in range(m):
                x, y, z = (
                    points[i, 0] - leaf_origin[j, 0],
                    points[i, 1] - leaf_origin[j, 1],
                    points[i, 2] - leaf_origin[j, 2],
                )
                w = leaf_frame[j, 0, 2] * x + leaf_frame[j, 1, 2] * y + leaf_frame[j, 2, 2] * z
                if w > depth or w < -depth:
                    continue
                u = leaf_frame[j, 0, 0] * x + leaf_frame[j, 1, 0] * y + leaf_frame[j, 2, 0] * z
                length = leaf_length[j]
                if u < -reach or u > length + reach:
                    continue
                v = leaf_frame[j, 0, 1] * x + leaf_frame[j, 1, 1] * y + leaf_frame[j, 2, 1] * z
                slope = leaf_half[j + 1] - leaf_half[j]
                if v > max(leaf_half[j], leaf_half[j + 1]) + reach or v < -max(leaf_half[j], leaf_half[j + 1]) - reach:
                    continue
                along = _between(u - length, u, leaf_noise)
                if along <= 0.0:
                    continue
                # the half width is taken where the point comes from on average, given u
                square = leaf_noise * leaf_noise
                at_start, at_end = _normal(u, leaf_noise), _normal(u - length, leaf_noise)
                pull = (at_start - at_end) / along
                s = min(max((u + square * pull) / length, 0.0), 1.0)
                half = leaf_half[j] + s * slope
                across = 0.0
                for e in range(4):
                    step = _step(leaf_density[j], e)
                    if step != 0.0:
                        across -= step * 0.5 * erf((half * EDGES[e] - v) / (ROOT_TWO * leaf_noise))
                density = weight * _normal(w, thickness) * along * across
                if density <= 0.0:
                    continue
                on_leaf += density
                if wanted:
                    by_u, by_v, by_half, sideways = pull, 0.0, 0.0, 0.0
                    for e in range(4):
                        step = _step(leaf_density[j], e)
                        if step != 0.0:
                            edge = half * EDGES[e] - v
                            at_edge = step * _normal(edge, leaf_noise) / across
                            by_v += at_edge
                            by_half -= EDGES[e] * at_edge
                            sideways += edge * at_edge
                    by_w = -w / (thickness * thickness)
                    by_length = at_end / along
                    spread = (u * at_start - (u - length) * at_end) / along
                    by_place = by_half * slope / length  # of the place where the half width is taken
                    by_u += by_place * (1.0 - spread - square * pull * pull)
                    by_length -= by_place * (((u - length) + square * pull) * at_end / along + s)
                    by_thickness = w * w / (thickness * thickness) - 1.0
                    by_noise = (
                        thin * by_thickness
                        - spread
                        + by_place
                        * (square * pull * (1.0 + spread) + (u * u * at_start - (u - length) ** 2 * at_end) / along)
                        + sideways
                    )
                    for c in range(k):
                        change = leaf_change[j, c]
                        du = -change[0] - (change[4] * w - change[5] * v)
                        dv = -change[1] - (change[5] * u - change[3] * w)
                        dw = -change[2] - (change[3] * v - change[4] * u)
                        scores[i, c] += density * (
                            by_u * du
                            + by_v * dv
                            + by_w * dw
                            + by_length * change[6]
                            + by_half * ((1.0 - s) * change[7] + s * change[8])
                        )
                    scores[i, k + 1] += density * by_noise
                    scores[i, k + 2] += density * (1.0 - thin) * by_thickness
        p = floor + on_stem + on_leaf
        log_p[i] = np.log(p)
        if wanted:
            for c in range(k):
                scores[i, c] = (scores[i, c] - on_leaf * leaf_area_change[c] - on_stem * stem_area_change[c]) / p
            scores[i, k] /= p
            scores[i, k + 1] /= p
            scores[i, k + 2] /= p
            scores[i, k + 3] = on_stem / p - share[0]
            scores[i, k + 4] = floor / p - share[2]
