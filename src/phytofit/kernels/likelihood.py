"""Density of points that lie on a phytomer's surface, with noise, and its derivatives."""

import numpy as np

from phytofit.kernels.compiling import kernel

__all__ = ["CHANGES", "log_density", "segment_changes"]

REACH = 5.5  # noise levels from a surface at which its density counts as none: e^-15 of the greatest
CHANGES = 9  # of a segment: translation (3), rotation (3), length, half widths (a stem's radii) at both ends
FARTHEST = 8.5  # standard deviations, beyond which a normal density is none: 1e-16
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
def _normal(z):
    """Probability that a standard normal number lies between 0 and z, negative below 0, and its density at z.

    What lies beyond z is the density times a rational function of z, to 1e-10 of it: a least squares fit.
    """
    size = abs(z)
    if size > FARTHEST:
        return np.copysign(0.5, z), 0.0
    bell = np.exp(-0.5 * size * size)
    share = 1.0 / ((size + 4.0) * (size + 1.0))
    t = (size - 4.0) * (size + 1.0) * share
    s = t * t
    even = 0.472053206485 + s * (
        0.0139996395984
        + s * (-0.0321979645691 + s * (-0.0050018708879 + s * (0.00070266075507 - s * 0.000135104776746)))
    )
    odd = -0.0967034777153 + s * (
        0.0286003951387
        + s * (0.0179353271814 + s * (-0.000278489400423 + s * (-0.000111017173137 - s * 0.000022171402950)))
    )
    inside = 0.5 - bell * (even + t * odd) * (size + 4.0) * share
    return np.copysign(inside, z), bell / ROOT_TWO_PI


@kernel
def log_density(
    points, organ, seen,
    leaf_origin, leaf_frame, leaf_length, leaf_half, leaf_area, leaf_change, leaf_area_change,
    stem_origin, stem_frame, stem_length, stem_radius, stem_area, stem_change, stem_area_change,
    facing, noise, share, outlier_density,
    log_p, scores,
):  # fmt: skip
    """Log density of points, each from the stem's surface, the leaf's, or an outlier, and its derivatives.

    A point of an organ is uniform on its surface, displaced by isotropic normal noise; but around a tube, which may
    have been seen from one side, its angle has a von Mises density.  For a flat patch the density is a normal density
    across it times differences of error functions along and across; for a tube, a ring blurred by noise times such a
    difference along the axis.  With R the radius, s the noise and p the place across the axis, the ring's is
    exp(-(p² + R²) / 2 s²) I0(|R p / s² + facing|) / (2 pi s² I0(|facing|)): a Rice density where it faces nowhere.

    Parameters
    ----------
    points : (n, 3)
    organ : (n,) int8: 0 stem, 1 leaf; -1 unknown, may be of either
    seen : (n,) share of the leaf's points that is seen where each lies
    leaf_origin (m, 3), leaf_frame (m, 3, 3) columns tangent, lateral, normal, leaf_length (m,), leaf_half (m + 1,) :
        the leaf's segments, and half widths at the nodes
    leaf_area : of the leaf, as far as it was seen
    stem_origin (s, 3), stem_frame (s, 3, 3) columns tangent and two across, stem_length (s,), stem_radius (s,) : the
        stem's segments
    stem_area : of the stem, as far as it was seen
    leaf_change (m, 9, k), leaf_area_change (k,), stem_change (s, 9, k), stem_area_change (k,) : change of a segment,
        in its own frame, and of the logarithm of the organ's area, for a unit change of each
        of k parameters
    facing : (2,) von Mises concentration of the stem's points, towards a side, in the frame across it
    noise : (3,) standard deviation: on the stem; on the leaf; and what its thickness adds to that across the blade
    share : (3,) of the points: stem, leaf, outliers
    outlier_density : of an outlier, per volume
    log_p : (n,), filled with the log density
    scores : (n, k + 7), filled with its derivatives by the k parameters, by what the stem faces, by the logarithms of
        the three noises, and by the logits of the shares of stem and outliers (relative to the leaf's); or (0, 0): not
        wanted
    """
    n = points.shape[0]
    m = leaf_origin.shape[0]
    k = stem_change.shape[2]
    wanted = scores.shape[0] > 0
    stem_noise, leaf_noise, thickness = noise[0], noise[1], np.hypot(noise[1], noise[2])
    far, reach, depth = REACH * stem_noise, REACH * leaf_noise, REACH * thickness
    stem_square, leaf_square = stem_noise * stem_noise, leaf_noise * leaf_noise
    thin = leaf_square / (thickness * thickness)
    floor = share[2] * outlier_density
    facing_v, facing_w = facing[0], facing[1]
    one_sided = np.sqrt(facing_v * facing_v + facing_w * facing_w)
    at_all_sides, mean_facing = _bessel(one_sided)
    mean_facing = mean_facing / one_sided if one_sided > 0.0 else 0.5
    for i in range(n):
        on_stem = 0.0
        on_leaf = 0.0
        if wanted:
            for c in range(k + 7):
                scores[i, c] = 0.0
        if organ[i] != 1:
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
                from_foot, at_foot = _normal(u / stem_noise)
                from_top, at_top = _normal((u - length) / stem_noise)
                along = from_foot - from_top
                if along <= 0.0:
                    continue
                pull_v, pull_w = radius * v / stem_square + facing_v, radius * w / stem_square + facing_w
                pull = np.sqrt(pull_v * pull_v + pull_w * pull_w)
                bessel, ratio = _bessel(pull)
                ratio = ratio / pull if pull > 0.0 else 0.5
                gap = rho - radius
                exponent = pull - rho * radius / stem_square - one_sided - 0.5 * gap * gap / stem_square
                around = np.exp(exponent) * bessel / (2.0 * np.pi * stem_square * at_all_sides)
                density = share[0] * 2.0 * np.pi * radius / stem_area * around * along
                if density <= 0.0:
                    continue
                on_stem += density
                if wanted:
                    at_foot /= stem_noise * along
                    at_top /= stem_noise * along
                    by_u = density * (at_foot - at_top)
                    by_length = density * at_top
                    towards = ratio * (pull_v * v + pull_w * w)
                    by_half = 0.5 * density * ((towards - radius) / stem_square + 1.0 / radius)
                    by_v = density * (radius * ratio * pull_v - v) / stem_square
                    by_w = density * (radius * ratio * pull_w - w) / stem_square
                    change = stem_change[j]
                    for c in range(k):
                        scores[i, c] += (
                            by_length * change[6, c]
                            + by_half * (change[7, c] + change[8, c])
                            - by_u * (change[0, c] + change[4, c] * w - change[5, c] * v)
                            - by_v * (change[1, c] + change[5, c] * u - change[3, c] * w)
                            - by_w * (change[2, c] + change[3, c] * v - change[4, c] * u)
                        )
                    scores[i, k] += density * (ratio * pull_v - mean_facing * facing_v)
                    scores[i, k + 1] += density * (ratio * pull_w - mean_facing * facing_w)
                    scores[i, k + 2] += density * (
                        -2.0
                        + (rho * rho + radius * radius - 2.0 * radius * towards) / stem_square
                        - (u * at_foot - (u - length) * at_top)
                    )
        if organ[i] != 0:
            for j in range(m):
                x, y, z = (
                    points[i, 0] - leaf_origin[j, 0],
                    points[i, 1] - leaf_origin[j, 1],
                    points[i, 2] - leaf_origin[j, 2],
                )
                u = leaf_frame[j, 0, 0] * x + leaf_frame[j, 1, 0] * y + leaf_frame[j, 2, 0] * z
                length = leaf_length[j]
                if u < -reach or u > length + reach:
                    continue
                w = leaf_frame[j, 0, 2] * x + leaf_frame[j, 1, 2] * y + leaf_frame[j, 2, 2] * z
                if w > depth or w < -depth:
                    continue
                v = leaf_frame[j, 0, 1] * x + leaf_frame[j, 1, 1] * y + leaf_frame[j, 2, 1] * z
                slope = leaf_half[j + 1] - leaf_half[j]
                if abs(v) > max(leaf_half[j], leaf_half[j + 1]) + reach:
                    continue
                from_start, at_start = _normal(u / leaf_noise)
                from_end, at_end = _normal((u - length) / leaf_noise)
                along = from_start - from_end
                if along <= 0.0:
                    continue
                at_start /= leaf_noise * along
                at_end /= leaf_noise * along
                # the half width is taken where the point comes from on average, given u
                pull = at_start - at_end
                s = min(max((u + leaf_square * pull) / length, 0.0), 1.0)
                half = leaf_half[j] + s * slope
                right, left = half + v, half - v  # from the edges
                until_right, at_right = _normal(right / leaf_noise)
                until_left, at_left = _normal(left / leaf_noise)
                across = until_right + until_left
                if across <= 0.0:
                    continue
                at_right /= leaf_noise * across
                at_left /= leaf_noise * across
                bell = np.exp(-0.5 * (w / thickness) ** 2) / (ROOT_TWO_PI * thickness)
                density = share[1] * seen[i] / leaf_area * bell * along * across
                if density <= 0.0:
                    continue
                on_leaf += density
                if wanted:
                    by_v, by_half = at_right - at_left, at_right + at_left
                    spread = u * at_start - (u - length) * at_end
                    by_place = by_half * slope / length  # of the place where the half width is taken
                    by_thickness = w * w / (thickness * thickness) - 1.0
                    by_noise = (
                        thin * by_thickness
                        - spread
                        + by_place
                        * (leaf_square * pull * (1.0 + spread) + u * u * at_start - (u - length) ** 2 * at_end)
                        - (right * at_right + left * at_left)
                    )
                    by_u = density * (pull + by_place * (1.0 - spread - leaf_square * pull * pull))
                    by_v *= density
                    by_w = -density * w / (thickness * thickness)
                    by_length = density * (at_end - by_place * (((u - length) + leaf_square * pull) * at_end + s))
                    by_first, by_second = density * by_half * (1.0 - s), density * by_half * s
                    change = leaf_change[j]
                    for c in range(k):
                        scores[i, c] += (
                            by_length * change[6, c]
                            + by_first * change[7, c]
                            + by_second * change[8, c]
                            - by_u * (change[0, c] + change[4, c] * w - change[5, c] * v)
                            - by_v * (change[1, c] + change[5, c] * u - change[3, c] * w)
                            - by_w * (change[2, c] + change[3, c] * v - change[4, c] * u)
                        )
                    scores[i, k + 3] += density * by_noise
                    scores[i, k + 4] += density * (1.0 - thin) * by_thickness
        p = floor + on_stem + on_leaf
        log_p[i] = np.log(p)
        if wanted:
            for c in range(k):
                scores[i, c] = (scores[i, c] - on_leaf * leaf_area_change[c] - on_stem * stem_area_change[c]) / p
            for c in range(k, k + 5):
                scores[i, c] /= p
            scores[i, k + 5] = on_stem / p - share[0]
            scores[i, k + 6] = floor / p - share[2]


@kernel
def segment_changes(axis, frame, length, half, steps, turning, shifting, center, change):
    """Change of the segments of an organ, each in its own frame, per unit of the parameters, by central differences of
    a population (row 0 as it is, rows 1 .. k with a parameter raised by its step, rows k + 1 .. 2 k lowered), and per
    unit of turn and shift of its pose.

    Parameters
    ----------
    axis (2 k + 1, m + 1, 3), frame (2 k + 1, m, 3, 3) columns tangent, lateral, normal, length (2 k + 1, m), half
        (2 k + 1, m + 1) : the organ
    steps : (k,)
    turning, shifting (3, 3), center (3,) : columns of the axes of turning, and of the shifts, and the place about
        which it is turned, in the frame in which the organ is given
    change : (m, 9, k + 6), filled
    """
    k = len(steps)
    offset, arm = np.empty(3), np.empty(3)
    for j in range(frame.shape[1]):
        own = frame[0, j]
        for c in range(k):
            high, low, twice = 1 + c, 1 + k + c, 2.0 * steps[c]
            for a in range(3):
                offset[a] = (axis[high, j, a] - axis[low, j, a]) / twice
            for a in range(3):
                after, last = (a + 1) % 3, (a + 2) % 3
                change[j, a, c] = own[0, a] * offset[0] + own[1, a] * offset[1] + own[2, a] * offset[2]
                turn = 0.0
                for b in range(3):
                    turn += own[b, last] * (frame[high, j, b, after] - frame[low, j, b, after])
                change[j, 3 + a, c] = turn / twice
            change[j, 6, c] = (length[high, j] - length[low, j]) / twice
            change[j, 7, c] = (half[high, j] - half[low, j]) / twice
            change[j, 8, c] = (half[high, j + 1] - half[low, j + 1]) / twice
        for b in range(3):
            arm[b] = axis[0, j, b] - center[b]
        for t in range(3):
            for a in range(3):
                after, last = (a + 1) % 3, (a + 2) % 3
                offset[a] = turning[after, t] * arm[last] - turning[last, t] * arm[after]
            for a in range(3):
                along, about, shift = 0.0, 0.0, 0.0
                for b in range(3):
                    along += own[b, a] * offset[b]
                    about += own[b, a] * turning[b, t]
                    shift += own[b, a] * shifting[b, t]
                change[j, a, k + t] = along
                change[j, 3 + a, k + t] = about
                change[j, a, k + 3 + t] = shift
                change[j, 3 + a, k + 3 + t] = 0.0
        for a in range(6, 9):
            change[j, a, k:] = 0.0
