"""Pictures of a fit: the model on the points, and how the search went."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from phytofit.fitted import Fit
from phytofit.models import LEAF, STEM, Organ, mesh, move

__all__ = ["plot_convergence", "plot_fit"]

FloatArray = NDArray[np.float64]
COLORS = {STEM: "#D55E00", LEAF: "#009E73"}  # Okabe and Ito: told apart by the colour-blind
REFERENCE = "#333333"
VIEWS = (("from the side", 0, 2), ("from the front", 1, 2), ("from above", 0, 1))
SHOWN = ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter")


def plot_fit(result: Fit, title: str = "") -> Figure:
    """The reference cloud and the fitted model from three sides, upright, cm (or relative lengths)."""
    upright: FloatArray = np.linalg.inv(result.pose).astype(float)
    points = result.reference @ upright[:3, :3].T + upright[:3, 3]
    organs = move(result.organs, upright)
    drawn = np.concatenate([points, *(organ.axis for organ in organs)])
    span = np.ptp(drawn, axis=0) + 4.0 * result.scale
    widths = [span[a] for _, a, _ in VIEWS]
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, width_ratios=[max(w, 0.35 * max(widths)) for w in widths])
    unit = "relative length" if result.relative else "cm"
    for ax, (name, a, b) in zip(axes, VIEWS, strict=True):
        ax.scatter(points[:, a], points[:, b], s=1.2, c=REFERENCE, linewidths=0, rasterized=True, zorder=1)
        for organ in organs:
            _draw(ax, organ, a, b)
        ax.set_aspect("equal")
        ax.xaxis.set_major_locator(MaxNLocator(nbins=max(1, round(9 * span[a] / max(widths)))))
        ax.set_xlabel(f"{'xyz'[a]} ({unit})")
        ax.set_ylabel(f"{'xyz'[b]} ({unit})")
        ax.set_title(name, fontsize=10)
        ax.grid(alpha=0.25)
    handles = [
        Line2D([], [], marker="o", linestyle="", markersize=3, color=REFERENCE, label="reference cloud"),
        Line2D([], [], linewidth=6, alpha=0.5, color=COLORS[STEM], label="fitted stem"),
        Line2D([], [], linewidth=6, alpha=0.5, color=COLORS[LEAF], label="fitted leaf, midrib in black"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    found = {trait.name: trait for trait in result.traits}
    numbers = ", ".join(f"{name.replace('_', ' ')} {found[name].value:.1f} {found[name].unit}" for name in SHOWN)
    lines = [title, numbers.replace(" deg", "°"), *(f"flag: {flag}" for flag in result.flags)]
    figure.suptitle("\n".join(line for line in lines if line), fontsize=11)
    figure.draw_without_rendering()  # the layout is right from the second time on
    return figure


def _draw(ax: Axes, organ: Organ, a: int, b: int) -> None:
    """An organ's surface, half transparent, over the points; its midrib or axis as a line."""
    surface = mesh([organ], n_around=16)
    triangles = np.asarray(surface.vertices)[np.asarray(surface.faces)][:, :, [a, b]]
    color = COLORS[organ.kind]
    ax.add_collection(PolyCollection(list(triangles), facecolor=color, edgecolor="none", alpha=0.25, zorder=2))
    ax.add_collection(PolyCollection(list(triangles), facecolor="none", edgecolor=color, lw=0.25, alpha=0.6, zorder=3))
    if organ.kind == LEAF:
        ax.add_collection(LineCollection([organ.axis[:, [a, b]]], colors="black", linewidths=1.0, zorder=4))


def plot_convergence(result: Fit) -> Figure:
    """Mean and spread of the elite for each parameter, and its errors, over the generations (Fig. 6b)."""
    searched = len(result.history[0].mean)
    names, units = result.species.space.names[:searched], result.species.space.units[:searched]
    generation = np.array([g.index for g in result.history])
    mean = np.array([g.mean for g in result.history])
    std = np.array([np.sqrt(np.diag(g.cov)) for g in result.history])
    scale = np.array([result.scale if unit == "cm" else 1.0 for unit in units])
    mean, std = mean * scale, std * scale
    figure = Figure(figsize=(13.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, (len(names) + 2) // 2, sharex=True).ravel()
    for i, (ax, name, unit) in enumerate(zip(axes, names, units, strict=False)):
        ax.fill_between(generation, mean[:, i] - std[:, i], mean[:, i] + std[:, i], color="#0072B2", alpha=0.25, lw=0)
        ax.plot(generation, mean[:, i], color="#0072B2", marker="o", markersize=3)
        if result.estimate is not None:
            ax.axhline(result.parameters[name], color="black", lw=1.0, ls="--")
        ax.set_title(name.replace("_", " "), fontsize=10)
        ax.set_ylabel("relative length" if result.relative and unit == "cm" else unit)
    ax = axes[len(names)]
    ax.plot(
        generation, [g.threshold * result.scale for g in result.history], color="#D55E00", label="worst of the elite"
    )
    ax.plot(generation, [g.best_error * result.scale for g in result.history], color="#009E73", label="best", ls="--")
    ax.set_title("error", fontsize=10)
    ax.set_ylabel("relative length" if result.relative else "cm")
    ax.legend(frameon=False, fontsize=8)
    for ax in axes:
        ax.grid(alpha=0.25)
        ax.set_xlabel("generation")
        ax.xaxis.get_major_locator().set_params(integer=True)
    for ax in axes[len(names) + 1 :]:
        ax.remove()
    figure.suptitle(
        "Elite mean and standard deviation in each generation of the search: how far it has contracted, not the error"
        + ("; dashed: after refinement" if result.estimate is not None else ""),
        fontsize=11,
    )
    return figure
