"""The one loop: cloud -> start pose -> search -> Fit."""

import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.cloud import PointCloud, from_points, remove_outliers, size_cm, thin
from phytofit.distances import DISTANCES, Distance, Reference
from phytofit.errors import SettingError, Status
from phytofit.models import Organ, move
from phytofit.objectives import PaperObjective, Registration
from phytofit.optimize import CrossEntropy, Generation
from phytofit.pose import StartPose, start_poses
from phytofit.species import Species, load_species
from phytofit.traits import CHORD_CM, Trait, measure

__all__ = ["Fit", "fit", "minimise", "parse_up"]

FloatArray = NDArray[np.float64]
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
PREVIEW_SAMPLES, PREVIEW_GENERATIONS, PREVIEW_POINTS = (
    120,
    3,
    1000,
)  # the short search that judges a start pose
SIMILAR_ERROR = (
    1.25  # start poses whose previews end within this factor of the best are judged by plausibility
)
PLAUSIBLE_LEAD = (
    4.0  # by so much less squared Mahalanobis distance from the prior is one of two more plausible
)
CANONICAL_DECIMALS = 6  # cm; hides the rounding of a rotated copy's coordinates
UP_UNKNOWN = "up and down can't be told apart: both were tried, the better is given; state up if it is known"

Progress = Callable[[str, Generation], None]
"""Called after each generation with what is being done and what it left."""


@dataclass(frozen=True)
class Fit:
    """A phytomer model fitted to a cloud.

    ``x`` (k,) are the parameters, in the order of ``species.space``; ``covariance`` (k, k) is the spread of the last
    elite: how far the search has contracted, not how far it is from the truth.  ``pose`` (4, 4) maps the model's frame
    to the cloud's, cm; ``error`` is the distance there, cm; ``registration`` tells how ICP ended (in the start pose's
    frame).  ``reference`` (m, 3) are the points that were fitted, in the cloud's frame, cm.  ``flags`` are remarks on
    the result in plain words, ``notes`` on what was done to the cloud.  ``relative`` says that the cloud had no unit:
    lengths are then relative to each other only.  ``settings`` repeat the run.
    """

    species: Species
    x: FloatArray
    covariance: FloatArray
    pose: FloatArray
    error: float
    registration: Registration
    history: tuple[Generation, ...]
    status: Status
    seed: int
    reference: FloatArray
    flags: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    method: str = "paper"
    relative: bool = False
    scale: float = 1.0
    settings: dict[str, object] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters of Eq. (1) by name; lengths in cm (or relative), angles in degrees."""
        return dict(zip(self.species.space.names, self._in_units(self.x).tolist(), strict=True))

    def _in_units(self, x: FloatArray) -> FloatArray:
        return np.where(np.array(self.species.space.units) == "cm", x * self.scale, x)

    @property
    def organs(self) -> tuple[Organ, ...]:
        """Stem and leaf in the cloud's frame, cm."""
        own = (o.row(0) for o in self.species.model.organs(self.x))
        scaled = tuple(Organ(o.kind, o.axis * self.scale, o.frame, o.half_width * self.scale) for o in own)
        return move(scaled, self.pose)

    @property
    def traits(self) -> list[Trait]:
        """The traits, measured on the fitted organs."""
        chord = np.inf if self.relative else CHORD_CM
        return measure(self.organs, chord_cm=chord, method=self.method, flags=self.flags)

    @property
    def elite_std(self) -> dict[str, float]:
        """Spread of each parameter in the last elite; not an error of the estimate."""
        return dict(
            zip(self.species.space.names, self._in_units(np.sqrt(np.diag(self.covariance))), strict=True)
        )


def parse_up(up: str | ArrayLike | None) -> FloatArray | None:
    """A unit vector (3,) from ``"x" .. "-z"`` or three numbers; None stays None."""
    if up is None:
        return None
    if isinstance(up, str):
        if up not in AXES:
            raise SettingError(f"up: expected one of {', '.join(AXES)}, got {up!r}")
        return np.array(AXES[up], float)
    vector = np.asarray(up, float)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.any(vector):
        raise SettingError(f"up: expected three numbers that are not all zero, got {up!r}")
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def fit(
    cloud: PointCloud | ArrayLike,
    units: str | None = None,
    *,
    species: Species | str | os.PathLike[str] = "sorghum",
    up: str | ArrayLike | None = None,
    method: str = "paper",
    distance: str = "hausdorff",
    n_samples: int = 500,
    n_points: int = 5000,
    n_generations: int = 10,
    elite_fraction: float = 0.1,
    covariance_noise: float = 0.5,
    random_start: bool = False,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit the species' phytomer model to a cloud of one leaf on its piece of stem.

    Parameters
    ----------
    cloud : a PointCloud, or points (n, 3) in `units`, n >= 100, in any orientation
    units : "cm", "mm", "m", or "none" for relative lengths; needed for bare points
    species : name of a species that comes with phytofit, a TOML file, or a Species
    up : "x", "-x", .. "-z" or a vector, where the upward direction is known
    method : "paper", the cross-entropy search of Sodhi et al., IROS 2018
    distance : what is minimised: hausdorff (the paper's), quantile, chamfer, labels
    n_samples, n_points, n_generations : candidates a generation, points a candidate, generations
    elite_fraction, covariance_noise : see :class:`phytofit.CrossEntropy`
    random_start : start the search from means drawn from the prior (as in Fig. 7d), not from the prior's
    seed : the same seed gives the same result, with any number of threads
    threads : how many to work with; as many as there are cores by default

    Raises InputError (a ValueError) for what can't be used, NoPhytomerError where there is no stem with a leaf.
    """
    if method != "paper":
        raise SettingError(f"method: expected 'paper', got {method!r}")
    if distance not in DISTANCES:
        raise SettingError(f"distance: expected one of {', '.join(DISTANCES)}, got {distance!r}")
    for name, value, least in (("points", n_points, 100), ("seed", seed, 0), ("threads", threads, 1)):
        if value is not None and value < least:
            raise SettingError(f"{name}: expected {least} or more, got {value}")
    direction = parse_up(up)
    species = species if isinstance(species, Species) else load_species(os.fspath(species))
    cloud = cloud if isinstance(cloud, PointCloud) else from_points(cloud, units)
    search = partial(
        CrossEntropy,
        species.space,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        mean=_random_mean(species, seed) if random_start else None,
        seed=seed,
    )
    search(n_samples=n_samples, n_generations=n_generations)  # settings are checked before any work is done

    keep = remove_outliers(cloud.points)
    clean = cloud.take(keep)
    relative = cloud.unit == "none"
    scale = size_cm(clean.points) / _expected_size(species) if relative else 1.0
    starts = start_poses(clean.points / scale, _largest_stem_radius(species), up=direction)

    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as executor:
        frame = partial(_Frame, clean, scale, species, DISTANCES[distance], seed=seed, executor=executor)

        def preview(start: StartPose) -> CrossEntropy:
            short = search(n_samples=min(PREVIEW_SAMPLES, n_samples), n_generations=PREVIEW_GENERATIONS)
            minimise(short, frame(start, min(PREVIEW_POINTS, n_points)).objective)
            return short

        chosen, undecided = _choose(starts, [preview(start) for start in starts], species)
        candidates = []
        for number, start in enumerate(chosen, start=1):
            what = "search" if len(chosen) == 1 else f"search {number} of {len(chosen)}"
            full, framed = search(n_samples=n_samples, n_generations=n_generations), frame(start, n_points)
            minimise(full, framed.objective, progress and partial(progress, what))
            candidates.append((*framed.objective.register(full.mean), full, framed))
    registration, error, full, framed = min(candidates, key=lambda candidate: candidate[1])

    status = Status.CONVERGED if error <= full.history[-1].threshold else Status.SPLIT_ELITE
    pose = framed.start.pose @ registration.T_target_source
    pose[:3, 3] *= scale
    return Fit(
        species=species,
        x=full.mean,
        covariance=full.history[-1].cov,
        pose=pose,
        error=error * scale,
        registration=registration,
        history=tuple(full.history),
        status=status,
        seed=seed,
        reference=clean.points[framed.kept],
        flags=(UP_UNKNOWN,) * undecided + ((status.value,) if status is Status.SPLIT_ELITE else ()),
        notes=(*cloud.notes, *_what_was_left_out(len(cloud), len(clean), len(framed.kept))),
        method=method,
        relative=relative,
        scale=scale,
        settings={
            "method": method,
            "distance": distance,
            "n_samples": n_samples,
            "n_points": n_points,
            "n_generations": n_generations,
            "elite_fraction": elite_fraction,
            "covariance_noise": covariance_noise,
            "random_start": random_start,
            "up": None if direction is None else direction.tolist(),
        },
    )


def minimise(
    search: CrossEntropy,
    objective: Callable[[FloatArray, int], FloatArray],
    progress: Callable[[Generation], None] | None = None,
) -> CrossEntropy:
    """Run the search to its end on ``objective(xs (n, k), n_elite) -> errors (n,)`` and return it."""
    while not search.done:
        xs = search.ask()
        generation = search.tell(xs, objective(xs, search.n_elite))
        if progress is not None:
            progress(generation)
    return search


class _Frame:
    """The cloud seen from one start pose: upright, thinned there, with the objective on it."""

    def __init__(
        self,
        cloud: PointCloud,
        scale: float,
        species: Species,
        distance: Callable[[Reference], Distance],
        start: StartPose,
        n_points: int,
        *,
        seed: int,
        executor: Executor,
    ) -> None:
        self.start = start
        upright = (cloud.points / scale - start.pose[:3, 3]) @ start.pose[:3, :3]
        upright = np.round(upright, CANONICAL_DECIMALS)
        self.kept = thin(upright, n_points)
        # labels count 0 unknown, 1 stem, 2.. leaves; organs 0 stem, 1 leaf, -1 unknown
        organ = None if cloud.labels is None else np.clip(cloud.labels[self.kept] - 1, -1, 1).astype(np.int8)
        self.objective = PaperObjective(
            species.model,
            Reference.of(upright[self.kept], organ),
            n_points=n_points,
            distance=distance,
            seed=seed,
            executor=executor,
        )


def _choose(
    starts: list[StartPose], previews: list[CrossEntropy], species: Species
) -> tuple[list[StartPose], bool]:
    """The start pose to search from, by short searches from each; or two, and True, if up and down look alike.

    Of the poses that fit about as well as the best, the one counts whose leaf is most plausible: leaves leave the
    stem upwards and bend down.
    """
    errors = np.array(
        [np.mean([preview.history[-1].threshold, preview.history[-1].best_error]) for preview in previews]
    )
    shape = [species.space.index(name) for name in ("leaf_angle", "leaf_rotate_angle")]
    surprise = np.array(
        [
            np.sum(((preview.mean[shape] - species.space.mean[shape]) / species.space.std[shape]) ** 2)
            for preview in previews
        ]
    )
    similar = np.flatnonzero(errors <= SIMILAR_ERROR * errors.min())
    best = similar[np.argmin(surprise[similar])]
    rivals = [
        i
        for i in similar
        if starts[i].pose[:3, 2] @ starts[best].pose[:3, 2] < -0.5
        and surprise[i] - surprise[best] < PLAUSIBLE_LEAD
    ]
    if rivals:
        return [starts[best], starts[min(rivals, key=lambda i: surprise[i])]], True
    return [starts[best]], False


def _what_was_left_out(n_read: int, n_clean: int, n_kept: int) -> list[str]:
    said = []
    if n_clean < n_read:
        said.append(f"{n_read - n_clean} of {n_read} points removed as outliers")
    if n_kept < n_clean:
        said.append(f"{n_clean} points thinned to {n_kept}")
    return said


def _largest_stem_radius(species: Species) -> float:
    i = species.space.index("stem_diameter")
    return float(0.5 * (species.space.mean[i] + 2.0 * species.space.std[i]))


def _expected_size(species: Species) -> float:
    """Size, as :func:`size_cm` takes it, of the phytomer that the prior expects."""
    nodes = np.concatenate([o.axis[0] for o in species.model.organs(species.space.mean)])
    return size_cm(nodes)


def _random_mean(species: Species, seed: int) -> FloatArray:
    """A start drawn from the prior within its bounds (Fig. 7d)."""
    drawn: FloatArray = CrossEntropy(species.space, n_samples=2, elite_fraction=0.9, seed=seed).ask()[0]
    return drawn
