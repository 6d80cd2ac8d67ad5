"""The one loop: cloud -> start pose -> search -> Fit."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.cloud import PointCloud, from_points, remove_outliers, size_cm, thin
from phytofit.distances import DISTANCES, Reference
from phytofit.errors import SettingError, Status
from phytofit.models import Organ, move
from phytofit.objectives import PaperObjective, Registration
from phytofit.optimize import CrossEntropy, Generation
from phytofit.parameters import ParameterSpace
from phytofit.pose import StartPose, start_poses
from phytofit.species import Species, load_species
from phytofit.traits import Trait, measure

__all__ = ["Fit", "fit", "minimise", "parse_up"]

FloatArray = NDArray[np.float64]
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
PLAUSIBLE_LEAD = 4.0  # by so much less squared Mahalanobis distance from the prior is one of two more plausible
CANONICAL_DECIMALS = 6  # cm; hides the rounding of a rotated copy's coordinates
UP_DOUBTFUL = "the leaf leaves the stem downwards or bends up: is the stated up right?"
UP_UNKNOWN = "up and down can't be told apart by this leaf: the more plausible is given; state up if it is known"


@dataclass(frozen=True)
class Fit:
    """A phytomer model fitted to a cloud.

    ``x`` (k,) are the parameters, in the order of ``species.space``; ``covariance`` (k, k) is the spread of the last
    elite: how far the search has contracted, not how far it is from the truth.  ``pose`` (4, 4) maps the model's frame
    to the cloud's, cm; ``error`` is the distance there, cm; ``registration`` tells how ICP ended (in the start pose's
    frame).  ``reference`` (m, 3) are the points that were fitted, in the cloud's frame, cm.  ``flags`` are remarks on
    the result in plain words, ``notes`` on what was done to the cloud.  ``relative`` says that the cloud had no unit:
    lengths are then relative to each other only, and ``scale`` of them make a cm of the prior (1 otherwise); `x`,
    `history` and `registration` are in the prior's cm.  ``method`` and ``settings`` repeat the run.
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
        """The traits, measured on the fitted organs; lengths in "rel" in place of "cm" where the cloud had no unit."""
        if not self.relative:
            return measure(self.organs, method=self.method, flags=self.flags)
        traits = measure(self.organs, chord_cm=np.inf, method=self.method, flags=self.flags)
        return [replace(trait, unit=trait.unit.replace("cm", "rel")) for trait in traits]

    @property
    def elite_std(self) -> dict[str, float]:
        """Spread of each parameter in the last elite; not an error of the estimate."""
        return dict(zip(self.species.space.names, self._in_units(np.sqrt(np.diag(self.covariance))), strict=True))


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
    stem_above: bool = True,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[Generation], None] | None = None,
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
    random_start : start the search from means drawn from the prior (as in Fig. 7d), not from the prior's and, for
        the stem's lengths, from the start pose
    stem_above : whether the stem may go on above the leaf; False is the paper's model of six parameters, Eq. (1)
    seed : the same seed gives the same result, with any number of threads
    threads : how many to work with; as many as there are cores by default
    progress : called after each generation with what it left

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
    if not isinstance(cloud, PointCloud):
        cloud = from_points(cloud, units)
    elif units not in (None, cloud.unit):
        raise SettingError(f"units: {cloud.name} was read in {cloud.unit}, got {units!r}; leave units out")
    if not stem_above:
        species = species.without("stem_length_above")
    search = partial(
        CrossEntropy,
        species.space,
        n_samples=n_samples,
        n_generations=n_generations,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        seed=seed,
    )
    search()  # checks its settings before any work is done

    keep = remove_outliers(cloud.points)
    clean = cloud.take(keep)
    relative = cloud.unit == "none"
    scale = size_cm(clean.points) / _expected_size(species) if relative else 1.0
    starts = start_poses(clean.points / scale, _largest_stem_radius(species), up=direction)
    mean = _random_mean(species.space, seed) if random_start else _mean_at(starts[0], species.space)

    # the cloud as it looks from the best start pose, rounded: a rotated copy of the cloud gives the same numbers
    home = starts[0].pose
    upright = np.round((clean.points / scale - home[:3, 3]) @ home[:3, :3], CANONICAL_DECIMALS)
    kept = thin(upright, n_points)
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as executor:
        objective = PaperObjective(
            species.model,
            Reference.of(upright[kept], None if clean.labels is None else _organ_numbers(clean.labels[kept])),
            starts=[np.round(_rigid_inverse(home) @ start.pose, CANONICAL_DECIMALS) for start in starts],
            n_points=n_points,
            distance=DISTANCES[distance],
            seed=seed,
            executor=executor,
        )
        last = minimise(search(mean=mean), objective, progress)
        registration, error = objective.register(last.mean)

    status = Status.CONVERGED if error <= last.history[-1].threshold else Status.SPLIT_ELITE
    pose = home @ registration.T_target_source
    pose[:3, 3] *= scale
    result = Fit(
        species=species,
        x=last.mean,
        covariance=last.history[-1].cov,
        pose=pose,
        error=error * scale,
        registration=registration,
        history=tuple(last.history),
        status=status,
        seed=seed,
        reference=clean.points[kept],
        flags=(status.value,) if status is Status.SPLIT_ELITE else (),
        notes=(*cloud.notes, *_what_was_left_out(len(cloud), len(clean), len(kept))),
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
            "stem_above": stem_above,
            "up": None if direction is None else direction.tolist(),
        },
    )
    return _right_way_up(result, direction)


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


def _right_way_up(result: Fit, up: FloatArray | None) -> Fit:
    """The result or its twin that is upside down: the same organs, so that no cloud can tell which is right.

    A stated `up` (3,) decides, and a flag says where the other is clearly more plausible.  Where up is not known, the
    one counts whose leaf is the more plausible by the prior (leaves leave the stem upwards and bend down), and a flag
    says where neither is clearly so.
    """
    space = result.species.space
    if "stem_length_above" not in space.names:
        return result
    turn, offset, pose = result.species.model.upside_down(result.x)
    pose[:3, 3] *= result.scale
    twin = replace(
        result,
        x=turn @ result.x + offset,
        covariance=turn @ result.covariance @ turn.T,
        pose=result.pose @ pose,
        history=tuple(
            replace(g, mean=turn @ g.mean + offset, cov=turn @ g.cov @ turn.T, best_x=turn @ g.best_x + offset)
            for g in result.history
        ),
    )
    shape = [space.index(name) for name in ("leaf_angle", "leaf_rotate_angle")]
    surprise, surprise_of_twin = (
        float(np.sum(((it.x[shape] - space.mean[shape]) / space.std[shape]) ** 2)) for it in (result, twin)
    )
    if up is not None:
        told, doubt = (
            (result, surprise - surprise_of_twin)
            if result.pose[:3, 2] @ up >= 0.0
            else (twin, surprise_of_twin - surprise)
        )
        return replace(told, flags=(*told.flags, UP_DOUBTFUL)) if doubt > PLAUSIBLE_LEAD else told
    better = twin if surprise_of_twin < surprise else result
    if abs(surprise - surprise_of_twin) < PLAUSIBLE_LEAD:
        return replace(better, flags=(*better.flags, UP_UNKNOWN))
    return better


def _rigid_inverse(pose: FloatArray) -> FloatArray:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def _organ_numbers(labels: NDArray[np.int64]) -> NDArray[np.int8]:
    """Labels count 0 unknown, 1 stem, 2.. leaves; organs 0 stem, 1 leaf, -1 unknown."""
    return np.clip(labels - 1, -1, 1).astype(np.int8)


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


def _random_mean(space: ParameterSpace, seed: int) -> FloatArray:
    """A start drawn from the prior within its bounds (Fig. 7d)."""
    drawn: FloatArray = CrossEntropy(space, n_samples=2, elite_fraction=0.9, seed=seed).ask()[0]
    return drawn


def _mean_at(start: StartPose, space: ParameterSpace) -> FloatArray:
    """The prior's mean, with the stem's lengths as the start pose saw them."""
    mean = space.mean
    seen = {"stem_length": -start.foot, "stem_length_above": start.top}
    if "stem_length_above" not in space.names:
        seen = {"stem_length": start.top - start.foot}
    for name, value in seen.items():
        i = space.index(name)
        mean[i] = np.clip(value, space.lower[i], space.upper[i])
    return mean
