"""Errors of what was fitted, and intervals of traits, which are not linear in it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ends", "covariance_of_independent", "propagated"]

FloatArray = NDArray[np.float64]
CLEAR = 3.0  # standard errors by which scores must vary more than the curvature has it


class Ends(NamedTuple):
    """How far (t,) below and above its value each trait's interval reaches; NaN where a trait can't be measured."""

    below: FloatArray
    above: FloatArray

    def with_error(self, below: FloatArray, above: FloatArray) -> "Ends":
        """With another, independent error (t,), positive or negative."""
        return Ends(np.hypot(self.below, below), np.hypot(self.above, above))

    def mixed(self, others: Sequence[tuple[float, FloatArray, "Ends"]], quantile: float) -> "Ends":
        """Of what may also lie elsewhere: each of the others with its probability, how far (t,) from here it lies, and
        how far it reaches from there.  In mean squares, as averages over models have it (Hoeting et al., Statistical
        Science 14, 1999)."""
        here = 1.0 - sum(p for p, _, _ in others)
        below, above = here * self.below**2, here * self.above**2
        for p, apart, ends in others:
            below = below + p * (ends.below**2 + (quantile * np.minimum(apart, 0.0)) ** 2)
            above = above + p * (ends.above**2 + (quantile * np.maximum(apart, 0.0)) ** 2)
        return Ends(np.sqrt(below), np.sqrt(above))


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


def covariance_of_independent(curvature: FloatArray, scores: FloatArray, precision: FloatArray) -> FloatArray:
    """Covariance (m, m) of an estimate's error, of points whose errors are independent.

    Of a right model, scores vary as much as the error is curved (Bartlett's second identity), and the covariance is
    the inverse curvature.  The sandwich with the scores' outer product as its middle (Huber, 1967) is also that of a
    wrong one, but a poor estimate where few points decide, as at a leaf's tip: at the maximum, those that would pull
    most have been followed most.  So the outer product counts only along those axes along which it clearly exceeds the
    curvature: White's information matrix test (Econometrica 50, 1982), one principal axis after the other.  The axes
    are those of the scores themselves, so that of many parameters some exceed it by chance; variances then come out a
    few per cent too large.

    Parameters
    ----------
    curvature : (m, m) of the error, the prior's `precision` (m,) included; 0 for what nothing is known of
    scores : (n, m) of the points, at the maximum
    """
    values, vectors = np.linalg.eigh(curvature)
    known = values > len(values) * np.finfo(float).eps * values.max()
    whiten = vectors[:, known] / np.sqrt(values[known])
    ratio, turn = np.linalg.eigh(whiten.T @ (scores.T @ scores + np.diag(precision)) @ whiten)
    axes = whiten @ turn
    square = (scores @ axes) ** 2
    std = np.sqrt(np.sum(square**2, axis=0))
    middle = np.where(ratio - 1.0 > CLEAR * std, ratio, 1.0)
    covariance: FloatArray = (axes * middle) @ axes.T
    return covariance
