"""The one loop: cloud -> start pose -> search -> Fit."""

import inspect
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from phytofit.cloud import PointCloud, from_points
from phytofit.distances import DISTANCES, Reference
from phytofit.errors import NoPhytomerError, SettingError, Status
from phytofit.flags import flags_of
from phytofit.intervals import Ends, propagated
from phytofit.models import STEM, Organ, move
from phytofit.objectives import PaperObjective, Registration, minimise
from phytofit.optimize import CrossEntropy, Generation
from phytofit.outcome import Estimate
from phytofit.parameters import ParameterSpace
from phytofit.parsing import parse_points, parse_up
from phytofit.pose import StartPose
from phytofit.posterior import DITHER_CM, estimate
from phytofit.preparation import Prepared, prepare
from phytofit.species import Species, load_species
from phytofit.traits import CHORD_CM, Trait, measure

__all__ = ["METHODS", "Fit", "fit", "mean_at"]

FloatArray = NDArray[np.float64]
N_PAPER = 6  # parameters of Eq. (1)
N_SEARCHED = 7  # those and the stem above the leaf
SEARCH = ("n_samples", "n_generations", "elite_fraction", "covariance_noise")
LEAST_ON_STEM = 10.0  # points; with fewer it is no stem
DITHERED = f"the points had no noise: {DITHER_CM:g} cm was added, without which the likelihood can't be climbed"
INTERVAL_METHOD = "sandwich interval"
OPEN_WITHOUT_TIP = ("leaf_length", "leaf_area")  # no upper end where the tip was not seen
PLAUSIBLE_LEAD = 4.0  # by so much less squared Mahalanobis distance from the prior is one of two more plausible
TOLD_OF_RIVALS = ("stem_diameter", "leaf_length", "leaf_angle", "leaf_width")
UP_DOUBTFUL = "the leaf leaves the stem downwards or bends up: is the stated up right?"
UP_UNKNOWN = "up and down can't be told apart by this leaf: the more plausible is given; state up if it is known"


@dataclass(frozen=True)
class Fit:
    """A phytomer model fitted to a cloud.

    ``x`` (k,) are the parameters, in the order of ``species.space``; ``pose`` (4, 4) maps the model's frame to the
    cloud's, cm.  By method "likelihood", ``covariance`` (k, k) is that of x's error, ``trait_covariance`` the same with
    what the leaf's last points tell of its end, ``error`` minus the log posterior (nats); ``estimate`` has the rest, in
    the start pose's frame.  By method "paper", ``covariance`` is the spread of the last elite: how far the search has
    contracted, not how far it is from the truth; ``error`` is the distance, cm, ``registration`` how ICP ended.

    ``reference`` (m, 3) are the points that were fitted, in the cloud's frame, cm.  ``flags`` are remarks on the
    result in plain words, ``notes`` on what was done to the cloud.  ``relative`` says that the cloud had no unit:
    lengths are then relative to each other only, and ``scale`` of them make a cm of the prior (1 otherwise); `x`,
    `history`, `registration` and `estimate` are in the prior's cm.  ``settings`` repeat the run.
    """

    species: Species
    x: FloatArray
    covariance: FloatArray
    pose: FloatArray
    error: float
    history: tuple[Generation, ...]
    status: Status
    seed: int
    reference: FloatArray
    method: str
    registration: Registration | None = None
    estimate: Estimate | None = None
    trait_covariance: FloatArray | None = None
    flags: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    relative: bool = False
    scale: float = 1.0
    settings: dict[str, object] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters by name; lengths in cm (or relative), angles in degrees."""
        return dict(zip(self.species.space.names, self._in_units(self.x).tolist(), strict=True))

    @property
    def parameter_intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter, within its bounds; empty where the method gives none."""
        if self.estimate is None:
            return {}
        space = self.species.space
        half = self.estimate.quantile * np.sqrt(np.diag(self.covariance))
        low = self._in_units(np.minimum(np.maximum(self.x - half, space.lower), self.x)).tolist()
        high = self._in_units(np.maximum(np.minimum(self.x + half, space.upper), self.x)).tolist()
        return dict(zip(space.names, zip(low, high, strict=True), strict=True))

    def _in_units(self, x: FloatArray) -> FloatArray:
        return np.where(np.array(self.species.space.units) == "cm", x * self.scale, x)

    @property
    def organs(self) -> tuple[Organ, ...]:
        """Stem and leaf in the cloud's frame, cm."""
        return move(self._organs_of(self.x), self.pose)

    def _organs_of(self, x: FloatArray, *, whole: bool = False) -> tuple[Organ, ...]:
        own = (o.row(0) for o in self.species.model.organs(x))
        stem, leaf = (Organ(o.kind, o.axis * self.scale, o.frame, o.half_width * self.scale) for o in own)
        return stem, leaf if whole or self.estimate is None else leaf.until(self.estimate.ends_at)

    @cached_property
    def traits(self) -> list[Trait]:
        """The traits, measured on the fitted organs, with 95 % intervals where the method gives them.

        Lengths are in "rel" in place of "cm" where the cloud had no unit.
        """
        traits = self._measured(self.x)
        if self.estimate is not None:
            ends = self._ends()
            open_above = () if self.estimate.tip_seen else OPEN_WITHOUT_TIP
            traits = [
                replace(
                    trait,
                    low=max(0.0, trait.value - self._not_seen(trait.name) - below),
                    high=None if trait.name in open_above else trait.value + above,
                )
                if np.isfinite(below + above)
                else trait
                for trait, below, above in zip(traits, ends.below.tolist(), ends.above.tolist(), strict=True)
            ]
        if not self.relative:
            return traits
        return [replace(trait, unit=trait.unit.replace("cm", "rel")) for trait in traits]

    def _measured(self, x: FloatArray) -> list[Trait]:
        method = self.method if self.estimate is None else f"{self.method}, 95 % {INTERVAL_METHOD}"
        return measure(self._organs_of(x), chord_cm=self._chord_cm, method=method, flags=self.flags)

    @property
    def _chord_cm(self) -> float:
        return np.inf if self.relative else CHORD_CM

    def _not_seen(self, name: str) -> float:
        """What of a trait is of an unseen tip, or beyond a blunt leaf's last point: its low end is without that."""
        assert self.estimate is not None
        made = self.estimate
        seen = min(1.0, made.sighting.end / made.ends_at) if made.blunt else made.seen
        if name not in OPEN_WITHOUT_TIP or seen == 1.0:
            return 0.0
        whole = self._organs_of(self.x)[1]
        part = whole.until(seen)
        if name == "leaf_area":
            return float(whole.area - part.area)
        return float(whole.segment_lengths.sum() - part.segment_lengths.sum())

    def _ends(self) -> Ends:
        """How far the traits' intervals reach: by the errors of the parameters, by how far the blade's surface lies
        off the model's where it leaves the stem, by how far its width does, and by what the stem's surface hides."""
        assert self.estimate is not None
        assert self.trait_covariance is not None
        space, made = self.species.space, self.estimate
        angle = np.array(space.units) == "deg"
        lower, upper = np.where(angle, -np.inf, space.lower), np.where(angle, np.inf, space.upper)
        ends = propagated(self._values, self.x, self.trait_covariance, made.quantile, lower, upper)
        off = made.quantile * made.misfit_cm * self.scale
        changes = np.array([self._values(self.x, thicker=by) for by in (off, -off)]) - self._values(self.x)
        changes[:, [trait.organ == STEM for trait in self._measured(self.x)]] = 0.0
        ends = ends.with_error(np.minimum(changes, 0.0).min(axis=0), np.maximum(changes, 0.0).max(axis=0))
        names = np.array([trait.name for trait in self._measured(self.x)])
        by_width = (names == "leaf_width") * made.quantile * made.width_misfit * self._values(self.x)
        return ends.with_error(by_width, by_width + (names == "leaf_length") * made.sighting.along_stem * self.scale)

    def _values(self, x: FloatArray, *, thicker: float = 0.0, whole: bool = False) -> FloatArray:
        """Values (t,) of the traits, of a stem with a radius so much larger, of the leaf as it ends, or `whole`."""
        stem, leaf = self._organs_of(x, whole=whole)
        stem = replace(stem, half_width=np.maximum(stem.half_width + thicker, 0.0))
        return np.array([trait.value for trait in measure((stem, leaf), chord_cm=self._chord_cm)])

    @property
    def elite_std(self) -> dict[str, float]:
        """Spread of each parameter in the last elite of the search; not an error of the estimate."""
        last = np.sqrt(np.diag(self.history[-1].cov))
        units = self.species.space.units[: len(last)]
        scaled = [s * self.scale if unit == "cm" else s for s, unit in zip(last.tolist(), units, strict=True)]
        return dict(zip(self.species.space.names, scaled, strict=False))


def fit(
    cloud: PointCloud | ArrayLike,
    units: str | None = None,
    *,
    species: Species | str | os.PathLike[str] = "sorghum",
    up: str | ArrayLike | None = None,
    seed_point: ArrayLike | None = None,
    method: str = "likelihood",
    distance: str | None = None,
    n_samples: int | None = None,
    n_points: int | None = None,
    n_generations: int | None = None,
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
    seed_point : (3,) or (k, 3) in the unit and frame that the cloud was read in, on the leaf that is meant, where the
        cloud shows others too: beside the stem, what is not of its leaf is left out; one for each piece of a leaf
    method : "likelihood", the most probable phytomer, with intervals; or "paper", the cross-entropy search of Sodhi et
        al., IROS 2018, for the least distance between the clouds
    distance : what the paper's method minimises: hausdorff (its own), quantile, chamfer, labels
    n_samples, n_generations : of the cross-entropy search: 500 candidates in each of 10 generations for "paper",
        60 in each of 4 for "likelihood", which is refined afterwards
    n_points : to which the cloud is thinned: 10,000 for "likelihood"; 5,000 for "paper", and also of each candidate
    elite_fraction, covariance_noise : see :class:`phytofit.CrossEntropy`
    random_start : start the search from means drawn from the prior (as in Fig. 7d), not from the prior's and, for
        the stem's lengths, from the start pose
    stem_above : whether the stem may go on above the leaf; False is the paper's model of six parameters, Eq. (1)
    seed : the same seed gives the same result, with any number of threads
    threads : how many to work with; as many as there are cores by default
    progress : called after each generation with what it left

    Raises InputError (a ValueError) for what can't be used, NoPhytomerError where there is no stem with a leaf.
    """
    if method not in METHODS:
        raise SettingError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if distance is not None and method != "paper":
        raise SettingError(f"distance: expected with method 'paper' only, got {distance!r} with {method!r}")
    if distance is not None and distance not in DISTANCES:
        raise SettingError(f"distance: expected one of {', '.join(DISTANCES)}, got {distance!r}")
    for name, value, least in (("points", n_points, 100), ("seed", seed, 0), ("threads", threads, 1)):
        if value is not None and value < least:
            raise SettingError(f"{name}: expected {least} or more, got {value}")
    direction = parse_up(up)
    seed_points = None if seed_point is None else parse_points(seed_point)
    species = species if isinstance(species, Species) else load_species(os.fspath(species))
    if not isinstance(cloud, PointCloud):
        cloud = from_points(cloud, units)
    elif units not in (None, cloud.unit):
        raise SettingError(f"units: {cloud.name} was read in {cloud.unit}, got {units!r}; leave units out")
    search: dict[str, Any] = {"elite_fraction": elite_fraction, "covariance_noise": covariance_noise}
    given = {"n_samples": n_samples, "n_points": n_points, "n_generations": n_generations, "distance": distance}
    search |= {name: value for name, value in given.items() if value is not None}
    used = {**_defaults(METHODS[method]), **search}
    CrossEntropy(species.space, **{name: value for name, value in used.items() if name in SEARCH})  # checks them
    if not stem_above:
        species = species.leading(N_PAPER)
    found = prepare(
        cloud,
        species,
        n_points=used["n_points"],
        up=direction,
        with_outliers=method == "likelihood",
        seed_points=None if seed_points is None else cloud.from_input_frame(seed_points),
    )
    means = [mean_at(start, species.leading(N_SEARCHED).space) for start in found.starts]
    if random_start:
        drawn = CrossEntropy(species.leading(N_SEARCHED).space, n_samples=2, elite_fraction=0.9, seed=seed)
        means[0] = drawn.ask()[0]  # from the prior, within its bounds (Fig. 7d)
    one_thread = threadpool_limits(limits=1, user_api="blas")  # more would round sums in another order
    with one_thread, ThreadPoolExecutor(threads or os.cpu_count() or 1) as executor:
        result = METHODS[method](found, species, means, seed=seed, executor=executor, progress=progress, **search)
    pose = found.home @ result.pose
    pose[:3, 3] *= found.scale
    result = replace(
        result,
        pose=pose,
        error=result.error * found.scale if method == "paper" else result.error,
        reference=found.used.points[found.kept],
        flags=(*((result.status.value,) if not result.status.good else ()), *result.flags),
        notes=(*cloud.notes, *found.notes, *result.notes),
        relative=cloud.unit == "none",
        scale=found.scale,
        settings={
            "method": method,
            **used,
            "random_start": random_start,
            "stem_above": stem_above,
            "up": None if direction is None else direction.tolist(),
            "seed_point": None if seed_points is None else seed_points.tolist(),
        },
    )
    return _remarked(_right_way_up(_beside_its_rival(result), direction))


def fit_paper(
    found: Prepared,
    species: Species,
    means: Sequence[FloatArray],
    *,
    seed: int,
    executor: Executor,
    progress: Callable[[Generation], None] | None,
    distance: str = "hausdorff",
    n_samples: int = 500,
    n_points: int = 5000,
    n_generations: int = 10,
    elite_fraction: float = 0.1,
    covariance_noise: float = 0.5,
) -> Fit:
    """The paper's method: cross-entropy search for the phytomer whose points, aligned by ICP, lie nearest the cloud."""
    species = species.leading(len(means[0]))
    objective = PaperObjective(
        species.model,
        Reference.of(found.points, found.organ),
        starts=[start.pose for start in found.starts],
        n_points=n_points,
        distance=DISTANCES[distance],
        seed=seed,
        executor=executor,
    )
    search = CrossEntropy(
        species.space,
        n_samples=n_samples,
        n_generations=n_generations,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        mean=means[0],
        seed=seed,
    )
    minimise(search, objective, progress)
    registration, error = objective.register(search.mean)
    return Fit(
        species=species,
        x=search.mean,
        covariance=search.history[-1].cov,
        pose=registration.T_target_source,
        error=error,
        history=tuple(search.history),
        status=Status.CONVERGED if error <= search.history[-1].threshold else Status.SPLIT_ELITE,
        seed=seed,
        reference=found.points,
        method="paper",
        registration=registration,
    )


def fit_likelihood(
    found: Prepared,
    species: Species,
    means: Sequence[FloatArray],
    *,
    seed: int,
    executor: Executor,
    progress: Callable[[Generation], None] | None,
    n_samples: int = 60,
    n_points: int = 10_000,
    n_generations: int = 4,
    elite_fraction: float = 0.1,
    covariance_noise: float = 0.5,
) -> Fit:
    """The most probable phytomer of a cloud, thinned to `n_points`: a short cross-entropy search, then refinement."""
    most_probable = estimate(
        species,
        found.points,
        [(mean, _foot_pose(start)) for mean, start in zip(means, found.starts, strict=True)],
        organ=found.organ,
        n_samples=n_samples,
        n_generations=n_generations,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        seed=seed,
        executor=executor,
        progress=progress,
    )
    return Fit(
        species=species.leading(len(most_probable.x)),
        x=most_probable.x,
        covariance=most_probable.covariance,
        trait_covariance=most_probable.trait_covariance,
        pose=most_probable.pose,
        error=most_probable.error,
        history=most_probable.history,
        status=Status.AT_REST if most_probable.converged else Status.MOVING,
        seed=seed,
        reference=found.points,
        method="likelihood",
        estimate=most_probable,
        notes=(DITHERED,) if most_probable.dithered else (),
    )


METHODS: dict[str, Callable[..., Fit]] = {"likelihood": fit_likelihood, "paper": fit_paper}


def _foot_pose(start: StartPose) -> FloatArray:
    """The start with the stem's foot as its origin, as the model has it."""
    pose = start.pose.copy()
    pose[:3, 3] += start.foot * start.pose[:3, 2]
    return pose


def _defaults(function: Callable[..., Fit]) -> dict[str, Any]:
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}


def _remarked(result: Fit) -> Fit:
    """The result with the flags of what it rests on; NoPhytomerError where it rests on no stem or no leaf."""
    made = result.estimate
    if made is None:
        return result
    length = next(t.value for t in result._measured(result.x) if t.name == "leaf_length")
    if made.sighting.stem_points < LEAST_ON_STEM or length <= 0.0:
        raise NoPhytomerError(
            f"no stem with a leaf was found: the best fit has {made.sighting.stem_points:.0f} points on its stem and a "
            f"leaf of {length:.3g} cm"
        )
    flags = flags_of(
        result.species.space,
        result.x,
        made.sighting,
        noise=made.noise,
        outlier_share=float(made.share[2]),
        midrib_seen=made.seen,
        tip_seen=made.tip_seen,
        blunt=made.blunt,
        ends_at=made.ends_at if made.too_long else 1.0,
        scale=result.scale,
    )
    return replace(result, flags=(*result.flags, *flags))


def _beside_its_rival(result: Fit) -> Fit:
    """The result, with a flag if another model is about as probable and its traits lie beyond the intervals."""
    if result.estimate is None or result.estimate.rival is None:
        return result
    other = dict(zip([t.name for t in result.traits], result._values(result.estimate.rival, whole=True), strict=True))
    differ = [
        f"{t.name} may be {other[t.name]:.3g} {t.unit}"
        for t in result.traits
        if t.name in TOLD_OF_RIVALS and not (t.low or 0.0) <= other[t.name] <= (np.inf if t.high is None else t.high)
    ]
    if not differ:
        return result
    return replace(result, flags=(*result.flags, f"two solutions are about as probable: {', '.join(differ)}"))


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
    searched = len(result.history[0].mean)
    part, shift = turn[:searched, :searched], offset[:searched]
    twin = replace(
        result,
        x=turn @ result.x + offset,
        covariance=turn @ result.covariance @ turn.T,
        trait_covariance=None if result.trait_covariance is None else turn @ result.trait_covariance @ turn.T,
        pose=result.pose @ pose,
        history=tuple(
            replace(g, mean=part @ g.mean + shift, cov=part @ g.cov @ part.T, best_x=part @ g.best_x + shift)
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


def mean_at(start: StartPose, space: ParameterSpace) -> FloatArray:
    """The prior's mean, with the stem's lengths as the start pose saw them."""
    mean = space.mean
    seen = {"stem_length": -start.foot, "stem_length_above": start.top}
    if "stem_length_above" not in space.names:
        seen = {"stem_length": start.top - start.foot}
    for name, value in seen.items():
        i = space.index(name)
        mean[i] = np.clip(value, space.lower[i], space.upper[i])
    return mean
