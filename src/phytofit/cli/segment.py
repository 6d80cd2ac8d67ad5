"""The command that takes plants apart."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from phytofit.cli.console import app, err, flag, note, or_exit, out, read_quietly, tell
from phytofit.cli.each import measure_each
from phytofit.cli.options import LabelsOption, OutOption, UnitsOption, UpOption
from phytofit.text import for_terminal

if TYPE_CHECKING:
    from phytofit.segmentation import Segmentation

__all__ = ["segment_command"]


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
    DIR/leaves.csv over all. Where a cloud holds several plants, each gets its folder, DIR/NAME/plant_1 and on. Where a
    leaf is wrong, edit the labels in plant.ply and give it back with --labels label.

    Examples:

        phytofit segment plant.ply --units mm --up z --out plants

        phytofit fit plants/plant/phytomers/*.ply --units mm --out results

        phytofit segment corrected.ply --units mm --labels label
    """
    from phytofit.parsing import parse_up
    from phytofit.pipeline import PLANT_CM
    from phytofit.results import leaf_tables, save_plants
    from phytofit.segmentation import segment, separate_plants

    def taken_apart(path: Path, name: str) -> "list[Segmentation]":
        with err.status(f"{for_terminal(name)}: looking for stem and leaves"):
            cloud = read_quietly(path, units, labels, plausible_cm=PLANT_CM)
            plants = (cloud,) if labels is not None else separate_plants(cloud, up=up)
            results = [segment(plant, up=up, labelled=labels is not None) for plant in plants]
            save_plants(results, folder, name)
            return results

    or_exit(lambda: parse_up(up))
    measure_each(
        clouds, folder, taken_apart, leaf_tables, _print_plants, f"clouds taken apart: {folder / 'leaves.csv'}"
    )


def _print_plants(results: "list[Segmentation]", name: str, where: Path) -> None:
    if len(results) == 1:
        _print_leaves(results[0], name, where)
        return
    for number, result in enumerate(results, start=1):
        _print_leaves(result, f"{name}, plant {number}", where / f"plant_{number}")
    tell(f"Which plant is which: {where / 'plants.png'}")


def _print_leaves(result: "Segmentation", name: str, where: Path) -> None:
    unit = "rel" if result.cloud.unit == "none" else "cm"
    table = Table(title=f"{for_terminal(name)}: {len(result.leaves)} leaves")
    for column in ("leaf", f"collar along the stem, {unit}", f"length, {unit}", "azimuth, deg", "points"):
        table.add_column(column, justify="right")
    for leaf in result.leaves:
        numbers = (f"{leaf.collar_distance:.1f}", f"{leaf.length:.1f}", f"{leaf.azimuth:.0f}", str(leaf.n_points))
        table.add_row(str(leaf.rank), *numbers)
    out.print(table)
    for text in (*result.cloud.notes, *result.notes):
        note(text)
    for leaf in result.leaves:
        for text in leaf.flags:
            flag(f"leaf {leaf.rank}: {text}")
    tell(f"Look at {where / 'segmentation.png'}")
