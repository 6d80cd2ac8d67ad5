"""What a fit looks like on disk: one folder a cloud, and a tidy table."""

from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phytofit.cloud import PointCloud
from phytofit.errors import NoPhytomerError, OutputError
from phytofit.io.files import files_made, input_of, json_text
from phytofit.io.models import write_mesh
from phytofit.io.replacing import whole_folder
from phytofit.io.tables import FolderTable, write_table
from phytofit.plots import plot_convergence, plot_fit
from phytofit.recipe import recipe_of
from phytofit.results.fit import Fit
from phytofit.text import for_file_name
from phytofit.traits import Trait

__all__ = ["COLUMNS", "fit_tables", "save_fit", "trait_table"]

COLUMNS = ["cloud", "plant", "organ", "rank", "trait", "value", "unit", "low", "high", "method", "flags"]


def trait_table(name: str, traits: Iterable[Trait], *, plant: int = 1) -> pd.DataFrame:
    """Tidy table of traits with the columns `COLUMNS`, one row for each organ and trait.

    `name` is the cloud's; `plant` the number of the plant in it, from 1, where a cloud holds several.
    """
    rows = [
        (name, plant, t.organ, t.rank, t.name, t.value, t.unit, t.low, t.high, t.method, "; ".join(t.flags))
        for t in traits
    ]
    return pd.DataFrame(rows, columns=COLUMNS).astype({"low": float, "high": float})


def fit_tables(folder: Path) -> FolderTable:
    """The table over all fits that lie in a folder; OutputError if it is that of a whole plant."""
    if (folder / "segmentation" / "stage.json").is_file():
        raise OutputError(f"{folder}: it holds the result of a whole plant; choose another folder for those of leaves")
    return FolderTable(folder, "traits.csv", "fit.json", COLUMNS)


def save_fit(
    result: Fit,
    cloud: PointCloud,
    folder: str | Path,
    name: str | None = None,
    *,
    meshes: Sequence[str] = ("ply",),
    convergence: bool = False,
) -> Path:
    """Write ``folder/name/``: fit.json, traits.csv, model.ply and fit.png; all of them or none.

    A folder of that name from an earlier run is replaced; files in it that phytofit did not make are kept.  The model
    is in the input's unit and frame; `meshes` says in which formats, of ply, obj and glb.  With `convergence`, there is
    convergence.png too: how the search went.

    Raises NoPhytomerError where a trait is not a number, OutputError where the result can't be written.
    """
    name = for_file_name(name or cloud.name)
    _check_finite(result)
    with whole_folder(Path(folder), name, "fit.json", "stage.json") as part:
        write_table(part / "traits.csv", trait_table(name, result.traits))
        for kind in dict.fromkeys(("ply", *meshes)):
            write_mesh(part / f"model.{kind}", result.organs, cloud)
        plot_fit(result, title=name).savefig(part / "fit.png", dpi=150, metadata={"Software": None})
        if convergence:
            plot_convergence(result).savefig(part / "convergence.png", dpi=150, metadata={"Software": None})
        said = _as_json(result, cloud, name) | {"files": files_made(part)}
        (part / "fit.json").write_text(json_text(said), encoding="utf-8", newline="")
    return Path(folder) / name


def _check_finite(result: Fit) -> None:
    """NoPhytomerError where the fit is no phytomer of this world."""
    ends = [(t.name, end) for t in result.traits for end in (t.value, t.low, t.high) if end is not None]
    for what, value in (*ends, *result.parameters.items(), ("error", result.error)):
        if not np.isfinite(value):
            raise NoPhytomerError(f"its {what.replace('_', ' ')} came out as {value}, not a number: look at the cloud")


def _as_json(result: Fit, cloud: PointCloud, name: str) -> dict[str, Any]:
    """What fit.json holds; no times, so that the same run gives the same bytes."""
    space = result.species.space
    intervals = result.parameter_intervals
    traits = trait_table(name, result.traits).drop(columns=["cloud", "plant", "flags"]).replace({np.nan: None})
    return {
        "phytofit": version("phytofit"),
        "cloud": name,
        "input": input_of(cloud),
        "species": result.species.name,
        "prior": {
            p.name: {"mean": p.mean, "std": p.std, "lower": _finite(p.lower), "upper": _finite(p.upper), "unit": p.unit}
            for p in space.parameters
        },
        "model": type(result.species.model).__name__,
        "method": result.method,
        "status": result.status.value,
        "flags": list(result.flags),
        "notes": list(result.notes),
        "parameters": {
            p: dict(zip(("value", "low", "high"), (value, *intervals.get(p, (None, None))), strict=True))
            | {"unit": _unit(unit, result)}
            for (p, value), unit in zip(result.parameters.items(), space.units, strict=True)
        },
        "traits": traits.to_dict(orient="records"),
        "error": result.error,
        "pose": result.pose.tolist(),
        **_how_it_ended(result),
        "history": [
            {
                "generation": g.index,
                "mean": g.mean.tolist(),
                "cov": g.cov.tolist(),
                "threshold": g.threshold,
                "best_x": g.best_x.tolist(),
                "best_error": g.best_error,
            }
            for g in result.history
        ],
        "seed": result.seed,
        "settings": recipe_of(result),
    }


def _how_it_ended(result: Fit) -> dict[str, Any]:
    """What only one of the methods has: the registration of the paper's, the noise and shares of the likelihood's."""
    if result.registration is not None:
        ended = result.registration
        return {
            "registration": {"rmse": ended.rmse, "iterations": ended.iterations, "converged": ended.converged},
        }
    assert result.estimate is not None
    made = result.estimate
    noise = made.noise * result.scale
    return {
        "noise": dict(zip(("stem", "leaf", "leaf_thickness"), noise.tolist(), strict=True)),
        "share": dict(zip(("stem", "leaf", "outliers"), made.share.tolist(), strict=True)),
        "midrib_seen": made.seen,
        "tip_seen": made.tip_seen,
        "leaf_ends_at": made.ends_at,
        "correlated_cm": made.correlated_cm,
        "evidence": made.evidence,
        "variance_inflation": made.inflation,
        "covariance": result.covariance.tolist(),
        "trait_covariance": None if result.trait_covariance is None else result.trait_covariance.tolist(),
    }


def _finite(bound: float) -> float | None:
    return bound if np.isfinite(bound) else None


def _unit(unit: str, result: Fit) -> str:
    return "rel" if result.relative and unit == "cm" else unit
