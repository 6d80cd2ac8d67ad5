"""Fig. 6: the fit over generations on a simulated, a greenhouse and a field phytomer, with mean and spread."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import phytofit
import phytofit.fitting
import phytofit.models
import phytofit.paper
import phytofit.start
from evaluation.draw import BLACK, outline, save, side_of
from evaluation.jobs import run_all
from evaluation.settings import COLORS, NAMES, PAPERS, SPECIES, Budget, clouds, read

SHOWN = ("leaf_length", "leaf_angle")


def make(budget: Budget, out: Path) -> None:
    chosen: list[tuple[str, Path | None]] = [("simulated, 0.5 cm noise", None)]
    chosen += [(f"greenhouse, {p.stem}", p) for p in clouds("greenhouse") if p.stem == "0007"]
    chosen += [(f"field, {p.stem[:2]}", p) for p in clouds("field")[:1]]
    done = run_all(search, [(path, budget.search) for _, path in chosen], "Fig. 6", one_by_one=True)
    stages(chosen, done, out)
    spread(chosen, done, out)


def search(path: Path | None, settings: dict[str, int]) -> dict[str, Any]:
    """The paper's search on a cloud, its model at each generation's mean, and the traits of the default."""
    made = phytofit.simulate(stem_above="equal", seed=3)
    cloud = phytofit.from_points(made.points, "cm") if path is None else read(path)
    species = PAPERS
    found = phytofit.start.prepare(cloud, species, n_points=settings["n_points"])
    objective = phytofit.paper.PaperObjective(
        species.model,
        phytofit.paper.Reference.of(found.points),
        starts=[start.pose for start in found.starts],
        n_points=settings["n_points"],
    )
    run = phytofit.paper.minimise(
        phytofit.paper.CrossEntropy(
            species.space,
            n_samples=settings["n_samples"],
            n_generations=settings["n_generations"],
            mean=phytofit.fitting.mean_at(found.starts[0], species),
        ),
        objective,
    )
    models = []
    for generation in run.history:
        registration, error = objective.register(generation.mean)
        organs = [organ.row(0) for organ in species.model.organs(generation.mean)]
        models.append((phytofit.models.move(organs, registration.T_target_source), error))
    default = phytofit.fit(cloud, threads=1)
    return {
        "points": found.points,
        "models": models,
        "history": run.history,
        "default": default.parameters,
        "true": None if path else dict(zip(SPECIES.space.names, made.x.tolist(), strict=True)),
    }


def stages(chosen: list[tuple[str, Path | None]], done: list[dict[str, Any]], out: Path) -> None:
    last = len(done[0]["models"]) - 1
    shown = sorted({0, last // 3, 2 * last // 3, last})
    figure = Figure(figsize=(12.0, 3.4 * len(done)), layout="constrained")
    axes = figure.subplots(len(done), len(shown), squeeze=False)
    for row, (title, _), made in zip(axes, chosen, done, strict=True):
        upright = side_of(made["models"][-1][0])
        limits = [made["points"] @ upright.T] + [organ.axis @ upright.T for organ in made["models"][0][0]]
        box = np.concatenate(limits)[:, :2]
        for ax, i in zip(row, shown, strict=True):
            organs, error = made["models"][i]
            ax.plot(*(made["points"] @ upright.T)[:, :2].T, ".", ms=1.0, color=BLACK, zorder=1, rasterized=True)
            outline(ax, organs, upright, COLORS["paper"])
            ax.set(aspect="equal", xlabel="cm")
            ax.set_xlim(box[:, 0].min() - 3.0, box[:, 0].max() + 3.0)
            ax.set_ylim(box[:, 1].min() - 3.0, box[:, 1].max() + 3.0)
            ax.set_title(f"generation {i + 1}: {error:.1f} cm", fontsize=10)
            ax.grid(alpha=0.25)
        row[0].set_ylabel(f"{title}\ncm")
    figure.suptitle(
        "Reference cloud (black) and the model at the elite's mean, with its Hausdorff distance", fontsize=11
    )
    save(figure, out / "fig6a.png")


def spread(chosen: list[tuple[str, Path | None]], done: list[dict[str, Any]], out: Path) -> None:
    figure = Figure(figsize=(4.0 * len(done), 6.0), layout="constrained")
    axes = figure.subplots(len(SHOWN), len(done), squeeze=False, sharex=True)
    for column, ((title, _), made) in enumerate(zip(chosen, done, strict=True)):
        number = np.array([g.index for g in made["history"]])
        for ax, name in zip(axes[:, column], SHOWN, strict=True):
            k = SPECIES.space.index(name)
            mean = np.array([g.mean[k] for g in made["history"]])
            std = np.sqrt([g.cov[k, k] for g in made["history"]])
            ax.fill_between(number, mean - std, mean + std, color=COLORS["paper"], alpha=0.25, lw=0)
            ax.plot(number, mean, color=COLORS["paper"], marker="s", ms=4)
            ax.axhline(made["default"][name], color=COLORS["likelihood"], ls="--")
            if made["true"]:
                ax.axhline(made["true"][name], color=COLORS["truth"], ls=":")
            ax.set_ylabel(f"{name.replace('_', ' ')} ({SPECIES.space.units[k]})")
            ax.grid(alpha=0.25)
        axes[0, column].set_title(title, fontsize=10)
        axes[-1, column].set_xlabel("generation")
        axes[-1, column].xaxis.get_major_locator().set_params(integer=True)
    handles = [
        Line2D([], [], color=COLORS["paper"], marker="s", ms=4, label="mean of the elite, and its standard deviation"),
        Line2D([], [], color=COLORS["likelihood"], ls="--", label=f"{NAMES['likelihood']}, for comparison"),
        Line2D([], [], color=COLORS["truth"], ls=":", label="truth (simulated)"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    save(figure, out / "fig6b.png")
