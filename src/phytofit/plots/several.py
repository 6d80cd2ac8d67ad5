"""Which plant of a cloud is which."""

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from phytofit.plots.plant import LEAF_COLORS
from phytofit.segmentation import Segmentation
from phytofit.segmentation.derive import azimuth_frame
from phytofit.text import for_picture

__all__ = ["plot_plants"]

MOST_DRAWN = 30_000  # points


def plot_plants(results: Sequence[Segmentation], title: str = "") -> Figure:
    """The plants of a cloud, coloured and numbered, from two sides at right angles and from above, cm."""
    figure = Figure(figsize=(15.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    up = results[0].up
    zero, ninety = azimuth_frame(up)
    unit = "relative length" if results[0].cloud.unit == "none" else "cm"
    sides = (("from the side", zero, up), ("from the front", ninety, up), ("from above", zero, ninety))
    for ax, (name, across, upward) in zip(figure.subplots(1, 3), sides, strict=True):
        for number, result in enumerate(results, start=1):
            points = result.cloud.points[:: max(1, len(result.cloud) * len(results) // MOST_DRAWN)]
            color = LEAF_COLORS[(number - 1) % len(LEAF_COLORS)]
            ax.scatter(points @ across, points @ upward, s=1.0, color=color, linewidths=0, rasterized=True)
            middle, top = float(np.median(points @ across)), float((points @ upward).max())
            ax.annotate(str(number), (middle, top), (0, 4), textcoords="offset points", ha="center", weight="bold")
        ax.set_aspect("equal")
        ax.margins(0.08)
        ax.set_xlabel(unit)
        ax.set_title(name, fontsize=10)
        ax.grid(alpha=0.25)
    said = f"{len(results)} plants"
    figure.suptitle(f"{for_picture(title)}: {said}" if title else said, fontsize=11)
    return figure
