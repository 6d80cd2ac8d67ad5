"""What simulated phytomers look like on disk: a cloud and its truth for each, and a table over all."""

import json
from pathlib import Path

from phytofit.cloud import PointCloud, write_cloud
from phytofit.results.files import files_made, json_text
from phytofit.results.phytomer import COLUMNS
from phytofit.results.replacing import check_made, file_hash, whole_files
from phytofit.results.tables import check_table
from phytofit.simulation import SimulatedPhytomer
from phytofit.species import Species
from phytofit.traits import measure

__all__ = ["clear_simulated", "save_simulated"]

NAMES = "phytomer_[0-9]*"
TRUTH = "truth.csv"


def save_simulated(
    made: SimulatedPhytomer, species: Species, folder: Path, name: str, *, with_labels: bool = True
) -> Path:
    """Write ``folder/name.ply``, cm, and ``folder/name.json``, its truth: both or none; the path of the cloud."""
    cloud = PointCloud(made.points, labels=made.labels if with_labels else None, name=name)
    with whole_files(folder) as part:
        write_cloud(part / f"{name}.ply", cloud)
        truth = {
            "parameters": dict(zip(species.space.names, made.x.tolist(), strict=True)),
            "traits": {t.name: t.value for t in measure(made.organs)},
            "pose": made.pose.tolist(),
            "units": "cm, deg",
            "files": files_made(part),
        }
        (part / f"{name}.json").write_text(json_text(truth), encoding="utf-8", newline="")
    return folder / f"{name}.ply"


def clear_simulated(folder: Path) -> None:
    """Delete the clouds that an earlier run simulated into the folder, and their truth, so that none stands beside a
    new table.  OutputError, before anything is deleted, if one was changed since, or is no such cloud."""
    check_table(folder / TRUTH, COLUMNS)
    truths = sorted(folder.glob(f"{NAMES}.json"))
    clouds = sorted(folder.glob(f"{NAMES}.ply"))
    made: dict[str, str] = {}
    for file in truths:
        made |= _made(file)
        check_made(file, lambda path: bool(_made(path)))
    for file in clouds:
        check_made(file, lambda path: made.get(path.name) == file_hash(path))
    for file in (folder / TRUTH, *clouds, *truths):  # a cloud before what says whose it is
        file.unlink(missing_ok=True)


def _made(truth: Path) -> dict[str, str]:
    """SHA-256 of the cloud of which a file holds the truth, by its name."""
    try:
        said: dict[str, str] = json.loads(truth.read_text(encoding="utf-8"))["files"]
        return dict(said)
    except (OSError, ValueError, KeyError, TypeError):
        return {}
