"""What the figures share."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

import phytofit
import phytofit.models

BLACK = "#222222"
DPI = 130
ABOVE = np.deg2rad(20.0)


def save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=DPI, metadata={"Software": None})


def side_of(organs: Sequence[phytofit.models.Organ]) -> np.ndarray:
    """Rotation (3, 3) that shows a phytomer from its side, somewhat from above so that its blade is seen: the stem's
    axis upwards, the leaf to the right."""
    stem, leaf = organs
    up = stem.axis[-1] - stem.axis[0]
    up = up / np.linalg.norm(up)
    away = leaf.axis[-1] - leaf.axis[0]
    away = away - (away @ up) * up
    away = away / np.linalg.norm(away)
    c, s = np.cos(ABOVE), np.sin(ABOVE)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ np.stack([away, up, np.cross(away, up)])


def outline(ax: Axes, organs: Sequence[phytofit.models.Organ], view: np.ndarray, color: str) -> None:
    """The organs' surfaces as seen along the third axis of the view, half transparent, and the midrib."""
    surface = phytofit.models.mesh(organs, n_around=16)
    triangles = (np.asarray(surface.vertices) @ view.T)[np.asarray(surface.faces)][:, :, :2]
    ax.add_collection(PolyCollection(list(triangles), facecolor=color, edgecolor="none", alpha=0.3, zorder=2))
    midrib = organs[1].axis @ view.T
    ax.plot(midrib[:, 0], midrib[:, 1], color=color, lw=1.2, zorder=3)


def faceted(ax: Axes, vertices: np.ndarray, faces: np.ndarray, view: np.ndarray) -> None:
    """A mesh, far triangles first, shaded by how they face the eye."""
    seen = (vertices @ view.T)[faces]
    normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    light = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    order = np.argsort(seen[:, :, 2].mean(axis=1))
    shade = 0.35 + 0.55 * light[order, np.newaxis] * np.ones(3)
    ax.add_collection(PolyCollection(list(seen[order, :, :2]), facecolors=shade, edgecolors="none"))
