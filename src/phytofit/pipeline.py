"""From the images or the cloud of a plant to the traits of all its leaves: reconstruct, segment, fit."""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from phytofit.cloud import PointCloud, read_cloud
from phytofit.display import Shown, Summary
from phytofit.errors import CloudError, InputError, NoPhytomerError, OutputError, PhytofitError
from phytofit.fitting import fit
from phytofit.plots import plot_plant
from phytofit.reconstruct import depth_files, reconstruct
from phytofit.results import (
    COLUMNS,
    LOG,
    OURS,
    check_made,
    check_reconstruction,
    check_table,
    delete_made,
    file_hash,
    is_our_picture,
    prepare_folder,
    read_segmentation,
    read_table,
    save_fit,
    save_reconstruction,
    save_segmentation,
    trait_table,
    whole_file,
    whole_folder,
    write_table,
    write_text,
)
from phytofit.segmentation import PLANT_CM, Segmentation, SegmentedLeaf, segment
from phytofit.species import Species, load_species
from phytofit.text import one_line
from phytofit.traits import Trait

__all__ = ["PlantRun", "plant_traits", "run"]

KEY = "stage.json"
MOST_OUTLIERS = 0.5  # share of a phytomer's points, beyond which what was fitted is not the leaf
OF_SEGMENTATION = "from the segmentation"
OF_THE_CUT = ("stem_length",)  # of a phytomer: where it was cut decides them
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, repr=False)
class PlantRun(Shown):
    """What became of a plant: ``table`` of its traits (the columns of ``traits.csv``), its ``segmentation``, ``flags``
    in plain words, ``notes`` on what was done to the cloud, and which stages were ``skipped``, being up to date."""

    table: pd.DataFrame
    segmentation: Segmentation
    flags: tuple[str, ...]
    notes: tuple[str, ...]
    skipped: tuple[str, ...]

    def summary(self) -> Summary:
        """The traits of the plant and of its leaves, and the flags."""
        columns = ["organ", "rank", "trait", "value", "unit"]
        cells = self.table[columns].to_numpy().tolist()
        rows = [[organ, str(rank or ""), trait, f"{value:.2f}", unit] for organ, rank, trait, value, unit in cells]
        title = f"Plant {self.segmentation.cloud.name}: {len(self.segmentation.leaves)} leaves"
        return Summary(
            title, ("organ", "leaf", "trait", "value", "unit"), rows, [f"flag: {flag}" for flag in self.flags]
        )

    def to_frame(self) -> pd.DataFrame:
        """All traits as a table, with the columns of ``traits.csv``."""
        return self.table.copy()

    def plot(self) -> Figure:
        """The plant with its leaves coloured and numbered, beside their traits: ``plant.png``."""
        return plot_plant(self.segmentation, self.table, title=self.segmentation.cloud.name)


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
    progress: Progress = lambda stage, done, total: None,
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
    progress : called with a stage, and how much of how much of it is done

    Raises InputError and NoStemError where nothing can be measured.  A leaf whose fit is refused keeps what its
    segmentation tells.
    """
    source, folder = Path(source), Path(folder)
    if source.is_dir() and source.resolve() == folder.resolve():
        raise InputError(f"{folder}: the folder of the images can't hold the results; choose another folder")
    name = source.resolve().stem if source.is_file() else source.resolve().name
    _prepare(folder)
    species = species if isinstance(species, Species) else load_species(species)
    log = _Log([], [], [], progress)
    cloud_file = source
    if source.is_dir():
        if camera is None:
            raise InputError(f"{source}: a folder of depth images needs its camera: a preset, or a TOML file")
        how = {"camera": camera, "step_deg": step_deg, "unit": unit, "poses": poses, "pattern": pattern}
        cloud_file, units, up = _reconstructed(source, folder, how, log), "cm", up or "z"
    elif camera is not None:
        raise InputError(f"{source}: a camera is for a folder of depth images, and this is none")
    found = _segmented(cloud_file, folder, {"name": name, "units": units, "up": up, "labels": labels}, log)
    tables = [trait_table(name, plant_traits(found))]
    for i, (leaf, phytomer) in enumerate(zip(found.leaves, found.phytomers(), strict=True)):
        progress("fit", i, len(found.leaves))
        tables.append(_fitted(found, leaf, phytomer, folder, species, {"seed": seed, "threads": threads}, log))
    progress("fit", len(found.leaves), len(found.leaves))
    whole = pd.concat(tables, ignore_index=True)
    write_table(folder / "traits.csv", whole)
    for old in sorted((folder / "leaves").glob("leaf_*"))[len(found.leaves) :]:
        delete_made(old)  # of an earlier run that saw more leaves
    picture = plot_plant(found, whole, title=name)
    with whole_file(folder / "plant.png") as part:
        picture.savefig(part, dpi=150, format="png", metadata=OURS)
    return PlantRun(whole, found, tuple(log.flags), tuple(log.notes), tuple(log.skipped))


def _prepare(folder: Path) -> None:
    """Repair what an earlier run left in the folder of a plant; OutputError if it can't hold one."""
    prepare_folder(folder)
    for place in (folder / "reconstruction", folder / "segmentation", folder / "leaves"):
        if place.is_dir():
            prepare_folder(place)
    for leaf in (folder / "leaves").glob("leaf_*"):
        prepare_folder(leaf)
    check_table(folder / "traits.csv", COLUMNS)
    check_made(folder / "plant.png", is_our_picture)
    if any(folder.glob("*/fit.json")):
        raise OutputError(f"{folder}: it holds results of single leaves; choose another folder for a whole plant")


@dataclass(frozen=True)
class _Log:
    """What happens on the way."""

    flags: list[str]
    notes: list[str]
    skipped: list[str]
    progress: Progress


def _reconstructed(source: Path, folder: Path, how: Mapping[str, Any], log: _Log) -> Path:
    """The file of the cloud that the images give."""
    log.progress("reconstruct", 0, 1)
    images = depth_files(source, how["pattern"])
    given = [Path(file) for file in (how["camera"], how["poses"]) if file is not None and Path(file).is_file()]
    settings = {name: None if value is None else str(value) for name, value in how.items()}
    key = _key("reconstruct", [*images, *given], settings)
    target = folder / "reconstruction"
    if _up_to_date(target, key):
        log.skipped.append("reconstruct")
    else:
        check_reconstruction(target)
        save_reconstruction(reconstruct(source, **how), target)
        _done(target, key, ("plant.ply", "reconstruction.json"))
    said = json.loads((target / "reconstruction.json").read_text(encoding="utf-8"))
    log.flags.extend([*said["flags"], *(f"{v['file']} left out: {v['reason']}" for v in said["rejected"])])
    return target / "plant.ply"


def _segmented(cloud_file: Path, folder: Path, how: Mapping[str, Any], log: _Log) -> Segmentation:
    log.progress("segment", 0, 1)
    target = folder / "segmentation"
    labels = how["labels"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they stand in the cloud's notes
        cloud = read_cloud(cloud_file, how["units"], label_property=labels, plausible_cm=PLANT_CM)
    key = _key("segment", [cloud_file], how)
    if _same_but_edited(target, key, "plant.ply"):
        raise InputError(
            f"{target / 'plant.ply'}: it was changed since it was written; to use its labels, measure that file and "
            f"name the property that holds them, label, and choose another folder; or delete {target} to begin anew"
        )
    if _up_to_date(target, key):
        found = read_segmentation(target)
        log.skipped.append("segment")
    else:
        found = segment(replace(cloud, name=how["name"]), up=how["up"], labelled=labels is not None)
        save_segmentation(found, folder, "segmentation")
        _done(target, key, ("plant.ply", "segmentation.json"))
    log.notes.extend([*cloud.notes, *found.notes])
    log.flags.extend(f"leaf {leaf.rank}: {flag}" for leaf in found.leaves for flag in leaf.flags)
    return found


def _fitted(
    found: Segmentation,
    leaf: SegmentedLeaf,
    phytomer: PointCloud,
    folder: Path,
    species: Species,
    how: Mapping[str, Any],
    log: _Log,
) -> pd.DataFrame:
    """The traits of one leaf, by its fit; where that is refused, its length along its points."""
    name = f"leaf_{leaf.rank:02d}"
    target = folder / "leaves" / name
    segmented = [folder / "segmentation" / file for file in ("plant.ply", "segmentation.json")]
    key = _key(name, segmented, {"species": repr(species), "seed": how["seed"]})
    if _up_to_date(target, key):
        log.skipped.append(name)
    else:
        try:
            fitted = fit(phytomer, species=species, up=found.up, **how)
            assert fitted.estimate is not None
            outliers = float(fitted.estimate.share[2])
            if outliers > MOST_OUTLIERS:
                raise NoPhytomerError(f"the model does not explain {100 * outliers:.0f} % of the points")
            save_fit(fitted, phytomer, folder / "leaves", name)
            _done(target, key, ("traits.csv",))
        except (NoPhytomerError, CloudError) as error:
            _save_by_points(found, leaf, str(error), target, key)
        except PhytofitError:
            raise
        except Exception as error:  # whatever it is, the other leaves go on
            LOG.exception("%s: a fault of phytofit", name)
            reason = f"a fault of phytofit, {type(error).__name__}: {one_line(error)}"
            _save_by_points(found, leaf, reason, target, _key(name, [], {"fault": reason}))  # to be tried again
    table = read_table(target / "traits.csv")
    flags = "; ".join(table["flags"].dropna()).split("; ")
    log.flags.extend(f"leaf {leaf.rank}: {flag}" for flag in dict.fromkeys(flags) if flag)
    return _of_leaf(table, found.cloud.name, leaf.rank)


def _save_by_points(found: Segmentation, leaf: SegmentedLeaf, reason: str, target: Path, key: str) -> None:
    """In place of a fit, the length of a leaf along its points."""
    with whole_folder(target.parent, target.name, KEY, "fit.json") as part:
        write_table(part / "traits.csv", trait_table(found.cloud.name, [_by_its_points(found, leaf, reason)]))
        _done(part, key, ("traits.csv",))


def plant_traits(found: Segmentation) -> list[Trait]:
    """What a segmentation tells of the plant: its height above the stem's base, how many leaves it has, and the median
    angle by which one diverges from the one below (phyllotaxy); and of each leaf: the height of its collar above the
    stem's base, the distance along the stem from the collar below, its azimuth, and that angle, 0 to 180 degrees."""
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


def _by_its_points(found: Segmentation, leaf: SegmentedLeaf, reason: str) -> Trait:
    """The length of a leaf that could not be fitted, along its points."""
    unit = "rel" if found.cloud.unit == "none" else "cm"
    flags = (f"not fitted: {reason}",)
    return Trait("leaf", leaf.rank, "leaf_length", leaf.length, unit, None, None, OF_SEGMENTATION, flags)


def _of_leaf(table: pd.DataFrame, name: str, rank: int) -> pd.DataFrame:
    """The traits of a phytomer as those of the plant's leaf of that rank, and of the internode that bears it."""
    kept = table[~table["trait"].isin(OF_THE_CUT)]
    return kept.assign(cloud=name, rank=rank, organ=kept["organ"].replace("stem", "internode"))


def _key(stage: str, files: Sequence[Path], settings: Mapping[str, Any]) -> str:
    """What a stage's result follows from: version, input files by their content, settings."""
    inputs = {path.name: file_hash(path) for path in files}
    return json.dumps({"phytofit": version("phytofit"), "stage": stage, "inputs": inputs, "settings": dict(settings)})


def _up_to_date(folder: Path, key: str) -> bool:
    """Whether the folder holds what a stage with this key made, unchanged."""
    made = _made(folder, key)
    return made is not None and all(file_hash(folder / name) == was for name, was in made.items())


def _same_but_edited(folder: Path, key: str, name: str) -> bool:
    """Whether of what a stage with this key made this file was changed, not deleted."""
    made = _made(folder, key)
    return made is not None and file_hash(folder / name) not in (None, made[name])


def _made(folder: Path, key: str) -> dict[str, str] | None:
    """Names and hashes of what the folder's stage made, if it had this key."""
    try:
        said = json.loads((folder / KEY).read_text(encoding="utf-8"))
        made: dict[str, str] = said.pop("made")
    except (OSError, ValueError, KeyError):
        return None
    return made if json.dumps(said) == json.dumps(json.loads(key)) else None


def _done(folder: Path, key: str, made: Sequence[str]) -> None:
    """Said last, so that a stage that was stopped before is done again."""
    said = json.loads(key) | {"made": {name: file_hash(folder / name) for name in made}}
    write_text(folder / KEY, json.dumps(said, indent=1) + "\n")
