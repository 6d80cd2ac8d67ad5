"""What simulated phytomers look like on disk: a cloud and its truth for each, and a table over all."""

import json
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from phytofit.cloud import PointCloud, write_cloud
from phytofit.io.files import json_text
from phytofit.io.phytomer import COLUMNS, trait_table
from phytofit.io.replacing import check_made, file_hash, whole_files
from phytofit.io.tables import check_table, write_table
from phytofit.simulation import SimulatedPhytomer
from phytofit.species import Species
from phytofit.traits import measure

__all__ = ["save_simulated"]

NAMES = "phytomer_[0-9]*"
TRUTH = "truth.csv"


def save_simulated(
    made: Iterable[SimulatedPhytomer], species: Species, folder: Path, *, with_labels: bool = True, table: bool = True
) -> list[Path]:
    """Write ``folder/phytomer_0001.ply``, cm, and ``.json``, its truth, for each phytomer and on, and with `table`
    ``truth.csv`` over all; the paths of the clouds.

    What an earlier run simulated into the folder is deleted, so that no cloud stands beside a table without it; until
    all is made nothing is.

    Raises OutputError if that can't be done, or if there is such a file that is not of an earlier run, or was changed.
    """
    earlier = _earlier(folder)
    clouds, tables = [], []
    with whole_files(folder, earlier if table else ()) as part:
        for i, phytomer in enumerate(made, start=1):
            name = f"phytomer_{i:04d}"
            labels = phytomer.labels if with_labels else None
            write_cloud(part / f"{name}.ply", PointCloud(phytomer.points, labels=labels, name=name))
            truth = {
                "parameters": dict(zip(species.space.names, phytomer.x.tolist(), strict=True)),
                "traits": {t.name: t.value for t in measure(phytomer.organs)},
                "pose": phytomer.pose.tolist(),
                "units": "cm, deg",
                "files": {f"{name}.ply": file_hash(part / f"{name}.ply")},
            }
            (part / f"{name}.json").write_text(json_text(truth), encoding="utf-8", newline="")
            clouds.append(folder / f"{name}.ply")
            tables.append(trait_table(name, measure(phytomer.organs, method="truth")))
        if table:
            write_table(part / TRUTH, pd.concat(tables))
    return clouds


def _earlier(folder: Path) -> list[Path]:
    """What an earlier run simulated into the folder; OutputError if it was changed since, or is of somebody else."""
    check_table(folder / TRUTH, COLUMNS)
    made: dict[str, str] = {}
    for file in sorted(folder.glob(f"{NAMES}.json")):
        made |= _made(file)
        check_made(file, lambda path: bool(_made(path)))
    for file in sorted(folder.glob(f"{NAMES}.ply")):
        check_made(file, lambda path: made.get(path.name) == file_hash(path))
    return [path for pattern in (TRUTH, f"{NAMES}.json", f"{NAMES}.ply") for path in sorted(folder.glob(pattern))]


def _made(truth: Path) -> dict[str, str]:
    """SHA-256 of the cloud of which a file holds the truth, by its name."""
    try:
        said: dict[str, str] = json.loads(truth.read_text(encoding="utf-8"))["files"]
        return dict(said)
    except (OSError, ValueError, KeyError, TypeError):
        return {}
