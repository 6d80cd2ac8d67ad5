"""Fig. 8: estimates against the truth, simulated; and against the hand, for the few real clouds that there are."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from evaluation.draw import save
from evaluation.jobs import run_all
from evaluation.settings import COLORS, MARKERS, NAMES, Budget
from evaluation.table2 import simulated

SHOWN = {"leaf_length": "leaf length (cm)", "leaf_angle": "leaf angle (°)"}


def make(budget: Budget, out: Path) -> None:
    """After Table II, whose fits (of the first seed) and greenhouse clouds it shows."""
    real = pd.read_csv(out / "real.csv") if (out / "real.csv").is_file() else None
    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    axes = figure.subplots(2, len(SHOWN))
    for method in ("paper", "likelihood"):
        settings = budget.search if method == "paper" else {}
        jobs = [(method, n, 0, settings) for n in range(budget.phytomers)]
        done = run_all(simulated, jobs, f"Fig. 8, {NAMES[method]}")
        for ax, name in zip(axes[0], SHOWN, strict=True):
            true = np.array([d["true"][name] for d in done])
            value = np.array([d["traits"][name][0] for d in done])
            r = np.corrcoef(true, value)[0, 1]
            ax.plot(
                true,
                value,
                MARKERS[method],
                ms=4.5,
                color=COLORS[method],
                alpha=0.8,
                label=f"{NAMES[method]}, R = {r:.4f}",
            )
        if real is None:
            continue
        for ax, name in zip(axes[1], SHOWN, strict=True):
            those = real[(real["method"] == method) & (real["trait"] == name)]
            ends = [those["value"] - those["low"], those["high"] - those["value"]]
            ends = [end.fillna(0.0).clip(lower=0.0) for end in ends]
            ax.errorbar(
                those["measured"],
                those["value"],
                ends,
                fmt=MARKERS[method],
                ms=5,
                lw=1,
                color=COLORS[method],
                label=NAMES[method],
            )
            if method == "likelihood":
                for row in those.itertuples():
                    ax.annotate(
                        row.cloud, (row.measured, row.value), fontsize=8, xytext=(5, -10), textcoords="offset points"
                    )
    for row, against in zip(axes, ("true", "by hand"), strict=True):
        for ax, label in zip(row, SHOWN.values(), strict=True):
            ends = np.array([ax.get_xlim(), ax.get_ylim()])
            span = [ends.min(), ends.max()]
            ax.plot(span, span, color="0.6", lw=1, zorder=0)
            ax.set(xlabel=f"{against}: {label}", ylabel=f"fitted: {label}", xlim=span, ylim=span, aspect="equal")
            ax.grid(alpha=0.25)
            if ax.get_legend_handles_labels()[0]:
                ax.legend(fontsize=9, loc="upper left")
    axes[0, 0].set_title(f"{budget.phytomers} simulated phytomers")
    axes[1, 0].set_title("Greenhouse clouds, 95 % intervals where there are")
    save(figure, out / "fig8.png")
