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
from phytofit.fitting import METHODS, Fit, fit
from phytofit.formats import read_cloud, write_cloud
from phytofit.optimize import Generation
from phytofit.preparation import AXES, parse_up
from phytofit.recipe import defaults, recipe
from phytofit.report import agreement_page, agreement_table
from phytofit.results import (
    leaf_table,
    prepare_folder,
    result_names,
    save_fit,
    save_segmentation,
    table_text,
    trait_table,
    write_text,
)
from phytofit.segmentation import Segmentation, segment
from phytofit.simulation import SimulatedPhytomer, simulate
from phytofit.species import Species, load_species, species_names
from phytofit.traits import Trait, measure
from phytofit.validation import agreement, compare, read_measures, read_results

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
PLANT_CM = (3.0, 500.0)  # sizes that are believed of a whole plant, from the seedling on
SHOWN = ("n", "bias", "RMSE", "R", "CCC", "covered", "flagged")  # of an agreement, on the screen


def _by_method(setting: str) -> str:
    return ", ".join(f"{defaults(function)[setting]} for {name}" for name, function in METHODS.items())


Seed = Annotated[int, typer.Option(help="The same seed gives the same result.", min=0)]
SpeciesOption = Annotated[
    str, typer.Option(help=f"A species that comes with phytofit ({', '.join(species_names())}), or a TOML file.")
]
UnitsOption = Annotated[
    str | None, typer.Option("--units", "-u", help="Unit of the coordinates: cm, mm, m; none: relative lengths.")
]
UpOption = Annotated[str | None, typer.Option(help=f"Upward direction where it is known: {', '.join(AXES)}.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.", file_okay=True)]


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
            help="A point on the leaf that is meant, where the cloud shows others too; repeat for a leaf in pieces.",
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
        typer.Option(help=f"What --method paper minimises: {', '.join(DISTANCES)}; hausdorff by default."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(help=f"Candidates a generation of the search; by default {_by_method('n_samples')}.")
    ] = None,
    points: Annotated[
        int, typer.Option(help="Points of the cloud after thinning; for --method paper also of a candidate.")
    ] = FIT["n_points"],
    generations: Annotated[
        int | None, typer.Option(help=f"Generations of the search; by default {_by_method('n_generations')}.")
    ] = None,
    random_start: Annotated[
        bool, typer.Option("--random-start", help="Start from means drawn from the prior (Fig. 7d of the paper).")
    ] = FIT["random_start"],
    stem_above: Annotated[
        bool,
        typer.Option(
            "--stem-above/--no-stem-above",
            help="Whether the stem may go on above the leaf; without, the paper's six parameters only.",
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

        phytofit fit crowded.ply --units cm --seed-point 12.5,-3,40
    """
    seed_points = _or_exit(lambda: _seed_points(seed_point or [], len(clouds)))
    chosen = _or_exit(lambda: load_species(species))
    _or_exit(lambda: prepare_folder(folder))
    _or_exit(lambda: parse_up(up))
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
    tables = []
    for path, name in zip(clouds, result_names(clouds), strict=True):
        try:
            cloud = _read(path, units, labels)
            result = _fit_with_progress(cloud, name, settings)
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


@app.command("segment")
def segment_command(
    clouds: Annotated[list[Path], typer.Argument(help="Clouds of whole plants: PLY, PCD, LAS/LAZ, XYZ, TXT, CSV, ...")],
    units: UnitsOption = None,
    up: UpOption = None,
    labels: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Take stem and leaves from this property (1 stem, 2.. leaves) instead of finding them: "
            "`label` in a corrected plant.ply.",
        ),
    ] = None,
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
    _or_exit(lambda: prepare_folder(folder))
    _or_exit(lambda: parse_up(up))
    tables = []
    for path, name in zip(clouds, result_names(clouds), strict=True):
        try:
            with err.status(f"{name}: looking for stem and leaves"):
                cloud = _read(path, units, labels or "label", plausible_cm=PLANT_CM)
                result = segment(cloud, up=up, labelled=labels is not None)
                where = save_segmentation(result, folder, name)
        except PhytofitError as error:
            _complain(error if str(path) in str(error) or path.name in str(error) else f"{path}: {error}")
            continue
        tables.append(leaf_table(name, result))
        _print_leaves(result, name, where)
    if tables:
        _or_exit(lambda: write_text(folder / "leaves.csv", table_text(pd.concat(tables))))
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
    _or_exit(lambda: _write_simulated(made, species, folder, "phytomer_0001", labels=False))
    out.print(
        f"Simulated a phytomer: {len(made.points)} points, 0.5 cm noise, two 6 cm spheres cut out, "
        f"random pose.\nMeasuring it: phytofit fit {cloud_file} --units cm --out {folder}",
        highlight=False,
    )
    cloud = _or_exit(lambda: read_cloud(cloud_file, "cm"))
    result = _or_exit(lambda: _fit_with_progress(cloud, cloud.name, {"species": species, "seed": seed}))
    where = _or_exit(lambda: save_fit(result, cloud, folder))
    table = Table(title="Estimate beside truth")
    for column in ("trait", "estimate", "95 % interval", "truth", "unit"):
        table.add_column(column, justify="left" if column in ("trait", "unit") else "right")
    for estimate, truth in zip(result.traits, measure(made.organs), strict=True):
        table.add_row(estimate.name, f"{estimate.value:.2f}", _interval(estimate), f"{truth.value:.2f}", estimate.unit)
    out.print(table)
    _print_remarks(result)
    out.print(f"The model on the points: {where / 'fit.png'}", highlight=False)


@app.command("validate")
def validate_command(
    results: Annotated[Path, typer.Argument(help="Folder of results of `phytofit fit`, or its traits.csv.")],
    truth: Annotated[
        Path,
        typer.Option(help="CSV of hand measures: a row a cloud, columns such as leaf_length_cm, 'Leaf angle (deg)'."),
    ],
    folder: OutOption = Path("validation"),
) -> None:
    """Compare results with hand measures: bias, errors, correlation, concordance, limits of agreement, coverage.

    Prints a table and writes DIR/validation.html (the same with plots, in one file), DIR/validation.csv (the
    statistics) and DIR/pairs.csv (each cloud and trait that both have).

    Example:

        phytofit validate results --truth measurements.csv
    """
    measures = _or_exit(lambda: read_measures(truth))
    comparison = _or_exit(lambda: compare(measures, read_results(results)))
    found = agreement(comparison.pairs)
    for text in comparison.unmatched:
        out.print(f"note: {text}", highlight=False)
    if not found:
        _complain(
            f"{truth}: none of its clouds and traits is among those of {results}; are the clouds' names the same?"
        )
        raise typer.Exit(2)
    _or_exit(lambda: prepare_folder(folder))
    shown = agreement_table(found)
    table = Table(title=f"{results} against {truth.name}")
    for column in ("trait", *SHOWN):
        table.add_column(column, justify="left" if column == "trait" else "right", no_wrap=True)
    for name, row in zip(shown.index, shown[list(SHOWN)].to_numpy(), strict=True):
        table.add_row(str(name), *row)
    page = agreement_page(comparison, found, f"Results in {results.name} against {truth.name}")
    statistics = pd.DataFrame(found).assign(outliers=["; ".join(a.outliers) for a in found])
    _or_exit(lambda: write_text(folder / "pairs.csv", table_text(comparison.pairs)))
    _or_exit(lambda: write_text(folder / "validation.csv", table_text(statistics)))
    _or_exit(lambda: write_text(folder / "validation.html", page))
    out.print(table)
    for a in found:
        if a.outliers:
            out.print(f"note: {a.trait} is far off in {', '.join(a.outliers)}", highlight=False)
    out.print(f"With plots: {folder / 'validation.html'}", highlight=False)


@app.command("recipe")
def recipe_command() -> None:
    """Print every setting with its default, as JSON; each result's fit.json stores its own under "settings"."""
    out.print_json(json.dumps(recipe()))


def _read(path: Path, units: str | None, labels: str, **how: Any) -> PointCloud:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they stand in the cloud's notes, which are printed
        return read_cloud(path, units, label_property=labels, **how)


def _fit_with_progress(cloud: PointCloud, name: str, settings: dict[str, Any]) -> Fit:
    by_default = defaults(METHODS.get(settings.get("method", FIT["method"]), fit))["n_generations"]
    generations = settings.get("n_generations") or by_default
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[errors]}"))
    with Progress(*columns, TimeElapsedColumn(), console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(f"{name}: start pose", total=generations, errors="")

        def told(generation: Generation) -> None:
            errors = f"best {generation.best_error:.2f}, elite {generation.threshold:.2f}"
            bar.update(task, completed=generation.index, description=f"{name}: search", errors=errors)

        return fit(cloud, progress=told, **settings)


def _print_fit(result: Fit, name: str, where: Path) -> None:
    table = Table(title=name)
    for column in ("organ", "trait", "value", "95 % interval", "unit"):
        table.add_column(column, justify="right" if column in ("value", "95 % interval") else "left")
    for trait in result.traits:
        table.add_row(trait.organ, trait.name, f"{trait.value:.2f}", _interval(trait), trait.unit)
    out.print(table)
    _print_remarks(result)
    unit = "relative" if result.relative else "cm"
    if result.estimate is None:
        said = f"{result.settings['distance']} distance {result.error:.2f} {unit}"
    else:
        stem, leaf, thickness = result.estimate.noise * result.scale
        said = (
            f"noise {stem:.2f} {unit} on the stem, {leaf:.2f} on the leaf, {thickness:.2f} more across it; "
            f"{100 * result.estimate.share[2]:.0f} % outliers"
        )
    out.print(f"{said}; model on the points: {where / 'fit.png'}", highlight=False)


def _interval(trait: Trait) -> str:
    low, high = ("" if end is None else f"{end:.2f}" for end in (trait.low, trait.high))
    return f"{low} – {high}" if low or high else ""


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


def _write_simulated(
    made: SimulatedPhytomer, species: Species, folder: Path, name: str, *, labels: bool = True
) -> None:
    write_cloud(folder / f"{name}.ply", PointCloud(made.points, labels=made.labels if labels else None, name=name))
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
