"""The command that measures phytomers: one leaf on its piece of stem in each cloud."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from phytofit.cli.console import command, read_quietly, results_in, say, show
from phytofit.cli.each import measure_each
from phytofit.cli.inputs import cloud_files
from phytofit.cli.options import (
    MOST_POINTS,
    STEMS_ABOVE,
    MeshOption,
    OutOption,
    Seed,
    SpeciesOption,
    ThreadsOption,
    UnitsOption,
    UpOption,
    WorkbookOption,
    choice,
    numeric,
    only,
)
from phytofit.cli.progress import Told
from phytofit.cli.settings import defaults_of, entries_of
from phytofit.cli.tables import graded, print_remarks, print_skipped
from phytofit.errors import SettingError
from phytofit.text import for_terminal

if TYPE_CHECKING:
    from phytofit.cloud import PointCloud
    from phytofit.paper.cross_entropy import Generation
    from phytofit.results import Fit, FittedPhytomer, PaperFit

__all__ = ["fit_command", "fit_in_view"]

FIT = defaults_of("fitting", "fit")
STEM_ABOVE = [*entries_of("species", "STEM_ABOVE")]
DISTANCES = [*entries_of("paper.distances", "DISTANCES")]
SEARCH_SHARE = 0.3  # of the time of a fit by the default method; the rest refines what was found
METHODS = {name: defaults_of("fitting", function) for name, function in entries_of("fitting", "METHODS").items()}


def _by_method(setting: str) -> str:
    return ", ".join(f"{settings[setting]} for {name}" for name, settings in METHODS.items())


@command("fit")
def fit_command(
    context: typer.Context,
    clouds: Annotated[
        list[str],
        typer.Argument(
            metavar="CLOUDS",
            help="Point clouds (PLY, PCD, LAS/LAZ, E57, OBJ, XYZ, TXT, CSV, PTS, ASC), folders of them, or patterns.",
            show_default=False,
        ),
    ],
    units: UnitsOption = None,
    species: SpeciesOption = FIT["species"],
    up: UpOption = None,
    seed_point: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z",
            help="A point on the leaf to measure, in the cloud's unit, where the cloud shows other leaves too; "
            "give one for each piece of a leaf.",
        ),
    ] = None,
    method: Annotated[
        str,
        choice(
            "likelihood: the most probable phytomer, with 95 % intervals. "
            "paper: the search of Sodhi et al., IROS 2018, which minimises a distance.",
            among=[*METHODS],
        ),
    ] = FIT["method"],
    distance: Annotated[
        str | None,
        choice(
            f"What --method paper minimises: {', '.join(DISTANCES)}; {METHODS['paper']['distance']} by default.",
            among=DISTANCES,
        ),
    ] = None,
    samples: Annotated[
        int | None,
        numeric(
            f"Candidates in each generation of the search; by default {_by_method('n_samples')}.", least=1, most=100_000
        ),
    ] = None,
    points: Annotated[
        int | None,
        numeric(
            f"Points to which the cloud is thinned; by default {_by_method('n_points')}; for paper, also the "
            "number of points on each candidate.",
            least=1,
            most=MOST_POINTS,
        ),
    ] = None,
    generations: Annotated[
        int | None,
        numeric(f"Generations of the search; by default {_by_method('n_generations')}.", least=1, most=10_000),
    ] = None,
    random_start: Annotated[
        bool,
        typer.Option(
            "--random-start", metavar="", help="Start from means drawn from the prior (Fig. 7d of the paper)."
        ),
    ] = FIT["random_start"],
    stem_above: Annotated[
        str | None,
        choice(
            f"{STEMS_ABOVE}; by default {_by_method('stem_above')}. Without a length of its own the model has the "
            "paper's six parameters.",
            among=STEM_ABOVE,
        ),
    ] = None,
    labels: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Property that holds labels (1 stem, 2 and up leaves); none: use no labels.",
        ),
    ] = "label",
    seed: Seed = FIT["seed"],
    threads: ThreadsOption = None,
    folder: OutOption = Path("results"),
    meshes: MeshOption = None,
    workbook: WorkbookOption = False,
    convergence: Annotated[
        bool, typer.Option("--convergence", metavar="", help="Write convergence.png as well: how the search went.")
    ] = False,
) -> None:
    """Measure phytomers: one leaf on its piece of stem in each cloud, in any orientation.

    Prints a table of traits and writes, for each cloud, DIR/NAME/ with fit.png (the model on the points),
    traits.csv, model.ply and fit.json; and DIR/traits.csv over all. A whole plant is measured by
    phytofit run.

    Examples:

        phytofit fit leaf.ply --units cm

        phytofit fit scans --units mm --up z --out results

        phytofit fit crowded.ply --units cm --seed-point 12.5,-3,40
    """
    from phytofit.io import fit_tables, save_fit
    from phytofit.species import load_species

    if method != "paper":
        only(context, ["distance"], "it changes nothing without --method paper; leave it out")
    files, skipped = cloud_files(clouds)
    settings: dict[str, Any] = {
        "species": load_species(species),
        "up": up,
        "seed_point": _seed_points(seed_point or [], len(files)),
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

    def measured(path: Path, name: str, told: Told) -> "Fit | PaperFit":
        cloud = read_quietly(path, units, None if labels == "none" else labels)
        result = fit_in_view(cloud, settings, told)
        save_fit(result, cloud, folder, name, meshes=meshes or (), convergence=convergence)
        return result

    with results_in(folder):
        print_skipped(skipped)
        done = f"clouds measured: {folder / 'traits.csv'}"
        measure_each(files, folder, measured, fit_tables, _print_fit, done, workbook=workbook)


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


def fit_in_view(cloud: "PointCloud", settings: dict[str, Any], told: Told) -> "Fit | PaperFit":
    """The fit of a cloud, which tells how far it is."""
    from phytofit.fitting import fit

    by_default = METHODS[settings.get("method", FIT["method"])]["n_generations"]
    generations = settings.get("n_generations") or by_default
    told("start pose", 0.0)

    def searched(generation: "Generation") -> None:
        told(
            "search" if generation.index < generations else "refinement", SEARCH_SHARE * generation.index / generations
        )

    return fit(cloud, progress=searched, **settings)


def _print_fit(result: "FittedPhytomer", name: str, where: Path) -> None:
    from phytofit.results import Placed

    table = Table(title=for_terminal(name))
    for column in ("organ", "trait", "value", "95 % interval", "unit", "quality"):
        table.add_column(column, justify="right" if column in ("value", "95 % interval") else "left")
    for trait in result.traits:
        table.add_row(trait.organ, trait.name, f"{trait.value:.2f}", trait.interval, trait.unit, graded(trait.quality))
    show(table)
    print_remarks(result.notes, map(Placed, result.remarks))
    say(f"{result.closeness}; model on the points: {where / 'fit.png'}")
