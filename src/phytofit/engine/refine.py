"""Refinements of a phytomer in a cloud, and where they end."""

from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phytofit.engine.holes import find_holes
from phytofit.engine.likelihood import CloudLikelihood, Evaluation, State
from phytofit.engine.scoring import Refined, refine
from phytofit.engine.visibility import Hidden
from phytofit.species import Species

__all__ = [
    "COARSE_TOLERANCE",
    "FEW_POINTS",
    "Cloud",
    "End",
    "evidence_of",
    "refined_end",
    "refinement",
    "terms",
]

FloatArray = NDArray[np.float64]
FEW_POINTS = 1250  # with which a refinement begins, and which decide from where a richer leaf is begun
COARSE_TOLERANCE = 1.0  # nats; it is refined with all points afterwards
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

    def likelihood(self, species: Species, **settings: Any) -> CloudLikelihood:
        weights = None if self.stride == 1 else np.full(len(self.points), float(self.stride))
        return CloudLikelihood(
            species.model,
            species.space,
            self.points,
            organ=self.organ,
            weights=weights,
            leaf_noise_cm=self.leaf_noise_cm,
            executor=self.executor,
            **settings,
        )


class End(NamedTuple):
    """Where a refinement ended, evaluated there."""

    likelihood: CloudLikelihood
    state: State
    at: Evaluation
    converged: bool

    @property
    def fit_of_points(self) -> float:
        """Log probability of the points, each counted for those that it stands for."""
        weights = self.likelihood.weights
        return float(self.at.log_p.sum() if weights is None else weights @ self.at.log_p)


def refined_end(
    species: Species,
    state: State,
    cloud: Cloud,
    *,
    thick: bool = False,
    cut: bool = False,
    hidden: Hidden | None = None,
    with_void: bool = False,
) -> End:
    """Where the state leads to; `hidden` is what is known before of what was not seen.

    The void around the leaf's base stays as it is; `with_void`, it is found anew. Models that are compared must have
    the same, for points are always denser beside a larger one.
    """
    for number in range(HOLE_ROUNDS):
        likelihood = cloud.likelihood(species, thick=thick, cut=cut, hidden=hidden)
        state = likelihood.extended(state)
        if number == 0 and len(cloud.points) >= 2 * FEW_POINTS:
            few = cloud.part(FEW_POINTS).likelihood(species, thick=thick, cut=cut, hidden=hidden)
            state = likelihood.with_theta(state, refinement(few, state, tolerance=COARSE_TOLERANCE).theta)
        end = refinement(likelihood, state)
        state = State(end.theta, state.pose, state.center)
        at = likelihood.evaluate(state)
        hidden = find_holes(likelihood, state, at.scores, with_void=with_void)
        if _alike(hidden, likelihood.hidden):
            break
    return End(likelihood, state, at, end.converged)


def _alike(one: Hidden | None, other: Hidden | None) -> bool:
    if one is None or other is None:
        return one is other
    if one.void is None or other.void is None:
        same = one.void is other.void
    else:
        apart = float(np.linalg.norm(one.void.center - other.void.center))
        same = max(apart, abs(one.void.radius - other.void.radius)) <= SAME_SHARE * one.void.radius
    return same and bool(np.abs(one.share - other.share).max() <= SAME_SHARE)


def refinement(likelihood: CloudLikelihood, state: State, **limits: Any) -> Refined:
    def evaluate(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        return terms(likelihood, likelihood.with_theta(state, theta))

    return refine(evaluate, state.theta, lower=likelihood.lower, upper=likelihood.upper, **limits)


def terms(likelihood: CloudLikelihood, state: State) -> tuple[float, FloatArray, FloatArray]:
    """Error, gradient (k,), and Fisher information by the scores' outer product, with the prior's (k, k)."""
    at = likelihood.evaluate(state)
    weighted = at.scores if likelihood.weights is None else at.scores * likelihood.weights[:, np.newaxis]
    return at.error, likelihood.gradient(state, at), at.scores.T @ weighted + np.diag(likelihood.pull)


def evidence_of(end: End, inflation: float) -> float:
    """Laplace's approximation of the log probability of the cloud under the model, up to a constant of the cloud.

    Points whose errors depend on each other count as `inflation` times fewer.
    """
    likelihood, theta, free, at = end.likelihood, end.state.theta, end.likelihood.free, end.at
    precision = likelihood.precision[free]
    information = (at.scores.T @ at.scores)[np.ix_(free, free)] / inflation + np.diag(precision)
    surprise = 0.5 * np.sum((theta - likelihood.mean)[free] ** 2 * precision)
    prior = 0.5 * np.sum(np.log(precision[precision > 0.0]))
    return float(at.log_p.sum() / inflation - surprise + prior - 0.5 * np.linalg.slogdet(information)[1])
