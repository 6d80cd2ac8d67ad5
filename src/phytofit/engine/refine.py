"""Refinements of a phytomer in a cloud, and where they end."""

from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phytofit.engine.evidence import log_evidence
from phytofit.engine.holes import find_holes
from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior
from phytofit.engine.scoring import Refined, refine
from phytofit.engine.visibility import Hidden
from phytofit.species import Species

__all__ = [
    "COARSE_TOLERANCE",
    "FEW_POINTS",
    "Cloud",
    "Optimum",
    "optimum_near",
    "optimum_of",
    "refinement",
    "terms",
]

FloatArray = NDArray[np.float64]
FEW_POINTS = 1250  # with which a refinement begins, and which decide from where a richer leaf is begun
COARSE_TOLERANCE, FINE_TOLERANCE = 1.0, 3e-3  # nats; the one where it is refined further afterwards
HOLE_ROUNDS = 3  # in which a fit and the holes that it leaves in the leaf come to agree
SAME_SHARE = 0.05


class Cloud(NamedTuple):
    """Points (n, 3), what their labels say (n,) or None, who works on them, for how many each of them stands, and the
    noise of the leaf's, if something is known of it."""

    points: FloatArray
    organ: NDArray[np.int8] | None
    executor: Executor | None
    stride: int = 1
    leaf_noise_cm: float | None = None

    def part(self, n: int) -> "Cloud":
        """Every so-many-th point, n or a little more, with the weight of those that it stands for."""
        stride = max(1, len(self.points) // n)
        organ = None if self.organ is None else self.organ[::stride]
        return self._replace(points=self.points[::stride], organ=organ, stride=self.stride * stride)

    def posterior(
        self, species: Species, *, thick: bool = False, cut: bool = False, hidden: Hidden | None = None
    ) -> Posterior:
        weights = None if self.stride == 1 else np.full(len(self.points), float(self.stride))
        return Posterior.of(
            species,
            self.points,
            thick=thick,
            cut=cut,
            leaf_noise_cm=self.leaf_noise_cm,
            organ=self.organ,
            weights=weights,
            executor=self.executor,
            hidden=hidden,
        )


class Optimum(NamedTuple):
    """Where a refinement ended, evaluated there."""

    posterior: Posterior
    state: State
    at: Evaluation
    converged: bool

    @property
    def log_likelihood(self) -> float:
        """Log probability of the points, each counted for those that it stands for."""
        weights = self.posterior.weights
        return float(self.at.log_p.sum() if weights is None else weights @ self.at.log_p)

    def log_evidence(self, inflation: float) -> float:
        """Log probability of the cloud; see :func:`phytofit.engine.evidence.log_evidence`."""
        return log_evidence(self.posterior, self.state, self.at, inflation)


def optimum_near(
    species: Species,
    state: State,
    cloud: Cloud,
    *,
    thick: bool = False,
    cut: bool = False,
    hidden: Hidden | None = None,
    with_void: bool = False,
    tolerance: float = FINE_TOLERANCE,
) -> Optimum:
    """Where the state leads to; `hidden` is what is known before of what was not seen.

    The void around the leaf's base stays as it is; `with_void`, it is found anew. Models that are compared must have
    the same, for points are always denser beside a larger one.
    """
    for number in range(HOLE_ROUNDS):
        posterior = cloud.posterior(species, thick=thick, cut=cut, hidden=hidden)
        state = posterior.extended(state)
        if number == 0 and len(cloud.points) >= 2 * FEW_POINTS:
            few = cloud.part(FEW_POINTS).posterior(species, thick=thick, cut=cut, hidden=hidden)
            state = state.at(refinement(few, state, tolerance=COARSE_TOLERANCE).theta)
        optimum = optimum_of(posterior, state, tolerance=tolerance)
        state = optimum.state
        hidden = find_holes(posterior, state, optimum.at, with_void=with_void)
        if _alike(hidden, posterior.hidden):
            break
    return optimum


def _alike(one: Hidden | None, other: Hidden | None) -> bool:
    if one is None or other is None:
        return one is other
    if one.void is None or other.void is None:
        same = one.void is other.void
    else:
        apart = float(np.linalg.norm(one.void.center - other.void.center))
        same = max(apart, abs(one.void.radius - other.void.radius)) <= SAME_SHARE * one.void.radius
    return same and bool(np.abs(one.share - other.share).max() <= SAME_SHARE)


def optimum_of(posterior: Posterior, state: State, **limits: Any) -> Optimum:
    """Where the state leads to under this posterior, holes and all."""
    end = refinement(posterior, state, **limits)
    there = state.at(end.theta)
    return Optimum(posterior, there, posterior.evaluate(there), end.converged)


def refinement(posterior: Posterior, state: State, **limits: Any) -> Refined:
    def evaluate(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        return terms(posterior, state.at(theta))

    return refine(evaluate, state.theta, lower=posterior.prior.lower, upper=posterior.prior.upper, **limits)


def terms(posterior: Posterior, state: State) -> tuple[float, FloatArray, FloatArray]:
    """Error, gradient (k,), and Fisher information by the scores' outer product, with the prior's (k, k)."""
    at = posterior.evaluate(state)
    weighted = at.scores if posterior.weights is None else at.scores * posterior.weights[:, np.newaxis]
    return at.error, posterior.gradient(state, at), at.scores.T @ weighted + np.diag(posterior.prior.curvature)
