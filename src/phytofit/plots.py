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
from phytofit.segmentation import Segmentation
from phytofit.validation import Agreement

__all__ = ["plot_agreement", "plot_convergence", "plot_fit", "plot_segmentation"]

FloatArray = NDArray[np.float64]
COLORS = {STEM: "#D55E00", LEAF: "#009E73"}  # Okabe and Ito: told apart by the colour-blind
REFERENCE = "#333333"
VIEWS = (("from the side", 0, 2), ("from the front", 1, 2), ("from above", 0, 1))
FEW = 8  # pairs, up to which each is named; of more only those that are far off
LEAF_COLORS = ("#E69F00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")  # Okabe and Ito, by rank
STEM_COLOR, UNKNOWN_COLOR = "#000000", "#BBBBBB"
MOST_DRAWN = 30_000  # points of a plant
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


def plot_segmentation(result: Segmentation, title: str = "") -> Figure:
    """A plant's points by organ from two sides at right angles, leaves coloured and numbered by rank, cm."""
    cloud, upright = result.cloud.points, _upright(result.up)
    chosen = np.linspace(0, len(cloud) - 1, min(len(cloud), MOST_DRAWN)).astype(int)
    points, labels = cloud[chosen] @ upright.T, result.labels[chosen]
    unit = "relative length" if result.cloud.unit == "none" else "cm"
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharey=True)
    path = result.stem_path @ upright.T
    for ax, (name, a, b) in zip(axes, VIEWS[:2], strict=True):
        for label in np.unique(labels):
            inside = points[labels == label]
            color = UNKNOWN_COLOR if label == 0 else STEM_COLOR if label == 1 else LEAF_COLORS[(label - 2) % 7]
            ax.scatter(inside[:, a], inside[:, b], s=1.5, c=color, linewidths=0, rasterized=True, zorder=1)
        ax.plot(path[:, a], path[:, b], color="white", lw=1.2, zorder=3)
        for leaf in result.leaves:
            line = leaf.midrib @ upright.T
            ax.plot(line[:, a], line[:, b], color="black", lw=0.6, zorder=2)
            ax.annotate(
                str(leaf.rank), line[-1, [a, b]], fontsize=10, ha="center", va="center", zorder=4,
                bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": LEAF_COLORS[(leaf.rank - 1) % 7], "lw": 1.8},
            )  # fmt: skip
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"across ({unit})", title=name)
        ax.grid(alpha=0.25)
    axes[0].set_ylabel(f"up ({unit})")
    said = f"{len(result.leaves)} leaves, stem {result.stem_length:.1f} {unit}: black, its axis white; grey: no organ"
    figure.suptitle("\n".join(line for line in (title, said) if line), fontsize=11)
    return figure


def _upright(up: FloatArray) -> FloatArray:
    """Rotation (3, 3) that turns `up` to +z, and leaves the cloud as it is where it is that already."""
    first = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = first - (first @ up) * up
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up])


def plot_agreement(pairs: pd.DataFrame, found: Agreement) -> Figure:
    """Results of one trait against the hand, with intervals; and their differences against the mean of both (Bland and
    Altman), with bias and limits of agreement.  ``pairs`` as a :class:`phytofit.validation.Comparison` has them."""
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
    scatter.set(xlabel=f"by hand: {name}", ylabel=f"result: {name}", aspect="equal", xlim=span)
    middle = 0.5 * (measured + value)
    difference.plot(middle, value - measured, "o", ms=4, color="#0072B2")
    difference.axhline(0.0, color="0.5", lw=1)
    difference.axhline(found.bias, color="#D55E00", label="bias")
    if found.n > 1:
        for end in (found.lower, found.upper):
            difference.axhline(
                end, color="#D55E00", ls="--", label="95 % limits of agreement" if end > found.bias else ""
            )
    difference.set(xlabel=f"mean of both: {name}", ylabel=f"result minus hand ({found.unit})")
    difference.legend(fontsize=8)
    named = pairs["cloud"].isin(found.outliers) if found.n > FEW else pairs["cloud"].notna()
    for cloud, x, y in zip(pairs["cloud"][named], middle[named], (value - measured)[named], strict=True):
        difference.annotate(str(cloud), (x, y), fontsize=8, xytext=(4, 4), textcoords="offset points")
    for ax in (scatter, difference):
        ax.grid(alpha=0.25)
    return figure
