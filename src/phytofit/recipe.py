"""The recipe of a run: every setting, read off the one place where it stands, its function's keyword default."""

import inspect
from collections.abc import Callable
from typing import Any

from phytofit.cloud import remove_outliers, thin
from phytofit.fitting import METHODS, fit, fit_likelihood, fit_paper
from phytofit.paper.distances import chamfer, hausdorff, labelled_hausdorff, quantile_hausdorff
from phytofit.paper.objective import PaperObjective
from phytofit.paper.scouting import SCOUTING, scout
from phytofit.reconstruct import reconstruct
from phytofit.results import FittedPhytomer
from phytofit.segmentation import segment

__all__ = ["defaults", "recipe", "recipe_of"]

STEPS: dict[str, Callable[..., Any]] = {
    "reconstruct": reconstruct,
    "segment": segment,
    "fit": fit,
    "method_likelihood": fit_likelihood,
    "method_paper": fit_paper,
    "remove_outliers": remove_outliers,
    "thin": thin,
    "objective": PaperObjective,
    "distance_hausdorff": hausdorff,
    "distance_quantile": quantile_hausdorff,
    "distance_chamfer": chamfer,
    "distance_labels": labelled_hausdorff,
}
STEPS_OF = {"likelihood": ("remove_outliers", "search"), "paper": ("remove_outliers", "objective")}  # beside fit
NOT_SETTINGS = {
    "progress",
    "executor",
    "threads",
    "units",
    "starts",
}  # inputs, and what does not change the result
BY_METHOD = {"n_points", "seed", "distance"}  # that a method hands on
BY_FIT = {"seed", "distance", "random_start"}  # that fit hands on
HANDED_ON: dict[Callable[..., Any], set[str]] = {fit: set(), **dict.fromkeys(METHODS.values(), BY_FIT)}


def defaults(function: Callable[..., Any]) -> dict[str, Any]:
    """The keyword defaults of a function."""
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}


def recipe() -> dict[str, dict[str, Any]]:
    """All settings with their defaults: ``{step: {setting: value}}``; ``search`` is the short one of the likelihood."""
    found = {}
    for step, function in STEPS.items():
        handed_on = HANDED_ON.get(function, BY_METHOD)
        found[step] = {k: v for k, v in defaults(function).items() if k not in NOT_SETTINGS | handed_on}
    found["search"] = {**found["objective"], **SCOUTING, "n_points": defaults(scout)["n_points"]}
    return {step: settings for step, settings in found.items() if settings}


def recipe_of(result: FittedPhytomer) -> dict[str, dict[str, Any]]:
    """What made this result, no more: what `fit` was given or chose by itself, and the settings of the steps that its
    method uses."""
    steps = recipe()
    used = {"species": result.species.name, "seed": result.seed, **result.settings}
    names = [*STEPS_OF[result.method], f"distance_{used.get('distance', 'chamfer')}"]
    return {"fit": used, **{step: steps[step] for step in names if step in steps}}
