"""The command that takes plants apart."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from phytofit.cli.console import command, read_quietly, results_in, say, show
from phytofit.cli.each import measure_each
from phytofit.cli.inputs import cloud_files
from phytofit.cli.options import LabelsOption, OutOption, UnitsOption, UpOption
from phytofit.cli.progress import Told
from phytofit.cli.tables import print_remarks, print_skipped
from phytofit.text import for_terminal

if TYPE_CHECKING:
    from phytofit.segmentation import Segmentation

__all__ = ["segment_command"]


@command("segment")
def segment_command(
    clouds: Annotated[
        list[str],
        typer.Argument(
            metavar="CLOUDS",
            help="Clouds of plants (PLY, PCD, LAS/LAZ, E57, OBJ, XYZ, TXT, CSV, PTS, ASC), folders, or patterns.",
            show_default=False,
        ),
    ],
    units: UnitsOption = None,
    up: UpOption = None,
    labels: LabelsOption = None,
    folder: OutOption = Path("plants"),
) -> None:
    """Separate plants into stem and leaves, numbered from the base; cut out each leaf with its piece of stem.

    Writes, for each cloud, DIR/NAME/ with segmentation.png (look at it first), leaves.csv, plant.ply (all points with
    their labels: 0 no organ, 1 stem, 2 and up leaves) and phytomers/leaf_01.ply, …, ready for phytofit fit; and
    DIR/leaves.csv over all. Where a cloud holds several plants, each gets its folder, DIR/NAME/plant_1 and on. Where a
    leaf is wrong, edit the labels in plant.ply and give it back with --labels label.

    Examples:

        phytofit segment plant.ply --units mm --up z --out plants

        phytofit fit plants/plant/phytomers/*.ply --units mm --out results

        phytofit segment corrected.ply --units mm --labels label
    """
    from phytofit.io import leaf_tables, save_plants
    from phytofit.segmentation import PLANT_CM, segment, separate_plants

    files, skipped = cloud_files(clouds)

    def taken_apart(path: Path, name: str, told: Told) -> "list[Segmentation]":
        told("looking for stem and leaves", 0.0)
        cloud = read_quietly(path, units, labels, plausible_cm=PLANT_CM)
        plants = (cloud,) if labels is not None else separate_plants(cloud, up=up)
        results = [segment(plant, up=up, labelled=labels is not None) for plant in plants]
        save_plants(results, folder, name)
        return results

    with results_in(folder):
        print_skipped(skipped)
        done = f"clouds segmented: {folder / 'leaves.csv'}"
        measure_each(files, folder, taken_apart, leaf_tables, _print_plants, done)


def _print_plants(results: "list[Segmentation]", name: str, where: Path) -> None:
    if len(results) == 1:
        _print_leaves(results[0], name, where)
        return
    for number, result in enumerate(results, start=1):
        _print_leaves(result, f"{name}, plant {number}", where / f"plant_{number}")
    say(f"Which plant is which: {where / 'plants.png'}")


def _print_leaves(result: "Segmentation", name: str, where: Path) -> None:
    from phytofit.results import Placed, of_codes

    unit = "rel" if result.cloud.unit == "none" else "cm"
    table = Table(title=for_terminal(f"{name}: {len(result.leaves)} leaves"))
    for column in ("leaf", f"collar along the stem, {unit}", f"length, {unit}", "azimuth, deg", "points"):
        table.add_column(column, justify="right")
    for leaf in result.leaves:
        numbers = (f"{leaf.collar_distance:.1f}", f"{leaf.length:.1f}", f"{leaf.azimuth:.0f}", str(leaf.n_points))
        table.add_row(str(leaf.rank), *numbers)
    show(table)
    found = [Placed(one, rank=leaf.rank) for leaf in result.leaves for one in of_codes(leaf.flags)]
    print_remarks((*result.cloud.notes, *result.notes), found)
    say(f"Look at {where / 'segmentation.png'}")
