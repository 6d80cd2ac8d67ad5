"""From the images or the cloud of a plant, or of several, to the traits of all leaves: reconstruct, segment, fit."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from phytofit.cloud import PointCloud, read_cloud
from phytofit.display import Shown, Summary
from phytofit.errors import CloudError, InputError, NoPhytomerError, NoStemError, OutputError, PhytofitError
from phytofit.fitting import fit
from phytofit.io import (
    COLUMNS,
    LOG,
    OURS,
    check_made,
    check_meshes,
    check_reconstruction,
    check_table,
    delete_made,
    is_our_picture,
    prepare_folder,
    read_remarks,
    read_segmentation,
    read_table,
    remarks_text,
    save_fit,
    save_reconstruction,
    save_segmentation,
    trait_table,
    whole_file,
    whole_folder,
    write_table,
    write_text,
)
from phytofit.pipeline.stages import KEY, done, is_edited, key_of, up_to_date
from phytofit.pipeline.traits import by_its_points, of_leaf, plant_traits
from phytofit.plots import plot_plant, plot_plants
from phytofit.recipe import recipe
from phytofit.reconstruct import depth_files, reconstruct
from phytofit.results import Fit, Placed, grouped, of_codes, remark
from phytofit.segmentation import PLANT_CM, Segmentation, SegmentedLeaf, numbering, segment, separate_plants
from phytofit.small_files import read_json
from phytofit.species import Species, load_species
from phytofit.text import one_line

__all__ = ["PlantRun", "run"]

MOST_OUTLIERS = 0.5  # share of a phytomer's points, beyond which what was fitted is not the leaf
MADE = ("plant.ply", "segmentation.json")  # of a segmentation: what says whether it is up to date
REMARKS = "remarks.json"  # of a leaf that could not be fitted
RECONSTRUCTION = "what phytofit reconstruct writes"
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, repr=False)
class PlantRun(Shown):
    """What became of a plant, or of several in one cloud: ``table`` of their traits (the columns of ``traits.csv``),
    their ``segmentations`` in the order of the table's column ``plant``, ``remarks`` on them, ``notes`` on what was
    done to the cloud, and which stages were ``skipped``, being up to date."""

    table: pd.DataFrame
    segmentations: tuple[Segmentation, ...]
    remarks: tuple[Placed, ...]
    notes: tuple[str, ...]
    skipped: tuple[str, ...]

    def summary(self) -> Summary:
        """The traits of each plant and of its leaves, and the remarks."""
        columns = ["plant", "organ", "rank", "trait", "value", "unit", "quality"]
        cells = self.table[columns].to_numpy().tolist()
        rows = [
            [str(n), organ, str(rank or ""), name, f"{v:.2f}", *others] for n, organ, rank, name, v, *others in cells
        ]
        n_leaves = " and ".join(str(len(found.leaves)) for found in self.segmentations)
        title = f"{self.segmentations[0].cloud.name}: {n_leaves} leaves"
        head = ("plant", "organ", "leaf", "trait", "value", "unit", "quality")
        return Summary(title, head, rows, [f"{grade}: {line}" for grade, line in grouped(self.remarks)])

    def to_frame(self) -> pd.DataFrame:
        """All traits as a table, with the columns of ``traits.csv``."""
        return self.table.copy()

    def plot(self) -> Figure:
        """Each plant with its leaves coloured and numbered, beside their traits: ``plant.png``."""
        return plot_plant(self.segmentations, self.table, title=self.segmentations[0].cloud.name)


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
    meshes: str | Sequence[str] = (),
    progress: Progress = lambda stage, done, total: None,
) -> PlantRun:
    """Measure all leaves of a plant, or of each of several plants in one cloud.

    Writes ``reconstruction/`` (of images), ``segmentation/``, ``leaves/leaf_01/`` and on, ``traits.csv`` over all, and
    ``plant.png``; of several plants, the two latter lie in ``plant_1/`` and on, and ``plants.png`` shows which is
    which.  A stage whose input, settings and code are those of its last run is not done again.

    Parameters
    ----------
    source : a folder of depth images, with `camera`, `step_deg`, `unit`, `poses` and `pattern` as for
        :func:`phytofit.reconstruct`; or a cloud in `units`, with `up` where it is known
    labels : name of a property of the cloud that tells stem (1) and leaves (2..) instead of finding them, of one plant
    species, seed, threads : as for :func:`phytofit.fit`
    meshes : formats in which the model of each leaf is written beside PLY: obj, glb
    progress : called with a stage, and how much of how much of it is done

    Raises InputError and NoStemError where nothing can be measured.  A leaf whose fit is refused keeps what its
    segmentation tells.
    """
    source, folder, meshes = Path(source), Path(folder), check_meshes(meshes)
    if source.is_dir() and source.resolve() == folder.resolve():
        raise InputError(f"{folder}: the folder of the images can't hold the results; choose another folder")
    name = source.resolve().stem if source.is_file() else source.resolve().name
    _prepare(folder)
    species = species if isinstance(species, Species) else load_species(species)
    log = _Log(progress)
    cloud_file = source
    if source.is_dir():
        if camera is None:
            raise InputError(f"{source}: a folder of depth images needs its camera: a preset, or a TOML file")
        images = {"camera": camera, "step_deg": step_deg, "unit": unit, "poses": poses, "pattern": pattern}
        cloud_file, units, up = _reconstructed(source, folder, images, log), "cm", up or "z"
    elif camera is not None:
        raise InputError(f"{source}: a camera is for a folder of depth images, and this is none")
    plants = _segmented(cloud_file, folder, {"name": name, "units": units, "up": up, "labels": labels}, log)
    how = {"seed": seed, "threads": threads}
    tables = _measured(plants, species, how, meshes, log)
    whole = pd.concat(tables, ignore_index=True)
    write_table(folder / "traits.csv", whole)
    _forget_others(folder, plants)
    found = [plant.found for plant in plants]
    pictures = {"plant.png": plot_plant(found, whole, title=name)}
    if len(found) > 1:
        pictures["plants.png"] = plot_plants(found, title=name)
    for file, picture in pictures.items():
        with whole_file(folder / file) as part:
            picture.savefig(part, dpi=150, format="png", metadata=OURS)
    return PlantRun(whole, tuple(found), tuple(log.remarks), tuple(dict.fromkeys(log.notes)), tuple(log.skipped))


@dataclass(frozen=True)
class _Log:
    """What happens on the way."""

    progress: Progress
    remarks: list[Placed] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Plant:
    """One of the plants of a cloud, numbered from 1; ``place`` is the folder of its stages, ``called`` what comes
    before notes on it: nothing where it is the only one."""

    number: int
    place: Path
    called: str
    found: Segmentation

    @property
    def in_remarks(self) -> int:
        """Its number where there are several, else 0."""
        return self.number if self.called else 0


def _prepare(folder: Path) -> None:
    """Repair what an earlier run left in the folder of a plant; OutputError if it can't hold one."""
    prepare_folder(folder)
    for place in (folder, *folder.glob("plant_*")):
        for stage in (place / "reconstruction", place / "segmentation", place / "leaves"):
            if stage.is_dir():
                prepare_folder(stage)
        for leaf in (place / "leaves").glob("leaf_*"):
            prepare_folder(leaf)
    check_table(folder / "traits.csv", COLUMNS)
    for picture in ("plant.png", "plants.png"):
        check_made(folder / picture, is_our_picture)
    if any(folder.glob("*/fit.json")):
        raise OutputError(f"{folder}: it holds results of single leaves; choose another folder for a whole plant")


def _reconstructed(source: Path, folder: Path, how: Mapping[str, Any], log: _Log) -> Path:
    """The file of the cloud that the images give."""
    log.progress("reconstruct", 0, 1)
    images = depth_files(source, how["pattern"])
    given = [Path(file) for file in (how["camera"], how["poses"]) if file is not None and Path(file).is_file()]
    settings = {name: None if value is None else str(value) for name, value in how.items()}
    key = key_of("reconstruct", [*images, *given], {**recipe()["reconstruct"], **settings})
    target = folder / "reconstruction"
    if up_to_date(target, key):
        log.skipped.append("reconstruct")
    else:
        check_reconstruction(target)
        save_reconstruction(reconstruct(source, **how), target)
        done(target, key, ("plant.ply", "reconstruction.json"))
    said = read_json(target / "reconstruction.json", RECONSTRUCTION)
    log.notes.extend(said["notes"])
    of_views = [*said["flags"], *(f"{v['file']} left out: {v['reason']}" for v in said["rejected"])]
    log.remarks.extend(Placed(remark("views", said=text)) for text in of_views)
    return target / "plant.ply"


def _segmented(cloud_file: Path, folder: Path, how: Mapping[str, Any], log: _Log) -> list[_Plant]:
    """The plants of a cloud, taken apart; NoStemError if none can be."""
    log.progress("segment", 0, 1)
    labels = how["labels"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they stand in the cloud's notes
        cloud = read_cloud(cloud_file, how["units"], label_property=labels, plausible_cm=PLANT_CM)
    cloud = replace(cloud, name=how["name"])
    before = sorted(folder.glob("plant_*"))
    for place in (folder, *before):
        file = place / "segmentation" / "plant.ply"
        if is_edited(file.parent, file.name):
            raise InputError(
                f"{file}: it was changed since it was written; to use its labels, measure that file and name the "
                f"property that holds them, label, and choose another folder; or delete {file.parent} to begin anew"
            )
    log.notes.extend(cloud.notes)
    settings = {**recipe()["segment"], **how}
    for n in {1, len(before)}:
        places = _places(folder, n)
        keys = [key_of("segment", [cloud_file], {**settings, "plant": i, "of": n}) for i in range(1, n + 1)]
        if n and all(up_to_date(at / "segmentation", key) for at, key in zip(places, keys, strict=True)):
            log.skipped.append("segment")
            return _plants([read_segmentation(at / "segmentation") for at in places], folder, log)
    found = _taken_apart(cloud, how["up"], labelled=labels is not None)
    for number, (one, place) in enumerate(zip(found, _places(folder, len(found)), strict=True), start=1):
        save_segmentation(one, prepare_folder(place), "segmentation")
        key = key_of("segment", [cloud_file], {**settings, "plant": number, "of": len(found)})
        done(place / "segmentation", key, MADE)
    return _plants(found, folder, log)


def _taken_apart(cloud: PointCloud, up: str | None, *, labelled: bool) -> list[Segmentation]:
    """Each plant of a cloud that can be taken apart; NoStemError if none can be."""
    clouds = (cloud,) if labelled else separate_plants(cloud, up=up)
    found, failed = [], []
    for plant in clouds:
        try:
            found.append(segment(plant, up=up, labelled=labelled))
        except NoStemError as error:
            failed.append(error)
    if not found:
        raise failed[0]
    if failed:
        note = f"{len(clouds)} plants were found, and {len(failed)} of them not measured: {failed[0]}"
        found[0] = replace(found[0], notes=(*found[0].notes, note))
    return found


def _places(folder: Path, n: int) -> list[Path]:
    """The folders of the stages of `n` plants."""
    return [folder] if n == 1 else [folder / f"plant_{i}" for i in range(1, n + 1)]


def _plants(found: Sequence[Segmentation], folder: Path, log: _Log) -> list[_Plant]:
    """The plants, numbered; what is remarkable about them goes into the log."""
    places = _places(folder, len(found))
    plants = [
        _Plant(number, place, f"plant {number}: " if len(found) > 1 else "", one)
        for number, (place, one) in enumerate(zip(places, found, strict=True), start=1)
    ]
    if len(found) > 1:
        log.notes.append(numbering(np.array([one.stem_path[0] for one in found])))
    for plant in plants:
        log.notes.extend(f"{plant.called}{note}" for note in plant.found.notes)
        for leaf in plant.found.leaves:
            log.remarks.extend(Placed(one, plant.in_remarks, leaf.rank) for one in of_codes(leaf.flags))
    return plants


def _forget_others(folder: Path, plants: list[_Plant]) -> None:
    """Delete what phytofit made of plants and leaves that an earlier run saw, and this one does not."""
    own = {plant.place for plant in plants}
    for place in (folder, *sorted(folder.glob("plant_*"))):
        n_leaves = next((len(plant.found.leaves) for plant in plants if plant.place == place), 0)
        for leaf in sorted((place / "leaves").glob("leaf_*"))[n_leaves:]:
            delete_made(leaf)
        if place not in own:
            for old in (place / "segmentation", place / "leaves", *([] if place == folder else [place])):
                if old.is_dir():
                    delete_made(old)


def _measured(
    plants: list[_Plant], species: Species, how: Mapping[str, Any], meshes: Sequence[str], log: _Log
) -> list[pd.DataFrame]:
    """The traits of all plants, their leaves fitted one after the other."""
    tables, n_leaves, n_done = [], sum(len(plant.found.leaves) for plant in plants), 0
    for plant in plants:
        name = plant.found.cloud.name
        tables.append(trait_table(name, plant_traits(plant.found), plant=plant.number))
        for leaf, phytomer in zip(plant.found.leaves, plant.found.phytomers(), strict=True):
            log.progress("fit", n_done, n_leaves)
            table = _fitted(plant, leaf, phytomer, species, how, meshes, log)
            tables.append(of_leaf(table, name, plant.number, leaf))
            n_done += 1
    log.progress("fit", n_leaves, n_leaves)
    return tables


def _fitted(
    plant: _Plant,
    leaf: SegmentedLeaf,
    phytomer: PointCloud,
    species: Species,
    how: Mapping[str, Any],
    meshes: Sequence[str],
    log: _Log,
) -> pd.DataFrame:
    """The traits of one leaf, by its fit; where that is refused, its length along its points."""
    name = f"leaf_{leaf.rank:02d}"
    target = plant.place / "leaves" / name
    segmented = [plant.place / "segmentation" / file for file in MADE]
    acting = {step: settings for step, settings in recipe().items() if step not in ("reconstruct", "segment")}
    key = key_of(name, segmented, {**acting, "species": _content(species), "seed": how["seed"], "meshes": meshes})
    if up_to_date(target, key):
        log.skipped.append(f"{plant.called}{name}")
    else:
        try:
            fitted = fit(phytomer, species=species, up=plant.found.up, **how)
            assert isinstance(fitted, Fit)
            outliers = float(fitted.estimate.share[2])
            if outliers > MOST_OUTLIERS:
                raise NoPhytomerError(f"the model does not explain {100 * outliers:.0f} % of the points")
            save_fit(fitted, phytomer, target.parent, name, meshes=meshes)
            done(target, key, ("traits.csv", "fit.json"))
        except (NoPhytomerError, CloudError) as error:
            _save_by_points(plant, leaf, str(error), target, key)
        except PhytofitError:
            raise
        except Exception as error:  # whatever it is, the other leaves go on
            LOG.exception("%s: an internal error of phytofit", one_line(name))
            reason = f"an internal error of phytofit, {type(error).__name__}: {one_line(error)}"
            _save_by_points(plant, leaf, reason, target, key_of(name, [], {"fault": reason}))  # to be tried again
    table = read_table(target / "traits.csv")
    said = next(file for name in ("fit.json", REMARKS) if (file := target / name).is_file())
    log.remarks.extend(Placed(one, plant.in_remarks, leaf.rank) for one in read_remarks(said))
    return table


def _content(species: Species) -> dict[str, Any]:
    """All that a species says, whatever its file is called."""
    prior = [asdict(parameter) for parameter in species.space.parameters]
    return {"name": species.name, "model": repr(species.model), "prior": prior, "ranges": species.ranges.tolist()}


def _save_by_points(plant: _Plant, leaf: SegmentedLeaf, reason: str, target: Path, key: Mapping[str, Any]) -> None:
    """In place of a fit, the length of a leaf along its points."""
    with whole_folder(target.parent, target.name, KEY, "fit.json") as part:
        why = remark("not_fitted", reason=one_line(reason))
        traits = by_its_points(plant.found, leaf, why)
        write_table(part / "traits.csv", trait_table(plant.found.cloud.name, traits, plant=plant.number))
        write_text(part / REMARKS, remarks_text([why]))
        done(part, key, ("traits.csv", REMARKS))
