"""The command that takes plants apart."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from phytofit.cli.console import app, complain, err, or_exit, out, read_quietly
from phytofit.cli.options import LabelsOption, OutOption, UnitsOption, UpOption
from phytofit.errors import PhytofitError

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
    DIR/leaves.csv over all. Where a leaf is wrong, edit the labels in plant.ply and give it back with --labels label.

    Examples:

        phytofit segment plant.ply --units mm --up z --out plants

        phytofit fit plants/plant/phytomers/*.ply --units mm --out results

        phytofit segment corrected.ply --units mm --labels label
    """
    import pandas as pd

    from phytofit.parsing import parse_up
    from phytofit.pipeline import PLANT_CM
    from phytofit.results import leaf_table, prepare_folder, result_names, save_segmentation, table_text, write_text
    from phytofit.segmentation import segment

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


def _print_leaves(result: "Segmentation", name: str, where: Path) -> None:
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
