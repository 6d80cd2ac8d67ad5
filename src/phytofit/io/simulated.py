"""What simulated phytomers and plants look like on disk: a cloud and its truth for each, and a table over all."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from phytofit.cloud import PointCloud, write_cloud
from phytofit.io.files import json_text
from phytofit.io.phytomer import COLUMNS, trait_table
from phytofit.io.replacing import check_made, file_hash, whole_files
from phytofit.io.tables import check_table, write_table
from phytofit.models import Organ, mesh
from phytofit.simulation import SimulatedPhytomer, SimulatedPlant
from phytofit.species import Species
from phytofit.traits import Trait, measure

__all__ = ["save_simulated", "save_simulated_plants"]

PHYTOMER, PLANT = "phytomer", "plant"
TRUTH = "truth.csv"
ENDS = (".json", ".ply")


class _Made(NamedTuple):
    """What is written of one: its cloud, its true traits, what else is true of it, and the organs of its mesh."""

    cloud: PointCloud
    traits: list[Trait]
    truth: dict[str, Any]
    organs: tuple[Organ, ...] = ()


def save_simulated(
    made: Iterable[SimulatedPhytomer], species: Species, folder: Path, *, with_labels: bool = True, table: bool = True
) -> list[Path]:
    """Write ``folder/phytomer_0001.ply``, cm, and ``.json``, its truth, for each phytomer and on, and with `table`
    ``truth.csv`` over all; the paths of the clouds.

    What an earlier run simulated into the folder is deleted, so that no cloud stands beside a table without it; until
    all is made nothing is.

    Raises OutputError if that can't be done, or if there is such a file that is not of an earlier run, or was changed.
    """

    def each() -> Iterator[_Made]:
        for phytomer in made:
            labels = phytomer.labels if with_labels else None
            truth = {
                "parameters": dict(zip(species.space.names, phytomer.x.tolist(), strict=True)),
                "traits": {t.name: t.value for t in measure(phytomer.organs)},
                "pose": phytomer.pose.tolist(),
                "units": "cm, deg",
            }
            yield _Made(PointCloud(phytomer.points, labels=labels), measure(phytomer.organs, method="truth"), truth)

    return _save(each(), PHYTOMER, folder, table=table)


def save_simulated_plants(made: Iterable[SimulatedPlant], folder: Path) -> list[Path]:
    """The same of whole plants: ``plant_0001.ply``, cm, with labels; ``plant_0001_mesh.ply``; ``plant_0001.json``, with
    the plant as its grammar writes it; and ``truth.csv`` over all."""

    def each() -> Iterator[_Made]:
        for plant in made:
            symbols = [{"symbol": it.kind, "rank": it.rank, **it.values} for it in plant.plant.symbols]
            truth = {
                "n_leaves": plant.plant.n_leaves,
                "symbols": symbols,
                "pose": plant.pose.tolist(),
                "units": "cm, deg",
            }
            organs = tuple(it.organ for it in plant.organs)
            yield _Made(PointCloud(plant.points, labels=plant.labels), plant.traits, truth, organs)

    return _save(each(), PLANT, folder)


def _save(made: Iterable[_Made], kind: str, folder: Path, *, table: bool = True) -> list[Path]:
    earlier = _earlier(folder)
    clouds, tables = [], []
    with whole_files(folder, earlier if table else ()) as part:
        for i, one in enumerate(made, start=1):
            name = f"{kind}_{i:04d}"
            write_cloud(part / f"{name}.ply", one.cloud)
            files = [part / f"{name}.ply"]
            if one.organs:
                files.append(part / f"{name}_mesh.ply")
                mesh(one.organs).export(files[-1])
            truth = {**one.truth, "files": {file.name: file_hash(file) for file in files}}
            (part / f"{name}.json").write_text(json_text(truth), encoding="utf-8", newline="")
            clouds.append(folder / f"{name}.ply")
            tables.append(trait_table(name, one.traits))
        if table:
            write_table(part / TRUTH, pd.concat(tables))
    return clouds


def _earlier(folder: Path) -> list[Path]:
    """What an earlier run simulated into the folder; OutputError if it was changed since, or is of somebody else."""
    check_table(folder / TRUTH, COLUMNS)
    made: dict[str, str] = {}
    found = {end: [p for k in (PHYTOMER, PLANT) for p in sorted(folder.glob(f"{k}_[0-9]*{end}"))] for end in ENDS}
    for file in found[".json"]:
        made |= _made(file)
        check_made(file, lambda path: bool(_made(path)))
    for file in found[".ply"]:
        check_made(file, lambda path: made.get(path.name) == file_hash(path))
    return [*folder.glob(TRUTH), *found[".json"], *found[".ply"]]


def _made(truth: Path) -> dict[str, str]:
    """SHA-256 of the cloud of which a file holds the truth, by its name."""
    try:
        said: dict[str, str] = json.loads(truth.read_text(encoding="utf-8"))["files"]
        return dict(said)
    except (OSError, ValueError, KeyError, TypeError):
        return {}
