"""Pictures of how results agree with the hand, or with the truth of simulated phytomers."""

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from phytofit.validation import Agreement

__all__ = ["plot_agreement", "plot_trials"]

FEW = 8  # pairs, up to which each is named; of more only those that are far off
LINES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"))


def plot_agreement(pairs: pd.DataFrame, found: Agreement, against: str = "by hand") -> Figure:
    """Results of one trait against the hand (or the truth), with intervals; and their differences against the mean of
    both (Bland and Altman), with bias and limits of agreement.  ``pairs`` as :func:`phytofit.compare` makes them."""
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
    scatter.set(xlabel=f"{against}: {name}", ylabel=f"result: {name}", aspect="equal", xlim=span)
    middle = 0.5 * (measured + value)
    difference.plot(middle, value - measured, "o", ms=4, color="#0072B2")
    difference.axhline(0.0, color="0.5", lw=1)
    difference.axhline(found.bias, color="#D55E00", label="bias")
    if found.n > 1:
        for end in (found.lower, found.upper):
            difference.axhline(
                end, color="#D55E00", ls="--", label="95 % limits of agreement" if end > found.bias else ""
            )
    difference.set(xlabel=f"mean of both: {name}", ylabel=f"difference of the result ({found.unit})")
    difference.legend(fontsize=8)
    named = pairs["cloud"].isin(found.outliers) if found.n > FEW else pairs["cloud"].notna()
    for cloud, x, y in zip(pairs["cloud"][named], middle[named], (value - measured)[named], strict=True):
        difference.annotate(str(cloud), (x, y), fontsize=8, xytext=(4, 4), textcoords="offset points")
    for ax in (scatter, difference):
        ax.grid(alpha=0.25)
    return figure


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
        ylabel=f"within {percent:g} % (angle: {degrees:g}°) of the truth, % of the leaves", ylim=(-3.0, 103.0)
    )
    axes[1, 0].set(ylabel="root mean square error, cm (angle: °)", yscale="log")
    handles, names = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False)
    return figure
