"""The paper's objective: candidates -> organs -> points -> ICP -> distance to the reference (sections IV-A to IV-C)."""

import heapq
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phytofit.distances import Distance, Reference, hausdorff
from phytofit.kernels.icp import icp, transform
from phytofit.models import Phytomer, SurfaceSampler
from phytofit.models.organs import PopulationSurfaces

__all__ = ["PaperObjective", "Registration"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
BLOCK = 10  # candidates that a thread takes at a time
SHORTLIST = 2  # times the elite's size: so many candidates are tried from the further starts


@dataclass(frozen=True)
class Registration:
    """How a source cloud was laid on a target: ``p -> T_target_source p``.

    ``rmse`` is the root mean square distance of the last matches, cm; ``converged`` says whether the pose had come to
    rest within ``iterations``.
    """

    T_target_source: FloatArray
    rmse: float
    iterations: int
    converged: bool


def _tilted(degrees: float) -> FloatArray:
    """Rotation (3, 3) about y: the leaf dips (positive) or lifts."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


class PaperObjective:
    """E(X) of section IV-C: sample the model's surface, align it with ICP, take the distance.

    The reference stands in the start pose: model upright, leaf towards +x, origin where the leaf joins the stem's
    axis.  ICP begins with the model's own junction there, on every `coarse_stride`-th point, and goes on with all of
    them; the distance is exact at the pose it ends in.  Where it ends depends on where it begins, so it begins
    anew with the model tilted by each of `tilts_deg`, and the smallest distance counts.

    Common random numbers: the same x always gets the same points, and so the same error.
    """

    def __init__(
        self,
        model: Phytomer,
        reference: Reference,
        *,
        n_points: int = 5000,
        distance: Callable[[Reference], Distance] = hausdorff,
        coarse_stride: int = 5,
        coarse_iterations: int = 30,
        iterations: int = 30,
        tolerance_cm: float = 1e-3,
        memory: int = 5,
        tilts_deg: tuple[float, ...] = (0.0, 9.0, -9.0),
        seed: int = 0,
        executor: Executor | None = None,
    ) -> None:
        self._model = model
        self._reference = reference
        self._distance = distance(reference)
        self._sampler = SurfaceSampler(n_points, seed)
        self._coarse = (coarse_iterations, tolerance_cm, memory)
        self._fine = (iterations, tolerance_cm, memory)
        self._stride = coarse_stride
        self._starts = [_tilted(degrees) for degrees in tilts_deg]
        self._executor = executor

    def __call__(self, xs: FloatArray, n_elite: int | None = None) -> FloatArray:
        """Errors (n,) of the candidates xs (n, k), cm.

        Given `n_elite`, only so many of the smallest errors are wanted, and the others come back as ``inf``.  All
        candidates are then tried from the first start and the best `SHORTLIST` times n_elite from the further ones;
        and a distance is given up as soon as it is proved larger than that many others.  Neither depends on the
        number of threads.
        """
        organs = self._model.organs(xs)
        surfaces, junction = self._sampler.population(organs), organs[1].axis[:, 0]
        every = range(len(xs))
        if n_elite is None:
            return self._errors(surfaces, junction, every, self._starts, len(xs))
        n_short = min(SHORTLIST * n_elite, len(xs))
        errors = _largest_to_inf(self._errors(surfaces, junction, every, self._starts[:1], n_short), n_short)
        if len(self._starts) > 1:
            short = np.flatnonzero(np.isfinite(errors))
            again = self._errors(surfaces, junction, short.tolist(), self._starts[1:], n_elite)
            errors[short] = np.minimum(errors[short], again)
        return _largest_to_inf(errors, min(n_elite, len(xs)))

    def register(self, x: FloatArray) -> tuple[Registration, float]:
        """The pose of one candidate x (k,), from the model's frame to the reference's, and its error, cm."""
        organs = self._model.organs(x)
        surfaces, junction = self._sampler.population(organs), organs[1].axis[:, 0]
        tries = [self._from_start(surfaces, junction, 0, start, np.inf) for start in self._starts]
        error, registration = min(tries, key=lambda result: result[0])
        return registration(), error

    def _errors(
        self, surfaces: PopulationSurfaces, junction: FloatArray, which: "range | list[int]", starts: list[FloatArray], n: int
    ) -> FloatArray:  # fmt: skip
        """Least error over the starts of the candidates `which`; only the n smallest are exact."""
        level = _Level(n)

        def block(first: int) -> list[float]:
            errors = []
            for i in which[first : first + BLOCK]:
                error = np.inf
                for start in starts:
                    error = min(
                        error, self._from_start(surfaces, junction, i, start, min(error, level.limit))[0]
                    )
                level.add(error)
                errors.append(error)
            return errors

        firsts = range(0, len(which), BLOCK)
        blocks: Iterable[list[float]] = (
            map(block, firsts) if self._executor is None else self._executor.map(block, firsts)
        )
        return np.array([error for errors in blocks for error in errors])

    def _from_start(
        self, surfaces: PopulationSurfaces, junction: FloatArray, i: int, start: FloatArray, limit: float
    ) -> tuple[float, Callable[[], Registration]]:
        """Error of candidate i with ICP from one start; exact up to `limit`."""
        points, organ = surfaces.draw(i)
        grid = self._reference.grid
        coarse, coarse_mean = _centered(np.ascontiguousarray(points[:, :: self._stride]))
        r, t, *_ = icp(coarse, grid, start, start @ (coarse_mean - junction[i]), *self._coarse)
        source, mean = _centered(points)
        r, t, mse, iterations, converged = icp(source, grid, r, t + r @ (mean - coarse_mean), *self._fine)
        transform(source, r, t, points)
        error = self._distance(points, organ, limit)

        def registration() -> Registration:
            pose = np.eye(4)
            pose[:3, :3] = r
            pose[:3, 3] = t - r @ mean
            return Registration(pose, float(np.sqrt(mse)), int(iterations), bool(converged))

        return error, registration


def _centered(points: Float32Array) -> tuple[Float32Array, FloatArray]:
    """Points (3, n) about their mean, and the mean (3,)."""
    mean = points.mean(axis=1)
    return points - mean[:, np.newaxis], mean.astype(float)


def _largest_to_inf(errors: FloatArray, n: int) -> FloatArray:
    """The n smallest errors, those that tie with the n-th too, and ``inf`` in place of the rest."""
    return np.where(errors <= np.partition(errors, n - 1)[n - 1], errors, np.inf)


class _Level:
    """The n-th smallest error so far: a candidate that is proved worse can't be among the n best."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._worst_first: list[float] = []
        self._lock = threading.Lock()

    @property
    def limit(self) -> float:
        with self._lock:
            return -self._worst_first[0] if len(self._worst_first) >= self._n else np.inf

    def add(self, error: float) -> None:
        with self._lock:
            if len(self._worst_first) < self._n:
                heapq.heappush(self._worst_first, -error)
            elif error < -self._worst_first[0]:
                heapq.heapreplace(self._worst_first, -error)
