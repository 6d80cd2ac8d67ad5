"""What each part of the method is worth: distances, covariance noise, elite fraction, and other optimisers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from cmaes import CMA
from scipy.optimize import differential_evolution

import phytofit
import phytofit.fitting
import phytofit.paper
import phytofit.parameters
import phytofit.start
from evaluation.jobs import run_all
from evaluation.settings import PAPERS, Budget
from evaluation.tables import write_markdown, write_table

FIRST_SEED = 300_000
TRAITS = ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter")
FITS: dict[str, dict[str, Any]] = {  # settings of phytofit.fit
    "the paper's: Hausdorff distance, covariance noise 0.5, elite 10 %": {},
    "quantile Hausdorff distance (95 %)": {"distance": "quantile"},
    "Chamfer distance": {"distance": "chamfer"},
    "without covariance noise": {"covariance_noise": 0.0},
    "elite 5 %": {"elite_fraction": 0.05},
    "elite 20 %": {"elite_fraction": 0.2},
    "likelihood, refined (the default)": {"method": "likelihood"},
}
Objective = Callable[[np.ndarray], np.ndarray]


def make(budget: Budget, out: Path) -> None:
    settings = {**budget.search, "n_samples": budget.ablation_samples}
    jobs = [(name, number, settings) for name in (*FITS, *OPTIMISERS) for number in range(budget.ablated)]
    table = pd.DataFrame(run_all(ablated, jobs, "Ablations"))
    write_table(table, "ablations", out)
    rows = []
    for name in (*FITS, *OPTIMISERS):
        those = table[table["what"] == name]
        errors = [f"{np.sqrt((those[t] ** 2).mean()):.2f}{'°' if 'angle' in t else ' cm'}" for t in TRAITS]
        distance = those["distance"].median()
        rows.append([name, *errors, "" if np.isnan(distance) else f"{distance:.2f} cm"])
    head = ["", *(f"RMSE, {t.replace('_', ' ')}" for t in TRAITS), "Hausdorff distance reached, median"]
    write_markdown(rows, head, "ablations", out)


def ablated(what: str, number: int, settings: dict[str, int]) -> dict[str, Any]:
    """Errors of the traits of a simulated phytomer, 0.5 cm noise, and the Hausdorff distance that was reached."""
    made = phytofit.simulate(stem_above="equal", seed=FIRST_SEED + number)
    true = {t.name: t.value for t in phytofit.measure(made.organs)}
    if what in FITS:
        own = FITS[what]
        others = {} if "method" in own else {"method": "paper", **settings}
        result = phytofit.fit(made.points, "cm", threads=1, **others, **own)
        traits = result.traits
        reached = result.error if not own.keys() & {"method", "distance"} else np.nan
    else:
        traits, reached = OPTIMISERS[what](made.points, settings)
    return {"what": what, "number": number, "distance": reached} | {
        t.name: t.value - true[t.name] for t in traits if t.name in TRAITS
    }


def problem_of(
    points: np.ndarray, n_points: int
) -> tuple[phytofit.parameters.ParameterSpace, np.ndarray, phytofit.paper.PaperObjective]:
    """What is searched: the space of Eq. (1), the mean to start from, and the paper's objective on a cloud (n, 3)."""
    species = PAPERS
    found = phytofit.start.prepare(phytofit.from_points(points, "cm"), species, n_points=n_points)
    objective = phytofit.paper.PaperObjective(
        species.model,
        phytofit.paper.Reference.of(found.points),
        starts=[start.pose for start in found.starts],
        n_points=n_points,
    )
    return species.space, phytofit.fitting.mean_at(found.starts[0], species), objective


def traits_at(objective: phytofit.paper.PaperObjective, x: np.ndarray) -> tuple[list[phytofit.Trait], float]:
    organs = [organ.row(0) for organ in PAPERS.model.organs(x)]
    return phytofit.measure(organs), objective.register(x)[1]


def box_of(space: phytofit.parameters.ParameterSpace, mean: np.ndarray) -> np.ndarray:
    """Lower and upper ends (k, 2) of three prior spreads around the mean, within the bounds."""
    return np.stack(
        [np.maximum(mean - 3.0 * space.std, space.lower), np.minimum(mean + 3.0 * space.std, space.upper)], axis=1
    )


def random_search(points: np.ndarray, settings: dict[str, int]) -> tuple[list[phytofit.Trait], float]:
    """The best of as many draws from the prior."""
    space, mean, objective = problem_of(points, settings["n_points"])
    best, least = mean, np.inf
    for seed in range(settings["n_generations"]):
        xs = phytofit.paper.CrossEntropy(space, n_samples=settings["n_samples"], mean=mean, seed=seed).ask()
        errors = objective(xs, 1)
        if errors.min() < least:
            best, least = xs[np.argmin(errors)], errors.min()
    return traits_at(objective, best)


def evolution(points: np.ndarray, settings: dict[str, int]) -> tuple[list[phytofit.Trait], float]:
    """Differential evolution (SciPy's), its first generation drawn from the prior."""
    space, mean, objective = problem_of(points, settings["n_points"])
    box = box_of(space, mean)
    first = phytofit.paper.CrossEntropy(space, n_samples=settings["n_samples"], mean=mean).ask()
    found = differential_evolution(
        lambda columns: objective(np.ascontiguousarray(columns.T)),
        box,
        init=np.clip(first, *box.T),
        maxiter=settings["n_generations"] - 1,
        tol=0.0,
        polish=False,
        updating="deferred",
        vectorized=True,
        rng=0,
    )
    return traits_at(objective, found.x)


def covariance_matrix_adaptation(points: np.ndarray, settings: dict[str, int]) -> tuple[list[phytofit.Trait], float]:
    """CMA-ES (the package cmaes), started with half the prior's spread; the mean of its last generation."""
    space, mean, objective = problem_of(points, settings["n_points"])
    box = (box_of(space, mean) - mean[:, np.newaxis]) / space.std[:, np.newaxis]
    search = CMA(np.zeros(len(mean)), 0.5, box, seed=0, population_size=settings["n_samples"])
    for _ in range(settings["n_generations"]):
        zs = [search.ask() for _ in range(search.population_size)]
        errors = objective(mean + space.std * np.array(zs))
        search.tell(list(zip(zs, errors.tolist(), strict=True)))
    return traits_at(objective, mean + space.std * search.mean)


OPTIMISERS = {
    "CMA-ES in place of cross-entropy": covariance_matrix_adaptation,
    "differential evolution": evolution,
    "random search": random_search,
}
