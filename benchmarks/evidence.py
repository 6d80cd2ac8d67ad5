"""Which parameters of a leaf's shape earn their place, by evidence that no ruler has a part in.

    python benchmarks/evidence.py [--leaves 8] [--points 2500] [--details]

A parameter earns its place if leaves of a plant that was left out are the more probable for it.  So, of all labelled
leaves in ../shared/data (and the paper's clouds, which are one leaf each):

1. A leaf is cut out with its piece of stem, and made as long as the species expects a leaf to be: only shape counts.
2. The model with all parameters is fitted; and, from where that ended, the model with each parameter in turn held at
   its neutral value (as if there were no such parameter), and with all of them held.  These fits hardly look at the
   species file's prior: it is made three times as wide.
3. For each plant and model, a prior is learned from the fits of the other plants: medians, and spreads from the
   10 % and 90 % quantiles, each plant counting as much as another.
4. With that prior the model is refined once more on each of the plant's leaves.  Laplace's approximation gives the log
   probability of the leaf's cloud, all parameters integrated out.  Points whose errors depend on each other count for
   fewer.
5. A parameter's gain is that log probability of the model with it minus that of the model without it, nats a leaf:
   mean over the leaves of a plant, then over plants, with the standard error over plants.  Above 0, it pays for itself.

"over a constant" is the gain over the parameter held at the other plants' median, which may be all that is needed.
"""

import argparse
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import product
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import numpy as np
import trimesh
from accuracy import DATA, MM, clouds, progress
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

import phytofit
from phytofit.dependence import score_dependence
from phytofit.fitting import mean_at
from phytofit.flags import density_over
from phytofit.likelihood import NO_THICKNESS_CM, THICKNESS, CloudLikelihood, State
from phytofit.optimize import refine
from phytofit.posterior import estimate

SPECIES = phytofit.load_species()
K = len(SPECIES.space)
N_GIVEN = 7  # parameters that every model has: those of Eq. (1), and the stem above the leaf
SHAPE = (*SPECIES.space.names[N_GIVEN:], "thickness")
PLACE = {name: N_GIVEN + i for i, name in enumerate(SHAPE)} | {"thickness": K + 12 + THICKNESS}  # in theta
NEUTRAL = {**dict(zip(SHAPE, SPECIES.model.neutral[N_GIVEN:], strict=False)), "thickness": np.log(NO_THICKNESS_CM)}
LEARNED = [*range(K), PLACE["thickness"]]  # places in theta whose prior is learned
SIDEWAYS = [PLACE[name] for name in ("leaf_side_bend", "leaf_side_bow", "leaf_roll", "leaf_twist")]
HELD: dict[str, tuple[str, ...]] = {"full": (), **{name: (name,) for name in SHAPE}, "all of them": SHAPE}
POSE, POSE_STD = slice(-11, -5), np.array([3.0] * 3 + [50.0] * 3)  # radians, cm: next to nothing is known
WIDER = 3.0  # times the species file's spreads, for the fits that priors are learned from
FLOOR = 0.2  # of the species file's spreads: a learned one is not narrower
LEAF_CM = float(SPECIES.space.mean[SPECIES.space.index("leaf_length")])  # to which leaves are scaled
BELOW_CM, ABOVE_CM = 15.0, 10.0  # of stem that is kept, at that scale
LEAST_POINTS, LEAST_ON_STEM = 150, 30  # of a leaf, of its piece of stem
MESH_POINTS, STEM_COLOR = 60_000, (0, 255, 255)
GAP = 0.05  # of a leaf's length: one whose base is further from the stem is hidden there
N_NEAR = 10  # neighbours in the graph that a leaf's length is measured along; points around an insertion
BEGUN_ANGLE, BEGUN_BEND, BEGUN_ROLL = (15.0, 60.0), (0.0, 4.0, 8.0), (0.0, 80.0)
COARSE_POINTS, START_NOISE_CM, COARSE_NOISE_CM, COARSE_OUTLIERS = 400, 2.0, (0.3, 0.8), -3.0
MOST_OUTLIERS = 0.25  # of the points: a leaf of which the full model explains less has another shape altogether
HOLE_ROUNDS = 2
CENTRAL = 2.563  # standard deviations from the 10 % to the 90 % quantile
BLUR = 3.0  # times the noise, from which the model with less parameters is begun as well
BETTER = 0.5  # nats by which a model with a parameter held must be the more probable to tell a poor optimum of the full


class Leaf(NamedTuple):
    """A leaf with its piece of stem: points (n, 3), at the prior's scale; organ (n,) 0 stem, 1 leaf, or None."""

    data_set: str
    plant: str
    name: str
    points: np.ndarray
    organ: np.ndarray | None
    starts: list[phytofit.StartPose]


class Fitted(NamedTuple):
    """A leaf and the modes of the models; what all models share:
    density of the points over the leaf, how many dependent points count as one."""

    leaf: Leaf
    states: dict[str, State]
    density: np.ndarray | None
    inflation: float


class Prior(NamedTuple):
    """Means and spreads of `LEARNED`."""

    mean: np.ndarray
    std: np.ndarray


WIDE = Prior(
    np.append(SPECIES.space.mean, np.log(0.3)),
    WIDER * np.append(SPECIES.space.std, np.log(3.0)),
)


def likelihood_of(fitted: Fitted, held: dict[str, float], prior: Prior) -> CloudLikelihood:
    """Of the leaf under a model with parameters `held`; errors of points that depend on each other count once."""
    leaf = fitted.leaf
    made = CloudLikelihood(
        SPECIES.model,
        SPECIES.space,
        leaf.points,
        organ=leaf.organ,
        weights=np.full(len(leaf.points), 1.0 / fitted.inflation),
        thick=True,
        density=fitted.density,
    )
    made.mean[LEARNED] = np.clip(prior.mean, made.lower[LEARNED], made.upper[LEARNED])
    made.precision[LEARNED] = prior.std**-2.0
    made.precision[POSE] = POSE_STD**-2.0
    for name, value in held.items():
        i = PLACE[name]
        made.mean[i] = made.lower[i] = made.upper[i] = value
    return made


def refined(likelihood: CloudLikelihood, state: State, max_iterations: int = 60) -> State:
    def evaluate(theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        at = likelihood.evaluate(likelihood.with_theta(state, theta))
        weighted = at.scores * likelihood.weights[:, np.newaxis]
        gradient = (theta - likelihood.mean) * likelihood.precision - weighted.sum(axis=0)
        return at.error, gradient, at.scores.T @ weighted + np.diag(likelihood.precision)

    def error_of(theta: np.ndarray) -> float:
        return likelihood.evaluate(likelihood.with_theta(state, theta), derivatives=False).error

    bounds = {"lower": likelihood.lower, "upper": likelihood.upper}
    end = refine(evaluate, error_of, state.theta, **bounds, max_iterations=max_iterations)
    return likelihood.with_theta(state, end.theta)


def log_evidence(likelihood: CloudLikelihood, state: State) -> float:
    """log p(cloud | model, prior) by Laplace's approximation of what lies within the bounds; up to a constant."""
    free = likelihood.lower < likelihood.upper
    at = likelihood.evaluate(state)
    weighted = (at.scores * likelihood.weights[:, np.newaxis])[:, free]
    theta, mean, precision = (values[free] for values in (state.theta, likelihood.mean, likelihood.precision))
    lower, upper = likelihood.lower[free], likelihood.upper[free]
    covariance = np.linalg.inv(at.scores[:, free].T @ weighted + np.diag(precision))
    gradient = (theta - mean) * precision - weighted.sum(axis=0)
    step = covariance @ gradient  # to the normal distribution's middle, which lies beyond a bound that is met
    std = np.sqrt(np.diag(covariance))
    inside = log_ndtr((theta - step - lower) / std) + log_ndtr((upper - theta + step) / std)
    known = precision > 0.0
    before = np.sqrt(precision[known])
    inside_before = log_ndtr((mean - lower)[known] * before) + log_ndtr((upper - mean)[known] * before)
    volume = 0.5 * np.linalg.slogdet(covariance)[1] + np.log(before).sum()
    return float(-at.error + 0.5 * gradient @ step + volume + inside.sum() - inside_before.sum())


def begun(leaf: Leaf) -> list[State]:
    """Where to begin: what the default method finds, and the most probable, for the model with no and with all of the
    parameters, of what a grid of angles leads to, with a part of the points, much noise and few outliers."""
    feet = [start.pose.copy() for start in leaf.starts]
    for foot, start in zip(feet, leaf.starts, strict=True):
        foot[:3, 3] += start.foot * start.pose[:3, 2]
    means = [mean_at(start, SPECIES.space) for start in leaf.starts]
    stride = max(1, len(leaf.points) // COARSE_POINTS)
    part = leaf._replace(points=leaf.points[::stride], organ=None if leaf.organ is None else leaf.organ[::stride])
    rough = Fitted(part, {}, None, 1.0 / stride)
    found = []
    for held, rolls in ((SHAPE, (0.0,)), ((), BEGUN_ROLL)):
        likelihood = likelihood_of(rough, {name: NEUTRAL[name] for name in held}, WIDE)
        likelihood.lower[-5:-3] = np.log(COARSE_NOISE_CM)
        likelihood.upper[-1] = COARSE_OUTLIERS
        ends = []
        for i, angle, bend, roll in product(range(len(means)), BEGUN_ANGLE, BEGUN_BEND, rolls):
            x = means[i].copy()
            x[[0, 2, 5, PLACE["leaf_roll"]]] = 2.0 * leaf.starts[i].radius, angle, bend, roll
            ends.append(refined(likelihood, likelihood.start(x, feet[i], START_NOISE_CM), max_iterations=30))
        found.append(min(ends, key=partial(error_at, likelihood)))
    with suppress(np.linalg.LinAlgError), np.errstate(invalid="ignore"):  # a leaf may collapse
        made = estimate(
            SPECIES, leaf.points, list(zip((mean[:N_GIVEN] for mean in means), feet, strict=True)), organ=leaf.organ
        )
        state = likelihood.start(made.x, made.pose, 1.0)
        state.theta[-5:] = [*np.log(made.noise), *np.log(made.share[[0, 2]] / made.share[1])]
        found.append(state)
    return found


def fit_leaf(leaf: Leaf) -> Fitted:
    """The modes of all models under the wide prior, step 2."""
    fitted = Fitted(leaf, {}, None, 1.0)
    likelihood = likelihood_of(fitted, {}, WIDE)
    state = min((refined(likelihood, state) for state in begun(leaf)), key=partial(error_at, likelihood))
    for _ in range(HOLE_ROUNDS):
        state = refined(likelihood_of(fitted, {}, WIDE), state)
        likelihood = likelihood_of(fitted, {}, WIDE)
        density = density_over(likelihood, state, likelihood.evaluate(state).scores)
        fitted = fitted._replace(density=density)
    fitted = fitted._replace(inflation=score_dependence(likelihood_of(fitted, {}, WIDE), state).inflation)
    likelihood = likelihood_of(fitted, {}, WIDE)
    full = refined(likelihood, state)
    blurred = State(full.theta.copy(), full.pose, full.center)
    blurred.theta[-5:-3] += np.log(BLUR)
    states = {}
    for model, held in HELD.items():
        if held:
            without = likelihood_of(fitted, {name: NEUTRAL[name] for name in held}, WIDE)
            ends = [refined(without, state) for state in (full, blurred)]
            states[model] = min(ends, key=partial(error_at, without))
    other = min(states.values(), key=partial(error_at, likelihood))
    if error_at(likelihood, other) < error_at(likelihood, full) - BETTER:
        full = refined(likelihood, other)
    return fitted._replace(states={"full": full} | states)


def error_at(likelihood: CloudLikelihood, state: State) -> float:
    inside = np.clip(state.theta, likelihood.lower, likelihood.upper)
    return likelihood.evaluate(likelihood.with_theta(state, inside), derivatives=False).error


def learned(others: Sequence[Fitted], model: str) -> Prior:
    """From fits of the model, step 3; a leaf counts together with its mirror image."""
    values = np.array([it.states[model].theta[LEARNED] for it in others])
    mirrored = values.copy()
    mirrored[:, SIDEWAYS] *= -1.0
    size = Counter(it.leaf.plant for it in others)
    weights = np.tile([1.0 / size[it.leaf.plant] for it in others], 2)
    low, middle, high = (
        np.quantile(np.concatenate([values, mirrored]), q, axis=0, weights=weights, method="inverted_cdf")
        for q in (0.1, 0.5, 0.9)
    )
    middle[SIDEWAYS] = 0.0
    return Prior(middle, np.maximum((high - low) / CENTRAL, FLOOR / WIDER * WIDE.std))


def gains(job: tuple[Fitted, dict[str, Prior]]) -> dict[str, tuple[float, float]]:
    """Of one leaf: by how much its log evidence under the full model is above that with the parameters `HELD` at their
    neutral values, and at the others' medians."""
    fitted, priors = job

    def evidence(begun: Sequence[State], held: dict[str, float], prior: Prior) -> float:
        likelihood = likelihood_of(fitted, held, prior)
        ends = [refined(likelihood, state) for state in begun]
        return log_evidence(likelihood, min(ends, key=partial(error_at, likelihood)))

    states, prior = fitted.states, priors["full"]
    full = evidence([states["full"]], {}, prior)
    median = dict(zip(LEARNED, prior.mean.tolist(), strict=True))
    return {
        model: (
            full - evidence([states[model]], {name: NEUTRAL[name] for name in held}, priors[model]),
            full - evidence([states["full"], states[model]], {name: median[PLACE[name]] for name in held}, prior),
        )
        for model, held in HELD.items()
        if held
    }


def unlabelled_leaves(n_points: int) -> Iterator[Leaf]:
    """The paper's clouds are one leaf on its piece of stem each, y is up."""
    for path in clouds():
        if "simulated" not in path.parts:
            cloud = phytofit.read_cloud(path, "mm" if path.stem in MM else "cm")
            found = phytofit.prepare(
                cloud, SPECIES, n_points=n_points, up=np.array([0.0, 1.0, 0.0]), with_outliers=True
            )
            yield Leaf(path.parent.name, path.stem, path.stem, found.points, None, found.starts)


def labelled_plants() -> Iterator[tuple[str, str, str, np.ndarray, np.ndarray]]:
    """Data set, plant, name of the cloud, points (n, 3), labels (n,): 1 the stem, 2.. leaves, 0 neither."""
    for path in sorted((DATA.parent / "trackplant3d").rglob("*.txt"), key=lambda path: path.stem.split("_")[1:]):
        rows = np.loadtxt(path)
        _, species, treatment, plant, day = path.stem.split("_")
        yield f"trackplant {species}", f"{species} {treatment} {plant}", day, rows[:, :3], rows[:, 3].astype(int) + 1
    for path in sorted((DATA.parent / "label3dmaize").glob("*.txt")):
        rows = np.loadtxt(path)
        labels = rows[:, 3].astype(int)
        if path.stem.startswith("nk"):  # the highest label is the pot
            labels[labels == labels.max()] = 0
        yield "label3dmaize", path.stem, path.stem, rows[:, :3], labels
    mesh = trimesh.load(DATA.parent / "mccormick2016_turntable" / "segmentedMesh.ply", process=False)
    points, face = trimesh.sample.sample_surface(mesh, MESH_POINTS, seed=0)
    colors, labels = np.unique(mesh.visual.vertex_colors[mesh.faces[face, 0], :3], axis=0, return_inverse=True)
    stem = int(np.flatnonzero((colors == STEM_COLOR).all(axis=1))[0])
    yield "mccormick", "mccormick", "mesh", np.asarray(points), np.where(labels.ravel() == stem, 1, labels.ravel() + 2)


def cut_leaf(points: np.ndarray, labels: np.ndarray, label: int, n_points: int) -> tuple[np.ndarray, ...] | None:
    """A labelled leaf and its piece of stem, scaled: points, organ, and the start pose; None where that can't be cut."""
    leaf, stem = points[labels == label], points[labels == 1]
    if len(leaf) < LEAST_POINTS:
        return None
    gap, nearest = cKDTree(leaf).query(stem)
    close = np.argsort(gap)[:N_NEAR]
    length = midrib_length(leaf, int(nearest[close[0]]))
    if gap[close].mean() > GAP * length:
        return None
    scale = LEAF_CM / length
    leaf, stem = (scale * (those - stem[close].mean(axis=0)) for those in (leaf, stem))
    near = stem[np.linalg.norm(stem, axis=1) < BELOW_CM]
    axis = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][0]
    axis *= np.sign((scale * points[labels > 1].mean(axis=0) - scale * points[labels == 1].mean(axis=0)) @ axis)
    stem = stem[(stem @ axis > -BELOW_CM) & (stem @ axis < ABOVE_CM)]
    middle = np.median(stem - np.outer(stem @ axis, axis), axis=0)
    side = leaf.mean(axis=0) - middle
    side -= side @ axis * axis
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([side, np.cross(axis, side), axis], axis=1), middle
    foot, top = np.quantile(stem @ axis, [0.01, 0.99])
    radius = float(np.median(np.linalg.norm(stem - middle - np.outer((stem - middle) @ axis, axis), axis=1)))
    both = np.concatenate([stem, leaf])
    organ = np.repeat(np.array([0, 1], np.int8), [len(stem), len(leaf)])
    kept = np.sort(np.random.default_rng(0).permutation(len(both))[:n_points])
    if np.sum(organ[kept] == 0) < LEAST_ON_STEM:
        return None
    return both[kept], organ[kept], phytofit.StartPose(pose, float(foot), float(top), radius, 0.0, 0.0)


def midrib_length(leaf: np.ndarray, base: int) -> float:
    """Of a leaf's points, from the one that is its base, along the graph of neighbours."""
    part = np.unique(np.append(np.linspace(0, len(leaf) - 1, min(len(leaf), 1500)).astype(int), base))
    leaf, base = leaf[part], int(np.flatnonzero(part == base)[0])
    gap, near = cKDTree(leaf).query(leaf, k=N_NEAR + 1)
    rows = np.repeat(np.arange(len(leaf)), N_NEAR)
    graph = coo_array((gap[:, 1:].ravel(), (rows, near[:, 1:].ravel())), shape=(len(leaf), len(leaf))).tocsr()
    far = dijkstra(graph, directed=False, indices=base)
    return float(far[np.isfinite(far)].max())


def labelled_leaves(n_points: int, most: int) -> Iterator[Leaf]:
    """At most so many leaves of a plant, evenly over its leaves and days."""
    plants: dict[str, list[Leaf]] = {}
    for data_set, plant, name, points, labels in labelled_plants():
        for label in range(2, labels.max() + 1):
            found = cut_leaf(points, labels, label, n_points)
            if found is not None:
                points_of, organ, start = found
                plants.setdefault(plant, []).append(
                    Leaf(data_set, plant, f"{name} {label - 1}", points_of, organ, [start])
                )
    for leaves in plants.values():
        for i in np.unique(np.linspace(0, len(leaves) - 1, min(most, len(leaves))).round().astype(int)):
            yield leaves[i]


class Summary(NamedTuple):
    """Over plants, nats a leaf: mean gain, its standard error, median, share of plants above 0."""

    mean: float
    error: float
    median: float
    share: float

    @classmethod
    def of(cls, gains_of_leaves: Sequence[float], plants: Sequence[str]) -> "Summary":
        of_plant: dict[str, list[float]] = {}
        for gain, plant in zip(gains_of_leaves, plants, strict=True):
            of_plant.setdefault(plant, []).append(gain)
        means = np.array([np.mean(values) for values in of_plant.values()])
        error = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
        return cls(means.mean(), error, float(np.median(means)), float(np.mean(means > 0.0)))


def study(
    leaves: Sequence[Leaf], pool: ProcessPoolExecutor
) -> tuple[list[Fitted], list[dict[str, tuple[float, float]]]]:
    """Steps 2 to 4: the fits, and the gains of each leaf."""
    print(f"{len(leaves)} leaves: fitting", file=sys.stderr, flush=True)
    every = list(progress(pool.map(fit_leaf, leaves), len(leaves)))
    fits = [it for it in every if it.states["full"].share[2] < MOST_OUTLIERS]
    for it in every:
        if it.states["full"].share[2] >= MOST_OUTLIERS:
            print(
                f"left out: {it.leaf.data_set}, {it.leaf.plant}, {it.leaf.name}: {100 * it.states['full'].share[2]:.0f} % not explained",
                file=sys.stderr,
            )
    priors = {
        plant: {model: learned([it for it in fits if it.leaf.plant != plant], model) for model in HELD}
        for plant in {it.leaf.plant for it in fits}
    }
    print("\npredicting left-out plants", file=sys.stderr, flush=True)
    return fits, list(progress(pool.map(gains, [(it, priors[it.leaf.plant]) for it in fits]), len(fits)))


def report(fits: Sequence[Fitted], found: Sequence[dict[str, tuple[float, float]]]) -> None:
    leaves = [it.leaf for it in fits]
    sets = list(dict.fromkeys(leaf.data_set for leaf in leaves))
    plants = [leaf.plant for leaf in leaves]
    print(f"{len(leaves)} leaves of {len(set(plants))} plants; gain of the full model, nats a leaf")
    print(f"{'':20}{'gain':>9}{'error':>8}{'median':>9}{'plants > 0':>11}{'over a constant':>17}")
    for model in found[0]:
        over_neutral, over_constant = ([it[model][i] for it in found] for i in range(2))
        all_of, constant = Summary.of(over_neutral, plants), Summary.of(over_constant, plants)
        print(
            f"{model:20}{all_of.mean:9.1f}{all_of.error:8.1f}{all_of.median:9.1f}{100 * all_of.share:9.0f} %"
            f"{constant.mean:9.1f} ±{constant.error:6.1f}"
        )
    print("\nThe same by data set: mean over plants (share of plants above 0)")
    print(f"{'':20}" + "".join(f"{name[-17:]:>19}" for name in sets))
    number = [len({leaf.plant for leaf in leaves if leaf.data_set == name}) for name in sets]
    print(
        f"{'plants, leaves':20}"
        + "".join(f"{n:>15}, {sum(leaf.data_set == s for leaf in leaves):2}" for n, s in zip(number, sets, strict=True))
    )
    for model in found[0]:
        cells = []
        for name in sets:
            those = [i for i, leaf in enumerate(leaves) if leaf.data_set == name]
            of_set = Summary.of([found[i][model][0] for i in those], [plants[i] for i in those])
            cells.append(f"{of_set.mean:10.1f} ({100 * of_set.share:3.0f} %)")
        print(f"{model:20}" + "".join(f"{cell:>19}" for cell in cells))


def report_priors(fits: Sequence[Fitted]) -> None:
    every = learned(fits, "full")
    print("\nWhat is learned from all plants beside the species file's prior: mean ± spread; 10 %, 90 % of fits")
    values = np.array([it.states["full"].theta[LEARNED] for it in fits])
    for row, place in enumerate(LEARNED):
        name = SPECIES.space.names[place] if place < K else "log thickness, cm"
        low, high = np.quantile(values[:, row], [0.1, 0.9])
        print(
            f"{name:20}{every.mean[row]:9.2f} ±{every.std[row]:7.2f}{WIDE.mean[row]:12.2f} ±{WIDE.std[row] / WIDER:7.2f}"
            f"{low:12.2f}{high:9.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--leaves", type=int, default=8, help="of a plant at most, over all its days; 99: all")
    parser.add_argument("--points", type=int, default=3000, help="of a leaf at most")
    arguments = parser.parse_args()
    if not DATA.is_dir():
        sys.exit(f"{DATA} is absent: there are no leaves to study")
    leaves = [*unlabelled_leaves(arguments.points), *labelled_leaves(arguments.points, arguments.leaves)]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        fits, found = study(leaves, pool)
    report(fits, found)
    report_priors(fits)


if __name__ == "__main__":
    main()
