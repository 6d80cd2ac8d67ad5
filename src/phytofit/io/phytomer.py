"""What a fit looks like on disk: one folder a cloud, and a tidy table."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phytofit.cloud import PointCloud
from phytofit.errors import InputError, NoPhytomerError, OutputError
from phytofit.io.files import files_made, input_of, json_text
from phytofit.io.models import write_mesh
from phytofit.io.replacing import whole_folder
from phytofit.io.tables import FolderTable, write_table
from phytofit.plots import plot_convergence, plot_fit
from phytofit.recipe import recipe_of
from phytofit.results import FittedPhytomer, Remark
from phytofit.small_files import read_json
from phytofit.text import for_file_name
from phytofit.traits import Trait

__all__ = ["COLUMNS", "SEPARATOR", "fit_tables", "read_remarks", "remarks_text", "save_fit", "trait_table"]

COLUMNS = ["cloud", "plant", "organ", "rank", "trait", "value", "unit", "low", "high", "quality", "flags", "method"]
SEPARATOR = ";"  # of flags


def trait_table(name: str, traits: Iterable[Trait], *, plant: int = 1) -> pd.DataFrame:
    """Tidy table of traits with the columns `COLUMNS`, one row for each organ and trait.

    `name` is the cloud's; `plant` the number of the plant in it, from 1, where a cloud holds several.
    """
    rows = [
        (name, plant, t.organ, t.rank, t.name, t.value, t.unit, t.low, t.high, t.quality, codes, t.method)
        for t, codes in ((t, SEPARATOR.join(t.flags)) for t in traits)
    ]
    return pd.DataFrame(rows, columns=COLUMNS).astype({"low": float, "high": float})


def fit_tables(folder: Path) -> FolderTable:
    """The table over all fits that lie in a folder; OutputError if it is that of a whole plant."""
    if (folder / "segmentation" / "stage.json").is_file():
        raise OutputError(f"{folder}: it holds the result of a whole plant; choose another folder for those of leaves")
    return FolderTable(folder, "traits.csv", "fit.json", COLUMNS)


def save_fit(
    result: FittedPhytomer,
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


def remarks_text(remarks: Iterable[Remark]) -> str:
    """Remarks as JSON, in the form in which ``fit.json`` has them."""
    return json_text({"remarks": [asdict(one) for one in remarks]})


def read_remarks(file: Path) -> list[Remark]:
    """The remarks in a file that has them as ``fit.json`` does; InputError if it has none, or can't be read."""
    expected = "the remarks of a fit, as phytofit writes them"
    said = read_json(file, expected)
    try:
        return [Remark(**{**one, "traits": tuple(one["traits"])}) for one in said["remarks"]]
    except (KeyError, TypeError) as error:
        raise InputError(f"{file}: expected {expected} ({type(error).__name__}: {error})") from None


def _check_finite(result: FittedPhytomer) -> None:
    """NoPhytomerError where the fit is no phytomer of this world."""
    ends = [(t.name, end) for t in result.traits for end in (t.value, t.low, t.high) if end is not None]
    for what, value in (*ends, *result.parameters.items(), ("error", result.error)):
        if not np.isfinite(value):
            raise NoPhytomerError(f"its {what.replace('_', ' ')} came out as {value}, not a number: look at the cloud")


def _as_json(result: FittedPhytomer, cloud: PointCloud, name: str) -> dict[str, Any]:
    """What fit.json holds; no times, so that the same run gives the same bytes."""
    space = result.species.space
    intervals = result.parameter_intervals
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
        "notes": list(result.notes),
        "parameters": {
            p: dict(zip(("value", "low", "high"), (value, *intervals.get(p, (None, None))), strict=True))
            | {"unit": result.length_unit if unit == "cm" else unit}
            for (p, value), unit in zip(result.parameters.items(), space.units, strict=True)
        },
        "traits": [_trait(trait) for trait in result.traits],
        "remarks": [asdict(one) for one in result.remarks],
        "error": result.error,
        "pose": result.pose.tolist(),
        **result.details,
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


def _trait(trait: Trait) -> dict[str, Any]:
    said = asdict(trait)
    return {"organ": said.pop("organ"), "rank": said.pop("rank"), "trait": said.pop("name"), **said}


def _finite(bound: float) -> float | None:
    return bound if np.isfinite(bound) else None
