"""A page laid out in inches from its upper left corner, so that nothing lies on anything else; text that fits; tables.

Widths of text are those of its outlines, which no screen and no resolution changes.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.textpath import text_to_path

from phytofit.text import for_picture, one_line

__all__ = [
    "CELL_IN",
    "GREY",
    "INK",
    "LARGE",
    "MARGIN_IN",
    "NORMAL",
    "PAGE_IN",
    "QUALITY",
    "SMALL",
    "SPACE_IN",
    "Legend",
    "Line",
    "Page",
    "Table",
    "digits",
    "figures",
    "fitting",
    "folded",
    "interval",
    "number",
    "quality_legend",
    "width_in",
]

PAGE_IN = 10.0  # width: where a page is shown 800 pixels wide, a point of type is 1.1 pixels
MARGIN_IN = 0.2
SMALL, NORMAL, LARGE = 9.0, 10.0, 13.0  # points of type
LINE_IN = 1.35 / 72.0  # from line to line, inches a point of type
SPACE_IN = 0.14  # between a table and what is above or below it
CELL_IN = 0.06  # above, below and beside what stands in a cell
MARK_WIDE_IN = 0.12  # of the mark of a table's row
MARK_IN, GAP_IN, ROW_IN = 0.36, 0.22, 0.19  # of a legend: a mark, what parts one entry from the next, and a row
INK, GREY, RULE = "#1A1A1A", "#555555", "#BBBBBB"
QUALITY = {  # how far to trust a value: a mark, and a colour that the colour-blind tell from the others
    "good": ("●", "#00704A"),
    "check": ("▲", "#B45F00"),
    "poor": ("✖", "#A3003C"),
}
MEANING = {"good": "good", "check": "check", "poor": "poor: do not use"}
ELLIPSIS = "…"
MOST_DIGITS = 6


@dataclass(frozen=True)
class Line:
    """One line of text: what was fitted into a width, and how it is set."""

    text: str
    size: float = SMALL
    bold: bool = False
    color: str = INK

    @property
    def height(self) -> float:
        """Inches."""
        return self.size * LINE_IN


class Page:
    """A figure of `PAGE_IN` by a height, inches; places are from its upper left corner."""

    def __init__(self, height: float) -> None:
        self.height = height
        self.figure = Figure(figsize=(PAGE_IN, height), facecolor="white")
        FigureCanvasAgg(self.figure)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Axes without ticks and frame, a point of which is an inch from their lower left corner."""
        box = (left / PAGE_IN, 1.0 - (top + height) / self.height, width / PAGE_IN, height / self.height)
        ax = self.figure.add_axes(box, xlim=(0.0, width), ylim=(0.0, height))
        ax.set_axis_off()
        return ax

    def write(self, left: float, top: float, line: Line, *, align: str = "left") -> None:
        """A line of text whose upper end is at `top`, and whose left (or right, or middle) is at `left`."""
        self.figure.text(
            left / PAGE_IN,
            1.0 - (top + 0.8 * line.height) / self.height,
            for_picture(line.text),
            fontsize=line.size,
            fontweight="bold" if line.bold else "normal",
            color=line.color,
            ha=align,
            va="baseline",
        )

    def write_all(self, left: float, top: float, lines: Sequence[Line]) -> float:
        """Lines below each other; where the next one would begin."""
        for line in lines:
            self.write(left, top, line)
            top += line.height
        return top

    def patch(self, left: float, top: float, width: float, height: float, color: str) -> None:
        corner = (left / PAGE_IN, 1.0 - (top + height) / self.height)
        self.figure.add_artist(Rectangle(corner, width / PAGE_IN, height / self.height, color=color, lw=0))

    def rule(self, left: float, top: float, width: float) -> None:
        y = 1.0 - top / self.height
        self.figure.add_artist(Line2D([left / PAGE_IN, (left + width) / PAGE_IN], [y, y], color=RULE, lw=0.8))


@dataclass(frozen=True)
class Table:
    """A table of cells that hold one or more lines: `widths` of its columns, inches, and how each is aligned; `colors`
    that mark the rows, with none for those that have no mark."""

    widths: tuple[float, ...]
    aligns: tuple[str, ...]
    rows: tuple[tuple[tuple[Line, ...], ...], ...]
    colors: tuple[str | None, ...] = ()

    @property
    def heights(self) -> list[float]:
        """Of the rows, inches."""
        return [max(sum(line.height for line in cell) for cell in row) + 2.0 * CELL_IN for row in self.rows]

    @property
    def height(self) -> float:
        return sum(self.heights)

    def draw(self, page: Page, left: float, top: float) -> float:
        """Rows with a rule below each; where what follows may begin."""
        starts = left + np.concatenate([[0.0], np.cumsum(self.widths)])
        colors = self.colors or (None,) * len(self.rows)
        for row, height, color in zip(self.rows, self.heights, colors, strict=True):
            if color is not None:
                page.patch(left + 0.5 * CELL_IN, top + CELL_IN, MARK_WIDE_IN, height - 2.0 * CELL_IN, color)
            for cell, start, width, align in zip(row, starts.tolist(), self.widths, self.aligns, strict=False):
                at = start + {"left": CELL_IN, "center": 0.5 * width, "right": width - CELL_IN}[align]
                y = top + 0.5 * (height - sum(line.height for line in cell))
                for line in cell:
                    page.write(at, y, line, align=align)
                    y += line.height
            top += height
            page.rule(left, top, sum(self.widths))
        return top


@dataclass(frozen=True)
class Legend:
    """What the marks of a picture mean, in rows of a `width`, inches: the kind of mark ("dot", "line", "dashed" or
    "area"), its colour, and what it is."""

    entries: tuple[tuple[str, str, str], ...]
    width: float

    @property
    def _places(self) -> list[tuple[float, int]]:
        """From the left, inches, and the row, of each."""
        places, left, row = [], 0.0, 0
        for _, _, text in self.entries:
            wide = MARK_IN + width_in(text) + GAP_IN
            if left and left + wide > self.width:
                left, row = 0.0, row + 1
            places.append((left, row))
            left += wide
        return places

    @property
    def height(self) -> float:
        return (max(row for _, row in self._places) + 1) * ROW_IN

    def draw(self, page: Page, left: float, top: float) -> None:
        ax = page.axes(left, top, self.width, self.height)
        for (kind, color, text), (at, row) in zip(self.entries, self._places, strict=True):
            y = self.height - (row + 0.5) * ROW_IN
            x = [at, at + 0.75 * MARK_IN]
            if kind == "dot":
                ax.scatter([x[0] + 0.1, x[1] - 0.1], [y, y], s=9.0, c=color, linewidths=0)
            elif kind == "area":
                ax.fill_between(x, y - 0.05, y + 0.05, color=color, lw=0)
            else:
                ax.plot(x, [y, y], color=color, lw=1.8, ls="--" if kind == "dashed" else "-")
            ax.text(at + MARK_IN, y, text, fontsize=SMALL, color=INK, ha="left", va="center_baseline")


def quality_legend() -> list[Line]:
    """What the marks of the qualities say, each in its colour."""
    return [Line(f"{mark} {MEANING[quality]}", color=color) for quality, (mark, color) in QUALITY.items()]


def width_in(text: str, size: float = SMALL, *, bold: bool = False) -> float:
    """Width of a line of text, inches."""
    return float(text_to_path.get_text_width_height_descent(text, _font(size, bold), False)[0]) / 72.0


def fitting(text: object, width: float, size: float = SMALL, *, bold: bool = False) -> str:
    """The text in one line that is at most so wide, inches: its middle gives way to an ellipsis."""
    line = _drawable(text)
    if width_in(line, size, bold=bold) <= width:
        return line
    wide = bisect_right(range(len(line)), width, key=lambda k: width_in(_without_middle(line, k), size, bold=bold))
    return _without_middle(line, max(wide - 1, 0))


def figures(text: str, width: float, size: float = NORMAL, *, bold: bool = False, color: str = INK) -> Line:
    """Numbers, smaller if need be, so that they are at most so wide, inches: of a number nothing can be left out."""
    return Line(text, size * min(1.0, width / max(width_in(text, size, bold=bold), 1e-9)), bold, color)


def folded(text: object, width: float, most: int, size: float = SMALL, *, bold: bool = False) -> list[str]:
    """The text in at most so many lines, each at most so wide, inches; an ellipsis where more would follow."""
    words = _drawable(text).split()
    lines: list[str] = []
    while words:
        n = 1
        while n < len(words) and width_in(" ".join(words[: n + 1]), size, bold=bold) <= width:
            n += 1
        if len(lines) == most - 1 and n < len(words):
            while n > 1 and width_in(f"{' '.join(words[:n])} {ELLIPSIS}", size, bold=bold) > width:
                n -= 1
            last = f"{' '.join(words[:n])} {ELLIPSIS}"
            return [*lines, fitting(last, width, size, bold=bold)]
        lines.append(fitting(" ".join(words[:n]), width, size, bold=bold))
        words = words[n:]
    return lines


def digits(value: float, low: float | None, high: float | None) -> int:
    """Decimals that a value deserves: its last digit is at most a fifth of half its interval; without one, three digits
    are kept."""
    ends = [end for end in (low, high) if end is not None and np.isfinite(end)]
    off = sum(abs(end - value) for end in ends) / max(len(ends), 1)
    step = 0.2 * off if off > 0.0 else 0.01 * abs(value)
    if not np.isfinite(step) or step == 0.0:
        return 1
    return int(np.clip(-np.floor(np.log10(step)), 0, MOST_DIGITS))


def number(value: float | None, decimals: int) -> str:
    """A value with so many decimals; a dash where there is none."""
    if value is None or not np.isfinite(value):
        return "–"
    text = f"{value:.{decimals}f}"
    if abs(value) >= 10.0**MOST_DIGITS or (value and not float(text)):
        digits_of, _, power = f"{value:.2e}".partition("e")
        text = f"{digits_of}e{int(power)}"
    return text.replace("-", "−")


def interval(low: float | None, high: float | None, decimals: int) -> str:
    """Both ends, or the one that there is; nothing where there is none."""
    low, high = (None if end is None or not np.isfinite(end) else end for end in (low, high))
    if low is None and high is None:
        return ""
    if high is None:
        return f"≥ {number(low, decimals)}"
    if low is None:
        return f"≤ {number(high, decimals)}"
    return f"{number(low, decimals)}–{number(high, decimals)}"


def _without_middle(line: str, kept: int) -> str:
    if kept >= len(line):
        return line
    return line[: (kept + 1) // 2] + ELLIPSIS + line[len(line) - kept // 2 :]


def _drawable(text: object) -> str:
    """The text in one line of characters that the font has; others as escapes such as ``\\u53f6``."""
    known = _characters()
    return "".join(c if ord(c) in known else c.encode("ascii", "backslashreplace").decode() for c in one_line(text))


@lru_cache(maxsize=8)
def _font(size: float, bold: bool) -> FontProperties:
    return FontProperties(size=size, weight="bold" if bold else "normal")


@lru_cache(maxsize=1)
def _characters() -> frozenset[int]:
    regular, bold = (get_font(findfont(_font(SMALL, weight))).get_charmap() for weight in (False, True))
    return frozenset(regular) & frozenset(bold)
