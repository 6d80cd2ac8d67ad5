"""The command that measures whole plants."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from phytofit.cli.console import app, err, flag, note, or_exit, out, tell
from phytofit.cli.options import (
    CameraOption,
    DepthUnitOption,
    LabelsOption,
    OutOption,
    PatternOption,
    PosesOption,
    Seed,
    SpeciesOption,
    StepOption,
    ThreadsOption,
    UnitsOption,
    UpOption,
)
from phytofit.cli.settings import defaults_of

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
STAGE_NAMES = {"reconstruct": "cloud from the images", "segment": "stem and leaves", "fit": "fitting leaves"}


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
    species: SpeciesOption = RUN["species"],
    seed: Seed = RUN["seed"],
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
    from phytofit.pipeline import run

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
    tell(f"Look at {folder / 'plant.png'}; all traits: {folder / 'traits.csv'}")


def _print_plant(made: "PlantRun") -> None:
    whole = made.table[made.table["organ"] == "plant"].set_index("trait")[["value", "unit"]].to_dict("index")
    said = [f"{str(trait).replace('_', ' ')} {row['value']:.3g} {row['unit']}" for trait, row in whole.items()]
    tell(f"{made.segmentation.cloud.name}: {', '.join(said).replace(' 1,', ',')}")
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column in ("leaf", *SHOWN.values()):
        table.add_column(column, justify="right", no_wrap=True)
    leaves = made.table[made.table["organ"] == "leaf"]
    for rank, mine in leaves.groupby("rank"):
        of_leaf = mine.drop_duplicates("trait").set_index("trait")
        table.add_row(str(rank), *(_with_interval(of_leaf, trait) for trait in SHOWN))
    out.print(table)
    for text in made.notes:
        note(text)
    for text in made.flags:
        flag(text)
    if made.skipped:
        tell(f"up to date, not done again: {', '.join(made.skipped)}")


def _with_interval(traits: "pd.DataFrame", name: str) -> str:
    if name not in traits.index:
        return ""
    value, low, high = (traits[column].to_dict()[name] for column in ("value", "low", "high"))
    ends = ["" if math.isnan(end) else f"{end:.1f}" for end in (low, high)]
    return f"{value:.1f}" + (f" ({ends[0]}–{ends[1]})" if any(ends) else "")
