"""How probable a cloud is under a model: what models that compete are compared by."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior

__all__ = ["log_evidence"]

FloatArray = NDArray[np.float64]
LEAST_KNOWN = 1e-9  # information on an entry of theta, so that one of which nothing is known has some


def log_evidence(posterior: Posterior, state: State, at: Evaluation, inflation: float = 1.0) -> float:
    """Log probability of the cloud, all free entries of theta integrated out; up to a constant of the cloud.

    Laplace's approximation of the posterior about `state`, of what of it lies within the bounds, each on its own: the
    normal distribution's middle is beyond a bound that holds an entry, else at the optimum.  Points whose errors depend
    on each other count as `inflation` times fewer.

    at : the state evaluated
    """
    prior, free = posterior.prior, posterior.prior.free
    count = np.full(len(at.log_p), 1.0 / inflation)
    if posterior.weights is not None:
        count *= posterior.weights
    theta, mean, precision = state.theta[free], prior.mean[free], prior.precision[free]
    lower, upper, scores = prior.lower[free], prior.upper[free], at.scores[:, free]
    weighted = scores * count[:, np.newaxis]
    information = scores.T @ weighted + np.diag(precision + LEAST_KNOWN)
    covariance = np.linalg.inv(information)
    gradient = np.where((theta <= lower) | (theta >= upper), (theta - mean) * precision - weighted.sum(axis=0), 0.0)
    step = covariance @ gradient  # from the normal distribution's middle
    std = np.sqrt(np.diag(covariance))
    inside = log_ndtr((theta - step - lower) / std) + log_ndtr((upper - theta + step) / std)
    known = precision > 0.0
    before = np.sqrt(precision[known])
    inside_before = log_ndtr((mean - lower)[known] * before) + log_ndtr((upper - mean)[known] * before)
    volume = np.log(before).sum() - 0.5 * np.linalg.slogdet(information)[1]
    surprise = 0.5 * float(np.sum((theta - mean) ** 2 * precision))
    of_points = float(count @ at.log_p) - surprise + 0.5 * float(gradient @ step)
    return float(of_points + volume + inside.sum() - inside_before.sum())
