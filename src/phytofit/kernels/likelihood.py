"""Density of points that come from tubes and strips, with noise, and its derivatives: one organ at a time."""

import numpy as np

from phytofit.kernels.compiling import kernel

__all__ = ["CHANGES", "add_scores", "seen_area", "segment_changes", "strip_density", "tube_density"]

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
def tube_density(
    points, weight, origin, frame, length, radius, area, facing, noise, change, area_change, density, derivative
):  # fmt: skip
    """Add the density of points that come from a tube, and its derivatives.

    A point is uniform along the tube, displaced by isotropic normal noise; around it, as it may have been seen from one
    side, its angle has a von Mises density.  The density is a ring blurred by noise, times a difference of normal
    distributions along the axis.  With R the radius, s the noise and p the place across the axis, the ring's is
    exp(-(p² + R²) / 2 s²) I0(|R p / s² + facing|) / (2 pi s² I0(|facing|)): a Rice density where it faces nowhere.

    Parameters
    ----------
    points : (n, 3)
    weight : (n,) by which the density is multiplied at each point; where it is 0, nothing is computed
    origin (s, 3), frame (s, 3, 3) columns tangent and two across, length (s,), radius (s,) : the tube's segments
    area : of the tube, as far as it was seen
    facing : (2,) von Mises concentration of the points, towards a side, in the frame across the tube
    noise : standard deviation
    change (s, 9, k), area_change (k,) : change of a segment, in its own frame, and of the logarithm of the area, for a
        unit change of each of k parameters
    density : (n,), added to
    derivative : (n, k + 3), to which the derivatives by the k parameters, by `facing` and by the logarithm of the noise
        are added; or (0, 0): not wanted
    """
    wanted = derivative.shape[0] > 0
    k = change.shape[2]
    far, square = REACH * noise, noise * noise
    facing_v, facing_w = facing[0], facing[1]
    one_sided = np.sqrt(facing_v * facing_v + facing_w * facing_w)
    at_all_sides, mean_facing = _bessel(one_sided)
    mean_facing = mean_facing / one_sided if one_sided > 0.0 else 0.5
    for i in range(points.shape[0]):
        if weight[i] == 0.0:
            continue
        for j in range(len(length)):
            x, y, z = points[i, 0] - origin[j, 0], points[i, 1] - origin[j, 1], points[i, 2] - origin[j, 2]
            u = frame[j, 0, 0] * x + frame[j, 1, 0] * y + frame[j, 2, 0] * z
            long, r = length[j], radius[j]
            if u < -far or u > long + far or long <= 0.0:
                continue
            v = frame[j, 0, 1] * x + frame[j, 1, 1] * y + frame[j, 2, 1] * z
            w = frame[j, 0, 2] * x + frame[j, 1, 2] * y + frame[j, 2, 2] * z
            rho = np.sqrt(v * v + w * w)
            if rho > r + far or rho < r - far:
                continue
            from_foot, at_foot = _normal(u / noise)
            from_top, at_top = _normal((u - long) / noise)
            along = from_foot - from_top
            if along <= 0.0:
                continue
            tilt_v, tilt_w = r * v / square + facing_v, r * w / square + facing_w
            tilt = np.sqrt(tilt_v * tilt_v + tilt_w * tilt_w)
            bessel, ratio = _bessel(tilt)
            ratio = ratio / tilt if tilt > 0.0 else 0.5
            gap = rho - r
            exponent = tilt - rho * r / square - one_sided - 0.5 * gap * gap / square
            around = np.exp(exponent) * bessel / (2.0 * np.pi * square * at_all_sides)
            here = weight[i] * 2.0 * np.pi * r / area * around * along
            if here <= 0.0:
                continue
            density[i] += here
            if wanted:
                at_foot /= noise * along
                at_top /= noise * along
                by_u = here * (at_foot - at_top)
                by_length = here * at_top
                towards = ratio * (tilt_v * v + tilt_w * w)
                by_half = 0.5 * here * ((towards - r) / square + 1.0 / r)
                by_v = here * (r * ratio * tilt_v - v) / square
                by_w = here * (r * ratio * tilt_w - w) / square
                shift = change[j]
                for c in range(k):
                    derivative[i, c] += (
                        by_length * shift[6, c]
                        + by_half * (shift[7, c] + shift[8, c])
                        - by_u * (shift[0, c] + shift[4, c] * w - shift[5, c] * v)
                        - by_v * (shift[1, c] + shift[5, c] * u - shift[3, c] * w)
                        - by_w * (shift[2, c] + shift[3, c] * v - shift[4, c] * u)
                        - here * area_change[c]
                    )
                derivative[i, k] += here * (ratio * tilt_v - mean_facing * facing_v)
                derivative[i, k + 1] += here * (ratio * tilt_w - mean_facing * facing_w)
                derivative[i, k + 2] += here * (
                    -2.0 + (rho * rho + r * r - 2.0 * r * towards) / square - (u * at_foot - (u - long) * at_top)
                )


@kernel
def strip_density(
    points, weight, origin, frame, length, half, right, left, area, noise, change, area_change, density, derivative
):  # fmt: skip
    """Add the density of points that come from a strip, or from one side of it, and its derivatives.

    A point is uniform on the flat segments, displaced by isotropic normal noise, to which the strip's thickness adds
    across it: the density is a normal density across the surface times differences of normal distributions along and
    across.

    Parameters
    ----------
    points : (n, 3)
    weight : (n,) by which the density is multiplied at each point; where it is 0, nothing is computed
    origin (m, 3), frame (m, 3, 3) columns tangent, lateral, normal, length (m,), half (m + 1,) : the segments, and half
        widths at the nodes
    right, left : how many half widths the surface reaches to either side of its midrib: 1 or 0
    area : of the strip, as far as it was seen
    noise : (2,) standard deviation, and what the thickness adds to that across the surface
    change (m, 9, k), area_change (k,), density, derivative (n, k + 2) : as of :func:`tube_density`; the derivatives are
        by the k parameters and by the logarithms of the two noises
    """
    wanted = derivative.shape[0] > 0
    k = change.shape[2]
    std, thickness = noise[0], np.hypot(noise[0], noise[1])
    reach, depth = REACH * std, REACH * thickness
    square = std * std
    thin = square / (thickness * thickness)
    for i in range(points.shape[0]):
        if weight[i] == 0.0:
            continue
        for j in range(len(length)):
            x, y, z = points[i, 0] - origin[j, 0], points[i, 1] - origin[j, 1], points[i, 2] - origin[j, 2]
            u = frame[j, 0, 0] * x + frame[j, 1, 0] * y + frame[j, 2, 0] * z
            long = length[j]
            if u < -reach or u > long + reach:
                continue
            w = frame[j, 0, 2] * x + frame[j, 1, 2] * y + frame[j, 2, 2] * z
            if w > depth or w < -depth:
                continue
            v = frame[j, 0, 1] * x + frame[j, 1, 1] * y + frame[j, 2, 1] * z
            slope = half[j + 1] - half[j]
            widest = max(half[j], half[j + 1])
            if v > right * widest + reach or v < -left * widest - reach:
                continue
            from_start, at_start = _normal(u / std)
            from_end, at_end = _normal((u - long) / std)
            along = from_start - from_end
            if along <= 0.0:
                continue
            at_start /= std * along
            at_end /= std * along
            # the half width is taken where the point comes from on average, given u
            drift = at_start - at_end
            s = min(max((u + square * drift) / long, 0.0), 1.0)
            wide = half[j] + s * slope
            to_right, to_left = right * wide - v, left * wide + v  # from the edges
            until_right, at_right = _normal(to_right / std)
            until_left, at_left = _normal(to_left / std)
            across = until_right + until_left
            if across <= 0.0:
                continue
            at_right /= std * across
            at_left /= std * across
            bell = np.exp(-0.5 * (w / thickness) ** 2) / (ROOT_TWO_PI * thickness)
            here = weight[i] / area * bell * along * across
            if here <= 0.0:
                continue
            density[i] += here
            if wanted:
                by_v, by_half = at_left - at_right, right * at_right + left * at_left
                spread = u * at_start - (u - long) * at_end
                by_place = by_half * slope / long  # of the place where the half width is taken
                by_thickness = w * w / (thickness * thickness) - 1.0
                by_noise = (
                    thin * by_thickness
                    - spread
                    + by_place * (square * drift * (1.0 + spread) + u * u * at_start - (u - long) ** 2 * at_end)
                    - (to_right * at_right + to_left * at_left)
                )
                by_u = here * (drift + by_place * (1.0 - spread - square * drift * drift))
                by_v *= here
                by_w = -here * w / (thickness * thickness)
                by_length = here * (at_end - by_place * (((u - long) + square * drift) * at_end + s))
                by_first, by_second = here * by_half * (1.0 - s), here * by_half * s
                shift = change[j]
                for c in range(k):
                    derivative[i, c] += (
                        by_length * shift[6, c]
                        + by_first * shift[7, c]
                        + by_second * shift[8, c]
                        - by_u * (shift[0, c] + shift[4, c] * w - shift[5, c] * v)
                        - by_v * (shift[1, c] + shift[5, c] * u - shift[3, c] * w)
                        - by_w * (shift[2, c] + shift[3, c] * v - shift[4, c] * u)
                        - here * area_change[c]
                    )
                derivative[i, k] += here * by_noise
                derivative[i, k + 1] += here * (1.0 - thin) * by_thickness


@kernel
def add_scores(scale, derivative, columns, scores):
    """Add derivatives (n, c) of a density, times `scale` (n,) each, to the `columns` (c,) of scores (n, k)."""
    for i in range(len(scale)):
        if scale[i] == 0.0:
            continue
        for c in range(len(columns)):
            scores[i, columns[c]] += scale[i] * derivative[i, c]


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


@kernel
def seen_area(along, across, scale, seen, slope, length, half, change, total):
    """Area of an organ, as far as it was seen, and its change per unit of the parameters that change its segments.

    Parameters
    ----------
    along (p,), across (p, 2) : the same patches of each segment: where their middles lie along it, a share of its
        length, and across and off it, shares of its half width (or radius) in its middle
    scale (p,) : area of each, as a share of the segment's length times the sum of its half widths
    seen (m, p), slope (m, p, 3) : share of each that was seen, and the change of that by moves along the columns of its
        segment's frame
    length (m,), half (m + 1,) : the segments
    change (m, 9, k) : of the segments, as of :func:`segment_changes`
    total : (k,), to which the changes are added
    """
    whole = 0.0
    for j in range(len(length)):
        long, wide = length[j], half[j] + half[j + 1]
        shift = change[j]
        for i in range(len(along)):
            area, share = scale[i] * long * wide, seen[j, i]
            whole += area * share
            right, up = across[i, 0], across[i, 1]
            u, v, w = along[i] * long, 0.5 * right * wide, 0.5 * up * wide
            by_u, by_v, by_w = area * slope[j, i, 0], area * slope[j, i, 1], area * slope[j, i, 2]
            by_length = scale[i] * wide * share + by_u * along[i]
            by_wide = scale[i] * long * share + 0.5 * (by_v * right + by_w * up)
            for c in range(change.shape[2]):
                total[c] += (
                    by_length * shift[6, c]
                    + by_wide * (shift[7, c] + shift[8, c])
                    + by_u * (shift[0, c] + shift[4, c] * w - shift[5, c] * v)
                    + by_v * (shift[1, c] + shift[5, c] * u - shift[3, c] * w)
                    + by_w * (shift[2, c] + shift[3, c] * v - shift[4, c] * u)
                )
    return whole
