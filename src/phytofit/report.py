"""Reports that a browser shows without anything else: one HTML file, pictures inside."""

import base64
import html
import io
import math
from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from phytofit.plots import plot_agreement
from phytofit.validation import Agreement, Comparison

__all__ = ["agreement_page", "agreement_table"]

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #ccc; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; } .note { color: #555; }
@media print { body { max-width: none; } }
"""
HEADINGS = ("n", "bias", "RMSE", "MAE", "R", "CCC", "limits of agreement", "covered", "flagged", "outliers")
MEANING = (
    "Differences are result minus hand measure. Bias is their mean; RMSE and MAE are their root mean square and mean "
    "size. R is Pearson's correlation, CCC Lin's concordance. The limits of agreement (Bland and Altman) hold 95 % of "
    "the differences, if they are normal. Covered: hand measures within the results' 95 % intervals. Outliers: clouds "
    "whose difference is far from the others' (modified z-score above 3.5)."
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
            str(a.flagged),
            ", ".join(a.outliers),
        )
        for a in found
    ]
    return pd.DataFrame(rows, columns=list(HEADINGS), index=[f"{a.trait} ({a.unit})" for a in found])


def agreement_page(comparison: Comparison, found: Sequence[Agreement], title: str) -> str:
    """One self-contained HTML page: the statistics, two plots a trait, and what has no partner."""
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        _table(agreement_table(found)),
        f'<p class="note">{html.escape(MEANING)}</p>',
    ]
    for a in found:
        those = comparison.pairs[comparison.pairs["trait"] == a.trait]
        parts += [f"<h2>{html.escape(a.trait.replace('_', ' '))}</h2>", _image(plot_agreement(those, a), a.trait)]
    if comparison.unmatched:
        parts.append("<h2>Without a partner</h2><ul>")
        parts += [f"<li>{html.escape(text)}</li>" for text in comparison.unmatched]
        parts.append("</ul>")
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else ""


def _table(table: pd.DataFrame) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in ("trait", *table.columns))
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in (name, *row)) + "</tr>"
        for name, row in zip(table.index, table.to_numpy(), strict=True)
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _image(figure: Figure, text: str) -> str:
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
        data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="{html.escape(text)}" src="data:image/png;base64,{data}">'
