"""Pictures of whole plants: reconstructed, taken apart, measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phytofit.plots.page import (
    CELL_IN,
    GREY,
    INK,
    LARGE,
    MARGIN_IN,
    NORMAL,
    PAGE_IN,
    QUALITY,
    SMALL,
    SPACE_IN,
    Legend,
    Line,
    Page,
    Table,
    digits,
    figures,
    fitting,
    folded,
    interval,
    number,
    quality_legend,
)
from phytofit.plots.views import Arrangement, Panel, View, arranged, widest_side
from phytofit.reconstruct import Reconstruction
from phytofit.results.remarks import OF_INTERVALS, in_short
from phytofit.segmentation import Segmentation

__all__ = ["LEAF_COLORS", "plot_plant", "plot_reconstruction", "plot_segmentation"]

FloatArray = NDArray[np.float64]

LEAF_COLORS = (  # by rank; told apart by the colour-blind, and neighbours in grey: a dark one follows a light one
    "#332288", "#DDAA33", "#117733", "#88CCEE", "#882255", "#BBCC33", "#0072B2", "#EE99AA",
    "#7A4A00", "#44BB99", "#AA3377", "#F0E442", "#004488", "#E69F00",
)  # fmt: skip
STEM_COLOR, UNKNOWN_COLOR, MIDRIB_COLOR = "#222222", "#C4C4C4", "#111111"
MOST_DRAWN = 30_000  # points of a plant
HIGHEST_IN = 8.4  # of the views of a plant
MEASURED = {"leaf_length": "length", "leaf_width": "width", "leaf_angle": "angle"}  # of each leaf
TABLE_IN = 4.9  # width of the tables, and of their columns
PLANT_IN = (1.6, 1.1, 2.2)
LEAVES_IN = (0.46, 0.86, 0.86, 0.86, 1.86)
SEGMENTED_IN = (0.46, 1.1, 0.74, 2.6)
BESIDE_IN, STRIP_IN = 3.4, 0.25  # width of what stands beside a reconstruction; height of its strip of colours
MOST_REMARKS = 12  # of a reconstruction
MOST_LINES = 3  # of what is to check of a leaf
DOTTED = 1.2  # dots, as a share of the room that the plant takes up: they make a surface
AROUND = 0.5  # of the plant's size, to each side of it, in which points of no organ are drawn


def plot_plant(result: Segmentation | Sequence[Segmentation], table: pd.DataFrame, title: str = "") -> Figure:
    """A plant, or several below each other, upright from two sides, with coloured and numbered leaves, beside the
    table of their traits with 95 % intervals and what to check of each leaf.

    ``table`` has the columns of ``traits.csv``; of several plants, the first is its ``plant`` 1.
    """
    plants = [result] if isinstance(result, Segmentation) else list(result)
    blocks = []
    for i, plant in enumerate(plants, start=1):
        mine = table[table["plant"] == i] if len(plants) > 1 else table
        name = f"{title}, plant {i}".removeprefix(", ") if len(plants) > 1 else title
        tables = (_plant_table(plant, mine), _leaf_traits(plant, mine))
        blocks.append(_Block.of(plant, name, "95 % intervals in brackets", tables, quality_legend()))
    return _page_of(blocks)


def plot_segmentation(result: Segmentation, title: str = "") -> Figure:
    """A plant's points by organ, upright from two sides, with coloured and numbered leaves, beside a table of them."""
    unit = _unit(result)
    head = ("leaf", f"length along\nits points ({unit})", "points", "to check")
    rows = []
    for leaf in result.leaves:
        length = number(leaf.length, digits(leaf.length, None, None))
        cells = [(Line(str(leaf.rank), NORMAL, bold=True),), (Line(length, NORMAL),), (Line(f"{leaf.n_points:,}"),)]
        rows.append((*cells, _remarks(leaf.flags, SEGMENTED_IN[-1])))
    table = Table(
        SEGMENTED_IN,
        ("right", "right", "right", "left"),
        (_head(head), *rows),
        (None, *(_leaf_color(leaf.rank) for leaf in result.leaves)),
    )
    said = f"{len(result.cloud):,} points; stem {number(result.stem_length, 1)} {unit} along its axis"
    notes = [Line(text, color=GREY) for note in result.notes for text in folded(f"• {note}", TABLE_IN, 3)]
    return _page_of([_Block.of(result, title, said, (table,), notes)])


@dataclass(frozen=True)
class _Block:
    """What a page shows of one plant: its views, and what stands beside them."""

    plant: Segmentation
    heading: tuple[Line, ...]
    tables: tuple[Table, ...]
    remarks: tuple[Line, ...]
    shown: Arrangement
    up: FloatArray
    points: FloatArray  # those that are drawn, and their labels
    labels: NDArray[np.int64]
    legend: Legend

    @classmethod
    def of(
        cls, plant: Segmentation, title: str, said: str, tables: tuple[Table, ...], remarks: Sequence[Line]
    ) -> "_Block":
        up, stated = _upright(plant)
        heading = [Line(text, LARGE, bold=True) for text in folded(title, TABLE_IN, 2, LARGE, bold=True)]
        said += "" if stated else "; drawn upright along its stem, as it was not stated which way is up"
        heading += [Line(text, color=GREY) for text in folded(said, TABLE_IN, 3)]
        near = _near(plant)
        chosen = np.flatnonzero(near)
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_DRAWN)).astype(int)]
        points, labels = plant.cloud.points[chosen], plant.labels[chosen]
        side = widest_side(np.concatenate([leaf.midrib - plant.stem_path[0] for leaf in plant.leaves]), up)
        views = (View("from the side", np.stack([side, up])), View("turned by 90°", np.stack([np.cross(up, side), up])))
        all_drawn = np.concatenate([points, plant.stem_path, *(leaf.midrib for leaf in plant.leaves)])
        room = PAGE_IN - TABLE_IN - 3.0 * MARGIN_IN
        beside = sum(line.height for line in (*heading, *remarks)) + sum(t.height + SPACE_IN for t in tables)
        legend = Legend(_marks(plant, near), room)
        shown = arranged(views, all_drawn, room, max(HIGHEST_IN, beside - legend.height))
        return cls(plant, tuple(heading), tables, tuple(remarks), shown, up, points, labels, legend)

    @property
    def height(self) -> float:
        text = sum(line.height for line in (*self.heading, *self.remarks))
        return max(
            text + sum(table.height + SPACE_IN for table in self.tables) + SPACE_IN,
            self.shown.height + self.legend.height,
        )

    def draw(self, page: Page, top: float) -> None:
        room = PAGE_IN - TABLE_IN - 3.0 * MARGIN_IN
        left = 2.0 * MARGIN_IN + room
        at = page.write_all(left, top, self.heading) + SPACE_IN
        for table in self.tables:
            at = table.draw(page, left, at) + SPACE_IN
        page.write_all(left, at, self.remarks)
        for panel in self.shown.panels(page, MARGIN_IN + 0.5 * (room - self.shown.width), top, _unit(self.plant)):
            self._draw_plant(panel)
        self.legend.draw(page, MARGIN_IN, top + self.shown.height)

    def _draw_plant(self, panel: Panel) -> None:
        panel.up_arrow(self.plant.stem_path[0], self.up)
        size = panel.dot_size(self.points, DOTTED)
        toward = np.cross(*panel.view.axes)
        order = np.argsort(self.points @ toward, kind="stable")  # what is nearer covers what is behind it
        points, labels = self.points[order], self.labels[order]
        colors = np.array([to_rgb(_color(label)) for label in range(int(labels.max(initial=0)) + 1)])
        for part, zorder in ((labels == 0, 1.0), (labels > 0, 2.0)):
            panel.dots(points[part], colors[labels[part]], size=size, zorder=zorder)
        panel.line(self.plant.stem_path, "white", 0.9, zorder=3.0)
        for leaf in self.plant.leaves:
            panel.line(leaf.midrib, MIDRIB_COLOR, 0.7, zorder=3.0)
        for leaf in self.plant.leaves:
            panel.label(str(leaf.rank), leaf.tip, color=_leaf_color(leaf.rank), ring=True)


def _page_of(blocks: Sequence[_Block]) -> Figure:
    page = Page(sum(block.height + MARGIN_IN for block in blocks) + MARGIN_IN)
    top = MARGIN_IN
    for block in blocks:
        block.draw(page, top)
        top += block.height + MARGIN_IN
    return page.figure


def _plant_table(plant: Segmentation, table: pd.DataFrame) -> Table:
    """Height, number of leaves, and the stem's diameter at the lowest leaf of which it was measured."""
    unit = _unit(plant)
    heights = table[(table["organ"] == "plant") & (table["trait"] == "plant_height")]
    stems = table[table["trait"] == "stem_diameter"].sort_values("rank", kind="stable")
    head = ("plant height", "leaves", "stem diameter")
    cells = [
        _value(heights, unit),
        (Line(str(len(plant.leaves)), NORMAL, bold=True),),
        _value(stems, unit),
    ]
    if len(stems):
        head = (*head[:2], f"stem diameter\nbelow leaf {int(stems['rank'].iloc[0])}")
    return Table(PLANT_IN, ("center",) * 3, (_head(head), tuple(cells)))


def _leaf_traits(plant: Segmentation, table: pd.DataFrame) -> Table:
    """The traits of each leaf, and what to check of it."""
    unit = _unit(plant)
    units = {"leaf_angle": "°"}
    rows = [_head(("leaf", *(f"{said}\n({units.get(name, unit)})" for name, said in MEASURED.items()), "to check"))]
    for leaf in plant.leaves:
        mine = table[(table["rank"] == leaf.rank) & (table["organ"] != "plant")]
        flags = [code for text in mine["flags"].dropna() for code in str(text).split(";") if code]
        traits = [_value(mine[mine["trait"] == name]) for name in MEASURED]
        rows.append(((Line(str(leaf.rank), NORMAL, bold=True),), *traits, _remarks(flags, LEAVES_IN[-1])))
    aligns = ("right", "center", "center", "center", "left")
    return Table(LEAVES_IN, aligns, tuple(rows), (None, *(_leaf_color(leaf.rank) for leaf in plant.leaves)))


def _value(rows: pd.DataFrame, unit: str = "") -> tuple[Line, ...]:
    """The value of the first of the rows, with the mark of its quality, and its interval below; a dash where there is
    none."""
    if not len(rows):
        return (Line("–", NORMAL, color=GREY),)
    value, low, high = (float(rows[column].iloc[0]) for column in ("value", "low", "high"))
    decimals = digits(value, low, high)
    width = LEAVES_IN[1] - CELL_IN
    mark, color = QUALITY.get(str(rows["quality"].iloc[0]), ("", INK))
    first = figures(" ".join(filter(None, (number(value, decimals), unit, mark))), width, bold=True, color=color)
    ends = interval(low, high, decimals)
    return (first, figures(f"({ends})", width, SMALL, color=GREY)) if ends else (first,)


def _remarks(flags: Sequence[str], width: float) -> tuple[Line, ...]:
    """What the codes say, in a few lines, but for those on intervals, which are shown; that there is no fit comes
    first."""
    codes = [code for code in dict.fromkeys(flags) if code not in OF_INTERVALS]
    said = "; ".join(map(in_short, sorted(codes, key=lambda code: code != "not_fitted")))
    return tuple(Line(text) for text in folded(said, width - 0.12, MOST_LINES)) or (Line("–", color=GREY),)


def _head(texts: Sequence[str]) -> tuple[tuple[Line, ...], ...]:
    return tuple(tuple(Line(text, color=GREY) for text in cell.split("\n")) for cell in texts)


def _marks(plant: Segmentation, shown: NDArray[np.bool_]) -> tuple[tuple[str, str, str], ...]:
    """The legend of the views."""
    marks = [("area", STEM_COLOR, "stem"), ("line", MIDRIB_COLOR, "midribs, numbered at the tip")]
    unknown, beyond = np.count_nonzero(plant.labels == 0), np.count_nonzero(~shown)
    if unknown:
        said = f"of no organ: {unknown:,} points" + (f", {beyond:,} beyond the picture" if beyond else "")
        marks.append(("area", UNKNOWN_COLOR, said))
    return tuple(marks)


def _near(plant: Segmentation) -> NDArray[np.bool_]:
    """Which points are drawn: of no organ only those around the plant, which others would make small."""
    points, labels = plant.cloud.points, plant.labels
    organs = points[labels > 0] if np.any(labels > 0) else points
    low, high = organs.min(axis=0), organs.max(axis=0)
    margin = AROUND * float((high - low).max())
    near: NDArray[np.bool_] = (labels > 0) | np.all((points >= low - margin) & (points <= high + margin), axis=1)
    return near


def _upright(plant: Segmentation) -> tuple[FloatArray, bool]:
    """Which way (3,) is up in the picture, and whether that was stated; else it is along the stem, so that the plant
    stands."""
    if plant.settings.get("up") is not None:
        return plant.up, True
    rise = plant.stem_path[-1] - plant.stem_path[0]
    length = float(np.linalg.norm(rise))
    return (rise / length if length > 0.0 else plant.up), False


def _unit(plant: Segmentation) -> str:
    return "rel" if plant.cloud.unit == "none" else "cm"


def _leaf_color(rank: int) -> str:
    return LEAF_COLORS[(rank - 1) % len(LEAF_COLORS)]


def _color(label: int) -> str:
    return (UNKNOWN_COLOR, STEM_COLOR)[label] if label < 2 else _leaf_color(label - 1)


def plot_reconstruction(result: Reconstruction, title: str = "") -> Figure:
    """The cloud upright from two sides and from above, each point coloured by the view that it came from; beside it,
    how well the views fit each other, and what to check."""
    points, up = result.cloud.points, np.array([0.0, 0.0, 1.0])
    side = widest_side(points - points.mean(axis=0), up)
    across = np.cross(up, side)
    views = (
        View("from the side", np.stack([side, up])),
        View("turned by 90°", np.stack([across, up])),
        View("from above", np.stack([side, across])),
    )
    room = PAGE_IN - BESIDE_IN - 3.0 * MARGIN_IN
    left = 2.0 * MARGIN_IN + room
    text = _of_reconstruction(result, title)
    beside = sum(line.height for line in text) + SPACE_IN + STRIP_IN + 2.0 * Line("").height
    shown = arranged(views, points, room, max(HIGHEST_IN, beside))
    page = Page(max(shown.height, beside) + 2.0 * MARGIN_IN)
    top = page.write_all(left, MARGIN_IN, text) + SPACE_IN
    _strip_of_views(page, left, top, result)
    chosen = np.random.default_rng(0).permutation(len(points))[:MOST_DRAWN]  # so that no view covers the others
    share = result.view / max(len(result.files) - 1, 1)
    colors = colormaps["viridis"](share[chosen])
    for panel in shown.panels(page, MARGIN_IN + 0.5 * (room - shown.width), MARGIN_IN, "cm"):
        panel.dots(points[chosen], colors, size=panel.dot_size(points[chosen], DOTTED))
        if panel.view is not views[2]:
            panel.up_arrow(points[int(np.argmin(points[:, 2]))], up)
    return page.figure


def _of_reconstruction(result: Reconstruction, title: str) -> list[Line]:
    lines = [Line(text, LARGE, bold=True) for text in folded(title, BESIDE_IN, 2, LARGE, bold=True)]
    said = [f"{len(result.files)} views, {len(result.cloud):,} points"]
    if result.step_deg is not None:
        said.append(f"turned by {abs(result.step_deg):.1f}° from view to view")
    if result.pairs:
        said.append(f"{result.residual_cm:.2f} cm between neighbouring views")
    if result.loop is not None:
        said.append(f"after a whole turn off by {result.loop[0]:.1f}° and {result.loop[1]:.2f} cm")
    lines += [Line(part) for text in said for part in folded(text, BESIDE_IN, 2)]
    remarks = [f"left out: {view.file}, {view.reason}" for view in result.rejected] + list(result.flags)
    lines.append(Line("To check", NORMAL, bold=True) if remarks else Line("Nothing to check: no flag.", color=GREY))
    for i, remark in enumerate(remarks):
        if i == MOST_REMARKS:
            lines.append(Line(f"and {len(remarks) - i} more"))
            break
        lines += [Line(part) for part in folded(f"• {remark}", BESIDE_IN, 4)]
    return lines


def _strip_of_views(page: Page, left: float, top: float, result: Reconstruction) -> None:
    """The colours of the views, from the first to the last file."""
    page.write(left, top, Line("colour: the view that a point came from", color=GREY))
    n = len(result.files)
    top += Line("").height
    for i, color in enumerate(colormaps["viridis"](np.arange(n) / max(n - 1, 1))):
        page.patch(left + i * BESIDE_IN / n, top, BESIDE_IN / n, STRIP_IN - 0.05, color)
    names = [fitting(name.rpartition("/")[2], 0.48 * BESIDE_IN) for name in (result.files[0], result.files[-1])]
    page.write(left, top + STRIP_IN, Line(names[0]))
    if n > 1:
        page.write(left + BESIDE_IN, top + STRIP_IN, Line(names[1]), align="right")
