"""A short cross-entropy search with few points, which finds where the default method begins."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phytofit.paper.cross_entropy import CrossEntropy, Generation
from phytofit.paper.distances import Reference, chamfer
from phytofit.paper.objective import PaperObjective, minimise
from phytofit.species import Species

__all__ = ["SCOUTING", "scout"]

FloatArray = NDArray[np.float64]
Start = tuple[FloatArray, FloatArray]
SCOUTING: dict[str, Any] = {"scout_stride": 4, "tilts_deg": ()}  # few points, and no leaf from two sides


def scout(
    species: Species,
    points: FloatArray,
    starts: Sequence[Start],
    *,
    n_samples: int = 60,
    n_points: int = 200,
    n_generations: int = 4,
    elite_fraction: float = 0.1,
    covariance_noise: float = 0.5,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[Generation], None] | None = None,
) -> tuple[Start, tuple[Generation, ...]]:
    """Parameters (k,) and pose (4, 4) near those that explain points (n, 3), and how the search went.

    starts : parameters (k,) and pose (4, 4) of the model's frame to begin from, each; the first is the search's mean
    """
    search = CrossEntropy(
        species.space,
        n_samples=n_samples,
        n_generations=n_generations,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        mean=starts[0][0],
        seed=seed,
    )
    stride = max(1, round(len(points) / n_points))
    objective = PaperObjective(
        species.model,
        Reference.of(points[::stride], None),
        starts=[_at_junction(mean, pose) for mean, pose in starts],
        n_points=n_points,
        distance=chamfer,
        **SCOUTING,
        seed=seed,
        executor=executor,
    )
    minimise(search, objective, progress)
    registration, _ = objective.register(search.mean)
    return (search.mean, registration.T_target_source), tuple(search.history)


def _at_junction(mean: FloatArray, pose: FloatArray) -> FloatArray:
    """The start as :class:`PaperObjective` takes it: with the junction of leaf and stem as its origin."""
    at = pose.copy()
    at[:3, 3] += pose[:3, 2] * mean[1]
    return at
