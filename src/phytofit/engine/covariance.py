"""How far an estimate may be off: the covariance of its error, and the misfit of the blade that it knows nothing of."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, pinvh

from phytofit.engine.dependence import Dependence, GaussianCorrelation
from phytofit.engine.intervals import covariance_of_independent
from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior

__all__ = ["covariance_of", "grown", "misfit_of", "of_sensor", "shared_by_neighbors"]

FloatArray = NDArray[np.float64]
LEAST_KNOWN = 1e-9  # information on an entry of theta, below which it is none: labels may leave no share to be told
LEAST_LEFT = 1.0 / 3.0  # of the residuals' degrees of freedom
STEP = 0.02  # of a parameter's standard error, for differences of the gradient


def covariance_of(
    posterior: Posterior,
    state: State,
    at: Evaluation,
    dependence: Dependence,
) -> tuple[FloatArray, float]:
    """Covariance (k + 14, k + 14) of the error of the maximum of a posterior, and how many independent points are left
    for it after the fit.

    A sandwich: that of independent points, what neighbours share, and what is not known of holes.  An entry that its
    bound holds (a length or a share, not an angle, for which 0 is no end) has an error of its own, which the others do
    not follow.
    """
    free = posterior.prior.free
    curvature = _curvature(posterior, state, at)
    held = _held(posterior, state, at)[free]
    curvature = np.where(held[:, np.newaxis] | held, np.diag(np.diag(curvature)), curvature)
    inverse = pinvh(curvature)
    left = max(
        dependence.n_independent - free.sum(), LEAST_LEFT * dependence.n_independent
    )  # a fit takes some errors up
    scores = at.scores[:, free]
    shared = dependence.variability[np.ix_(free, free)] - scores.T @ scores  # by neighbours
    pull = posterior.prior.curvature[free]
    shared += np.diag(pull * (posterior.prior.weight[free] - 1.0))  # what a prior counts for again is no more news
    alone = covariance_of_independent(curvature, scores, pull)
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = (alone + inverse @ shared @ inverse) * dependence.n_independent / left
    covariance[np.ix_(free, free)] += _by_holes(posterior, state, at, inverse)
    return covariance, float(left)


def grown(covariance: FloatArray, other: FloatArray, those: NDArray[np.bool_]) -> FloatArray:
    """A covariance (k, k), more by what another (k, k) of `those` (k,) has beyond it, on the axes on which it has."""
    part = np.ix_(those, those)
    scale = np.sqrt(np.diag(other)[those]) + 1e-12
    values, vectors = np.linalg.eigh((other - covariance)[part] / np.outer(scale, scale))
    more: FloatArray = covariance.copy()
    more[part] += (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale)
    return more


def misfit_of(dependence: Dependence, noise: FloatArray) -> float:
    """How far, cm, the blade's surface lies off the model's: by what errors of neighbours on it share beyond what those
    on the stem do, for a sensor's are on both, and are in the covariance.  ``noise`` (3,) as of a :class:`State`."""
    everything, sensors = dependence.leaf.correlation, of_sensor(dependence, noise).correlation
    return float(np.sqrt((everything - sensors) * float(noise[1] ** 2 + noise[2] ** 2)))


def of_sensor(dependence: Dependence, noise: FloatArray) -> GaussianCorrelation:
    """How the sensor's errors of neighbours on the leaf are correlated: those that neighbours on the stem share are on
    both, in squares of cm.  ``noise`` (3,) as of a :class:`State`."""
    on_stem = dependence.stem.correlation * float(noise[0] ** 2) / float(noise[1] ** 2 + noise[2] ** 2)
    return dependence.leaf._replace(correlation=min(dependence.leaf.correlation, on_stem))


def shared_by_neighbors(dependence: Dependence, noise: FloatArray) -> float:
    """Standard deviation, cm, of the error that neighbours on the leaf share; ``noise`` (3,) as of a :class:`State`."""
    return float(np.sqrt(dependence.leaf.correlation * float(noise[1] ** 2 + noise[2] ** 2)))


def _held(posterior: Posterior, state: State, at: Evaluation) -> NDArray[np.bool_]:
    """Which entries of theta would be beyond their bounds, were there none; of the model's parameters but angles, and
    but those that a weighted prior takes there, not the points."""
    gradient = posterior.gradient(state, at)
    held = np.where(gradient > 0.0, state.theta <= posterior.prior.lower, state.theta >= posterior.prior.upper)
    held[state.layout.model] &= np.array(posterior.space.units) != "deg"
    held &= posterior.prior.weight == 1.0
    return held


def _by_holes(posterior: Posterior, state: State, at: Evaluation, inverse: FloatArray) -> FloatArray:
    """Covariance (m, m) of the free entries of theta, of which `inverse` is that of the curvature, as it is not known
    where holes end: to a cell either way; 0 where there are none, or where points were left out on purpose."""
    if posterior.hidden is None or posterior.is_part:
        return np.zeros_like(inverse)
    before = posterior.gradient(state, at)[posterior.prior.free]
    shifts = []
    for other in (posterior.hidden.smaller(), posterior.hidden.larger()):
        there = posterior.hiding(other)
        shifts.append(inverse @ (there.gradient(state, there.evaluate(state))[posterior.prior.free] - before))
    both = np.array(shifts)
    covariance: FloatArray = 0.5 * both.T @ both
    return covariance


def _curvature(posterior: Posterior, state: State, at: Evaluation) -> FloatArray:
    """Second derivatives of the error by the free entries of theta, by differences of the gradient, 0 for those of
    which nothing is known; the information where they are not positive definite."""
    free = np.flatnonzero(posterior.prior.free)
    gradient = posterior.gradient(state, at)[free]
    information = (at.scores.T @ at.scores + np.diag(posterior.prior.curvature))[np.ix_(free, free)]
    curvature = np.zeros_like(information)
    for row, i in enumerate(free):
        if information[row, row] < LEAST_KNOWN:
            continue
        step = STEP / np.sqrt(information[row, row])
        theta = state.theta.copy()
        theta[i] += step if theta[i] + step <= posterior.prior.upper[i] else -step
        moved = state.at(theta)
        change = posterior.gradient(moved, posterior.evaluate(moved))[free] - gradient
        curvature[row] = change / (theta[i] - state.theta[i])
    curvature = 0.5 * (curvature + curvature.T)
    try:
        known = np.diag(information) >= LEAST_KNOWN
        cho_factor(curvature[np.ix_(known, known)])
    except LinAlgError:
        return information
    return curvature
