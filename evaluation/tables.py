"""Tables as CSV for programs and as Markdown for pages."""

from pathlib import Path

import numpy as np
import pandas as pd


def write_table(table: pd.DataFrame, name: str, out: Path) -> None:
    """``out/name.csv``, with six significant digits."""
    table.to_csv(out / f"{name}.csv", index=False, float_format="%.6g", lineterminator="\n")


def write_markdown(rows: list[list[str]], head: list[str], name: str, out: Path) -> None:
    """``out/name.md``, as a page shows it."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    (out / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def interval_of_r(true: np.ndarray, fitted: np.ndarray, *, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """95 % bootstrap interval of the correlation of true (n,) and fitted (runs, n), mean over the runs.

    Phytomers are drawn with replacement, the same for all runs: percentiles (Efron and Tibshirani, 1993).
    """
    random = np.random.default_rng(seed)
    which = random.integers(len(true), size=(draws, len(true)))
    x = true[which]
    x = x - x.mean(axis=1, keepdims=True)
    found = np.zeros(draws)
    for run in fitted:
        y = run[which]
        y = y - y.mean(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):  # of a draw that is one phytomer again and again
            found += (x * y).sum(axis=1) / np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1))
    low, high = np.nanquantile(found / len(fitted), [0.025, 0.975])
    return float(low), float(high)
