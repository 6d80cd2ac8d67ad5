"""Pictures of whole plants: reconstructed, taken apart, measured."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phytofit.reconstruct import Reconstruction
from phytofit.segmentation import Segmentation

__all__ = ["plot_plant", "plot_reconstruction", "plot_segmentation"]

FloatArray = NDArray[np.float64]

SIDES = (("from the side", 0, 2), ("from the front", 1, 2), ("from above", 0, 1))
LEAF_COLORS = ("#E69F00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")  # Okabe and Ito, by rank
STEM_COLOR, UNKNOWN_COLOR = "#000000", "#BBBBBB"
MOST_DRAWN = 30_000  # points of a plant
TABLE_TRAITS = ("leaf_length", "leaf_width", "leaf_angle", "leaf_azimuth", "collar_height")  # of each leaf


def plot_reconstruction(result: Reconstruction, title: str = "") -> Figure:
    """The cloud from three sides, cm, z up, each point coloured by the view that it came from; flags in the title."""
    points = result.cloud.points
    span = np.ptp(points, axis=0) + 4.0
    widths = [float(span[a]) for _, a, _ in SIDES]
    figure = Figure(figsize=(14.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, width_ratios=[max(w, 0.4 * max(widths)) for w in widths])
    n = len(result.files)
    norm = BoundaryNorm(np.arange(-0.5, max(n, 2)), 256)
    mixed = np.random.default_rng(0).permutation(len(points))  # so that no view covers the others
    for ax, (name, a, b) in zip(axes, SIDES, strict=True):
        across, up, view = points[mixed, a], points[mixed, b], result.view[mixed]
        ax.scatter(across, up, c=view, cmap="viridis", norm=norm, s=1.0, linewidths=0, rasterized=True)
        ax.set_aspect("equal")
        ax.set_xlabel(f"{'xyz'[a]} (cm)")
        ax.set_ylabel(f"{'xyz'[b]} (cm)")
        ax.set_title(name, fontsize=10)
        ax.grid(alpha=0.25)
    ticks = list(range(0, n, max(1, n // 12)))
    bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=list(axes), shrink=0.7, ticks=ticks)
    bar.ax.set_yticklabels([Path(result.files[i]).stem for i in ticks], fontsize=7)
    bar.set_label("view that a point came from")
    numbers = [f"{len(result.files)} views, {len(points)} points"]
    if result.step_deg is not None:
        numbers.append(f"step {abs(result.step_deg):.1f}°")
    if result.pairs:
        numbers.append(f"{result.residual_cm:.2f} cm between neighbours")
    if result.loop is not None:
        numbers.append(f"loop {result.loop[0]:.1f}°, {result.loop[1]:.2f} cm")
    lines = [title, ", ".join(numbers)]
    lines += [f"rejected: {view.file}, {view.reason}" for view in result.rejected]
    lines += [f"flag: {flag}" for flag in result.flags]
    figure.suptitle("\n".join(line for line in lines if line), fontsize=10)
    return figure


def plot_segmentation(result: Segmentation, title: str = "") -> Figure:
    """A plant's points by organ from two sides at right angles, leaves coloured and numbered by rank, cm."""
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    _draw_organs(list(figure.subplots(1, 2, sharey=True)), result)
    figure.suptitle("\n".join(line for line in (title, _described(result)) if line), fontsize=11)
    return figure


def plot_plant(result: Segmentation, table: pd.DataFrame, title: str = "") -> Figure:
    """The plant by organ, leaves coloured and numbered, beside the table of their traits with 95 % intervals.

    ``table`` has the columns of ``traits.csv``; a star marks leaves with a flag.
    """
    figure = Figure(figsize=(15.0, max(6.5, 2.5 + 0.45 * len(result.leaves))), layout="constrained")
    FigureCanvasAgg(figure)
    side, front, beside = figure.subplots(1, 3, width_ratios=[1.0, 1.0, 1.7])
    _draw_organs([side, front], result)
    leaves = table[table["organ"] == "leaf"]
    rows, colors = [], []
    for leaf in result.leaves:
        mine = leaves[leaves["rank"] == leaf.rank].set_index("trait")
        flagged = bool(mine["flags"].fillna("").astype(bool).any())
        rows.append([f"{leaf.rank}{'*' if flagged else ''}", *(_cell(mine, trait) for trait in TABLE_TRAITS)])
        colors.append(LEAF_COLORS[(leaf.rank - 1) % len(LEAF_COLORS)])
    unit = "rel" if result.cloud.unit == "none" else "cm"
    units = {"leaf_angle": "°", "leaf_azimuth": "°"}
    head = ["leaf", *(f"{trait.replace('_', ' ')}\n({units.get(trait, unit)})" for trait in TABLE_TRAITS)]
    beside.axis("off")
    drawn = beside.table(rows, colLabels=head, loc="center", cellLoc="center", colWidths=[0.08, *[0.184] * 5])
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    drawn.scale(1.0, 2.1)
    for (row, column), cell in drawn.get_celld().items():
        cell.set_edgecolor("0.8")
        if row == 0:
            cell.set_height(1.5 * cell.get_height())
        elif column == 0:
            cell.set_facecolor((*to_rgb(colors[row - 1]), 0.35))
    lines = [title, _described(result), "95 % intervals in brackets; * flagged: see traits.csv"]
    figure.suptitle("\n".join(line for line in lines if line), fontsize=11)
    return figure


def _cell(traits: pd.DataFrame, name: str) -> str:
    """A trait's value, with its interval in brackets below where there is one."""
    if name not in traits.index:
        return "–"
    value, low, high = (traits[column].to_dict()[name] for column in ("value", "low", "high"))
    ends = ["–" if np.isnan(end) else f"{end:.1f}" for end in (low, high)]
    said = f"{value:.1f}"
    return said if ends == ["–", "–"] else f"{said}\n[{ends[0]}, {ends[1]}]"


def _described(result: Segmentation) -> str:
    unit = "relative" if result.cloud.unit == "none" else "cm"
    return f"{len(result.leaves)} leaves, stem {result.stem_length:.1f} {unit}: black, its axis white; grey: no organ"


def _draw_organs(axes: list[Axes], result: Segmentation) -> None:
    cloud, upright = result.cloud.points, _upright(result.up)
    chosen = np.linspace(0, len(cloud) - 1, min(len(cloud), MOST_DRAWN)).astype(int)
    points, labels = cloud[chosen] @ upright.T, result.labels[chosen]
    unit = "relative length" if result.cloud.unit == "none" else "cm"
    path = result.stem_path @ upright.T
    for ax, (name, a, b) in zip(axes, SIDES[:2], strict=True):
        for label in np.unique(labels):
            inside = points[labels == label]
            color = UNKNOWN_COLOR if label == 0 else STEM_COLOR if label == 1 else LEAF_COLORS[(label - 2) % 7]
            ax.scatter(inside[:, a], inside[:, b], s=1.5, c=color, linewidths=0, rasterized=True, zorder=1)
        ax.plot(path[:, a], path[:, b], color="white", lw=1.2, zorder=3)
        for leaf in result.leaves:
            line = leaf.midrib @ upright.T
            ax.plot(line[:, a], line[:, b], color="black", lw=0.6, zorder=2)
            ax.annotate(
                str(leaf.rank), (line[-1, a], line[-1, b]), fontsize=10, ha="center", va="center", zorder=4,
                bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": LEAF_COLORS[(leaf.rank - 1) % 7], "lw": 1.8},
            )  # fmt: skip
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"across ({unit})", title=name)
        ax.grid(alpha=0.25)
    axes[0].set_ylabel(f"up ({unit})")


def _upright(up: FloatArray) -> FloatArray:
    """Rotation (3, 3) that turns `up` to +z, and leaves the cloud as it is where it is that already."""
    first = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = first - (first @ up) * up
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up])
