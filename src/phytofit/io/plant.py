"""What a reconstruction and a segmentation look like on disk: all of it, or nothing."""

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phytofit.cloud import read_cloud, write_cloud
from phytofit.errors import InputError
from phytofit.io.files import files_made, input_of, json_text
from phytofit.io.replacing import check_made, file_hash, made_in, whole_files, whole_folder
from phytofit.io.tables import FolderTable, write_table
from phytofit.plots import plot_plants, plot_reconstruction, plot_segmentation
from phytofit.reconstruct import Reconstruction
from phytofit.segmentation import Segmentation, SegmentedLeaf
from phytofit.text import for_file_name, one_line

__all__ = [
    "check_reconstruction",
    "leaf_table",
    "leaf_tables",
    "read_segmentation",
    "save_reconstruction",
    "save_segmentation",
]

LENGTHS = ("collar_distance", "collar_height", "length")
LEAF_COLUMNS = [
    *("cloud", "plant", "rank", "label", "azimuth_deg", "n_points", "flags"),
    *(f"{name}_{unit}" for name in LENGTHS for unit in ("cm", "rel")),
]


def save_reconstruction(result: Reconstruction, folder: str | Path) -> Path:
    """Write into the folder plant.ply (cm, z up, normals, ``view`` and ``n_views`` a point), reconstruction.json and
    reconstruction.png; those of an earlier run are replaced once all three are made.

    Raises
    ------
    OutputError
        If they can't be written there; then nothing is.
    """
    folder = Path(folder)
    check_reconstruction(folder)
    with whole_files(folder) as part:
        write_cloud(
            part / "plant.ply",
            result.cloud,
            {"view": result.view.astype(np.int32), "n_views": result.n_views.astype(np.int32)},
        )
        figure = plot_reconstruction(result, title=result.cloud.name)
        figure.savefig(part / "reconstruction.png", dpi=150, metadata={"Software": None})
        said = _as_json(result) | {"files": files_made(part)}
        (part / "reconstruction.json").write_text(json_text(said), encoding="utf-8", newline="")
    return folder


def check_reconstruction(folder: str | Path) -> None:
    """OutputError if there are files in the folder that a reconstruction would replace and phytofit did not make, or
    that were changed since."""
    folder = Path(folder)
    made = made_in(folder)
    for name in ("plant.ply", "reconstruction.png", "reconstruction.json"):
        check_made(folder / name, lambda path: (path.name, file_hash(path)) in made)


def _as_json(result: Reconstruction) -> dict[str, Any]:
    """What reconstruction.json holds; no times, so that the same run gives the same bytes."""
    turn = result.turn
    camera = result.camera
    n_seen = np.bincount(result.n_views, minlength=len(result.files) + 1)[1:]
    return {
        "phytofit": version("phytofit"),
        "input": one_line(result.cloud.name),
        "camera": {
            "name": camera.name,
            **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
            "distortion": list(camera.distortion),
        },
        "unit": "cm",
        "n_points": len(result.cloud),
        "points_seen_by": {str(n): int(count) for n, count in enumerate(n_seen, start=1)},
        "turntable": None
        if turn is None
        else {
            "step_deg": result.step_deg,
            "axis_direction": turn.up.tolist(),
            "axis_point_cm": turn.point.tolist(),
            "frame": "first view's camera: x right, y down, z forward",
        },
        "views": [
            {
                "file": file,
                "angle_deg": None if turn is None else float(np.degrees(turn.angles[i])),
                "pose": result.poses[i].tolist(),
            }
            for i, file in enumerate(result.files)
        ],
        "pairs": [
            {
                "first": result.files[pair.first],
                "second": result.files[pair.second],
                "overlap": pair.overlap,
                "residual_cm": pair.residual_cm if np.isfinite(pair.residual_cm) else None,
            }
            for pair in result.pairs
        ],
        "residual_cm": result.residual_cm if result.pairs else None,
        "loop": None if result.loop is None else {"rotation_deg": result.loop[0], "shift_cm": result.loop[1]},
        "contradicted_share": result.contradicted,
        "rejected": [{"file": view.file, "reason": view.reason} for view in result.rejected],
        "flags": list(result.flags),
        "notes": list(result.cloud.notes),
        "settings": result.settings,
    }


def save_segmentation(result: Segmentation, folder: str | Path, name: str | None = None) -> Path:
    """Write ``folder/name/``: plant.ply, phytomers/leaf_01.ply .., leaves.csv, segmentation.json and
    segmentation.png; all of them or none.

    A folder of that name from an earlier run is replaced.  The clouds are in the input's unit and frame, with labels.
    """
    return save_plants([result], folder, name)


def save_plants(results: Sequence[Segmentation], folder: str | Path, name: str | None = None) -> Path:
    """Write the plants of one cloud into ``folder/name/``: one as `save_segmentation` does; of several each into
    plant_1/ and on, with leaves.csv over all and plants.png, which shows which is which."""
    name = for_file_name(name or results[0].cloud.name)
    with whole_folder(Path(folder), name, "segmentation.json") as part:
        if len(results) == 1:
            _write_segmentation(part, results[0], name, 1)
            return Path(folder) / name
        for number, result in enumerate(results, start=1):
            (part / f"plant_{number}").mkdir()
            _write_segmentation(part / f"plant_{number}", result, name, number)
        tables = [leaf_table(name, result, plant=number) for number, result in enumerate(results, start=1)]
        write_table(part / "leaves.csv", pd.concat(tables))
        picture = plot_plants(results, title=name)
        picture.savefig(part / "plants.png", dpi=150, metadata={"Software": None})
        said = {"phytofit": version("phytofit"), "cloud": one_line(name), "plants": len(results)}
        said |= {"files": files_made(part)}
        (part / "segmentation.json").write_text(json_text(said), encoding="utf-8", newline="")
    return Path(folder) / name


def _write_segmentation(folder: Path, result: Segmentation, name: str, number: int) -> None:
    write_cloud(folder / "plant.ply", result.plant)
    (folder / "phytomers").mkdir()
    for leaf, phytomer in zip(result.leaves, result.phytomers(), strict=True):
        write_cloud(folder / "phytomers" / f"leaf_{leaf.rank:02d}.ply", phytomer)
    write_table(folder / "leaves.csv", leaf_table(name, result, plant=number))
    picture = plot_segmentation(result, title=name)
    picture.savefig(folder / "segmentation.png", dpi=150, metadata={"Software": None})
    said = _segmented(result) | {"files": files_made(folder)}
    (folder / "segmentation.json").write_text(json_text(said), encoding="utf-8", newline="")


def leaf_table(name: str, result: Segmentation, *, plant: int = 1) -> pd.DataFrame:
    """Tidy table of a plant's leaves, one row for each; lengths in cm, or relative where the cloud has no unit."""
    unit = "rel" if result.cloud.unit == "none" else "cm"
    rows = [
        {
            "cloud": name,
            "plant": plant,
            "rank": leaf.rank,
            "label": leaf.rank + 1,
            "azimuth_deg": leaf.azimuth,
            f"collar_distance_{unit}": leaf.collar_distance,
            f"collar_height_{unit}": leaf.collar_height,
            f"length_{unit}": leaf.length,
            "n_points": leaf.n_points,
            "flags": ";".join(leaf.flags),
        }
        for leaf in result.leaves
    ]
    return pd.DataFrame(rows)


def leaf_tables(folder: Path) -> FolderTable:
    """The table over all segmentations that lie in a folder."""
    return FolderTable(folder, "leaves.csv", "segmentation.json", LEAF_COLUMNS)


def read_segmentation(folder: str | Path) -> Segmentation:
    """What :func:`save_segmentation` wrote into ``folder``; InputError if it is not there, or damaged."""
    file = Path(folder) / "segmentation.json"
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
        leaves = tuple(_leaf_of(leaf) for leaf in said["leaves"])
        path, up = np.array(said["stem_path"]), np.array(said["up"])
        name, radius, unit, notes = said["cloud"], float(said["stem_radius"]), said["unit"], tuple(said["notes"])
        settings = dict(said["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: expected what phytofit segment writes ({type(error).__name__}: {error})") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they were shown when the cloud was read first
        cloud = read_cloud(file.with_name("plant.ply"), unit, plausible_cm=(0.0, np.inf))
    cloud = replace(cloud, name=name, notes=())
    assert cloud.labels is not None
    return Segmentation(cloud, cloud.labels, path, radius, up, leaves, notes, settings)


def _leaf_of(said: dict[str, Any]) -> SegmentedLeaf:
    arrays = {key: np.array(said[key]) for key in ("collar", "tip", "midrib")}
    others: dict[str, Any] = {**said, **arrays, "flags": tuple(said["flags"])}
    return SegmentedLeaf(**others)


def _segmented(result: Segmentation) -> dict[str, Any]:
    """What segmentation.json holds: all but the points, which are in plant.ply."""
    return {
        "phytofit": version("phytofit"),
        "cloud": one_line(result.cloud.name),
        "input": input_of(result.cloud),
        "unit": result.cloud.unit,
        "stem_path": result.stem_path.tolist(),
        "stem_radius": result.stem_radius,
        "up": result.up.tolist(),
        "leaves": [
            {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in asdict(leaf).items()}
            for leaf in result.leaves
        ],
        "notes": list(result.notes),
        "settings": result.settings,
    }
