"""The command line: parse, call, print, exit code (0 all measured; 1 some inputs failed; 2 nothing could be done)."""

import json
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from phytofit.cloud import PointCloud
from phytofit.distances import DISTANCES
from phytofit.errors import PhytofitError, SettingError
from phytofit.fitting import AXES, Fit, fit, parse_up
from phytofit.formats import read_cloud, write_cloud
from phytofit.optimize import CrossEntropy, Generation
from phytofit.recipe import defaults, recipe
from phytofit.results import prepare_folder, result_names, save_fit, table_text, trait_table, write_text
from phytofit.simulation import SimulatedPhytomer, simulate
from phytofit.species import Species, load_species, species_names
from phytofit.traits import measure

__all__ = ["app", "main"]

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    help="Plant traits from 3D point clouds, by fitting parametric plant models.\n\n"
    "Start with `phytofit demo`; then `phytofit fit leaf.ply --units cm`.",
)
out = Console()
err = Console(stderr=True)
FIT = defaults(fit)
SIMULATE = defaults(simulate)

Seed = Annotated[int, typer.Option(help="The same seed gives the same result.", min=0)]
SpeciesOption = Annotated[
    str, typer.Option(help=f"A species that comes with phytofit ({', '.join(species_names())}), or a TOML file.")
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.", file_okay=True)]


@app.command("fit")
def fit_command(
    clouds: Annotated[list[Path], typer.Argument(help="Point clouds: PLY, PCD, LAS/LAZ, XYZ, TXT, CSV, PTS, ASC.")],
    units: Annotated[
        str | None, typer.Option("--units", "-u", help="Unit of the coordinates: cm, mm, m; none: relative lengths.")
    ] = None,
    species: SpeciesOption = FIT["species"],
    up: Annotated[str | None, typer.Option(help=f"Upward direction where it is known: {', '.join(AXES)}.")] = None,
    method: Annotated[str, typer.Option(help="paper: the search of Sodhi et al., IROS 2018.")] = FIT["method"],
    distance: Annotated[str, typer.Option(help=f"What is minimised: {', '.join(DISTANCES)}.")] = FIT["distance"],
    samples: Annotated[int, typer.Option(help="Candidates a generation.")] = FIT["n_samples"],
    points: Annotated[int, typer.Option(help="Points a candidate, and of the cloud after thinning.")] = FIT["n_points"],
    generations: Annotated[int, typer.Option(help="Generations of the search.")] = defaults(CrossEntropy.__init__)[
        "n_generations"
    ],
    random_start: Annotated[
        bool, typer.Option("--random-start", help="Start from means drawn from the prior (Fig. 7d of the paper).")
    ] = FIT["random_start"],
    stem_above: Annotated[
        bool,
        typer.Option(
            "--stem-above/--no-stem-above",
            help="Whether the stem may go on above the leaf; without, the paper's six parameters.",
        ),
    ] = FIT["stem_above"],
    labels: Annotated[str, typer.Option(help="Name of the label property (1 stem, 2.. leaves).")] = "label",
    seed: Seed = FIT["seed"],
    threads: Annotated[int | None, typer.Option(help="Threads to work with; all cores by default.")] = None,
    folder: OutOption = Path("results"),
) -> None:
    """Measure phytomers: one leaf on its piece of stem a cloud, in any orientation.

    Prints a table of traits and writes, for each cloud, DIR/NAME/ with fit.png (the model on the points),
    convergence.png, traits.csv, model.ply and fit.json; and DIR/traits.csv over all.

    Examples:

        phytofit fit leaf.ply --units cm

        phytofit fit scans/*.ply --units mm --up z --out results
    """
    chosen = _or_exit(lambda: load_species(species))
    _or_exit(lambda: prepare_folder(folder))
    _or_exit(lambda: parse_up(up))
    settings: dict[str, Any] = {
        "species": chosen,
        "up": up,
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
    tables = []
    for path, name in zip(clouds, result_names(clouds), strict=True):
        try:
            cloud = _read(path, units, labels)
            result = _fit_with_progress(cloud, name, generations, settings)
            where = save_fit(result, cloud, folder, name)
        except SettingError as error:  # as wrong for every other cloud
            _complain(error)
            raise typer.Exit(2) from None
        except PhytofitError as error:
            _complain(error if str(path) in str(error) or path.name in str(error) else f"{path}: {error}")
            continue
        tables.append(trait_table(name, result.traits))
        _print_fit(result, name, where)
    if tables:
        _or_exit(lambda: write_text(folder / "traits.csv", table_text(pd.concat(tables))))
        out.print(f"{len(tables)} of {len(clouds)} clouds measured: {folder / 'traits.csv'}", highlight=False)
    raise typer.Exit(0 if len(tables) == len(clouds) else 1 if tables else 2)


@app.command("simulate")
def simulate_command(
    folder: OutOption = Path("simulated"),
    number: Annotated[int, typer.Option("--number", "-n", help="How many phytomers.", min=1)] = 1,
    species: SpeciesOption = FIT["species"],
    parameters: Annotated[
        list[str] | None,
        typer.Option("--set", help="NAME=VALUE fixes a parameter that is else drawn from the species' range."),
    ] = None,
    points: Annotated[int, typer.Option(help="Points on each, before spheres are removed.")] = SIMULATE["n_points"],
    noise: Annotated[float, typer.Option(help="Gaussian noise a coordinate, cm.")] = SIMULATE["noise_cm"],
    spheres: Annotated[int, typer.Option(help="Spheres removed from each.")] = SIMULATE["n_spheres"],
    sphere_diameter: Annotated[float, typer.Option(help="Their diameter, cm.")] = SIMULATE["sphere_diameter_cm"],
    outliers: Annotated[float, typer.Option(help="Share of outliers added.")] = SIMULATE["outlier_share"],
    upright: Annotated[
        bool, typer.Option("--upright", help="Stem along +z, leaf towards +x; else a random pose.")
    ] = False,
    seed: Seed = SIMULATE["seed"],
) -> None:
    """Draw phytomers from a species' ranges and scan them: clouds with their true parameters and traits.

    Writes DIR/phytomer_0001.ply (cm, with labels) and phytomer_0001.json a phytomer, and DIR/truth.csv over all.

    Example:

        phytofit simulate --number 10 --noise 0.5 --spheres 1 --set leaf_length=60 --out simulated
    """
    chosen = _or_exit(lambda: load_species(species))
    fixed = _or_exit(lambda: _parse_parameters(parameters or [], chosen))
    _or_exit(lambda: prepare_folder(folder))
    tables = []
    for i in range(number):
        made = _or_exit(
            lambda i=i: simulate(
                chosen,
                fixed=fixed,
                n_points=points,
                noise_cm=noise,
                n_spheres=spheres,
                sphere_diameter_cm=sphere_diameter,
                outlier_share=outliers,
                random_orientation=not upright,
                seed=seed + i,
            )
        )
        name = f"phytomer_{i + 1:04d}"
        _or_exit(lambda made=made, name=name: _write_simulated(made, chosen, folder, name))
        tables.append(trait_table(name, measure(made.organs, method="truth")))
    _or_exit(lambda: write_text(folder / "truth.csv", table_text(pd.concat(tables))))
    out.print(f"{number} phytomers in {folder}, their true traits in {folder / 'truth.csv'}", highlight=False)


@app.command("demo")
def demo_command(folder: OutOption = Path("demo"), seed: Seed = 7) -> None:
    """Simulate a noisy, partly hidden phytomer, fit it, and show estimate beside truth.

    Needs no data and no screen; the picture to look at is DIR/phytomer_0001/fit.png.
    """
    _or_exit(lambda: prepare_folder(folder))
    species = load_species()
    made = simulate(species, n_spheres=2, seed=seed)
    cloud_file = folder / "phytomer_0001.ply"
    _or_exit(lambda: _write_simulated(made, species, folder, "phytomer_0001"))
    out.print(
        f"Simulated a phytomer: {len(made.points)} points, 0.5 cm noise, two 6 cm spheres cut out, "
        f"random pose.\nMeasuring it: phytofit fit {cloud_file} --units cm --out {folder}",
        highlight=False,
    )
    cloud = _or_exit(lambda: read_cloud(cloud_file, "cm"))
    generations = defaults(CrossEntropy.__init__)["n_generations"]
    result = _or_exit(lambda: _fit_with_progress(cloud, cloud.name, generations, {"species": species, "seed": seed}))
    where = _or_exit(lambda: save_fit(result, cloud, folder))
    table = Table(title="Estimate beside truth")
    for column in ("trait", "estimate", "truth", "unit"):
        table.add_column(column, justify="right" if column in ("estimate", "truth") else "left")
    for estimate, truth in zip(result.traits, measure(made.organs), strict=True):
        table.add_row(estimate.name, f"{estimate.value:.2f}", f"{truth.value:.2f}", estimate.unit)
    out.print(table)
    _print_remarks(result)
    out.print(f"The model on the points: {where / 'fit.png'}", highlight=False)


@app.command("recipe")
def recipe_command() -> None:
    """Print every setting with its default, as JSON; each result's fit.json stores its own under "settings"."""
    out.print_json(json.dumps(recipe()))


def _read(path: Path, units: str | None, labels: str) -> PointCloud:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they stand in the cloud's notes, which are printed
        return read_cloud(path, units, label_property=labels)


def _fit_with_progress(cloud: PointCloud, name: str, generations: int, settings: dict[str, Any]) -> Fit:
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[errors]}"))
    with Progress(*columns, TimeElapsedColumn(), console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(f"{name}: start pose", total=generations, errors="")

        def told(generation: Generation) -> None:
            errors = f"best {generation.best_error:.2f}, elite {generation.threshold:.2f}"
            bar.update(task, completed=generation.index, description=f"{name}: search", errors=errors)

        return fit(cloud, progress=told, **settings)


def _print_fit(result: Fit, name: str, where: Path) -> None:
    table = Table(title=name)
    for column in ("organ", "trait", "value", "unit"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for trait in result.traits:
        table.add_row(trait.organ, trait.name, f"{trait.value:.2f}", trait.unit)
    out.print(table)
    _print_remarks(result)
    error = f"{result.error:.2f} {'relative' if result.relative else 'cm'}"
    out.print(
        f"{result.settings['distance']} distance {error}; model on the points: {where / 'fit.png'}", highlight=False
    )


def _print_remarks(result: Fit) -> None:
    for note in result.notes:
        out.print(f"note: {note}", highlight=False)
    for flag in result.flags:
        out.print(f"[bold yellow]flag:[/] {flag}", highlight=False)


def _parse_parameters(texts: list[str], species: Species) -> dict[str, float]:
    fixed = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            fixed[name] = float(value)
        except ValueError:
            raise SettingError(f"--set {text}: expected NAME=NUMBER, for example leaf_length=60") from None
        species.space.index(name)
    return fixed


def _write_simulated(made: SimulatedPhytomer, species: Species, folder: Path, name: str) -> None:
    write_cloud(folder / f"{name}.ply", PointCloud(made.points, labels=made.labels, name=name))
    truth = {
        "parameters": dict(zip(species.space.names, made.x.tolist(), strict=True)),
        "traits": {t.name: t.value for t in measure(made.organs)},
        "pose": made.pose.tolist(),
        "units": "cm, deg",
    }
    write_text(folder / f"{name}.json", json.dumps(truth, indent=1) + "\n")


def _complain(error: Exception | str) -> None:
    err.print(f"[bold red]error:[/] {' '.join(str(error).split())}", highlight=False, soft_wrap=True)


def _or_exit(call: Any) -> Any:
    """What the call returns; or one line and exit code 2."""
    try:
        return call()
    except PhytofitError as error:
        _complain(error)
        raise typer.Exit(2) from None


def main() -> None:
    """Entry point of the ``phytofit`` command."""
    try:
        app()
    except KeyboardInterrupt:
        err.print("stopped; results that were finished are kept")
        sys.exit(130)
