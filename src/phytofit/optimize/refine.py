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
    evaluate : theta (k,) -> error, gradient (k,), information (k, k), positive semi-definite
    tolerance : of the error, which the next step is expected to lower by less
    kink : where no step lowers an error that was expected to fall by less than this, it has a kink, and that is its
        minimum
    """
    theta = np.clip(theta, lower, upper)
    error, gradient, information = evaluate(theta)
    missing = np.zeros_like(information)  # what the curvature has that the information lacks
    damping = 1e-3
    for iteration in range(1, max_iterations + 1):
        free = ~(((theta <= lower) & (gradient > 0.0)) | ((theta >= upper) & (gradient < 0.0)))
        diagonal = np.diag(information)[free]
        hoped = None  # by how much the error is expected to fall in a step that is not damped
        while True:
            damped = (information + missing)[np.ix_(free, free)] + np.diag(
                (damping if hoped is not None else NO_DAMPING) * diagonal + 1e-9
            )
            try:
                factor = cho_factor(damped)
            except LinAlgError:
                missing[:] = 0.0
                damping *= MORE
                continue
            step = np.zeros_like(theta)
            step[free] = -cho_solve(factor, gradient[free])
            if hoped is None:
                hoped = -0.5 * float(gradient @ step)
                if hoped < tolerance:
                    return Refined(theta, error, iteration, True)
                continue
            if damping > MOST_DAMPING:
                return Refined(theta, error, iteration, hoped < kink)
            tried = np.clip(theta + step, lower, upper)
            now = evaluate(tried)
            if now[0] < error:
                damping = max(LESS * damping, LEAST_DAMPING)
                break
            damping *= MORE
        moved = tried - theta
        before = gradient
        theta = tried
        error, gradient, information = now
        missing = _update(information + missing, moved, gradient - before) - information
    return Refined(theta, error, max_iterations, False)


def _update(curvature: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Broyden, Fletcher, Goldfarb and Shanno's update of a curvature (k, k) by the gradient's change over a step."""
    along = float(step @ change)
    bent = curvature @ step
    length = float(step @ bent)
    if along <= 1e-8 * abs(length) or length <= 0.0:
        return curvature
    updated: FloatArray = curvature + np.outer(change, change) / along - np.outer(bent, bent) / length
    return updated
