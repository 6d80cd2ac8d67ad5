"""Table II: how the estimates correlate with the truth, by the paper's method, by the default, and without a model."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phytofit
import phytofit.io
import phytofit.models
from benchmarks import model_free
from evaluation.jobs import run_all
from evaluation.settings import NAMES, Budget, clouds, read
from evaluation.tables import interval_of_r, write_markdown, write_table

PARAMETERS = phytofit.models.Phytomer.PARAMETERS[:6]  # of Eq. (1)
UNIT = {name: "°" if "angle" in name else " cm" for name in PARAMETERS}
FIRST_SEED = 100_000
TRAITS = ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter")
THEIRS = {"leaf_length": 0.99, "leaf_angle": 0.97}


def make(budget: Budget, out: Path) -> None:
    rows = []
    for method in ("paper", "likelihood"):
        settings = budget.search if method == "paper" else {}
        jobs = [(method, n, seed, settings) for seed in range(budget.seeds) for n in range(budget.phytomers)]
        done = run_all(simulated, jobs, f"Table II, {NAMES[method]}")
        true = np.array([d["x"] for d in done[: budget.phytomers]])
        fitted = np.array([d["fitted"] for d in done]).reshape(budget.seeds, budget.phytomers, len(PARAMETERS))
        rows += [summary(method, name, true[:, k], fitted[:, :, k]) for k, name in enumerate(PARAMETERS)]
    truth = {t: np.array([d["true"][t] for d in done[: budget.phytomers]]) for t in TRAITS}
    free = run_all(without_model, [(n,) for n in range(budget.phytomers)], "Table II, without a model")
    for name in TRAITS:
        rows.append(summary("without a model", name, truth[name], np.array([[d[name] for d in free]])))
    table = pd.DataFrame(rows)
    write_table(table, "table2", out)
    head = [
        "method",
        "parameter, or trait",
        "R",
        "95 % interval",
        "least, largest of the seeds",
        "RMSE",
        "bias",
        "paper's R",
    ]
    write_markdown([readable(row) for row in rows], head, "table2", out)
    real(budget, out)


def simulated(method: str, number: int, seed: int, settings: dict[str, int]) -> dict[str, Any]:
    """True and fitted parameters of one of the protocol's phytomers: 5,000 points, 0.5 cm noise, the leaf in the middle
    of its stem."""
    made = phytofit.simulate(stem_above="equal", seed=FIRST_SEED + number)
    truth = {"x": made.x[: len(PARAMETERS)], "true": {t.name: t.value for t in phytofit.measure(made.organs)}}
    try:
        result = phytofit.fit(made.points, "cm", method=method, seed=seed, threads=1, **settings)
    except phytofit.NoPhytomerError:
        nothing = (np.nan, None, None)
        return truth | {"fitted": np.full(6, np.nan), "traits": dict.fromkeys(truth["true"], nothing), "flags": ()}
    return truth | {
        "fitted": result.x[: len(PARAMETERS)],
        "traits": {t.name: (t.value, t.low, t.high) for t in result.traits},
        "flags": result.flags,
    }


def without_model(number: int) -> dict[str, float]:
    made = phytofit.simulate(stem_above="equal", seed=FIRST_SEED + number)
    try:
        return model_free.measure(made.points)
    except phytofit.NoPhytomerError:
        return dict.fromkeys(TRAITS, np.nan)


def summary(method: str, name: str, true: np.ndarray, fitted: np.ndarray) -> dict[str, Any]:
    """Of true (n,) and fitted (seeds, n); what could not be measured is left out, and counted."""
    found = np.isfinite(fitted).all(axis=0)
    true, fitted = true[found], fitted[:, found]
    r = [np.corrcoef(true, run)[0, 1] for run in fitted]
    low, high = interval_of_r(true, fitted)
    error = fitted - true
    return {
        "method": method,
        "parameter": name,
        "r": np.mean(r),
        "r_low": low,
        "r_high": high,
        "r_least": np.min(r),
        "r_largest": np.max(r),
        "rmse": np.sqrt(np.mean(error**2)),
        "bias": error.mean(),
        "not_found": int((~found).sum()),
    }


def readable(row: dict[str, Any]) -> list[str]:
    unit = UNIT[row["parameter"]]
    several = row["r_least"] < row["r_largest"]
    return [
        NAMES[row["method"]],
        row["parameter"].replace("_", " "),
        f"{row['r']:.4f}",
        f"{row['r_low']:.4f}, {row['r_high']:.4f}",
        f"{row['r_least']:.4f}, {row['r_largest']:.4f}" if several else "",
        f"{row['rmse']:.2f}{unit}" + (f", {row['not_found']} not found" if row["not_found"] else ""),
        f"{row['bias']:+.2f}{unit}",
        f"{THEIRS[row['parameter']]}" if row["method"] == "paper" and row["parameter"] in THEIRS else "",
    ]


def real(budget: Budget, out: Path) -> None:
    """The real clouds with hand measures: too few for a correlation, so their differences."""
    paths = clouds("greenhouse")
    if not paths:
        return
    jobs = [
        (method, path, budget.search if method == "paper" else {})
        for method in ("likelihood", "paper")
        for path in paths
    ]
    done = dict(zip([job[:2] for job in jobs], run_all(real_fit, jobs, "Greenhouse clouds"), strict=True))
    measures = phytofit.read_measures(paths[0].parent / "ground_truth.csv")
    columns, every = {}, []
    for method in ("likelihood", "paper"):
        results = pd.concat([done[method, path] for path in paths])
        pairs = phytofit.compare(measures, results).pairs
        columns[method] = pairs.set_index(["cloud", "trait"])
        every.append(pairs.assign(method=method))
    write_table(pd.concat(every), "real", out)
    rows = []
    for (cloud, trait), row in columns["likelihood"].iterrows():
        ends = [f"{end:.2f}" if np.isfinite(end) else "–" for end in (row["low"], row["high"])]
        other = columns["paper"].loc[(cloud, trait), "value"]
        unit = "°" if row["unit"] == "deg" else f" {row['unit']}"
        rows.append(
            [
                cloud,
                trait.replace("_", " "),
                f"{row['measured']:.2f}{unit}",
                f"{row['value']:.2f}",
                f"{ends[0]}, {ends[1]}",
                f"{other:.2f}",
            ]
        )
    head = ["cloud", "trait", "by hand", NAMES["likelihood"], "95 % interval", NAMES["paper"]]
    write_markdown(rows, head, "real", out)
    mean = []
    for method, pairs in columns.items():
        off = (pairs["value"] - pairs["measured"]).abs()
        share = off.where(pairs["unit"] == "deg", 100.0 * off / pairs["measured"]).groupby("trait", sort=False).mean()
        cells = [f"{share[trait]:.1f}" + ("°" if "angle" in trait else " %") for trait in TRAITS]
        held = pairs[pairs["low"].notna()]
        inside = (held["low"] <= held["measured"]) & ~(held["high"] < held["measured"])
        mean.append([NAMES[method], *cells, f"{inside.sum()} of {len(held)}" if len(held) else ""])
    head = ["mean absolute difference from the hand", *(t.replace("_", " ") for t in TRAITS), "hand measures held"]
    write_markdown(mean, head, "real_means", out)


def real_fit(method: str, path: Path, settings: dict[str, int]) -> pd.DataFrame:
    result = phytofit.fit(read(path), method=method, threads=1, **settings)
    return phytofit.io.trait_table(path.stem, result.traits)
