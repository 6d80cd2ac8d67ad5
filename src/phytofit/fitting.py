"""The one loop: cloud -> start pose -> search -> Fit."""

import inspect
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from phytofit.cloud import PointCloud, as_cloud
from phytofit.engine.search import estimate
from phytofit.errors import ONE_LEAF_ONLY, NoPhytomerError, SettingError, Status
from phytofit.paper import DISTANCES, CrossEntropy, Generation, PaperObjective, Reference, minimise
from phytofit.paper.scouting import scout
from phytofit.parsing import checked_flag, checked_number, checked_whole, parse_points, parse_up
from phytofit.results import Fit, PaperFit, Remark, beside_its_rival, remark, reviewed
from phytofit.segmentation.plants import separate_plants
from phytofit.species import Species, load_species
from phytofit.start.pose import StartPose, parts_of_stem
from phytofit.start.prepare import DITHER_CM, Prepared, dithered, prepare

__all__ = ["METHODS", "fit", "mean_at"]

FloatArray = NDArray[np.float64]
T = TypeVar("T")
Found = TypeVar("Found", Fit, PaperFit)
N_SEARCHED = 7  # those and the stem above the leaf
SEARCH = ("n_samples", "n_generations", "elite_fraction", "covariance_noise")
DITHERED = f"the points had no noise: {DITHER_CM:g} cm was added, because the fit needs some"
LEAST_ALIKE = 0.5  # of the stem's parts above and below a leaf, shorter over longer: half-way from "none" to "equal"
PLAUSIBLE_LEAD = 4.0  # by so much less squared Mahalanobis distance from the prior is one of two more plausible


def fit(
    cloud: PointCloud | ArrayLike | str | os.PathLike[str],
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
    stem_above: str | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[Generation], None] | None = None,
) -> Fit | PaperFit:
    """Fit the species' phytomer model to a cloud of one leaf on its piece of stem.

    Returns a :class:`Fit` by method "likelihood", a :class:`PaperFit` by method "paper".

    Parameters
    ----------
    cloud : a PointCloud; or a file, or points (n, 3), n >= 100, in `units`; in any orientation
    units : "cm", "mm", "m", or "none" for relative lengths; needed for points, and for files that do not say it
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
    elite_fraction, covariance_noise : see :class:`phytofit.paper.CrossEntropy`
    random_start : start the search from means drawn from the prior (as in Fig. 7d), not from the prior's and, for
        the stem's diameter and lengths, from the start pose
    stem_above : of the stem above the leaf: "equal", as long as below it; "none"; or "free", a parameter of its own.
        Equal by default for "paper", since so it is in the clouds that the paper's authors simulated; free for
        "likelihood".  The first two have the paper's six parameters only, Eq. (1), also for "likelihood".
    seed : the same seed gives the same result, with any number of threads
    threads : how many to work with; as many as there are cores by default
    progress : called after each generation with what it left

    Raises InputError (a ValueError) for what can't be used, NoPhytomerError where there is no stem with a leaf,
    or more than one leaf.
    """
    if method not in METHODS:
        raise SettingError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if distance is not None and method != "paper":
        raise SettingError(f"distance: expected with method 'paper' only, got {distance!r} with {method!r}")
    if distance is not None and distance not in DISTANCES:
        raise SettingError(f"distance: expected one of {', '.join(DISTANCES)}, got {distance!r}")
    counts = ("points", n_points, 100), ("samples", n_samples, 1), ("generations", n_generations, 1)
    for name, value, least in (*counts, ("threads", threads, 1)):
        if value is not None:
            checked_whole(name, value, least)
    checked_whole("seed", seed, 0, math.inf)
    for name, number in (("elite_fraction", elite_fraction), ("covariance_noise", covariance_noise)):
        checked_number(name, number)
    checked_flag("random_start", random_start)
    if not isinstance(species, Species | str | os.PathLike):
        raise SettingError(f"species: expected a name, a file or a Species, got {species!r}")
    direction = parse_up(up)
    seed_points = None if seed_point is None else parse_points(seed_point)
    species = species if isinstance(species, Species) else load_species(os.fspath(species))
    cloud = as_cloud(cloud, units).unrounded()
    search: dict[str, Any] = {"elite_fraction": elite_fraction, "covariance_noise": covariance_noise}
    search["random_start"] = random_start
    given: dict[str, Any] = {"n_samples": n_samples, "n_points": n_points, "n_generations": n_generations}
    given |= {"distance": distance, "stem_above": stem_above}
    search |= {name: value for name, value in given.items() if value is not None}
    used = {**_defaults(METHODS[method]), **search}
    CrossEntropy(species.space, **{name: value for name, value in used.items() if name in SEARCH})  # checks them
    species.with_stem_above(used["stem_above"])  # checks it
    try:
        return _fit(cloud, species, method, used, search, direction, seed_points, seed, threads, progress)
    except NoPhytomerError as error:
        plants = 1 if seed_points is not None else len(separate_plants(cloud, up=direction))
        if plants == 1:
            raise
        raise NoPhytomerError(f"this looks like {plants} plants: {ONE_LEAF_ONLY}") from error


def _fit(
    cloud: PointCloud,
    species: Species,
    method: str,
    used: Mapping[str, Any],
    search: Mapping[str, Any],
    direction: FloatArray | None,
    seed_points: FloatArray | None,
    seed: int,
    threads: int | None,
    progress: Callable[[Generation], None] | None,
) -> Fit | PaperFit:
    """As :func:`fit`, of settings that were checked: `used`, of which `search` were chosen."""
    one_thread = threadpool_limits(limits=1, user_api="blas")  # more would round sums in another order
    workers = threads or os.cpu_count() or 1
    with one_thread, ThreadPoolExecutor(workers) if workers > 1 else _AtOnce() as executor:
        found = prepare(
            cloud,
            species,
            n_points=used["n_points"],
            up=direction,
            with_outliers=method == "likelihood",
            seed_points=None if seed_points is None else cloud.from_input_frame(seed_points),
        )
        result = METHODS[method](found, species, seed=seed, executor=executor, progress=progress, **search)
    pose = found.home @ result.pose
    pose[:3, 3] *= found.scale
    result = replace(
        result,
        pose=pose,
        error=result.error * found.scale if method == "paper" else result.error,
        reference=found.used.points[found.kept],
        observed=(*_of_the_way(result.status, found), *result.observed),
        notes=(*cloud.notes, *found.notes, *result.notes),
        relative=cloud.unit == "none",
        scale=found.scale,
        name=cloud.name,
        settings={
            "method": method,
            **used,
            "up": None if direction is None else direction.tolist(),
            "seed_point": None if seed_points is None else seed_points.tolist(),
        },
    )
    labelled = found.organ is not None and bool((found.organ == 0).any() and (found.organ == 1).any())
    if isinstance(result, PaperFit):
        return _beside_its_stem(_right_way_up(result, direction), found)
    upright = _right_way_up(beside_its_rival(result), direction)
    return reviewed(_beside_its_stem(upright, found), labelled=labelled)


def _of_the_way(status: Status, found: Prepared) -> Iterator[Remark]:
    """Remarks on how the fit went, and on what was fitted."""
    if not status.good:
        yield remark("search_split" if status is Status.SPLIT_ELITE else "not_converged")
    if found.others_touch:
        yield remark("others_touch")


class _AtOnce(Executor):
    """An executor that does all work at once, in the thread that asks for it."""

    def map(
        self, fn: Callable[..., T], *iterables: Iterable[Any], timeout: float | None = None, chunksize: int = 1
    ) -> Iterator[T]:
        return map(fn, *iterables)


def fit_paper(
    found: Prepared,
    species: Species,
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
    random_start: bool = False,
    stem_above: str = "equal",
) -> PaperFit:
    """The paper's method: cross-entropy search for the phytomer whose points, aligned by ICP, lie nearest the cloud."""
    species = species.with_stem_above(stem_above).leading(N_SEARCHED)
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
        mean=_means(found, species, random_start, seed)[0],
        seed=seed,
    )
    minimise(search, objective, progress)
    registration, error = objective.register(search.mean)
    return PaperFit(
        species=species,
        x=search.mean,
        pose=registration.T_target_source,
        error=error,
        history=tuple(search.history),
        status=Status.CONVERGED if error <= search.history[-1].threshold else Status.SPLIT_ELITE,
        seed=seed,
        reference=found.points,
        registration=registration,
    )


def fit_likelihood(
    found: Prepared,
    species: Species,
    *,
    seed: int,
    executor: Executor,
    progress: Callable[[Generation], None] | None,
    n_samples: int = 60,
    n_points: int = 10_000,
    n_generations: int = 4,
    elite_fraction: float = 0.1,
    covariance_noise: float = 0.5,
    random_start: bool = False,
    stem_above: str = "free",
) -> Fit:
    """The most probable phytomer of a cloud, thinned to `n_points`: a short cross-entropy search, then refinement."""
    species = species.with_stem_above(stem_above)
    means = _means(found, species.leading(N_SEARCHED), random_start, seed)
    points = dithered(found.points, seed)
    starts = [(mean, _foot_pose(start)) for mean, start in zip(means, found.starts, strict=True)]
    near, history = scout(
        species.leading(N_SEARCHED),
        points,
        starts,
        n_samples=n_samples,
        n_generations=n_generations,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        seed=seed,
        executor=executor,
        progress=progress,
    )
    most_probable = estimate(species, points, [near, *starts], organ=found.organ, executor=executor)
    return Fit(
        species=species.leading(len(most_probable.x)),
        x=most_probable.x,
        covariance=most_probable.covariance,
        trait_covariance=most_probable.trait_covariance,
        pose=most_probable.pose,
        error=most_probable.error,
        history=history,
        status=Status.AT_REST if most_probable.converged else Status.MOVING,
        seed=seed,
        reference=found.points,
        estimate=most_probable,
        notes=(DITHERED,) if points is not found.points else (),
    )


METHODS: dict[str, Callable[..., Fit | PaperFit]] = {"likelihood": fit_likelihood, "paper": fit_paper}


def _means(found: Prepared, species: Species, random_start: bool, seed: int) -> list[FloatArray]:
    """Parameters (k,) that a search may begin with, for each start pose."""
    means = [mean_at(start, species) for start in found.starts]
    if random_start:
        drawn = CrossEntropy(species.space, n_samples=2, elite_fraction=0.9, seed=seed)
        means[0] = drawn.ask()[0]  # from the prior, within its bounds (Fig. 7d)
    return means


def _foot_pose(start: StartPose) -> FloatArray:
    """The start with the stem's foot as its origin, as the model has it."""
    pose = start.pose.copy()
    pose[:3, 3] += start.foot * start.pose[:3, 2]
    return pose


def _defaults(function: Callable[..., Fit | PaperFit]) -> dict[str, Any]:
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}


def _right_way_up(result: Found, up: FloatArray | None) -> Found:
    """The result or its twin that is upside down: the same organs, so that no cloud can tell which is right.

    A stated `up` (3,) decides, and a remark says where the other is clearly more plausible.  Where up is not known, the
    one counts whose leaf is the more plausible by the prior (leaves leave the stem upwards and bend down), and a remark
    says where neither is clearly so.
    """
    twin = result.upside_down()
    if twin is None:
        return result
    space = result.species.space
    shape = [space.index(name) for name in ("leaf_angle", "leaf_rotate_angle")]
    surprise, surprise_of_twin = (
        float(np.sum(((it.x[shape] - space.mean[shape]) / space.std[shape]) ** 2)) for it in (result, twin)
    )
    if up is not None:
        stated, doubt = (
            (result, surprise - surprise_of_twin)
            if result.pose[:3, 2] @ up >= 0.0
            else (twin, surprise_of_twin - surprise)
        )
        return _with(stated, remark("up_doubtful")) if doubt > PLAUSIBLE_LEAD else stated
    better = twin if surprise_of_twin < surprise else result
    return _with(better, remark("up_unknown")) if abs(surprise - surprise_of_twin) < PLAUSIBLE_LEAD else better


def _beside_its_stem(result: Found, found: Prepared) -> Found:
    """The result, with a remark where the cloud's stem does not end as `stem_above` says: as the start pose saw it, and
    as the leaf's points beside the fitted stem say too, since either may be wrong."""
    how = str(result.settings["stem_above"])
    axis = result.pose[:3, 2]
    along = [float((found.home @ start.pose)[:3, 2] @ axis) for start in found.starts]
    best = int(np.argmax(np.abs(along)))
    start = found.starts[best]
    below, above = (-start.foot, start.top) if along[best] > 0.0 else (start.top, -start.foot)
    points = (result.reference - result.pose[:3, 3]) @ result.pose[:3, :3] / result.scale
    again = parts_of_stem(points, max(start.radius, 0.5 * float(result.x[0])))
    if how == "free" or again is None:
        return result
    alike = [min(parts) > LEAST_ALIKE * max(parts) for parts in ((below, above), again)]
    if alike[0] != alike[1] or alike[0] == (how == "equal"):
        return result
    unit = "" if result.relative else " cm"
    over, under = (f"{length * found.scale:.3g}{unit}" for length in (above, below))
    better = "equal" if alike[0] else "free"
    return _with(result, remark("stem_ends_elsewhere", above=over, below=under, better=better, how=how))


def _with(result: Found, one: Remark) -> Found:
    return replace(result, observed=(*result.observed, one))


def mean_at(start: StartPose, species: Species) -> FloatArray:
    """The prior's mean, with the stem's diameter and lengths as the start pose saw them; of a stem that has one length
    for both sides of the leaf, that which leaves the least at either end.

    Where the leaf lies further off the model than the stem's surface does, the largest distance says nothing of the
    stem's diameter, and the search leaves it near where it began.
    """
    space = species.space
    mean, seen = space.mean, {"stem_diameter": 2.0 * start.radius}
    if "stem_length_above" in space.names:
        seen |= {"stem_length": -start.foot, "stem_length_above": start.top}
    else:
        seen["stem_length"] = (start.top - start.foot) / (1.0 + species.model.stem_above)
    for name, value in seen.items():
        i = space.index(name)
        mean[i] = np.clip(value, space.lower[i], space.upper[i])
    return mean
