"""Intervals of traits, which are not linear in what was fitted."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ends", "propagated"]

FloatArray = NDArray[np.float64]


class Ends(NamedTuple):
    """How far (t,) below and above its value each trait's interval reaches; NaN where a trait can't be measured."""

    below: FloatArray
    above: FloatArray

    def with_error(self, below: FloatArray, above: FloatArray) -> "Ends":
        """With another, independent error (t,), positive or negative."""
        return Ends(np.hypot(self.below, below), np.hypot(self.above, above))


def propagated(
    measured: Callable[[FloatArray], FloatArray],
    x: FloatArray,
    covariance: FloatArray,
    quantile: float,
    lower: FloatArray,
    upper: FloatArray,
) -> Ends:
    """Interval of functions of parameters with errors.

    Along each principal axis of the correlations, to both sides, the functions are taken as many standard errors away
    as the interval shall reach; what they change by is summed in squares, falls and rises apart.  For linear functions
    that is the delta method; where they bend, the interval is not symmetric.

    Parameters
    ----------
    measured : x (k,) -> values (t,)
    covariance : (k, k)
    quantile : standard errors to either side
    lower, upper : (k,) within which x may be
    """
    std = np.sqrt(np.diag(covariance))
    scaled = np.where(std > 0.0, std, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(scaled, scaled))
    value = measured(x)
    below, above = np.zeros(len(value)), np.zeros(len(value))
    for j in np.flatnonzero(variance > 1e-12 * variance.max()):
        step = quantile * np.sqrt(variance[j]) * scaled * axes[:, j]
        changes = np.array([measured(np.clip(x + sign * step, lower, upper)) - value for sign in (1.0, -1.0)])
        above += np.maximum(changes, 0.0).max(axis=0) ** 2
        below += np.minimum(changes, 0.0).min(axis=0) ** 2
    return Ends(np.sqrt(below), np.sqrt(above))
