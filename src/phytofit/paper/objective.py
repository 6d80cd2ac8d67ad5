"""The paper's objective: candidates -> organs -> points -> ICP -> distance to the reference (sections IV-A to IV-C)."""

import heapq
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import SettingError
from phytofit.kernels.icp import MAX_MEMORY, icp, transform
from phytofit.models import Phytomer, SurfaceSampler
from phytofit.models.organs import PopulationSurfaces
from phytofit.paper.distances import Distance, Reference, hausdorff

__all__ = ["Optimiser", "PaperObjective", "Registration", "minimise"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
OrganArray = NDArray[np.int8]
_Round = tuple[int, tuple[int, float, int]]  # every how many-th point; iterations, tolerance, memory
BLOCK = 10  # candidates that a thread takes at a time
SearchT = TypeVar("SearchT", bound="Optimiser")
SHORTLIST = 2  # times the elite's size: so many candidates go on to the fine round


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


class _Placed(NamedTuple):
    """A candidate laid on the reference."""

    error: float
    registration: Registration
    start: int = 0  # the number of the start that it came from


class _Population(NamedTuple):
    """Candidates ready to be sampled, and where the leaf of each joins the stem's axis, (n, 3)."""

    surfaces: PopulationSurfaces
    junction: FloatArray


class PaperObjective:
    """E(X) of section IV-C: sample the model's surface, align it with ICP, take the distance.

    The reference stands upright as seen from one start pose; `starts` (4, 4) each say where the model may begin
    there: its directions, and the place of its junction of leaf and stem.  ICP goes from coarse to fine: with a few
    points from every start, with more from where those fitted best, with all at last.  The distance is exact at the
    pose it ends in.  Where ICP ends depends on where it begins, so the last rounds are run again with the leaf tilted
    up and down by each of `tilts_deg`, and the smallest distance counts.

    Common random numbers: the same x always gets the same points, and so the same error.
    """

    def __init__(
        self,
        model: Phytomer,
        reference: Reference,
        *,
        starts: Sequence[FloatArray] = (np.eye(4),),
        n_points: int = 5000,
        distance: Callable[[Reference], Distance] = hausdorff,
        scout_stride: int = 20,
        scout_iterations: int = 15,
        coarse_stride: int = 3,
        coarse_iterations: int = 20,
        iterations: int = 20,
        tolerance_cm: float = 1e-3,
        memory: int = 5,
        tilts_deg: tuple[float, ...] = (9.0, -9.0, 18.0, -18.0),
        seed: int = 0,
        executor: Executor | None = None,
    ) -> None:
        if not 0 <= memory <= MAX_MEMORY:
            raise SettingError(f"memory: expected 0 to {MAX_MEMORY}, got {memory}")
        self._model = model
        self._reference = reference
        self._starts = list(starts)
        self._distance = distance(reference)
        self._sampler = SurfaceSampler(n_points, seed)
        self._scout = (scout_stride, (scout_iterations, tolerance_cm, memory))
        self._coarse = (coarse_stride, (coarse_iterations, tolerance_cm, memory))
        self._fine = (1, (iterations, tolerance_cm, memory))
        self._tilts = [_about_y(degrees) for degrees in tilts_deg]
        self._executor = executor

    def __call__(self, xs: FloatArray, n_elite: int | None = None) -> FloatArray:
        """Errors (n,) of the candidates xs (n, k), cm.

        Given `n_elite`, only so many of the smallest errors are wanted, and the others come back as ``inf``: only the
        `SHORTLIST` times n_elite candidates that look best after the coarse round go on to the fine one, and a
        distance is given up as soon as it is proved larger than so many others.  Neither depends on the number of
        threads.
        """
        population = self._population(xs)
        if n_elite is None:
            placed = self._in_blocks(range(len(xs)), len(xs), lambda i, limit: self._register(population, i))
            return np.array([each.error for each in placed])
        n_short, n_elite = min(SHORTLIST * n_elite, len(xs)), min(n_elite, len(xs))
        first = self._in_blocks(range(len(xs)), n_short, lambda i, limit: self._roughly(population, i, limit))
        errors = _largest_to_inf(np.array([placed.error for placed in first]), n_short)
        short = np.flatnonzero(np.isfinite(errors)).tolist()
        again = self._in_blocks(short, n_elite, lambda i, limit: self._finely(population, i, first[i], limit))
        errors[short] = [placed.error for placed in again]
        return _largest_to_inf(errors, n_elite)

    def register(self, x: FloatArray) -> tuple[Registration, float]:
        """The pose of one candidate x (k,), from the model's frame to the reference's, and its error, cm."""
        placed = self._register(self._population(x), 0)
        return placed.registration, placed.error

    def _population(self, xs: FloatArray) -> _Population:
        organs = self._model.organs(xs)
        return _Population(self._sampler.population(organs), organs[1].axis[:, 0])

    def _register(self, population: _Population, i: int) -> _Placed:
        return self._finely(population, i, self._roughly(population, i, 0.0), np.inf)

    def _in_blocks(self, which: Sequence[int], n_best: int, place: Callable[[int, float], _Placed]) -> list[_Placed]:
        """Place the candidates `which` on the executor's threads; only the errors of the n_best are exact."""
        level = _Level(n_best)

        def block(first: int) -> list[_Placed]:
            placed = []
            for i in which[first : first + BLOCK]:
                placed.append(place(i, level.limit))
                level.add(placed[-1].error)
            return placed

        firsts = range(0, len(which), BLOCK)
        blocks: Iterable[list[_Placed]] = (
            map(block, firsts) if self._executor is None else self._executor.map(block, firsts)
        )
        return [placed for placed_of_block in blocks for placed in placed_of_block]

    def _roughly(self, population: _Population, i: int, limit: float) -> _Placed:
        """ICP with a few points from every start, then with more from the best; error exact up to `limit`."""
        points, organ = population.surfaces.draw(i)
        junction = population.junction[i]
        poses = _poses_at(junction, self._starts)
        scouted = [self._align(points, pose, self._scout).rmse for pose in poses] if len(poses) > 1 else [0.0]
        start = int(np.argmin(scouted))
        return self._place(points, organ, poses[start], self._coarse, limit)._replace(start=start)

    def _finely(self, population: _Population, i: int, rough: _Placed, limit: float) -> _Placed:
        """ICP with all points from where a candidate was placed, and anew from its start with the leaf tilted."""
        points, organ = population.surfaces.draw(i)
        start = self._starts[rough.start]
        best = self._place(points, organ, rough.registration.T_target_source, self._fine, limit)
        for tilted in _poses_at(population.junction[i], [start @ tilt for tilt in self._tilts]):
            pose = self._align(points, tilted, self._coarse).T_target_source
            again = self._place(points, organ, pose, self._fine, min(best.error, limit))
            best = min(best, again, key=lambda placed: placed.error)
        return best

    def _place(self, points: Float32Array, organ: OrganArray, pose: FloatArray, how: _Round, limit: float) -> _Placed:
        """ICP from a pose, and the distance of all points where it ends, exact up to `limit`."""
        registration = self._align(points, pose, how)
        moved = np.empty_like(points)
        transform(points, registration.T_target_source[:3, :3], registration.T_target_source[:3, 3], moved)
        return _Placed(self._distance(moved, organ, limit), registration)

    def _align(self, points: Float32Array, pose: FloatArray, how: _Round) -> Registration:
        """ICP of every stride-th of the points (3, n) from a pose."""
        stride, settings = how
        chosen = points[:, ::stride]
        mean = chosen.mean(axis=1)
        source = np.subtract(chosen, mean[:, np.newaxis], order="C")
        rotation = np.ascontiguousarray(pose[:3, :3])
        r, t, mse, iterations, converged = icp(
            source, self._reference.grid, rotation, rotation @ mean + pose[:3, 3], *settings
        )
        aligned = np.eye(4)
        aligned[:3, :3] = r
        aligned[:3, 3] = t - r @ mean
        return Registration(aligned, float(np.sqrt(mse)), int(iterations), bool(converged))


class Optimiser(Protocol):
    """What searches: :class:`CrossEntropy`, or another."""

    @property
    def done(self) -> bool:
        """Whether the search is over."""

    @property
    def n_elite(self) -> int | None:
        """How many of the smallest errors it uses; None if it needs all."""

    def ask(self) -> FloatArray:
        """Candidates (n, k)."""

    def tell(self, xs: FloatArray, errors: FloatArray) -> Any:
        """Take the errors (n,) of candidates (n, k), inf of some that are not of the elite; what it returns goes to
        `progress`."""


def minimise(
    search: SearchT,
    objective: Callable[[FloatArray, int | None], FloatArray],
    progress: Callable[[Any], None] | None = None,
) -> SearchT:
    """Run the search to its end on ``objective(xs (n, k), n_elite) -> errors (n,)`` and return it, with
    `progress` called after each generation."""
    while not search.done:
        xs = search.ask()
        generation = search.tell(xs, objective(xs, search.n_elite))
        if progress is not None:
            progress(generation)
    return search


def _poses_at(junction: FloatArray, starts: Sequence[FloatArray]) -> list[FloatArray]:
    """Poses (4, 4) of the model's frame that bring its junction (3,) to the origin of each start."""
    poses = []
    for start in starts:
        pose = start.copy()
        pose[:3, 3] -= start[:3, :3] @ junction
        poses.append(pose)
    return poses


def _about_y(degrees: float) -> FloatArray:
    """Pose (4, 4) turned about y: a leaf towards +x dips (positive) or lifts."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 0.0], [0.0, 0.0, 0.0, 1.0]])


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
