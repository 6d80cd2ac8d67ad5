"""Views of a plant, beside or below each other, upright and at one scale, with room for labels around what is drawn.

Places in a view are inches from its lower left corner, so that labels and scale bars can be laid out before anything is
rendered.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import FancyBboxPatch
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from phytofit.plots.page import GREY, INK, SMALL, Line, Page, width_in
from phytofit.text import for_picture

__all__ = ["Arrangement", "Panel", "View", "arranged", "widest_side"]

FloatArray = NDArray[np.float64]
PAD_IN = 0.36  # around what is drawn: room for labels, and for the arrow that points up
FOOT_IN = 0.3  # below that, for the scale bar
HEAD_IN = 0.2  # above, for the view's name
NARROWEST_IN = 1.75  # of a view, and lowest: room for its name and a label
CELL_IN = 0.04  # of the grid that says where something is drawn
NEAR_IN = 0.1  # from a label to what it names, beyond which a line leads to it
BAR_SHARE = 0.45  # of the narrowest view's width, that a scale bar is long at most
ARROW_IN, WORD_IN = 0.5, 0.2  # how long the arrow is that points up, and how high the word above it
DOT_SIZES = (0.3, 3.0)  # least and most area of a dot, square points of type
COVERED_IN = 3.0  # how much further off a label had better be than to cover what is drawn with all of itself
HALO = (withStroke(linewidth=2.5, foreground="white"),)


@dataclass(frozen=True)
class View:
    """How a plant is looked at: the rows of ``axes`` (2, 3) point right and up in the picture."""

    name: str
    axes: FloatArray

    def of(self, points: FloatArray) -> FloatArray:
        """Points (n, 3) in the picture, (n, 2)."""
        seen: FloatArray = points @ self.axes.T
        return seen


@dataclass
class Panel:
    """A view on a page.  ``size`` (2,) inches; ``scale`` inches make a length of 1; ``origin`` (2,) of the view is in
    the lower left corner; ``taken`` are boxes of labels: left, bottom, right, top."""

    view: View
    ax: Axes
    size: FloatArray
    scale: float
    origin: FloatArray
    unit: str
    covered: NDArray[np.bool_] = field(init=False)
    taken: list[FloatArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.covered = np.zeros(np.ceil(self.size / CELL_IN).astype(int), np.bool_)

    def at(self, points: ArrayLike) -> FloatArray:
        """Where points (n, 3) are in the panel, (n, 2) inches."""
        place: FloatArray = (self.view.of(np.asarray(points, float).reshape(-1, 3)) - self.origin) * self.scale
        return place

    def dots(self, points: FloatArray, color: ArrayLike | str, *, size: float = 1.5, zorder: float = 2.0) -> None:
        """Points (n, 3), in one colour or each in its own (n, 4)."""
        places = self.at(points)
        self._cover(places)
        self.ax.scatter(places[:, 0], places[:, 1], s=size, c=color, linewidths=0, rasterized=True, zorder=zorder)

    def dot_size(self, points: FloatArray, share: float) -> float:
        """Area of a dot, in square points of type, at which dots are such a share of the room that points take up."""
        cells = np.unique((self.at(points) / CELL_IN).astype(int), axis=0)
        room = len(cells) * (72.0 * CELL_IN) ** 2
        return float(np.clip(share * room / max(len(points), 1), *DOT_SIZES))

    def line(self, points: ArrayLike, color: str, width: float, *, style: str = "-", zorder: float = 4.0) -> None:
        places = self.at(points)
        self._cover(_along(places))
        self.ax.plot(places[:, 0], places[:, 1], color=color, lw=width, ls=style, zorder=zorder)

    def surface(self, triangles: FloatArray, color: str, *, zorder: float = 1.0) -> None:
        """Triangles (n, 3, 3) in one colour, without shade."""
        places = self.at(triangles).reshape(-1, 3, 2)
        self._cover(_along(places[:, [0, 1, 2, 0]].reshape(-1, 2)))
        self.ax.add_collection(PolyCollection(list(places), facecolor=color, edgecolor=color, lw=0.3, zorder=zorder))

    def label(self, text: str, point: ArrayLike, *, color: str = INK, ring: bool = False) -> None:
        """A label as near to a point (3,) as it can be without covering what is drawn or other labels; a thin line
        leads to it from afar.  In a `ring` of its colour, or as it is."""
        anchor = self.at(point)[0]
        lines = text.split("\n")
        size = [max(width_in(line, SMALL, bold=ring) for line in lines), (1.3 * len(lines) - 0.3) * SMALL / 72.0]
        half = 0.5 * np.array(size) + (0.055 if ring else 0.02)
        half[0] = max(half) if ring else half[0]
        place = self._free_place(anchor, half)
        if place is None:
            return
        self.taken.append(np.concatenate([place - half, place + half]))
        edge = place + np.clip(anchor - place, -half, half)
        if np.linalg.norm(edge - anchor) > NEAR_IN:
            self.ax.plot(*np.stack([anchor, edge]).T, color=color, lw=0.7, zorder=7)
        if ring:
            (left, bottom), (width, height) = (place - half).tolist(), (2.0 * half).tolist()
            style = f"round,pad=0,rounding_size={half[1]}"
            self.ax.add_patch(
                FancyBboxPatch((left, bottom), width, height, boxstyle=style, fc="white", ec=color, lw=1.6, zorder=8)
            )
        self.ax.text(
            float(place[0]), float(place[1]), "\n".join(map(for_picture, lines)), fontsize=SMALL, zorder=9,
            color=INK if ring else color, fontweight="bold" if ring else "normal", linespacing=1.05,
            ha="center", va="center" if len(lines) > 1 else "center_baseline", path_effects=None if ring else HALO,
        )  # fmt: skip

    def room(self, point: ArrayLike, way: FloatArray) -> float:
        """How far from a point (3,) in the panel one may go that way (3,), in the unit of lengths."""
        at, step = self.at(point)[0], self.view.axes @ way
        edge = np.where(step > 0.0, self.size - at, at) / np.maximum(np.abs(step), 1e-9)
        return float(edge.min()) / self.scale

    def _free_place(self, anchor: FloatArray, half: FloatArray) -> FloatArray | None:
        """The middle (2,) of a box of that half size in the panel, off other labels, near the anchor, that covers
        little; None where there is no room."""
        angle = np.deg2rad(np.arange(0.0, 360.0, 15.0))
        out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        beside = (half / np.maximum(np.abs(out), 1e-9)).min(axis=1)  # where a box in that direction meets the anchor
        steps = np.arange(CELL_IN, self.size.max(), 2.0 * CELL_IN)
        places = (anchor + (beside + steps[:, np.newaxis])[:, :, np.newaxis] * out).reshape(-1, 2)
        free = np.all((places - half >= 0.0) & (places + half <= self.size), axis=1)
        for box in self.taken:
            free &= np.any((places + half <= box[:2]) | (places - half >= box[2:]), axis=1)
        if not free.any():
            return None
        places, away = places[free], np.repeat(steps, len(out))[free]
        covered = self._covered_in(places - half, places + half) * CELL_IN**2 / np.prod(2.0 * half)
        return np.asarray(places[int(np.argmin(away + COVERED_IN * covered))])

    def _covered_in(self, low: FloatArray, high: FloatArray) -> NDArray[np.int64]:
        """In how many cells of the boxes from low to high (n, 2) something is drawn."""
        total = np.zeros(np.add(self.covered.shape, 1), np.int64)
        total[1:, 1:] = self.covered.cumsum(axis=0).cumsum(axis=1)
        i, j = np.clip((low / CELL_IN).astype(int), 0, self.covered.shape).T
        k, m = np.clip(np.ceil(high / CELL_IN).astype(int), 0, self.covered.shape).T
        count: NDArray[np.int64] = total[k, m] - total[i, m] - total[k, j] + total[i, j]
        return count

    def _cover(self, places: FloatArray) -> None:
        cell = np.clip((places / CELL_IN).astype(int), 0, np.subtract(self.covered.shape, 1))
        self.covered[cell[:, 0], cell[:, 1]] = True

    def scale_bar(self, length: float) -> None:
        """A bar of that length in the lower left corner."""
        left, y = 0.1, 0.08
        self.ax.plot([left, left + length * self.scale], [y, y], color=INK, lw=2.0, solid_capstyle="butt", zorder=6)
        text = f"{length:g} {self.unit}"
        self.ax.text(left, y + 0.06, text, fontsize=SMALL, color=INK, ha="left", va="bottom")
        self.taken.append(np.array([0.0, 0.0, left + max(length * self.scale, width_in(text)), y + 0.25]))

    def up_arrow(self, base: FloatArray, up: FloatArray) -> None:
        """An arrow that points up, beside the plant, from the height of its base (3,)."""
        left, foot = 0.16, float(self.at(base)[0, 1])
        top = foot + min(ARROW_IN * float((self.view.axes @ up)[1]), float(self.size[1]) - WORD_IN - foot)
        self.ax.plot([left - 0.06, left + 0.06], [foot, foot], color=INK, lw=1.2, zorder=6)
        style = {"arrowstyle": "-|>", "color": INK, "lw": 1.2, "shrinkA": 0.0, "shrinkB": 0.0}
        self.ax.annotate("", (left, top), (left, foot), arrowprops=style, zorder=6)
        self.ax.text(left, top + 0.02, "up", fontsize=SMALL, color=INK, ha="center", va="bottom")
        self.taken.append(np.array([0.0, foot - 0.02, 2.0 * left, top + WORD_IN]))


@dataclass(frozen=True)
class Arrangement:
    """Views with the middle (k, 2) of what they show, at `scale` inches to a length of 1; their panels' sizes (k, 2),
    beside or below each other."""

    views: tuple[View, ...]
    middles: FloatArray
    scale: float
    sizes: FloatArray
    below: bool

    @property
    def width(self) -> float:
        """Inches."""
        return float(self.sizes[:, 0].max() if self.below else self.sizes[:, 0].sum())

    @property
    def height(self) -> float:
        """Inches."""
        return float(self.sizes[:, 1].sum() if self.below else self.sizes[:, 1].max())

    def panels(self, page: Page, left: float, top: float, unit: str) -> list[Panel]:
        """The views on a page, named, with their scale bars."""
        made = []
        length = _round_length(BAR_SHARE * float(self.sizes[:, 0].min()) / self.scale)
        for view, middle, size in zip(self.views, self.middles, self.sizes, strict=True):
            at = left + (0.5 * (self.width - size[0]) if self.below else 0.0)
            ax = page.axes(at, top, *size.tolist())
            origin = middle - 0.5 * (size + np.array([0.0, FOOT_IN - HEAD_IN])) / self.scale
            panel = Panel(view, ax, size, self.scale, origin, unit)
            half = 0.5 * width_in(view.name)
            panel.taken.append(np.array([0.5 * size[0] - half, size[1] - HEAD_IN, 0.5 * size[0] + half, size[1]]))
            page.write(at + 0.5 * size[0], top, Line(view.name, color=GREY), align="center")
            panel.scale_bar(length)
            made.append(panel)
            left, top = (left, top + size[1]) if self.below else (left + size[0], top)
        return made


def arranged(views: Sequence[View], points: FloatArray, width: float, height: float) -> Arrangement:
    """The views of all points (n, 3) that are drawn, as large as a room of `width` by `height`, inches, allows."""
    seen = [view.of(points) for view in views]
    low, high = np.array([v.min(axis=0) for v in seen]), np.array([v.max(axis=0) for v in seen])
    largest = float((high - low).max())
    extents = high - low if largest > 0.0 else np.ones_like(low)
    arrangements = []
    for below in (False, True):
        small, large = 0.0, max(width, height) / float(extents.max())
        for _ in range(40):  # bisection: to 1e-12 of the scale
            scale = 0.5 * (small + large)
            sizes = _panel_sizes(extents, scale, below=below)
            found = Arrangement(tuple(views), 0.5 * (low + high), scale, sizes, below)
            small, large = (scale, large) if found.width <= width and found.height <= height else (small, scale)
        sizes = _panel_sizes(extents, small, below=below)
        arrangements.append(Arrangement(tuple(views), 0.5 * (low + high), small, sizes, below))
    beside, below_each_other = arrangements
    return beside if beside.scale >= below_each_other.scale else below_each_other


def widest_side(points: FloatArray, up: FloatArray) -> FloatArray:
    """The level direction (3,) along which points (n, 3), seen from the axis, spread most; the sign by where most of
    them are."""
    level = points - np.outer(points @ up, up)
    way = np.linalg.eigh(level.T @ level)[1][:, -1]
    best = way - (way @ up) * up
    if np.linalg.norm(best) < 0.5:  # nothing lies off the axis: any level direction will do
        best = np.eye(3)[int(np.argmin(np.abs(up)))]
        best = best - (best @ up) * up
    best = best / np.linalg.norm(best)
    ahead: FloatArray = best if float((level @ best).sum()) >= 0.0 else -best
    return ahead


def _panel_sizes(extents: FloatArray, scale: float, *, below: bool) -> FloatArray:
    sizes: FloatArray = scale * extents + 2.0 * PAD_IN + np.array([0.0, HEAD_IN + FOOT_IN])
    sizes = np.maximum(sizes, NARROWEST_IN)
    if not below:
        sizes[:, 1] = sizes[:, 1].max()
    return sizes


def _along(places: FloatArray) -> FloatArray:
    """Places (n, 2) and those between them, a cell apart."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    at = np.union1d(length, np.arange(0.0, length[-1], CELL_IN))
    return np.stack([np.interp(at, length, places[:, 0]), np.interp(at, length, places[:, 1])], axis=1)


def _round_length(most: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that is at most so long."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1.0 + 1e-9)))
