"""The picture of a reconstruction: functions of a result that return a figure."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from phytofit.reconstruct.depth import Reconstruction

__all__ = ["plot_reconstruction"]

SIDES = (("from the side", 0, 2), ("from the front", 1, 2), ("from above", 0, 1))
MOST_COLORS = 8  # views; more share the last colour


def plot_reconstruction(result: Reconstruction, title: str = "") -> Figure:
    """The cloud from three sides, cm, z up, each point coloured by how many views saw it; flags in the title."""
    points = result.cloud.points
    span = np.ptp(points, axis=0) + 4.0
    widths = [float(span[a]) for _, a, _ in SIDES]
    figure = Figure(figsize=(14.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, width_ratios=[max(w, 0.4 * max(widths)) for w in widths])
    most = min(MOST_COLORS, len(result.files))
    norm = BoundaryNorm(np.arange(0.5, max(most, 2) + 1.0), 256)
    shown = np.minimum(result.n_views, most)
    for ax, (name, a, b) in zip(axes, SIDES, strict=True):
        ax.scatter(points[:, a], points[:, b], c=shown, cmap="viridis", norm=norm, s=1.0, linewidths=0, rasterized=True)
        ax.set_aspect("equal")
        ax.set_xlabel(f"{'xyz'[a]} (cm)")
        ax.set_ylabel(f"{'xyz'[b]} (cm)")
        ax.set_title(name, fontsize=10)
        ax.grid(alpha=0.25)
    bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=list(axes), shrink=0.5, ticks=range(1, max(most, 2) + 1))
    more = f" ({most}: or more)" if len(result.files) > most else ""
    bar.set_label(f"views that saw a point{more}")
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
