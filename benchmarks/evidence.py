"""Which parameters of a leaf's shape earn their place, by evidence that no ruler has a part in.

    python benchmarks/evidence.py [--leaves 4] [--points 3000]

A parameter earns its place if leaves of a plant that was left out are the more probable for it.  So, of all labelled
leaves in ../shared/data (and the paper's clouds, which are one leaf each):

1. A leaf is cut out with its piece of stem, and made as long as the species expects a leaf to be: its shape counts.
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
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import numpy as np
from common import DATA, progress
from cut_leaves import Leaf, leaves

import phytofit
from phytofit.engine.dependence import score_dependence
from phytofit.engine.evidence import log_evidence
from phytofit.engine.holes import find_holes
from phytofit.engine.layout import Layout, State
from phytofit.engine.posterior import Posterior
from phytofit.engine.prior import NO_THICKNESS_CM, Prior
from phytofit.engine.refine import refinement
from phytofit.engine.search import estimate
from phytofit.engine.visibility import Hidden
from phytofit.fitting import mean_at

SPECIES = phytofit.load_species()
K = len(SPECIES.space)
N_GIVEN = 7  # parameters that every model has: those of Eq. (1), and the stem above the leaf
SHAPE = (*SPECIES.space.names[N_GIVEN:], "leaf_thickness")
LAYOUT = Layout(SPECIES.space.names)
PLACE = {name: LAYOUT.place(name) for name in SHAPE}  # in theta
NEUTRAL = {**dict(zip(SHAPE, SPECIES.model.neutral[N_GIVEN:], strict=False)), "leaf_thickness": np.log(NO_THICKNESS_CM)}
LEARNED = [*range(K), PLACE["leaf_thickness"]]  # places in theta whose prior is learned
SIDEWAYS = [PLACE[name] for name in ("leaf_side_bend", "leaf_side_bow", "leaf_roll", "leaf_twist")]
HELD: dict[str, tuple[str, ...]] = {"full": (), **{name: (name,) for name in SHAPE}, "all of them": SHAPE}
POSE_STD = {"turn": 3.0, "shift": 50.0}  # radians, cm: next to nothing is known
WIDER = 3.0  # times the species file's spreads, for the fits that priors are learned from
FLOOR = 0.2  # of the species file's spreads: a learned one is not narrower
BEGUN_ANGLE, BEGUN_BEND, BEGUN_ROLL = (15.0, 60.0), (0.0, 4.0, 8.0), (0.0, 80.0)
COARSE_POINTS, START_NOISE_CM, COARSE_NOISE_CM, COARSE_OUTLIERS = 400, 2.0, (0.3, 0.8), -3.0
MOST_OUTLIERS = 0.25  # of the points: a leaf of which the full model explains less has another shape altogether
HOLE_ROUNDS = 2
CENTRAL = 2.563  # standard deviations from the 10 % to the 90 % quantile
BLUR = 3.0  # times the noise, from which models are begun as well
ROUNDS = 4
BETTER = 0.5  # nats by which a model with a parameter held must be the more probable to tell a poor optimum of the full

Gains = dict[str, tuple[float, float]]  # by model: over the neutral value, over the others' median


class Fitted(NamedTuple):
    """A leaf, and where each model of `HELD` comes to rest; all have the same `hidden` parts of the leaf (what
    was not seen), and of the same `inflation` points whose errors depend on each other count as one."""

    leaf: Leaf
    states: dict[str, State]
    hidden: Hidden | None
    inflation: float


class Learned(NamedTuple):
    """Means and spreads of `LEARNED`."""

    mean: np.ndarray
    std: np.ndarray


THICK = Prior.of(SPECIES.space, thick=True)
FILE = Learned(THICK.mean[LEARNED], THICK.std[LEARNED])
WIDE = FILE._replace(std=WIDER * FILE.std)


def neutral(held: Iterable[str]) -> dict[str, float]:
    return {name: NEUTRAL[name] for name in held}


def likelihood_of(fitted: Fitted, held: dict[str, float], prior: Learned) -> Posterior:
    """Of the leaf under a model with parameters `held`; errors of points that depend on each other count once."""
    leaf = fitted.leaf
    made = Posterior.of(
        SPECIES,
        leaf.points,
        organ=leaf.organ,
        weights=np.full(len(leaf.points), 1.0 / fitted.inflation),
        thick=True,
        hidden=fitted.hidden,
    )
    mean, std, lower, upper = (values.copy() for values in (THICK.mean, THICK.std, THICK.lower, THICK.upper))
    mean[LEARNED] = np.clip(prior.mean, lower[LEARNED], upper[LEARNED])
    std[LEARNED] = prior.std
    for name, spread in POSE_STD.items():
        std[LAYOUT[name]] = spread
    for name, value in held.items():
        mean[PLACE[name]] = lower[PLACE[name]] = upper[PLACE[name]] = value
    return made.under(replace(THICK, mean=mean, std=std, lower=lower, upper=upper))


def refined(likelihood: Posterior, state: State, max_iterations: int = 60) -> State:
    return state.at(refinement(likelihood, state, max_iterations=max_iterations).theta)


def evidence_of(likelihood: Posterior, state: State) -> float:
    """log p(cloud | model, prior) by Laplace's approximation of what lies within the bounds; up to a constant."""
    return log_evidence(likelihood, state, likelihood.evaluate(state))


def beginnings(leaf: Leaf) -> list[State]:
    """Where to begin: what the default method finds, and the most probable, for the model with no and with all of the
    parameters, of what a grid of angles leads to, with a part of the points, much noise and few outliers."""
    feet = [start.pose.copy() for start in leaf.starts]
    for foot, start in zip(feet, leaf.starts, strict=True):
        foot[:3, 3] += start.foot * start.pose[:3, 2]
    means = [mean_at(start, SPECIES) for start in leaf.starts]
    stride = max(1, len(leaf.points) // COARSE_POINTS)
    part = leaf._replace(points=leaf.points[::stride], organ=None if leaf.organ is None else leaf.organ[::stride])
    rough = Fitted(part, {}, None, 1.0 / stride)
    found = []
    for held, rolls in ((SHAPE, (0.0,)), ((), BEGUN_ROLL)):
        likelihood = likelihood_of(rough, neutral(held), WIDE)
        prior = likelihood.prior.bounded("outlier_share", upper=COARSE_OUTLIERS)
        for name, least in zip(("stem_noise", "leaf_noise"), np.log(COARSE_NOISE_CM), strict=True):
            prior = prior.bounded(name, lower=float(least))
        likelihood = likelihood.under(prior)
        ends = []
        for i, angle, bend, roll in product(range(len(means)), BEGUN_ANGLE, BEGUN_BEND, rolls):
            x = means[i].copy()
            begun = {"stem_diameter": 2.0 * leaf.starts[i].radius, "leaf_angle": angle}
            for name, value in (begun | {"leaf_rotate_angle": bend, "leaf_roll": roll}).items():
                x[LAYOUT.place(name)] = value
            ends.append(refined(likelihood, likelihood.start(x, feet[i], START_NOISE_CM), max_iterations=30))
        found.append(min(ends, key=partial(error_at, likelihood)))
    with suppress(np.linalg.LinAlgError), np.errstate(invalid="ignore"):  # a leaf may collapse
        starts = [(mean[:N_GIVEN], foot) for mean, foot in zip(means, feet, strict=True)]
        made = estimate(SPECIES, leaf.points, starts, organ=leaf.organ)
        state = likelihood.start(made.x, made.pose, 1.0)
        stem, leaf_noise, thickness = np.log(made.noise)
        on_stem, _, outlier = np.log(made.share / made.share[1])
        found.append(
            state.changed(
                stem_noise=stem,
                leaf_noise=leaf_noise,
                leaf_thickness=thickness,
                stem_share=on_stem,
                outlier_share=outlier,
            )
        )
    return found


def fit_leaf(leaf: Leaf) -> Fitted:
    """The modes of all models under the wide prior, step 2."""
    fitted = Fitted(leaf, {}, None, 1.0)
    likelihood = likelihood_of(fitted, {}, WIDE)
    state = best_end(likelihood, beginnings(leaf))
    for _ in range(HOLE_ROUNDS):
        fitted = fitted._replace(hidden=find_holes(likelihood, state, likelihood.evaluate(state)))
        likelihood = likelihood_of(fitted, {}, WIDE)
        state = refined(likelihood, state)
    fitted = fitted._replace(inflation=score_dependence(likelihood, state).inflation)
    likelihood = likelihood_of(fitted, {}, WIDE)
    more = np.log(BLUR)
    blurred = state.changed(stem_noise=state["stem_noise"] + more, leaf_noise=state["leaf_noise"] + more)
    models = {model: likelihood_of(fitted, neutral(held), WIDE) for model, held in HELD.items()}
    return fitted._replace(states=at_rest(models, {model: [state, blurred] for model in HELD}))


def at_rest(models: dict[str, Posterior], begun: dict[str, list[State]]) -> dict[str, State]:
    """Where each model comes to rest: the best of its own beginnings, and of where the full model came to rest.

    An optimum that one model finds and another misses would count as a gain or a loss of a parameter that has no part
    in it.  So the full model is begun again from any that is more probable, and then all the others from there.
    """
    full = models["full"]
    others = [model for model in models if model != "full"]
    for _ in range(ROUNDS):
        states = {"full": best_end(full, begun["full"])}
        states |= {model: best_end(models[model], [*begun[model], states["full"]]) for model in others}
        best = min(states.values(), key=partial(error_at, full))
        if error_at(full, best) > error_at(full, states["full"]) - BETTER:
            break
        begun = {model: [state] for model, state in states.items()} | {"full": [best]}
    return states


def best_end(likelihood: Posterior, begun: Sequence[State]) -> State:
    return min((refined(likelihood, state) for state in begun), key=partial(error_at, likelihood))


def error_at(likelihood: Posterior, state: State) -> float:
    inside = np.clip(state.theta, likelihood.prior.lower, likelihood.prior.upper)
    return likelihood.evaluate(state.at(inside), derivatives=False).error


def learned(others: Sequence[Fitted], model: str) -> Learned:
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
    return Learned(middle, np.maximum((high - low) / CENTRAL, FLOOR * FILE.std))


def gains(job: tuple[Fitted, dict[str, Learned]]) -> Gains:
    """Of one leaf: by how much its log evidence under the full model is above that with the parameters `HELD` at their
    neutral values, and at the others' medians."""
    fitted, priors = job
    prior = priors["full"]
    median = dict(zip(LEARNED, prior.mean.tolist(), strict=True))
    models = {model: likelihood_of(fitted, neutral(held), priors[model]) for model, held in HELD.items()}
    constant = {
        f"{model}, constant": likelihood_of(fitted, {name: median[PLACE[name]] for name in held}, prior)
        for model, held in HELD.items()
        if held
    }
    begun = {model: [fitted.states[model.removesuffix(", constant")]] for model in models | constant}
    states = at_rest(models | constant, begun)
    evidence = {model: evidence_of(it, states[model]) for model, it in (models | constant).items()}
    return {
        model: (evidence["full"] - evidence[model], evidence["full"] - evidence[f"{model}, constant"])
        for model, held in HELD.items()
        if held
    }


def study(cut: Sequence[Leaf], each: Callable[..., Iterable[Any]]) -> tuple[list[Fitted], list[Gains]]:
    """Steps 2 to 4: the fits, and what is gained; `each` is map, or that of a pool."""
    print(f"{len(cut)} leaves are fitted", file=sys.stderr, flush=True)
    fits = []
    for it in progress(each(fit_leaf, cut), len(cut)):
        if it.states["full"].share[2] < MOST_OUTLIERS:
            fits.append(it)
        else:
            print(f"\rleft out, too little is explained: {it.leaf.data_set}, {it.leaf.plant} {it.leaf.name}")
    priors = {
        plant: {model: learned([it for it in fits if it.leaf.plant != plant], model) for model in HELD}
        for plant in {it.leaf.plant for it in fits}
    }
    print(f"\n{len(fits)} are predicted", file=sys.stderr, flush=True)
    return fits, list(progress(each(gains, [(it, priors[it.leaf.plant]) for it in fits]), len(fits)))


def of_plants(fits: Sequence[Fitted], values: Sequence[float]) -> np.ndarray:
    """Mean value of each plant's leaves."""
    plants = np.array([it.leaf.plant for it in fits])
    return np.array([np.mean(np.array(values)[plants == plant]) for plant in dict.fromkeys(plants)])


def report(fits: Sequence[Fitted], found: Sequence[Gains]) -> None:
    sets = list(dict.fromkeys(it.leaf.data_set for it in fits))
    print(f"\n{len(fits)} leaves of {len({it.leaf.plant for it in fits})} plants; gain in nats a leaf")
    print(f"{'':20}{'gain':>7}{'std error':>11}{'median':>8}{'plants > 0':>12}{'over a constant, std error':>28}")
    for model in found[0]:
        gain, over_constant = (of_plants(fits, [it[model][i] for it in found]) for i in range(2))
        error, of_constant = (x.std(ddof=1) / np.sqrt(len(x)) for x in (gain, over_constant))
        share = f"{sum(gain > 0)} of {len(gain)}"
        print(f"{model:20}{gain.mean():7.1f}{error:11.1f}{np.median(gain):8.1f}{share:>12}", end="")
        print(f"{over_constant.mean():17.1f}{of_constant:11.1f}")
    print("\nThe same by data set: mean of its plants, and how many of them gain")
    print(f"{'':20}" + "".join(f"{name:>19}" for name in sets))
    for model in found[0]:
        print(f"{model:20}", end="")
        for name in sets:
            here = [i for i, it in enumerate(fits) if it.leaf.data_set == name]
            gain = of_plants([fits[i] for i in here], [found[i][model][0] for i in here])
            print(f"{gain.mean():11.1f}{f'{sum(gain > 0)} of {len(gain)}':>8}", end="")
        print()
    print("\nPriors: what is learned of all plants (mean, spread), and the species file's")
    names = [*SPECIES.space.names, "log thickness, cm"]
    for name, *row in zip(names, *learned(fits, "full"), *FILE, strict=True):
        print(f"{name:20}" + "".join(f"{value:9.2f}" for value in row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--leaves", type=int, default=4, help="of a plant at most, evenly over its days; 99 are all")
    parser.add_argument("--points", type=int, default=3000, help="of a leaf at most")
    arguments = parser.parse_args()
    if not DATA.is_dir():
        sys.exit(f"{DATA.parent} is absent: there are no leaves to study")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        report(*study(list(leaves(arguments.points, arguments.leaves)), pool.map))


if __name__ == "__main__":
    main()
