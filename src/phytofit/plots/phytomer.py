"""Pictures of a fit: the model on the points with what was measured, and how the search went."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from phytofit.models import Organ, mesh
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
    folded,
    interval,
    number,
    quality_legend,
    width_in,
)
from phytofit.plots.views import Panel, View, arranged, widest_side
from phytofit.results import Fit, FittedPhytomer, Placed, grouped
from phytofit.traits import CHORD_CM, Trait, leaves_stem_at

__all__ = ["plot_convergence", "plot_fit"]

FloatArray = NDArray[np.float64]
POINTS = "#3C3C3C"
STEM_FILL, STEM_EDGE = "#DDAA66", "#8A4B08"  # told apart from the leaf's by the colour-blind, and in grey
LEAF_FILL, LEAF_EDGE = "#CDEBDA", "#1B7A4B"
MEASURE, SPREAD = "#0B3FA0", "#C5D3EC"
TABLE_IN = 3.4  # width of the table and of what stands below it
COLUMNS_IN = (1.1, 0.98, 1.1, 0.22)
HIGHEST_IN = 7.0  # of the views
DOTTED = 0.35  # dots, as a share of the room that the cloud takes up: the model is seen behind them
LEAST_LENGTH = 1e-9  # of the midrib, outside the stem: less is rounding
ARC_IN = 0.4  # radius of the angle's arc
STEEPEST_DEG = 60.0  # of the view onto the blade: from higher up it would not show which way is up
MOST_LINES = 4  # of a remark
MARK_IN, KEY_IN = 0.17, 0.24  # width of the mark before a remark; height of the row that says what the marks say
SHOWN = {
    "leaf_length": "leaf length",
    "leaf_angle": "leaf angle",
    "leaf_width": "leaf width",
    "leaf_area": "leaf area",
    "stem_diameter": "stem diameter",
}


def plot_fit(result: FittedPhytomer, title: str = "") -> Figure:
    """The cloud and the fitted model, upright, from the side and facing the blade, with the length, angle, width and
    diameter that were measured; beside them the table of traits, and what to check."""
    stem, leaf = result.organs
    up = result.pose[:3, 2]
    side = widest_side(leaf.axis - leaf.axis[0], up)
    views = (View("from the side", np.stack([side, up])), View("facing the blade", _facing(leaf, up, side)))
    room = PAGE_IN - TABLE_IN - 3.0 * MARGIN_IN
    traits = {trait.name: trait for trait in result.traits}
    text, table, remarks = _heading(result, title), _table(traits), _remarks(result)
    said = [line for _, lines in remarks for line in lines]
    beside = sum(line.height for line in (*text, *said)) + table.height + 2.0 * SPACE_IN + KEY_IN
    legend = Legend(_marks(result), room)
    drawn = np.concatenate([result.reference, _outline(stem), _outline(leaf)])
    shown = arranged(views, drawn, room, max(HIGHEST_IN, beside - legend.height))
    page = Page(max(beside, shown.height + legend.height) + 2.0 * MARGIN_IN)
    left = 2.0 * MARGIN_IN + room
    top = page.write_all(left, MARGIN_IN, text) + SPACE_IN
    top = _draw_key(page, left, table.draw(page, left, top)) + SPACE_IN
    for mark, lines in remarks:
        page.write(left, top, mark)
        top = page.write_all(left + MARK_IN, top, lines)
    at = MARGIN_IN + 0.5 * (room - shown.width)
    panels = shown.panels(page, at, MARGIN_IN, result.length_unit)
    for panel in panels:
        panel.up_arrow(stem.axis[0], up)
        _draw_model(panel, result)
    _draw_measures(panels[0], panels[1], result, traits)
    legend.draw(page, MARGIN_IN, MARGIN_IN + shown.height)
    return page.figure


def _heading(result: FittedPhytomer, title: str) -> list[Line]:
    lines = [Line(text, LARGE, bold=True) for text in folded(title, TABLE_IN, 2, LARGE, bold=True)]
    said = f"{len(result.reference):,} points, fitted by the method “{result.method}”"
    if result.relative:
        said += "; lengths are relative, as the cloud has no unit"
    return lines + [Line(text, color=GREY) for text in folded(said, TABLE_IN, 2)]


def _table(traits: dict[str, Trait]) -> Table:
    """The traits with their intervals."""
    rows = [tuple((Line(text, color=GREY),) for text in ("trait", "value", "95 % interval", ""))]
    for name, said in SHOWN.items():
        trait = traits[name]
        decimals = digits(trait.value, trait.low, trait.high)
        unit = "°" if trait.unit == "deg" else f" {trait.unit}"
        value = number(trait.value, decimals) + unit
        ends = interval(trait.low, trait.high, decimals) or "not given"
        cells = figures(value, COLUMNS_IN[1] - 2.0 * CELL_IN, bold=True), figures(ends, COLUMNS_IN[2] - 2.0 * CELL_IN)
        mark, color = QUALITY.get(trait.quality, ("", INK))
        rows.append(((Line(said, NORMAL),), (cells[0],), (cells[1],), (Line(mark, NORMAL, color=color),)))
    return Table(COLUMNS_IN, ("left", "right", "right", "center"), tuple(rows))


def _draw_key(page: Page, left: float, top: float) -> float:
    """What the marks behind the traits say, in a row; where what follows may begin."""
    at = left + CELL_IN
    for line in quality_legend():
        page.write(at, top + CELL_IN, line)
        at += width_in(line.text) + 2.0 * MARK_IN
    return top + KEY_IN


def _remarks(result: FittedPhytomer) -> list[tuple[Line, list[Line]]]:
    """What was noticed, the worst first: for each remark its mark, and lines."""
    lines = []
    for grade, said in grouped(map(Placed, result.remarks)):
        mark, color = QUALITY.get(grade, ("•", INK))
        lines.append((Line(mark, color=color), [Line(text) for text in folded(said, TABLE_IN - MARK_IN, MOST_LINES)]))
    return lines or [(Line(""), [Line("Nothing to check.", color=GREY)])]


def _marks(result: FittedPhytomer) -> tuple[tuple[str, str, str], ...]:
    """The legend of the views."""
    marks = [
        ("dot", POINTS, "cloud"),
        ("area", STEM_FILL, "fitted stem"),
        ("area", LEAF_FILL, "fitted leaf"),
        ("line", MEASURE, "what was measured"),
    ]
    if result.midrib_seen < 1.0:
        marks.append(("dashed", MEASURE, "not seen"))
    return tuple(marks)


def _facing(leaf: Organ, up: FloatArray, side: FloatArray) -> FloatArray:
    """Axes (2, 3) of the view in which most of the blade's area is seen, from the leaf's own side where others are as
    good, level or from above."""
    azimuth, height = np.deg2rad(np.mgrid[-180:180:5, 0 : STEEPEST_DEG + 1.0 : 5].reshape(2, -1))
    beside = np.cross(up, side)
    level = np.cos(azimuth)[:, np.newaxis] * side + np.sin(azimuth)[:, np.newaxis] * beside
    eyes = np.cos(height)[:, np.newaxis] * level + np.sin(height)[:, np.newaxis] * up
    area = leaf.segment_lengths * (leaf.half_width[1:] + leaf.half_width[:-1])
    seen = np.abs(eyes @ leaf.frame[:, :, 2].T) @ area
    best = int(np.argmax(np.round(seen / max(seen.max(), 1e-300), 6) + 1e-3 * (level @ side)))
    right = np.cross(up, level[best])
    return np.stack([right, np.cross(eyes[best], right)])


def _outline(organ: Organ) -> FloatArray:
    """Corners (n, 3) of the organ's surface."""
    return np.asarray(mesh([organ], n_around=32).vertices)


def _draw_model(panel: Panel, result: FittedPhytomer) -> None:
    """Stem and leaf, the points on them, and their edges."""
    for organ, fill, zorder in zip(result.organs, (STEM_FILL, LEAF_FILL), (1.0, 1.5), strict=True):
        surface = mesh([organ], n_around=32)
        panel.surface(np.asarray(surface.vertices)[np.asarray(surface.faces)], fill, zorder=zorder)
    panel.dots(result.reference, POINTS, size=panel.dot_size(result.reference, DOTTED))
    stem, leaf = result.organs
    across = panel.view.axes[0]
    for sign in (-1.0, 1.0):
        panel.line(stem.axis + sign * stem.half_width[:, np.newaxis] * across, STEM_EDGE, 1.0, zorder=3.0)
        lateral = np.concatenate([leaf.frame, leaf.frame[-1:]])[:, :, 1]
        panel.line(leaf.axis + sign * leaf.half_width[:, np.newaxis] * lateral, LEAF_EDGE, 1.0, zorder=3.0)


def _draw_measures(side: Panel, facing: Panel, result: FittedPhytomer, traits: dict[str, Trait]) -> None:
    """What was measured, drawn and named where it shows: length, angle and diameter from the side, width facing the
    blade."""
    stem, leaf = result.organs
    start = leaves_stem_at(stem, leaf)
    whole = float(leaf.segment_lengths.sum())
    if not 0.0 <= start < whole * (1.0 - LEAST_LENGTH):
        return
    at = np.concatenate([[0.0], np.cumsum(leaf.segment_lengths)])
    collar = _on(leaf, at, start)
    seen = result.midrib_seen * whole
    for panel in (side, facing):
        panel.line(_part(leaf, at, start, max(seen, start)), MEASURE, 1.8)
        panel.line(_part(leaf, at, max(seen, start), whole), MEASURE, 1.8, style=":")
    up = result.pose[:3, 2]
    chord = min(np.inf if result.relative else CHORD_CM, (whole - start) / 5.0)
    toward = _on(leaf, at, start + chord) - collar
    toward = toward / np.linalg.norm(toward)
    ray = min(1.5 * ARC_IN / side.scale, side.room(collar, up), side.room(collar, toward))
    radius = ray / 1.5
    arc = _arc(up, toward)
    side.line(np.stack([collar, collar + ray * up]), MEASURE, 1.2)
    side.line(np.stack([collar, collar + ray * toward]), MEASURE, 1.2)
    side.line(collar + radius * arc, MEASURE, 1.2)
    base = stem.axis[0] + 0.5 * ((collar - stem.axis[0]) @ up) * up
    across = 0.5 * traits["stem_diameter"].value * side.view.axes[0]
    side.line(np.stack([base - across, base + across]), MEASURE, 1.8)
    widest = int(np.argmax(leaf.half_width))
    lateral = leaf.half_width[widest] * leaf.frame[min(widest, len(leaf.frame) - 1), :, 1]
    facing.line(np.stack([leaf.axis[widest] - lateral, leaf.axis[widest] + lateral]), MEASURE, 1.8)
    side.label(_said("angle ", traits["leaf_angle"]), collar + radius * arc[len(arc) // 2], color=MEASURE)
    side.label(_said("length ", traits["leaf_length"]), _on(leaf, at, 0.5 * (start + whole)), color=MEASURE)
    side.label(_said("diameter ", traits["stem_diameter"]), base + across, color=MEASURE)
    facing.label(_said("width\n", traits["leaf_width"]), leaf.axis[widest] + lateral, color=MEASURE)


def _said(name: str, trait: Trait) -> str:
    unit = {"deg": "°", "rel": ""}.get(trait.unit, f" {trait.unit}")
    return f"{name}{number(trait.value, digits(trait.value, trait.low, trait.high))}{unit}"


def _on(leaf: Organ, at: FloatArray, s: float) -> FloatArray:
    return np.array([np.interp(s, at, leaf.axis[:, a]) for a in range(3)])


def _part(leaf: Organ, at: FloatArray, start: float, end: float) -> FloatArray:
    """The midrib (n, 3) from one length along it to another."""
    inside = leaf.axis[(at > start) & (at < end)]
    return np.concatenate([[_on(leaf, at, start)], inside, [_on(leaf, at, end)]])


def _arc(first: FloatArray, second: FloatArray) -> FloatArray:
    """Unit vectors (n, 3) from one (3,) to another, evenly turned."""
    turn = np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)
    beside = second - (second @ first) * first
    beside = beside / max(float(np.linalg.norm(beside)), 1e-12)
    angle = np.linspace(0.0, turn, 24)[:, np.newaxis]
    return np.asarray(np.cos(angle) * first + np.sin(angle) * beside)


def plot_convergence(result: FittedPhytomer) -> Figure:
    """How the search went: mean and spread of the elite for each parameter, and its errors, over the generations
    (Fig. 6b)."""
    searched = len(result.history[0].mean)
    names, units = result.species.space.names[:searched], result.species.space.units[:searched]
    generation = np.array([g.index for g in result.history])
    scale = np.array([result.scale if unit == "cm" else 1.0 for unit in units])
    mean = np.array([g.mean for g in result.history]) * scale
    std = np.array([np.sqrt(np.diag(g.cov)) for g in result.history]) * scale
    length = result.length_unit
    refined = isinstance(result, Fit)
    n_columns = 4
    n_rows = -(-(len(names) + 1) // n_columns)
    figure = Figure(figsize=(PAGE_IN, 2.2 * n_rows + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for i, (ax, name, unit) in enumerate(zip(axes, names, units, strict=False)):
        ax.fill_between(generation, mean[:, i] - std[:, i], mean[:, i] + std[:, i], color=SPREAD, lw=0)
        ax.plot(generation, mean[:, i], color=MEASURE, marker="o", markersize=3)
        if refined:
            ax.axhline(result.parameters[name], color=INK, lw=1.2, ls="--")
        ax.set_title(f"{name.replace('_', ' ')} ({length if unit == 'cm' else unit})", fontsize=SMALL)
    errors = axes[len(names)]
    errors.plot(generation, [g.threshold * result.scale for g in result.history], color=STEM_EDGE)
    errors.plot(generation, [g.best_error * result.scale for g in result.history], color=LEAF_EDGE, ls=":")
    errors.set_title(f"error ({length})", fontsize=SMALL)
    for ax in axes[: len(names) + 1]:
        ax.grid(alpha=0.25)
        ax.tick_params(labelsize=SMALL)
        ax.xaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
        ax.yaxis.set_major_locator(MaxNLocator(nbins=4))
    for ax in axes[len(names) + 1 :]:
        ax.remove()
    figure.supxlabel("generation of the search", fontsize=SMALL)
    marks = [
        (Line2D([], [], color=MEASURE, marker="o", markersize=3), "mean of the best candidates"),
        (Patch(color=SPREAD), "their spread: how far the search has come, not the error"),
        (Line2D([], [], color=STEM_EDGE), "worst of them"),
        (Line2D([], [], color=LEAF_EDGE, ls=":"), "best"),
    ]
    if refined:
        marks.insert(2, (Line2D([], [], color=INK, ls="--"), "the fit"))
    handles, texts = zip(*marks, strict=True)
    figure.legend(handles, texts, loc="outside upper left", ncols=3, frameon=False, fontsize=SMALL)
    return figure
