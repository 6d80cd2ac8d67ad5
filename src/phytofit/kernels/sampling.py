"""Points spread uniformly by area over the surfaces of one phytomer: tubes and strips swept along axes."""

import numpy as np

from phytofit.kernels.compiling import kernel

__all__ = ["sample_surfaces"]


@kernel
def _slant(axis, half_width, j, tube):
    """Length of segment j along its surface: down the side of a cone for a tube, along the midrib for a strip."""
    square = 0.0
    for a in range(3):
        square += (axis[j + 1, a] - axis[j, a]) ** 2
    if tube:
        square += (half_width[j + 1] - half_width[j]) ** 2
    return np.sqrt(square)


@kernel
def sample_surfaces(axis, frame, half_width, first, tube, fold, along, across, cosine, sine, out, label):
    """Map fixed random numbers to points on the surfaces of the organs, uniformly by area (Fig. 5d).

    Parameters
    ----------
    axis : (m, 3) nodes of all organs, one organ after the other
    frame : (m, 3, 3) columns tangent, lateral, normal of the segment that begins at the node (last nodes unused)
    half_width : (m,) at the nodes
    first : (o + 1,) where each organ's nodes begin
    tube : (o,) True for a tube (full turn), False for a strip (flat across)
    fold : (o,) angle, radians, by which each half of a strip is raised
    along : (n,) in [0, 1), ascending: share of the whole area passed
    across : (n,) in [-1, 1): place across a strip
    cosine, sine : (n,) of the angle around a tube
    out : (3, n) float32, filled with the points
    label : (n,) int8, filled with the organ's number

    Returns
    -------
    total area
    """
    total = 0.0
    for o in range(tube.shape[0]):
        for j in range(first[o], first[o + 1] - 1):
            share = _slant(axis, half_width, j, tube[o]) * (half_width[j] + half_width[j + 1])
            total += share * np.pi if tube[o] else share
    i = 0
    n = along.shape[0]
    passed = 0.0
    end_organ = tube.shape[0] - 1
    for o in range(tube.shape[0]):
        for j in range(first[o], first[o + 1] - 1):
            w0, w1 = half_width[j], half_width[j + 1]
            area = _slant(axis, half_width, j, tube[o]) * (w0 + w1)
            if tube[o]:
                area *= np.pi
            end = passed + area
            is_last = o == end_organ and j == first[o + 1] - 2
            while i < n and (along[i] * total < end or is_last):
                share = (along[i] * total - passed) / area if area > 0.0 else 0.0
                share = min(max(share, 0.0), 1.0)
                # the share of a trapezoid's area below s is ((w0 + s (w1 - w0))^2 - w0^2) / (w1^2 - w0^2)
                s = share
                if abs(w1 - w0) > 1e-9 * (w0 + w1):
                    s = (np.sqrt(w0 * w0 + share * (w1 * w1 - w0 * w0)) - w0) / (w1 - w0)
                w = w0 + s * (w1 - w0)
                if tube[o]:
                    lateral, normal = w * cosine[i], w * sine[i]
                else:
                    lateral, normal = w * across[i] * np.cos(fold[o]), w * abs(across[i]) * np.sin(fold[o])
                for a in range(3):
                    out[a, i] = np.float32(
                        axis[j, a]
                        + s * (axis[j + 1, a] - axis[j, a])
                        + lateral * frame[j, a, 1]
                        + normal * frame[j, a, 2]
                    )
                label[i] = o
                i += 1
            passed = end
    return total
