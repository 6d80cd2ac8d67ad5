"""Pictures of results.  Functions of a result that return a figure; nothing here needs a screen."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from phytofit.fitting import Fit
from phytofit.models import LEAF, STEM, Organ, mesh, move
from phytofit.validation import Agreement

__all__ = ["plot_agreement", "plot_convergence", "plot_fit", "plot_trials"]

FloatArray = NDArray[np.float64]
COLORS = {STEM: "#D55E00", LEAF: "#009E73"}  # Okabe and Ito: told apart by the colour-blind
REFERENCE = "#333333"
VIEWS = (("from the side", 0, 2), ("from the front", 1, 2), ("from above", 0, 1))
FEW = 8  # pairs, up to which each is named; of more only those that are far off
LINES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"))
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


def plot_agreement(pairs: pd.DataFrame, found: Agreement, against: str = "by hand") -> Figure:
    """Results of one trait against the hand (or the truth), with intervals; and their differences against the mean of
    both (Bland and Altman), with bias and limits of agreement.  ``pairs`` as :func:`phytofit.compare` makes them."""
    measured, value = pairs["measured"].to_numpy(float), pairs["value"].to_numpy(float)
    ends = np.stack([value - pairs["low"].to_numpy(float), pairs["high"].to_numpy(float) - value])
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    scatter, difference = figure.subplots(1, 2)
    name = f"{found.trait.replace('_', ' ')} ({found.unit})"
    scatter.errorbar(measured, value, np.nan_to_num(np.maximum(ends, 0.0)), fmt="o", ms=4, lw=1, color="#0072B2")
    span = np.array([min(measured.min(), value.min()), max(measured.max(), value.max())])
    span += np.array([-0.08, 0.08]) * max(np.ptp(span), 1e-9)
    scatter.plot(span, span, color="0.5", lw=1, zorder=0, label="the same")
    scatter.legend(fontsize=8)
    scatter.set(xlabel=f"{against}: {name}", ylabel=f"result: {name}", aspect="equal", xlim=span)
    middle = 0.5 * (measured + value)
    difference.plot(middle, value - measured, "o", ms=4, color="#0072B2")
    difference.axhline(0.0, color="0.5", lw=1)
    difference.axhline(found.bias, color="#D55E00", label="bias")
    if found.n > 1:
        for end in (found.lower, found.upper):
            difference.axhline(
                end, color="#D55E00", ls="--", label="95 % limits of agreement" if end > found.bias else ""
            )
    difference.set(xlabel=f"mean of both: {name}", ylabel=f"difference of the result ({found.unit})")
    difference.legend(fontsize=8)
    named = pairs["cloud"].isin(found.outliers) if found.n > FEW else pairs["cloud"].notna()
    for cloud, x, y in zip(pairs["cloud"][named], middle[named], (value - measured)[named], strict=True):
        difference.annotate(str(cloud), (x, y), fontsize=8, xytext=(4, 4), textcoords="offset points")
    for ax in (scatter, difference):
        ax.grid(alpha=0.25)
    return figure


def plot_trials(table: pd.DataFrame, percent: float, degrees: float) -> Figure:
    """What more points and more cameras bring: the share of the results of each trait within so many per cent, or
    degrees, of the truth, and their root mean square error.  ``table`` is that of :func:`phytofit.trials.trial_table`.
    """
    settings = list(dict.fromkeys(table["setting"]))
    figure = Figure(figsize=(5.0 * len(settings), 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(settings), squeeze=False, sharex="col", sharey="row")
    for column, setting in zip(axes.T, settings, strict=True):
        those = table[table["setting"] == setting]
        steps = sorted(those["value"].unique())
        for (trait, mine), (color, marker) in zip(those.groupby("trait", sort=False), LINES, strict=False):
            x = [steps.index(value) for value in mine["value"]]
            unit = mine["unit"].iloc[0].replace("deg", "°")
            name = f"{str(trait).replace('_', ' ')} ({unit})"
            column[0].plot(x, 100.0 * mine["within"], color=color, marker=marker, label=name)
            column[1].plot(x, mine["rmse"], color=color, marker=marker, label=name)
        column[1].set_xticks(range(len(steps)), [f"{step:,}" for step in steps])
        column[1].set_xlabel(setting)
        for ax in column:
            ax.grid(alpha=0.25)
    axes[0, 0].set(
        ylabel=f"within {percent:g} % (angle: {degrees:g}°) of the truth, % of the leaves", ylim=(-3.0, 103.0)
    )
    axes[1, 0].set(ylabel="root mean square error, cm (angle: °)", yscale="log")
    handles, names = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False)
    return figure
