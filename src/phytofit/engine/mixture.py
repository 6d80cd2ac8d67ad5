"""A mixture of organs over a background: the density of points, and its derivatives, organ by organ."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from phytofit.kernels.likelihood import add_scores, strip_density, tube_density

__all__ = ["Component", "Evaluation", "Mixture", "Side", "Strip", "Tube"]

FloatArray = NDArray[np.float64]
BLOCK = 500  # points that a thread takes at a time


class Component(Protocol):
    """An organ as the mixture sees it."""

    @property
    def columns(self) -> NDArray[np.intp]:
        """Entries of theta by which its density is derived, in the order of the derivatives."""

    def add(self, points: FloatArray, weight: FloatArray, density: FloatArray, derivative: FloatArray) -> None:
        """Add its density at points (n, 3), times `weight` (n,), to `density` (n,), and the derivatives to
        `derivative` (n, c), or to none of (0, 0)."""


@dataclass(frozen=True)
class Tube:
    """A stem: segments as :func:`phytofit.kernels.likelihood.tube_density` takes them.

    ``area_by_facing`` (2,) is the change of the logarithm of its area, as far as it was seen, by where its points face.
    """

    columns: NDArray[np.intp]
    origin: FloatArray
    frame: FloatArray
    length: FloatArray
    radius: FloatArray
    area: float
    facing: FloatArray
    noise: float
    change: FloatArray
    area_change: FloatArray
    area_by_facing: FloatArray

    def add(self, points: FloatArray, weight: FloatArray, density: FloatArray, derivative: FloatArray) -> None:
        tube_density(
            points, weight, self.origin, self.frame, self.length, self.radius, self.area, self.facing, self.noise,
            self.change, self.area_change, density, derivative,
        )  # fmt: skip
        if len(derivative):
            k = len(self.area_change)
            derivative[:, k : k + 2] -= np.outer(density, self.area_by_facing)


class Side(NamedTuple):
    """A strip, or what of it lies to one side of its fold: frames (m, 3, 3), how many half widths it reaches to the
    right and left of the midrib (1 or 0), and how its segments change (m, 9, k)."""

    frame: FloatArray
    right: float
    left: float
    change: FloatArray


@dataclass(frozen=True)
class Strip:
    """A leaf: segments as :func:`phytofit.kernels.likelihood.strip_density` takes them, of one side or of two."""

    columns: NDArray[np.intp]
    origin: FloatArray
    length: FloatArray
    half: FloatArray
    sides: tuple[Side, ...]
    area: float
    noise: FloatArray
    area_change: FloatArray

    def add(self, points: FloatArray, weight: FloatArray, density: FloatArray, derivative: FloatArray) -> None:
        for side in self.sides:
            strip_density(
                points, weight, self.origin, side.frame, self.length, self.half, side.right, side.left, self.area,
                self.noise, side.change, self.area_change, density, derivative,
            )  # fmt: skip


@dataclass(frozen=True)
class Evaluation:
    """``error``: minus the log posterior, nats; ``log_p`` (n,): log densities of the points; ``responsibilities``
    (n, organs + 1): probabilities that they are of each organ, or of none; ``scores`` (n, m): derivatives of log_p."""

    error: float
    log_p: FloatArray
    responsibilities: FloatArray
    scores: FloatArray


@dataclass(frozen=True)
class Mixture:
    """Organs over a background.

    ``share`` (organs + 1,) of the points: each organ, then the background, whose density is ``background`` (n,) at each
    point: that of outliers, or of all organs that are held while the others are refined.  ``share_columns``
    (organs + 1,) are the entries of theta that hold the logits of the shares, -1 for that to which the others relate.
    """

    organs: Sequence[Component]
    share: FloatArray
    share_columns: NDArray[np.intp]
    background: FloatArray

    def evaluate(
        self,
        points: FloatArray,
        weights: Sequence[FloatArray],
        n_entries: int,
        *,
        derivatives: bool = True,
        executor: Executor | None = None,
    ) -> Evaluation:
        """Of points (n, 3); each organ has a weight (n,) at them, which says how far its points were detected there,
        and agree with their labels.  ``n_entries`` of theta; the error is that of the points alone."""
        n = len(points)
        log_p = np.empty(n)
        responsibilities = np.empty((n, len(self.share)))
        scores = np.zeros((n if derivatives else 0, n_entries))

        def block(first: int) -> None:
            part = slice(first, first + BLOCK)
            here = points[part]
            found = [self._of_organ(i, here, weights[i][part], derivatives) for i in range(len(self.organs))]
            dense = np.stack([*(density for density, _ in found), self.background[part]], axis=1) * self.share
            p = dense.sum(axis=1)
            log_p[part] = np.log(p)
            responsibilities[part] = dense / p[:, np.newaxis]
            if derivatives:
                for i, (_, derivative) in enumerate(found):
                    add_scores(self.share[i] / p, derivative, self.organs[i].columns, scores[part])
                for i in np.flatnonzero(self.share_columns >= 0).tolist():
                    scores[part, self.share_columns[i]] = responsibilities[part, i] - self.share[i]

        run(block, range(0, n, BLOCK), executor)
        return Evaluation(-float(log_p.sum()), log_p, responsibilities, scores)

    def _of_organ(
        self, i: int, points: FloatArray, weight: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray]:
        organ, n = self.organs[i], len(points)
        density, derivative = np.zeros(n), np.zeros((n, len(organ.columns)) if derivatives else (0, 0))
        organ.add(points, weight, density, derivative)
        return density, derivative


def run(block: Callable[[int], None], firsts: range, executor: Executor | None) -> None:
    """Do the blocks, on the executor if there is one."""
    for _ in map(block, firsts) if executor is None else executor.map(block, firsts):
        pass
