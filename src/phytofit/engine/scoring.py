"""Refinement: damped Fisher scoring to the maximum of a posterior, within bounds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

__all__ = ["Refined", "refine"]

FloatArray = NDArray[np.float64]
NO_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-4, 1e6  # times the information: steps are full, nearly, or none
MORE, LESS = 10.0, 0.2  # times the damping, after a step that does not lower the error, and after one that does


@dataclass(frozen=True)
class Refined:
    """Where the refinement ended: ``theta`` (k,) and its ``error``; ``converged`` says whether it had come to rest."""

    theta: FloatArray
    error: float
    iterations: int
    converged: bool


def refine(
    evaluate: Callable[[FloatArray], tuple[float, FloatArray, FloatArray]],
    theta: FloatArray,
    *,
    lower: FloatArray,
    upper: FloatArray,
    max_iterations: int = 100,
    tolerance: float = 3e-3,
    kink: float = 0.1,
) -> Refined:
    """Minimise an error by damped scoring (Levenberg and Marquardt's damping of the Fisher information).

    Parameters
    ----------
    evaluate : theta (k,) -> error, gradient (k,), information (k, k), positive semi-definite; where any of them is not
        finite, no step is taken; where the information is indefinite, steps are damped until its curvature is positive,
        and the end is not called converged
    tolerance : of the error, which the next step is expected to lower by less
    kink : where no step lowers an error that was expected to fall by less than this, it has a kink, and that is its
        minimum
    """
    theta = np.clip(theta, lower, upper)
    now = evaluate(theta)
    if not _finite(now):
        return Refined(theta, now[0], 0, False)
    error, gradient, information = now
    missing = np.zeros_like(information)  # what the curvature has that the information lacks
    damping = 1e-3
    for iteration in range(1, max_iterations + 1):
        free = ~(((theta <= lower) & (gradient > 0.0)) | ((theta >= upper) & (gradient < 0.0)))
        diagonal = np.abs(np.diag(information)[free])
        hoped = None  # by how much the error is expected to fall in a step that is not damped
        least = NO_DAMPING  # with which the curvature is positive
        while True:
            if max(damping, least) > MOST_DAMPING:
                return Refined(theta, error, iteration, hoped is not None and least == NO_DAMPING and hoped < kink)
            factor = _factor(
                (information + missing)[np.ix_(free, free)]
                + np.diag((max(damping, least) if hoped is not None else least) * diagonal + 1e-9)
            )
            if factor is None:
                if missing.any():
                    missing[:] = 0.0
                    damping *= MORE
                else:  # the information itself is indefinite
                    least *= MORE
                continue
            step = np.zeros_like(theta)
            step[free] = -cho_solve(factor, gradient[free])
            if hoped is None:
                hoped = -0.5 * float(gradient @ step)
                if hoped < tolerance and least == NO_DAMPING:
                    return Refined(theta, error, iteration, True)
                continue
            tried = np.clip(theta + step, lower, upper)
            now = evaluate(tried)
            if now[0] < error and _finite(now):
                damping = max(LESS * damping, LEAST_DAMPING)
                break
            damping *= MORE
        moved = tried - theta
        before = gradient
        theta = tried
        error, gradient, information = now
        missing = _update(information + missing, moved, gradient - before) - information
    return Refined(theta, error, max_iterations, False)


def _finite(terms: tuple[float, FloatArray, FloatArray]) -> bool:
    return all(bool(np.isfinite(term).all()) for term in terms)


def _factor(curvature: FloatArray) -> tuple[FloatArray, bool] | None:
    """Cholesky's factor of a curvature (k, k), None where it is not positive."""
    try:
        factor: tuple[FloatArray, bool] = cho_factor(curvature, check_finite=False)
    except LinAlgError:
        return None
    return factor


def _update(curvature: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Broyden, Fletcher, Goldfarb and Shanno's update of a curvature (k, k) by the gradient's change over a step."""
    along = float(step @ change)
    bent = curvature @ step
    length = float(step @ bent)
    if along <= 1e-8 * abs(length) or length <= 0.0:
        return curvature
    updated: FloatArray = curvature + np.outer(change, change) / along - np.outer(bent, bent) / length
    return updated
