"""The command that measures phytomers: one leaf on its piece of stem in each cloud."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from phytofit.cli.console import app, err, or_exit, out, read_quietly, tell
from phytofit.cli.each import measure_each
from phytofit.cli.options import (
    MeshOption,
    OutOption,
    Seed,
    SpeciesOption,
    ThreadsOption,
    UnitsOption,
    UpOption,
    WorkbookOption,
)
from phytofit.cli.settings import defaults_of, entries_of
from phytofit.cli.tables import interval, print_remarks
from phytofit.errors import SettingError
from phytofit.text import for_terminal

if TYPE_CHECKING:
    from phytofit.cloud import PointCloud
    from phytofit.fitted import Fit
    from phytofit.optimize import Generation

__all__ = ["fit_command", "fit_with_progress"]

FIT = defaults_of("fitting", "fit")
DISTANCES = ", ".join(entries_of("distances", "DISTANCES"))
STEM_ABOVE = "|".join(entries_of("species", "STEM_ABOVE"))
METHODS = {name: defaults_of("fitting", function) for name, function in entries_of("fitting", "METHODS").items()}


def _by_method(setting: str) -> str:
    return ", ".join(f"{settings[setting]} for {name}" for name, settings in METHODS.items())


@app.command("fit")
def fit_command(
    clouds: Annotated[list[Path], typer.Argument(help="Point clouds: PLY, PCD, LAS/LAZ, XYZ, TXT, CSV, PTS, ASC.")],
    units: UnitsOption = None,
    species: SpeciesOption = FIT["species"],
    up: UpOption = None,
    seed_point: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z",
            help="A point on the leaf that is meant, in the cloud's unit, where others show too; one a piece.",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="likelihood: the most probable phytomer, with 95 % intervals. "
            "paper: the search of Sodhi et al., IROS 2018, for the least distance."
        ),
    ] = FIT["method"],
    distance: Annotated[
        str | None,
        typer.Option(help=f"What --method paper minimises: {DISTANCES}; hausdorff by default."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(help=f"Candidates a generation of the search; by default {_by_method('n_samples')}.")
    ] = None,
    points: Annotated[
        int | None,
        typer.Option(
            help="Points of the cloud after thinning, for --method paper also of a candidate; by default "
            f"{_by_method('n_points')}."
        ),
    ] = None,
    generations: Annotated[
        int | None, typer.Option(help=f"Generations of the search; by default {_by_method('n_generations')}.")
    ] = None,
    random_start: Annotated[
        bool, typer.Option("--random-start", help="Start from means drawn from the prior (Fig. 7d of the paper).")
    ] = FIT["random_start"],
    stem_above: Annotated[
        str | None,
        typer.Option(
            metavar=STEM_ABOVE,
            help="The stem above the leaf: as long as below it, not there, or with a length of its own; by default "
            f"{_by_method('stem_above')}. Without a length of its own the model has the paper's six parameters.",
        ),
    ] = None,
    labels: Annotated[
        str, typer.Option(help="Name of the label property (1 stem, 2.. leaves); none: use no labels.")
    ] = "label",
    seed: Seed = FIT["seed"],
    threads: ThreadsOption = None,
    folder: OutOption = Path("results"),
    mesh: MeshOption = None,
    workbook: WorkbookOption = False,
    convergence: Annotated[
        bool, typer.Option("--convergence", help="Write convergence.png as well: how the search went.")
    ] = False,
) -> None:
    """Measure phytomers: one leaf on its piece of stem a cloud, in any orientation.

    Prints a table of traits and writes, for each cloud, DIR/NAME/ with fit.png (the model on the points),
    traits.csv, model.ply and fit.json; and DIR/traits.csv over all.

    Examples:

        phytofit fit leaf.ply --units cm

        phytofit fit scans/*.ply --units mm --up z --out results

        phytofit fit crowded.ply --units cm --seed-point 12.5,-3,40
    """
    from phytofit.parsing import parse_up
    from phytofit.results import check_meshes, fit_tables, save_fit
    from phytofit.species import load_species

    seed_points = or_exit(lambda: _seed_points(seed_point or [], len(clouds)))
    chosen = or_exit(lambda: load_species(species))
    or_exit(lambda: parse_up(up))
    meshes = or_exit(lambda: check_meshes(mesh or []))
    settings: dict[str, Any] = {
        "species": chosen,
        "up": up,
        "seed_point": seed_points,
        "method": method,
        "distance": distance,
        "n_samples": samples,
        "n_points": points,
        "n_generations": generations,
        "random_start": random_start,
        "stem_above": stem_above,
        "seed": seed,
        "threads": threads,
    }

    def measured(path: Path, name: str) -> "Fit":
        cloud = read_quietly(path, units, None if labels == "none" else labels)
        result = fit_with_progress(cloud, name, settings)
        save_fit(result, cloud, folder, name, meshes=meshes, convergence=convergence)
        return result

    measure_each(
        clouds, folder, measured, fit_tables, _print_fit, f"clouds measured: {folder / 'traits.csv'}", workbook=workbook
    )


def _seed_points(given: list[str], n_clouds: int) -> list[list[float]] | None:
    if given and n_clouds > 1:
        raise SettingError(f"--seed-point: expected with one cloud, as it is a place in it; got {n_clouds} clouds")
    try:
        points = [[float(number) for number in text.split(",")] for text in given]
    except ValueError:
        raise SettingError(f"--seed-point: expected X,Y,Z, got {', '.join(given)!r}") from None
    if any(len(point) != 3 for point in points):
        raise SettingError(f"--seed-point: expected X,Y,Z, got {', '.join(given)!r}")
    return points or None


def fit_with_progress(cloud: "PointCloud", name: str, settings: dict[str, Any]) -> "Fit":
    """The fit of a cloud, with a bar on a terminal."""
    from phytofit.fitting import fit

    by_default = METHODS.get(settings.get("method", FIT["method"]), {}).get("n_generations")
    generations = settings.get("n_generations") or by_default
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[errors]}"))
    with Progress(*columns, TimeElapsedColumn(), console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(f"{for_terminal(name)}: start pose", total=generations, errors="")

        def told(generation: "Generation") -> None:
            errors = f"best {generation.best_error:.2f}, elite {generation.threshold:.2f}"
            bar.update(task, completed=generation.index, description=f"{for_terminal(name)}: search", errors=errors)

        return fit(cloud, progress=told, **settings)


def _print_fit(result: "Fit", name: str, where: Path) -> None:
    table = Table(title=for_terminal(name))
    for column in ("organ", "trait", "value", "95 % interval", "unit"):
        table.add_column(column, justify="right" if column in ("value", "95 % interval") else "left")
    for trait in result.traits:
        table.add_row(trait.organ, trait.name, f"{trait.value:.2f}", interval(trait), trait.unit)
    out.print(table)
    print_remarks(result)
    unit = "relative" if result.relative else "cm"
    if result.estimate is None:
        said = f"{result.settings['distance']} distance {result.error:.2f} {unit}"
    else:
        stem, leaf, thickness = result.estimate.noise * result.scale
        said = (
            f"noise {stem:.2f} {unit} on the stem, {leaf:.2f} on the leaf, {thickness:.2f} more across it; "
            f"{100 * result.estimate.share[2]:.0f} % outliers"
        )
    tell(f"{said}; model on the points: {where / 'fit.png'}")
