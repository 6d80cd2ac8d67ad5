"""Reports that a browser shows without anything else: one HTML file, pictures inside."""

import base64
import io
import math
from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from phytofit.plots import plot_agreement, plot_trials
from phytofit.text import for_page
from phytofit.validation import Agreement, Comparison, agreement
from phytofit.validation.trials import Trial

__all__ = ["GENERATOR", "agreement_page", "agreement_table", "trial_page"]

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #ccc; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; } .note { color: #555; }
@media print { body { max-width: none; } }
"""
GENERATOR = '<meta name="generator" content="phytofit">'  # says whose page it is
HEADINGS = ("n", "bias", "RMSE", "MAE", "R", "CCC", "limits of agreement", "covered", "good, check, poor", "outliers")
MEANING = (
    "Differences are result minus {measure}. Bias is their mean, RMSE their root mean square, MAE the mean of their "
    "sizes. R is Pearson's correlation, CCC Lin's concordance correlation, which falls with bias too. The limits of "
    "agreement (Bland and Altman) hold 95 % of the differences if these are normally distributed. Covered: how many "
    "{measure}s lie within the result's 95 % interval. An interval with one end only, drawn with an arrow, holds all "
    "that is beyond it. Good, check, poor: how far the results say that they can be trusted; poor ones should not be "
    "used. Outliers: clouds whose difference is "
    "far from the others' (modified z-score above 3.5)."
)


def agreement_table(found: Sequence[Agreement]) -> pd.DataFrame:
    """The statistics as text, one row a trait, for a screen or a page; the index is the trait with its unit."""
    rows = [
        (
            str(a.n),
            f"{a.bias:+.2f}",
            f"{a.rmse:.2f}",
            f"{a.mae:.2f}",
            _number(a.r),
            _number(a.ccc),
            "" if a.n < 2 else f"{a.lower:.2f} to {a.upper:.2f}",
            f"{round(a.coverage * a.n_intervals)} of {a.n_intervals}" if a.n_intervals else "",
            f"{a.good}, {a.check}, {a.poor}",
            ", ".join(a.outliers),
        )
        for a in found
    ]
    return pd.DataFrame(rows, columns=list(HEADINGS), index=[f"{a.trait} ({a.unit})" for a in found])


def agreement_page(comparison: Comparison, found: Sequence[Agreement], title: str) -> str:
    """One self-contained HTML page: the statistics, two plots a trait, and what has no partner."""
    return _page(title, _agreement_parts(comparison, found, "by hand", "hand measure", "Without a partner"))


def trial_page(
    base: Trial, table: pd.DataFrame, answers: Sequence[str], percent: float, degrees: float, title: str
) -> str:
    """One self-contained HTML page: what points and views are needed, and the statistics with the sensor as it is."""
    parts = _listed("What is needed", answers)
    parts += [_image(plot_trials(table, percent, degrees), "errors by number of points and of views")]
    shown = table.assign(within=(100.0 * table["within"]).round(), coverage=(100.0 * table["coverage"]).round())
    shown = shown.rename(columns={"within": "within, %", "coverage": "covered, %", "rmse": "RMSE"})
    parts += [_table(shown.set_index("setting").map(_short))]
    parts += ["<h2>The sensor as it was described</h2>"]
    found = agreement(base.comparison.pairs)
    return _page(title, parts + _agreement_parts(base.comparison, found, "true", "true value", "Refused"))


def _agreement_parts(
    comparison: Comparison, found: Sequence[Agreement], against: str, measure: str, alone: str
) -> list[str]:
    shown = agreement_table(found).rename(index=lambda trait: trait.replace("_", " "))
    shown = shown if shown["outliers"].any() else shown.drop(columns="outliers")
    parts = [_table(shown), f'<p class="note">{for_page(MEANING.format(measure=measure))}</p>']
    for a in found:
        those = comparison.pairs[comparison.pairs["trait"] == a.trait]
        name = a.trait.replace("_", " ")
        parts += [f"<h2>{for_page(name)}</h2>", _image(plot_agreement(those, a, against), name)]
    return parts + _listed("Notes", comparison.notes) + _listed(alone, comparison.unmatched)


def _listed(heading: str, texts: Sequence[str]) -> list[str]:
    return [f"<h2>{heading}</h2><ul>", *(f"<li>{for_page(text)}</li>" for text in texts), "</ul>"] if texts else []


def _page(title: str, parts: Sequence[str]) -> str:
    body = "\n".join([f"<h1>{for_page(title)}</h1>", *parts])
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">{GENERATOR}<title>{for_page(title)}</title>'
        f"<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _short(cell: object) -> str:
    return f"{cell:.3g}" if isinstance(cell, float) else str(cell)


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else ""


def _table(table: pd.DataFrame) -> str:
    head = "".join(f"<th>{for_page(text)}</th>" for text in (table.index.name or "trait", *table.columns))
    rows = "".join(
        "<tr>" + "".join(f"<td>{for_page(str(cell))}</td>" for cell in (name, *row)) + "</tr>"
        for name, row in zip(table.index, table.to_numpy(), strict=True)
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _image(figure: Figure, text: str) -> str:
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
        data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="{for_page(text)}" src="data:image/png;base64,{data}">'
