"""The commands for whole plants: reconstruct, segment, run."""

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from phytofit.cli.console import (
    OutOption,
    Seed,
    SpeciesOption,
    ThreadsOption,
    UnitsOption,
    UpOption,
    app,
    complain,
    err,
    or_exit,
    out,
    read_quietly,
)
from phytofit.errors import PhytofitError
from phytofit.fitting import fit
from phytofit.parsing import parse_up
from phytofit.pipeline import PLANT_CM, PlantRun, run
from phytofit.recipe import defaults
from phytofit.reconstruct import CAMERAS, Reconstruction, reconstruct
from phytofit.results import (
    leaf_table,
    prepare_folder,
    result_names,
    save_reconstruction,
    save_segmentation,
    table_text,
    write_text,
)
from phytofit.segmentation import Segmentation, segment

__all__ = ["reconstruct_command", "run_command", "segment_command"]

FIT = defaults(fit)
SHOWN = {  # traits of each leaf on the screen, and their headings
    "leaf_length": "length",
    "leaf_width": "width",
    "leaf_angle": "angle",
    "leaf_azimuth": "azimuth",
    "collar_height": "collar at",
}
STAGE_NAMES = {"reconstruct": "cloud from the images", "segment": "stem and leaves", "fit": "fitting leaves"}
STAGES = 6  # that reconstruct tells of


CameraOption = Annotated[
    str,
    typer.Option(
        "--camera",
        "-c",
        show_default=False,
        help=f"{', '.join(CAMERAS)}; or a TOML file with fx fy cx cy width height (pixels) and, if need be, "
        "depth_scale, unit, distortion = [k1, k2, p1, p2, k3].",
    ),
]
StepOption = Annotated[
    float | None, typer.Option(help="The turntable's nominal step, degrees; the true one is estimated either way.")
]
DepthUnitOption = Annotated[
    str | None,
    typer.Option("--depth-unit", help="What a stored depth of 1 is: mm, cm or m; by default the camera's, mm."),
]
PosesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Known viewpoints instead of a turntable, JSON: "
        '{"unit": "cm", "views": [{"file": "a.png", "pose": 4x4 camera to world, z up}]}.',
    ),
]
PatternOption = Annotated[str, typer.Option(help="Which files of the folder are depth images.")]
LabelsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Take stem and leaves from this property (1 stem, 2.. leaves) instead of finding them: "
        "`label` in a corrected plant.ply.",
    ),
]


@app.command("reconstruct")
def reconstruct_command(
    images: Annotated[Path, typer.Argument(metavar="FOLDER", help="Depth images: 16-bit PNG or TIFF, or NPY.")],
    camera: CameraOption,
    step: StepOption = None,
    unit: DepthUnitOption = None,
    poses: PosesOption = None,
    pattern: PatternOption = "*",
    spacing: Annotated[
        float | None,
        typer.Option(help="Between points of the cloud, cm; by default that of neighbouring pixels on the plant."),
    ] = None,
    folder: OutOption = Path("reconstruction"),
) -> None:
    """Make one cloud of a plant from depth images of it on a turntable, or from known viewpoints.

    The camera stands still and the plant turns, by about the same step between images, which are taken in the order of
    the numbers in their names. What turns is the plant; background, table and pot are removed. Axis and step are found
    from the images. Writes DIR/plant.ply (cm, z up, the number of views that saw each point), DIR/reconstruction.png
    (three sides, to believe it by) and DIR/reconstruction.json (step, axis, the pose of each view, how well each pair
    fits, views left out and why).

    Examples:

        phytofit reconstruct scan --camera kinect-v2 --out plant

        phytofit reconstruct scan --camera my_camera.toml --step 30 --pattern 'depth_*.png'

        phytofit reconstruct scan --camera realsense-d4xx --poses poses.json
    """
    if images.is_dir() and images.resolve() == folder.resolve():
        complain(f"{folder}: the folder of the images can't hold the results; name another with --out")
        raise typer.Exit(2)
    try:
        prepare_folder(folder)
        with Progress(
            SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
            console=err, transient=True, disable=not err.is_terminal,
        ) as bar:  # fmt: skip
            task = bar.add_task("images", total=STAGES)

            def progress(stage: str) -> None:
                bar.update(task, description=stage, advance=1)

            result = reconstruct(
                images,
                camera,
                step_deg=step,
                unit=unit,
                poses=poses,
                pattern=pattern,
                spacing_cm=spacing,
                progress=progress,
            )
            save_reconstruction(result, folder)
    except PhytofitError as error:
        complain(error)
        raise typer.Exit(2) from None
    _print(result, folder)


def _print(result: Reconstruction, folder: Path) -> None:
    table = Table(title=result.cloud.name)
    for column in ("view", "angle, °", "fits", "overlap, %", "apart, cm"):
        table.add_column(column, justify="left" if column in ("view", "fits") else "right", overflow="fold")
    for i, file in enumerate(result.files):
        mine = [pair for pair in result.pairs if i in (pair.first, pair.second)]
        best = max(mine, key=lambda pair: pair.overlap, default=None)
        angle = "" if result.turn is None else f"{abs(result.turn.angles[i]) * 57.29577951308232:.1f}"
        if best is None:
            table.add_row(file, angle, "", "", "")
        else:
            other = result.files[best.second if best.first == i else best.first]
            table.add_row(file, angle, other, f"{100 * best.overlap:.0f}", f"{best.residual_cm:.2f}")
    out.print(table)
    for view in result.rejected:
        out.print(f"[bold yellow]rejected:[/] {view.file}: {view.reason}", highlight=False)
    for flag in result.flags:
        out.print(f"[bold yellow]flag:[/] {flag}", highlight=False)
    said = [f"{len(result.cloud)} points of {len(result.files)} views"]
    if result.step_deg is not None:
        said.append(f"step {abs(result.step_deg):.2f}°")
    if result.pairs:
        said.append(f"neighbours {result.residual_cm:.2f} cm apart (median)")
    if result.loop is not None:
        said.append(f"loop closes within {result.loop[0]:.1f}° and {result.loop[1]:.2f} cm")
    where = f"{folder / 'plant.ply'}; believe it by {folder / 'reconstruction.png'}"
    out.print(f"{', '.join(said)}: {where}", highlight=False)


@app.command("segment")
def segment_command(
    clouds: Annotated[list[Path], typer.Argument(help="Clouds of whole plants: PLY, PCD, LAS/LAZ, XYZ, TXT, CSV, ...")],
    units: UnitsOption = None,
    up: UpOption = None,
    labels: LabelsOption = None,
    folder: OutOption = Path("plants"),
) -> None:
    """Take plants apart: stem, leaves numbered from the base, and a cloud of each leaf with its piece of stem.

    Writes, for each cloud, DIR/NAME/ with segmentation.png (look at it first), leaves.csv, plant.ply (all points with
    their labels: 0 none, 1 stem, 2.. leaves) and phytomers/leaf_01.ply and on, ready for `phytofit fit`; and
    DIR/leaves.csv over all. Where a leaf is wrong, edit the labels in plant.ply and give it back with --labels label.

    Examples:

        phytofit segment plant.ply --units mm --up z --out plants

        phytofit fit plants/plant/phytomers/*.ply --units mm --out results

        phytofit segment corrected.ply --units mm --labels label
    """
    or_exit(lambda: prepare_folder(folder))
    or_exit(lambda: parse_up(up))
    tables = []
    for path, name in zip(clouds, result_names(clouds), strict=True):
        try:
            with err.status(f"{name}: looking for stem and leaves"):
                cloud = read_quietly(path, units, labels or "label", plausible_cm=PLANT_CM)
                result = segment(cloud, up=up, labelled=labels is not None)
                where = save_segmentation(result, folder, name)
        except PhytofitError as error:
            complain(error if str(path) in str(error) or path.name in str(error) else f"{path}: {error}")
            continue
        tables.append(leaf_table(name, result))
        _print_leaves(result, name, where)
    if tables:
        or_exit(lambda: write_text(folder / "leaves.csv", table_text(pd.concat(tables))))
        out.print(f"{len(tables)} of {len(clouds)} plants taken apart: {folder / 'leaves.csv'}", highlight=False)
    raise typer.Exit(0 if len(tables) == len(clouds) else 1 if tables else 2)


def _print_leaves(result: Segmentation, name: str, where: Path) -> None:
    unit = "rel" if result.cloud.unit == "none" else "cm"
    table = Table(title=f"{name}: {len(result.leaves)} leaves")
    for column in ("leaf", f"collar along the stem, {unit}", f"length, {unit}", "azimuth, deg", "points"):
        table.add_column(column, justify="right")
    for leaf in result.leaves:
        numbers = (f"{leaf.collar_distance:.1f}", f"{leaf.length:.1f}", f"{leaf.azimuth:.0f}", str(leaf.n_points))
        table.add_row(str(leaf.rank), *numbers)
    out.print(table)
    for note in (*result.cloud.notes, *result.notes):
        out.print(f"note: {note}", highlight=False)
    for leaf in result.leaves:
        for flag in leaf.flags:
            out.print(f"[bold yellow]flag:[/] leaf {leaf.rank}: {flag}", highlight=False)
    out.print(f"Look at {where / 'segmentation.png'}", highlight=False)


@app.command("run")
def run_command(
    source: Annotated[Path, typer.Argument(help="Folder of depth images of a plant, or a cloud of it.")],
    camera: CameraOption = "",
    step: StepOption = None,
    unit: DepthUnitOption = None,
    poses: PosesOption = None,
    pattern: PatternOption = "*",
    units: UnitsOption = None,
    up: UpOption = None,
    labels: LabelsOption = None,
    species: SpeciesOption = FIT["species"],
    seed: Seed = FIT["seed"],
    threads: ThreadsOption = None,
    folder: OutOption = Path("plant"),
) -> None:
    """Measure all leaves of a plant, from depth images or from its cloud: reconstruct, segment, fit.

    Writes DIR/plant.png (look at it first: leaves coloured and numbered, beside their traits), DIR/traits.csv (plant,
    internodes and leaves), and what each stage made: DIR/reconstruction, DIR/segmentation, DIR/leaves/leaf_01 and on. A
    stage that is up to date is not done again. Where a leaf is wrong, edit the labels in DIR/segmentation/plant.ply and
    run on that file with --labels label.

    Examples:

        phytofit run scan --camera kinect-v2 --out plant

        phytofit run plant.ply --units mm --up z --out plant

        phytofit run plant/segmentation/plant.ply --units cm --labels label --out corrected
    """
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task("images", total=1)

        def progress(stage: str, done: int, total: int) -> None:
            bar.update(task, description=STAGE_NAMES[stage], completed=done, total=total)

        made = or_exit(
            lambda: run(
                source,
                folder,
                camera=camera or None,
                units=units,
                up=up,
                step_deg=step,
                unit=unit,
                poses=poses,
                pattern=pattern,
                labels=labels,
                species=species,
                seed=seed,
                threads=threads,
                progress=progress,
            )
        )
    _print_plant(made)
    out.print(f"Look at {folder / 'plant.png'}; all traits: {folder / 'traits.csv'}", highlight=False)


def _print_plant(made: PlantRun) -> None:
    whole = made.table[made.table["organ"] == "plant"].set_index("trait")[["value", "unit"]].to_dict("index")
    said = [f"{str(trait).replace('_', ' ')} {row['value']:.3g} {row['unit']}" for trait, row in whole.items()]
    out.print(f"{made.segmentation.cloud.name}: {', '.join(said).replace(' 1,', ',')}", highlight=False)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column in ("leaf", *SHOWN.values()):
        table.add_column(column, justify="right", no_wrap=True)
    leaves = made.table[made.table["organ"] == "leaf"]
    for rank, mine in leaves.groupby("rank"):
        of_leaf = mine.drop_duplicates("trait").set_index("trait")
        table.add_row(str(rank), *(_with_interval(of_leaf, trait) for trait in SHOWN))
    out.print(table)
    for text in made.notes:
        out.print(f"note: {text}", highlight=False)
    for text in made.flags:
        out.print(f"[bold yellow]flag:[/] {text}", highlight=False)
    if made.skipped:
        out.print(f"up to date, not done again: {', '.join(made.skipped)}", highlight=False)


def _with_interval(traits: pd.DataFrame, name: str) -> str:
    if name not in traits.index:
        return ""
    value, low, high = (traits[column].to_dict()[name] for column in ("value", "low", "high"))
    ends = ["" if np.isnan(end) else f"{end:.1f}" for end in (low, high)]
    return f"{value:.1f}" + (f" ({ends[0]}–{ends[1]})" if any(ends) else "")
