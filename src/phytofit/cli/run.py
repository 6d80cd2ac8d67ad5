"""The command that measures whole plants."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from phytofit.cli.console import command, complain, results_in, say, show, unforeseen
from phytofit.cli.inputs import check_images, cloud_files, holds_images
from phytofit.cli.options import (
    CAMERAS,
    CameraOption,
    DepthUnitOption,
    LabelsOption,
    MeshOption,
    OutOption,
    PatternOption,
    PosesOption,
    Seed,
    SpeciesOption,
    StepOption,
    ThreadsOption,
    UnitsOption,
    UpOption,
    WorkbookOption,
    only,
)
from phytofit.cli.progress import Items
from phytofit.cli.settings import defaults_of
from phytofit.cli.tables import MARKS, print_remarks, print_skipped
from phytofit.errors import InputError, PhytofitError

if TYPE_CHECKING:
    import pandas as pd

    from phytofit.pipeline import PlantRun

__all__ = ["run_command"]

RUN = defaults_of("pipeline", "run")
SHOWN = {  # traits of each leaf on the screen, and their headings
    "leaf_length": "length",
    "leaf_width": "width",
    "leaf_angle": "angle",
    "leaf_azimuth": "azimuth",
    "collar_height": "collar at",
}
STAGES = {  # their names, where they begin, and their share of a run's time
    "reconstruct": ("cloud from the images", 0.0, 0.2),
    "segment": ("stem and leaves", 0.2, 0.1),
    "fit": ("leaves", 0.3, 0.7),
}
FOR_IMAGES = ("camera", "step", "unit", "poses", "pattern")
FOR_CLOUDS = ("units", "labels")


@command("run")
def run_command(
    context: typer.Context,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCES",
            help="Folders of depth images, one for each plant; or clouds of plants, folders of clouds, or patterns.",
            show_default=False,
        ),
    ],
    camera: CameraOption = "",
    step: StepOption = None,
    unit: DepthUnitOption = None,
    poses: PosesOption = None,
    pattern: PatternOption = "*",
    units: UnitsOption = None,
    up: UpOption = None,
    labels: LabelsOption = None,
    species: SpeciesOption = RUN["species"],
    seed: Seed = RUN["seed"],
    threads: ThreadsOption = None,
    folder: OutOption = Path("plant"),
    meshes: MeshOption = None,
    workbook: WorkbookOption = False,
) -> None:
    """Measure all leaves of a plant, from depth images or from its cloud: reconstruct, segment, fit.

    Writes DIR/plant.png (look at it first: leaves coloured and numbered, beside their traits), DIR/traits.csv (plant,
    internodes and leaves), and what each stage made: DIR/reconstruction, DIR/segmentation, DIR/leaves/leaf_01, …; for
    several plants, all that in DIR/NAME, and DIR/traits.csv over all. Stages that are up to date are skipped.
    Where a leaf is wrong, edit the labels in DIR/segmentation/plant.ply and run on that file with --labels label.

    Examples:

        phytofit run scan --camera kinect-v2 --out plant

        phytofit run plant.ply --units mm --up z --out plant

        phytofit run plants --units mm --up z --out plants_measured

        phytofit run plant/segmentation/plant.ply --units cm --labels label --out corrected
    """
    plants, skipped = _plants(context, sources, folder)
    settings: dict[str, Any] = {
        "camera": camera or None,
        "units": units,
        "up": up,
        "step_deg": step,
        "unit": unit,
        "poses": poses,
        "pattern": pattern,
        "labels": labels,
        "species": species,
        "seed": seed,
        "threads": threads,
        "meshes": meshes or (),
    }
    with results_in(folder):
        print_skipped(skipped)
        _run_all(plants, settings, folder, workbook=workbook)


def _plants(context: typer.Context, sources: list[str], folder: Path) -> tuple[list[Path], list[Path]]:
    """What to measure: folders of images, or clouds; and what was skipped.  The options for the one are refused for the
    other."""
    with_camera = bool(context.params["camera"])
    images = [Path(source) for source in sources if holds_images(Path(source), with_camera=with_camera)]
    if not images:
        only(context, FOR_IMAGES, "for a folder of depth images, and this is a point cloud; leave it out")
        return cloud_files(sources)
    if len(images) < len(sources):
        raise InputError(f"{images[0]}: a folder of images among point clouds; measure them one after the other")
    for source in images:
        check_images(source)
        if source.resolve() == folder.resolve():
            raise InputError(f"{folder}: the folder of the images can't hold the results; choose another folder")
    only(context, FOR_CLOUDS, "for point clouds, and this is a folder of images; leave it out")
    if not context.params["camera"]:
        raise InputError(f"{images[0]}: a folder of depth images needs --camera: {', '.join(CAMERAS)}, or a TOML file")
    return images, []


def _run_all(plants: list[Path], settings: dict[str, Any], folder: Path, *, workbook: bool) -> None:
    """Measure one plant after the other; what goes wrong with one does not keep the others from being measured."""
    import pandas as pd

    from phytofit.io import read_table, result_names, write_table, write_workbook
    from phytofit.pipeline import run

    alone = len(plants) == 1
    items = Items(len(plants), "plant", in_stages=True)
    tables, n_without = [], 0
    for i, (source, name) in enumerate(zip(plants, result_names(plants), strict=True)):
        where = folder if alone else folder / name
        try:
            if not os.path.exists(source):  # noqa: PTH110  (pathlib raises where a name is too long)
                raise InputError(f"{source}: no such file or folder; check the path")
            with items.item(i, name) as told:
                made = run(source, where, **settings, progress=_stages(told))
        except Exception as error:
            said = str(error) if isinstance(error, PhytofitError) else unforeseen(error)
            complain(said if str(source) in said or source.name in said else f"{source}: {said}")
            continue
        tables.append(made.table if alone else made.table.assign(cloud=name))
        _print_plant(made)
        if not (made.table["trait"] == "leaf_width").any():
            complain(f"{source}: no leaf could be measured; look at {where / 'plant.png'}")
            n_without += 1
        say(f"Look at {where / 'plant.png'}; all traits: {where / 'traits.csv'}")
    if tables and not alone:
        write_table(folder / "traits.csv", pd.concat(tables))
        say(f"{len(tables) - n_without} of {len(plants)} plants measured: {folder / 'traits.csv'}")
    if tables and workbook:
        write_workbook(folder / "traits.xlsx", read_table(folder / "traits.csv"))
    n_measured = len(tables) - n_without
    raise typer.Exit(0 if n_measured == len(plants) else 1 if n_measured else 2)


def _stages(told: Callable[[str, float], None]) -> Callable[[str, int, int], None]:
    """Words for the stages of a run, and what share of it each takes, roughly."""

    def progress(stage: str, done: int, total: int) -> None:
        name, begins, share = STAGES[stage]
        name = f"leaf {min(done + 1, total)} of {total}" if stage == "fit" and total else name
        told(name, begins + share * done / max(total, 1))

    return progress


def _print_plant(made: "PlantRun") -> None:
    n_plants = len(made.segmentations)
    for number, found in enumerate(made.segmentations, start=1):
        mine = made.table[made.table["plant"] == number]
        whole = mine[mine["organ"] == "plant"].set_index("trait")[["value", "unit"]].to_dict("index")
        said = [f"{str(trait).replace('_', ' ')} {row['value']:.3g} {row['unit']}" for trait, row in whole.items()]
        name = f"{found.cloud.name}, plant {number} of {n_plants}" if n_plants > 1 else found.cloud.name
        say(f"{name}: {', '.join(said).replace(' 1,', ',')}")
        table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for column in ("leaf", *SHOWN.values()):
            table.add_column(column, justify="right", no_wrap=True)
        for rank, leaf in mine[mine["organ"] == "leaf"].groupby("rank"):
            of_leaf = leaf.drop_duplicates("trait").set_index("trait")
            table.add_row(str(rank), *(_with_interval(of_leaf, trait) for trait in SHOWN))
        show(table)
    say(f"{MARKS['check']} check; {MARKS['poor']} poor: do not use")
    print_remarks(made.notes, made.remarks)
    if made.skipped:
        say(f"up to date, skipped: {', '.join(made.skipped)}")


def _with_interval(traits: "pd.DataFrame", name: str) -> str:
    if name not in traits.index:
        return ""
    value, low, high = (traits[column].to_dict()[name] for column in ("value", "low", "high"))
    ends = ["" if math.isnan(end) else f"{end:.1f}" for end in (low, high)]
    mark = MARKS.get(traits["quality"].to_dict()[name], "")
    return f"{value:.1f}{mark}" + (f" ({ends[0]}–{ends[1]})" if any(ends) else "")
