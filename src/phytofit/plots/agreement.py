"""Pictures of how results agree with the hand, or with the truth of simulated phytomers."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from phytofit.text import for_picture
from phytofit.validation import Agreement

__all__ = ["plot_agreement", "plot_trials"]

FloatArray = NDArray[np.float64]
FEW = 8  # pairs, up to which each is named; of more only those that are far off
LONGEST = 28  # characters of a name; more take half the width of the axes
COLOR, BIAS = "#0072B2", "#D55E00"
GREY = "0.45"
MARGIN = 0.08  # of the range of the values, on each side
ARROW_PT = 22.0  # how long the arrow of an interval without an end is
DOT_PX = 4.0  # half a point's size
AROUND: tuple[tuple[float, float, Literal["left", "right"], Literal["bottom", "top"]], ...] = (
    (6, 5, "left", "bottom"),
    (-6, 5, "right", "bottom"),
    (6, -5, "left", "top"),
    (-6, -5, "right", "top"),
)
LINES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"))


def plot_agreement(pairs: pd.DataFrame, found: Agreement, against: str = "by hand") -> Figure:
    """Results of one trait against the hand (or the truth), with intervals; and their differences against the mean of
    both (Bland and Altman), with bias and limits of agreement.  ``pairs`` as :func:`phytofit.compare` makes them.

    An interval with one end only has an arrow where the other would be.
    """
    measured, value = pairs["measured"].to_numpy(float), pairs["value"].to_numpy(float)
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    scatter, difference = figure.subplots(1, 2)
    name = for_picture(f"{found.trait.replace('_', ' ')} ({found.unit})")
    _draw_intervals(scatter, measured, value, pairs["low"].to_numpy(float), pairs["high"].to_numpy(float))
    scatter.set(xlabel=f"{against}: {name}", ylabel=f"result: {name}")
    middle, off = 0.5 * (measured + value), value - measured
    difference.plot(middle, off, "o", ms=4, color=COLOR)
    _draw_limits(difference, found)
    difference.set(xlabel=f"mean of both: {name}", ylabel=f"difference of the result ({for_picture(found.unit)})")
    for ax in (scatter, difference):
        ax.grid(alpha=0.25)
    difference.margins(x=0.12, y=0.12)
    figure.draw_without_rendering()  # before it, nothing has its place
    named = (pairs["cloud"].isin(found.outliers) if found.n > FEW else pairs["cloud"].notna()).to_numpy(bool)
    _name(difference, pairs["cloud"].to_numpy()[named].tolist(), middle[named], off[named])
    return figure


def _draw_intervals(ax: Axes, x: FloatArray, y: FloatArray, low: FloatArray, high: FloatArray) -> None:
    """Points with their intervals in a square, beside the line on which both are the same."""
    shown = np.concatenate([x, y, low[np.isfinite(low)], high[np.isfinite(high)]])
    span = np.array([shown.min(), shown.max()])
    span += np.array([-MARGIN, MARGIN]) * (np.ptp(span) or 1.0)
    ax.set(aspect="equal", xlim=span, ylim=span)
    ax.plot(span, span, color=GREY, lw=1, zorder=0)
    ax.annotate("both the same", (span[0], span[0]), (22, 12), textcoords="offset points", fontsize=8, color=GREY,
                rotation=45, rotation_mode="anchor")  # fmt: skip
    ends = np.nan_to_num(np.stack([y - low, high - y])).clip(min=0.0)
    ax.errorbar(x, y, ends, fmt="o", ms=4, lw=1, capsize=2.5, color=COLOR)
    arrow = {"arrowstyle": "<|-", "color": COLOR, "lw": 1, "shrinkA": 0, "shrinkB": 0}
    for end, other, up in ((low, high, -1.0), (high, low, 1.0)):
        for i in np.flatnonzero(~np.isfinite(end) & np.isfinite(other)):
            ax.annotate("", (x[i], y[i]), (0.0, up * ARROW_PT), textcoords="offset points", arrowprops=arrow)


def _draw_limits(ax: Axes, found: Agreement) -> None:
    """Bias and limits of agreement, each with its number at the right."""
    lines = [(found.bias, "-", "bias")]
    lines += [(found.lower, "--", "95 % limit"), (found.upper, "--", "95 % limit")] if found.n > 1 else []
    ax.axhline(0.0, color=GREY, lw=1)
    for at, style, what in lines:
        ax.axhline(at, color=BIAS, ls=style)
        ax.annotate(
            f"{what}\n{at:+.3g}",
            (1.0, at),
            (4, 0),
            xycoords=ax.get_yaxis_transform(),
            textcoords="offset points",
            fontsize=8,
            color=BIAS,
            va="center",
            annotation_clip=False,
        )


def _name(ax: Axes, names: Sequence[str], x: FloatArray, y: FloatArray) -> None:
    """Write names beside points, each where it stays within the axes and meets the fewest others."""
    frame = ax.get_window_extent()
    places = ax.transData.transform(np.stack([x, y], axis=1))
    taken = [Bbox.from_bounds(px - DOT_PX, py - DOT_PX, 2.0 * DOT_PX, 2.0 * DOT_PX) for px, py in places]
    for name, px, py in zip(names, x, y, strict=True):
        text = for_picture(name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…")
        tried: list[tuple[float, Annotation, Bbox]] = []
        for dx, dy, ha, va in AROUND:
            made = ax.annotate(text, (px, py), (dx, dy), textcoords="offset points", fontsize=8, ha=ha, va=va)
            box = made.get_window_extent()
            outside = box.x0 < frame.x0 or box.x1 > frame.x1 or box.y0 < frame.y0 or box.y1 > frame.y1
            tried.append((len(taken) * outside + sum(box.overlaps(other) for other in taken), made, box))
        _, best, box = min(tried, key=lambda it: it[0])
        taken.append(box)
        for _, made, _ in tried:
            if made is not best:
                made.remove()


def plot_trials(table: pd.DataFrame, percent: float, degrees: float) -> Figure:
    """What more points and more cameras bring: the share of the results of each trait within so many per cent, or
    degrees, of the truth, and their root mean square error.  ``table`` is that of `trial_table`.
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
        ylabel=f"within {percent:g} % (angle: {degrees:g}°)\nof the truth, % of the leaves", ylim=(-3.0, 103.0)
    )
    axes[1, 0].set(ylabel="root mean square error,\ncm (angle: °)", yscale="log")
    handles, names = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False)
    return figure
