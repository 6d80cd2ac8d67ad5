"""What a result looks like on disk: one folder a cloud, one table over all, nothing half-written."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phytofit.cloud import PointCloud
from phytofit.errors import OutputError
from phytofit.fitting import Fit
from phytofit.formats import write_cloud
from phytofit.models import mesh
from phytofit.plots import plot_convergence, plot_fit, plot_segmentation
from phytofit.recipe import recipe_of
from phytofit.segmentation import Segmentation
from phytofit.traits import Trait

__all__ = [
    "COLUMNS",
    "leaf_table",
    "prepare_folder",
    "result_names",
    "save_fit",
    "save_segmentation",
    "trait_table",
    "write_text",
]

COLUMNS = ["cloud", "organ", "rank", "trait", "value", "unit", "low", "high", "method", "flags"]
DIGITS = 6  # significant, in tables; fit.json has all


def trait_table(name: str, traits: Iterable[Trait]) -> pd.DataFrame:
    """Tidy table of traits, one row an organ and trait, with the columns `COLUMNS`; `name` is the cloud's."""
    rows = [
        (name, t.organ, t.rank, t.name, t.value, t.unit, t.low, t.high, t.method, "; ".join(t.flags)) for t in traits
    ]
    return pd.DataFrame(rows, columns=COLUMNS).astype({"low": float, "high": float})


def result_names(paths: Sequence[Path]) -> list[str]:
    """A name for each cloud: its file's stem; names that collide take the parent folder's name in front, then the
    file's ending behind, then a number."""
    folders = [path.resolve().parent.name for path in paths]
    names = [path.stem for path in paths]
    for longer in (
        [f"{folder}_{path.stem}" for folder, path in zip(folders, paths, strict=True)],
        [f"{folder}_{path.name.replace('.', '_')}" for folder, path in zip(folders, paths, strict=True)],
        [f"{folder}_{path.stem}_{i}" for i, (folder, path) in enumerate(zip(folders, paths, strict=True), start=1)],
    ):
        names = [long if names.count(name) > 1 else name for name, long in zip(names, longer, strict=True)]
    return names


def prepare_folder(folder: Path) -> Path:
    """Make sure that results can be written to the folder; OutputError if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"{folder}: results can't be written there ({error.strerror}); name another folder with --out"
        ) from None
    return folder


def write_text(path: Path, text: str) -> None:
    """Write a whole file or nothing."""
    part = path.with_name(f".{path.name}.part-{os.getpid()}")
    try:
        part.write_text(text, encoding="utf-8", newline="")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"{path}: can't be written ({error.strerror})") from None


def save_fit(result: Fit, cloud: PointCloud, folder: str | Path, name: str | None = None) -> Path:
    """Write ``folder/name/``: fit.json, traits.csv, model.ply, fit.png and convergence.png; all of them or none.

    A folder of that name from an earlier run is replaced.  model.ply is in the input's unit and frame.
    """
    name = name or cloud.name
    with _whole_folder(Path(folder), name) as part:
        (part / "fit.json").write_text(json.dumps(_as_json(result, cloud, name), indent=1) + "\n", encoding="utf-8")
        (part / "traits.csv").write_text(table_text(trait_table(name, result.traits)), encoding="utf-8", newline="")
        model = mesh(result.organs)
        model.vertices = cloud.to_input_frame(np.asarray(model.vertices))
        model.export(part / "model.ply")
        plot_fit(result, title=name).savefig(part / "fit.png", dpi=150, metadata={"Software": None})
        plot_convergence(result).savefig(part / "convergence.png", dpi=150, metadata={"Software": None})
    return Path(folder) / name


def save_segmentation(result: Segmentation, folder: str | Path, name: str | None = None) -> Path:
    """Write ``folder/name/``: plant.ply, phytomers/leaf_01.ply .., leaves.csv, segmentation.png; all of them or none.

    A folder of that name from an earlier run is replaced.  The clouds are in the input's unit and frame, with labels.
    """
    name = name or result.cloud.name
    with _whole_folder(Path(folder), name) as part:
        write_cloud(part / "plant.ply", result.plant)
        (part / "phytomers").mkdir()
        for leaf, phytomer in zip(result.leaves, result.phytomers(), strict=True):
            write_cloud(part / "phytomers" / f"leaf_{leaf.rank:02d}.ply", phytomer)
        (part / "leaves.csv").write_text(table_text(leaf_table(name, result)), encoding="utf-8", newline="")
        picture = plot_segmentation(result, title=name)
        picture.savefig(part / "segmentation.png", dpi=150, metadata={"Software": None})
    return Path(folder) / name


def leaf_table(name: str, result: Segmentation) -> pd.DataFrame:
    """Tidy table of a plant's leaves, one row a leaf; lengths in cm, or relative where the cloud has no unit."""
    unit = "rel" if result.cloud.unit == "none" else "cm"
    rows = [
        {
            "cloud": name,
            "rank": leaf.rank,
            "label": leaf.rank + 1,
            "azimuth_deg": leaf.azimuth,
            f"collar_distance_{unit}": leaf.collar_distance,
            f"collar_height_{unit}": leaf.collar_height,
            f"length_{unit}": leaf.length,
            "n_points": leaf.n_points,
            "flags": "; ".join(leaf.flags),
        }
        for leaf in result.leaves
    ]
    return pd.DataFrame(rows)


@contextmanager
def _whole_folder(folder: Path, name: str) -> Iterator[Path]:
    """A hidden folder to write into; when all is written it becomes ``folder/name``, in the place of an older one."""
    folder = prepare_folder(folder)
    target = folder / name
    part = Path(tempfile.mkdtemp(prefix=f".{name}.part-", dir=folder))
    try:
        part.chmod(0o755)
        yield part
        if target.exists():
            shutil.rmtree(target)
        part.rename(target)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{target}: the result can't be written ({error.strerror})") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def table_text(table: pd.DataFrame) -> str:
    """The table as CSV, `DIGITS` significant digits, empty where there is no value."""
    text: str = table.to_csv(index=False, float_format=f"%.{DIGITS}g", lineterminator="\n")
    return text


def _as_json(result: Fit, cloud: PointCloud, name: str) -> dict[str, Any]:
    """What fit.json holds; no times, so that the same run gives the same bytes."""
    space = result.species.space
    intervals = result.parameter_intervals
    traits = trait_table(name, result.traits).drop(columns=["cloud", "flags"]).replace({np.nan: None})
    return {
        "phytofit": version("phytofit"),
        "cloud": name,
        "input": {
            "file": None if cloud.source is None else cloud.source.name,
            "sha256": _hash(cloud),
            "unit": cloud.unit,
        },
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
        "correlated_cm": made.correlated_cm,
        "evidence": made.evidence,
        "variance_inflation": made.inflation,
        "covariance": result.covariance.tolist(),
    }


def _finite(bound: float) -> float | None:
    return bound if np.isfinite(bound) else None


def _unit(unit: str, result: Fit) -> str:
    return "rel" if result.relative and unit == "cm" else unit


def _hash(cloud: PointCloud) -> str:
    """SHA-256 of the file, or of the points where there is none."""
    data = np.ascontiguousarray(cloud.points).tobytes() if cloud.source is None else cloud.source.read_bytes()
    return hashlib.sha256(data).hexdigest()
