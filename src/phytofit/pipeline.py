"""From the images or the cloud of a plant to the traits of all its leaves: reconstruct, segment, fit, stage by stage."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phytofit.cloud import PointCloud
from phytofit.errors import InputError, NoPhytomerError, PhytofitError
from phytofit.fitting import fit
from phytofit.formats import read_cloud
from phytofit.plots import plot_plant
from phytofit.reconstruct import reconstruct
from phytofit.results import (
    prepare_folder,
    read_segmentation,
    save_fit,
    save_reconstruction,
    save_segmentation,
    table_text,
    trait_table,
    write_text,
)
from phytofit.segmentation import Segmentation, segment
from phytofit.species import Species, load_species
from phytofit.traits import Trait

__all__ = ["PlantRun", "plant_traits", "run"]

PLANT_CM = (3.0, 500.0)  # sizes that are believed of a whole plant, from the seedling on
KEY = "stage.json"
OF_SEGMENTATION = "from the segmentation"
OF_THE_CUT = ("stem_length",)  # of a phytomer: where it was cut decides them
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PlantRun:
    """What became of a plant: ``table`` of its traits (the columns of ``traits.csv``), its ``segmentation``, what was
    ``remarked`` in plain words, and which stages were ``skipped``, being up to date."""

    table: pd.DataFrame
    segmentation: Segmentation
    remarked: tuple[str, ...]
    skipped: tuple[str, ...]


def run(
    source: str | Path,
    folder: str | Path,
    *,
    camera: str | None = None,
    units: str | None = None,
    up: str | None = None,
    step_deg: float | None = None,
    unit: str | None = None,
    poses: str | Path | None = None,
    pattern: str = "*",
    labels: str | None = None,
    species: Species | str = "sorghum",
    seed: int = 0,
    threads: int | None = None,
    told: Told = lambda stage, done, total: None,
) -> PlantRun:
    """Measure all leaves of a plant.

    Writes ``reconstruction/`` (of images), ``segmentation/``, ``leaves/leaf_01/`` and on, ``traits.csv`` over all, and
    ``plant.png``.  A stage whose input, settings and version are those of its last run is not done again.

    Parameters
    ----------
    source : a folder of depth images, with `camera`, `step_deg`, `unit`, `poses` and `pattern` as for
        :func:`phytofit.reconstruct`; or a plant's cloud in `units`, with `up` where it is known
    labels : name of a property of the cloud that tells stem (1) and leaves (2..) instead of finding them
    species, seed, threads : as for :func:`phytofit.fit`
    told : called with a stage, and how much of how much of it is done

    Raises InputError and NoStemError where nothing can be measured.  A leaf whose fit is refused keeps what its
    segmentation tells.
    """
    source, folder = Path(source), prepare_folder(Path(folder))
    species = species if isinstance(species, Species) else load_species(species)
    skipped: list[str] = []
    remarked: list[str] = []
    cloud_file, upward = source, up
    if source.is_dir():
        if camera is None:
            raise InputError(f"{source}: a folder of depth images needs --camera: a preset, or a TOML file")
        told("reconstruct", 0, 1)
        images = sorted(path for path in source.glob(pattern) if path.is_file())
        used = [*images, *(Path(given) for given in (camera, poses) if given is not None and Path(given).is_file())]
        how = {"camera": camera, "step_deg": step_deg, "unit": unit, "pattern": pattern}
        key = _key("reconstruct", used, how | {"poses": poses is not None})
        target = folder / "reconstruction"
        if _up_to_date(target, key):
            skipped.append("reconstruct")
        else:
            made = reconstruct(source, camera, step_deg=step_deg, unit=unit, poses=poses, pattern=pattern)
            save_reconstruction(made, target)
            _done(target, key)
        remarked += _flags_in(target / "reconstruction.json")
        cloud_file, units, upward = target / "plant.ply", "cm", up or "z"
    elif camera is not None:
        raise InputError(f"{source}: --camera is for a folder of depth images, and this is none")

    told("segment", 0, 1)
    cloud = read_cloud(cloud_file, units, label_property=labels or "label", plausible_cm=PLANT_CM)
    cloud = replace(cloud, name=source.stem)
    target = folder / "segmentation"
    key = _key("segment", [cloud_file], {"units": units, "up": upward, "labels": labels})
    if _up_to_date(target, key):
        found = read_segmentation(target)
        skipped.append("segment")
    else:
        found = segment(cloud, up=upward, labelled=labels is not None)
        save_segmentation(found, folder, "segmentation")
        _done(target, key)
    remarked += [f"leaf {leaf.rank}: {flag}" for leaf in found.leaves for flag in leaf.flags]

    tables = [trait_table(source.stem, plant_traits(found))]
    settings = {"species": species.name, "seed": seed, "up": found.up.tolist()}
    segmented = [target / "plant.ply", target / "segmentation.json"]
    phytomers = found.phytomers()
    for i, (leaf, phytomer) in enumerate(zip(found.leaves, phytomers, strict=True)):
        told("fit", i, len(phytomers))
        name = f"leaf_{leaf.rank:02d}"
        key = _key(name, segmented, settings)
        where = prepare_folder(folder / "leaves") / name
        if _up_to_date(where, key):
            skipped.append(name)
        else:
            try:
                result = fit(phytomer, species=species, up=found.up, seed=seed, threads=threads)
            except PhytofitError as error:
                if not isinstance(error, NoPhytomerError | InputError):
                    raise
                remarked.append(f"leaf {leaf.rank}: not fitted: {error}")
                tables.append(trait_table(source.stem, [_by_its_points(found, leaf.rank, str(error))]))
                continue
            save_fit(result, phytomer, folder / "leaves", name)
            _done(where, key)
        table = pd.read_csv(where / "traits.csv")
        tables.append(_of_leaf(table, source.stem, leaf.rank))
        flags = table["flags"].dropna()
        remarked += [f"leaf {leaf.rank}: {flag}" for flag in dict.fromkeys("; ".join(flags).split("; ")) if flag]
    told("fit", len(phytomers), len(phytomers))
    whole = pd.concat([table for table in tables if not table.empty], ignore_index=True)
    write_text(folder / "traits.csv", table_text(whole))
    picture = plot_plant(found, whole, title=source.stem)
    picture.savefig(folder / "plant.png", dpi=150, metadata={"Software": None})
    return PlantRun(whole, found, tuple(remarked), tuple(skipped))


def plant_traits(found: Segmentation) -> list[Trait]:
    """What a segmentation tells of the plant: its height, number of leaves and phyllotaxy; and of each leaf: the height of its
    collar above the stem's base, the distance along the stem from the collar below, its azimuth, and the angle by
    which it diverges from the leaf below (0 to 180)."""
    unit = "rel" if found.cloud.unit == "none" else "cm"
    organs = found.cloud.points[found.labels > 0]
    height = float(((organs - found.stem_path[0]) @ found.up).max())
    between = [_apart(b.azimuth, a.azimuth) for a, b in zip(found.leaves, found.leaves[1:], strict=False)]

    def trait(organ: str, rank: int, name: str, value: float, in_unit: str, flags: tuple[str, ...] = ()) -> Trait:
        return Trait(organ, rank, name, value, in_unit, None, None, OF_SEGMENTATION, flags)

    traits = [
        trait("plant", 0, "plant_height", height, unit),
        trait("plant", 0, "leaf_count", float(len(found.leaves)), "1"),
    ]
    if between:
        traits.append(trait("plant", 0, "divergence_angle", float(np.median(between)), "deg"))
    below = None
    for i, leaf in enumerate(found.leaves):
        rank, flags = leaf.rank, leaf.flags
        traits.append(trait("leaf", rank, "collar_height", leaf.collar_height, unit, flags))
        if below is not None:
            apart = leaf.collar_distance - below.collar_distance
            traits.append(trait("leaf", rank, "collar_distance", apart, unit, flags))
        traits.append(trait("leaf", rank, "leaf_azimuth", leaf.azimuth, "deg", flags))
        if below is not None:
            traits.append(trait("leaf", rank, "divergence_angle", between[i - 1], "deg", flags))
        below = leaf
    return traits


def _apart(a: float, b: float) -> float:
    """Angle between two azimuths, 0 to 180 degrees."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def _by_its_points(found: Segmentation, rank: int, reason: str) -> Trait:
    """The length of a leaf that could not be fitted, along its points."""
    leaf = found.leaves[rank - 1]
    unit = "rel" if found.cloud.unit == "none" else "cm"
    flags = (*leaf.flags, f"not fitted: {reason}")
    return Trait("leaf", rank, "leaf_length", leaf.length, unit, None, None, OF_SEGMENTATION, flags)


def _of_leaf(table: pd.DataFrame, name: str, rank: int) -> pd.DataFrame:
    """The traits of a phytomer as those of the plant's leaf of that rank, and of the internode that bears it."""
    kept = table[~table["trait"].isin(OF_THE_CUT)]
    return kept.assign(cloud=name, rank=rank, organ=kept["organ"].replace("stem", "internode"))


def _key(stage: str, files: list[Path], settings: dict[str, Any]) -> str:
    """What a stage's result follows from: version, input files by their content, settings."""
    try:
        inputs = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    except OSError as error:
        raise InputError(f"{error.filename}: can't be read ({error.strerror})") from None
    made = {"phytofit": version("phytofit"), "stage": stage, "inputs": inputs, "settings": settings}
    return json.dumps(made, indent=1) + "\n"


def _up_to_date(folder: Path, key: str) -> bool:
    try:
        return (folder / KEY).read_text(encoding="utf-8") == key
    except OSError:
        return False


def _done(folder: Path, key: str) -> None:
    """Said last: a stage that was stopped before is done again."""
    write_text(folder / KEY, key)


def _flags_in(file: Path) -> list[str]:
    said = json.loads(file.read_text(encoding="utf-8"))
    return [*said["flags"], *(f"view {view['file']} left out: {view['reason']}" for view in said["rejected"])]
