"""The commands that measure one phytomer a cloud, and those that make such clouds: fit, simulate, demo, recipe."""

import json
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from phytofit.cli.console import (
    NoiseOption,
    NoiseReachOption,
    OutliersOption,
    OutOption,
    Seed,
    SpeciesOption,
    SphereDiameterOption,
    SpheresOption,
    ThreadsOption,
    UnitsOption,
    UpOption,
    ViewsOption,
    app,
    complain,
    err,
    or_exit,
    out,
    read_quietly,
)
from phytofit.cloud import PointCloud, read_cloud, write_cloud
from phytofit.distances import DISTANCES
from phytofit.errors import PhytofitError, SettingError
from phytofit.fitted import Fit
from phytofit.fitting import METHODS, fit
from phytofit.optimize import Generation
from phytofit.parsing import parse_up
from phytofit.recipe import defaults, recipe
from phytofit.results import prepare_folder, result_names, save_fit, table_text, trait_table, write_text
from phytofit.simulation import SimulatedPhytomer, simulate
from phytofit.species import Species, load_species
from phytofit.traits import Trait, measure

__all__ = ["demo_command", "fit_command", "recipe_command", "simulate_command"]

FIT = defaults(fit)
SIMULATE = defaults(simulate)


def _by_method(setting: str) -> str:
    return ", ".join(f"{defaults(function)[setting]} for {name}" for name, function in METHODS.items())


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
        typer.Option(help=f"What --method paper minimises: {', '.join(DISTANCES)}; hausdorff by default."),
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
        bool,
        typer.Option(
            "--stem-above/--no-stem-above",
            help="Whether the stem may go on above the leaf; without, the paper's six parameters only.",
        ),
    ] = FIT["stem_above"],
    labels: Annotated[str, typer.Option(help="Name of the label property (1 stem, 2.. leaves).")] = "label",
    seed: Seed = FIT["seed"],
    threads: ThreadsOption = None,
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
    seed_points = or_exit(lambda: _seed_points(seed_point or [], len(clouds)))
    chosen = or_exit(lambda: load_species(species))
    or_exit(lambda: prepare_folder(folder))
    or_exit(lambda: parse_up(up))
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
            cloud = read_quietly(path, units, labels)
            result = _fit_with_progress(cloud, name, settings)
            where = save_fit(result, cloud, folder, name)
        except SettingError as error:  # as wrong for every other cloud
            complain(error)
            raise typer.Exit(2) from None
        except PhytofitError as error:
            complain(error if str(path) in str(error) or path.name in str(error) else f"{path}: {error}")
            continue
        tables.append(trait_table(name, result.traits))
        _print_fit(result, name, where)
    if tables:
        or_exit(lambda: write_text(folder / "traits.csv", table_text(pd.concat(tables))))
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
    noise: NoiseOption = SIMULATE["noise_cm"],
    noise_reach: NoiseReachOption = SIMULATE["noise_reach_cm"],
    views: ViewsOption = SIMULATE["n_views"],
    spheres: SpheresOption = SIMULATE["n_spheres"],
    sphere_diameter: SphereDiameterOption = SIMULATE["sphere_diameter_cm"],
    outliers: OutliersOption = SIMULATE["outlier_share"],
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
    chosen = or_exit(lambda: load_species(species))
    fixed = or_exit(lambda: _parse_parameters(parameters or [], chosen))
    or_exit(lambda: prepare_folder(folder))
    tables = []
    for i in range(number):
        made = or_exit(
            lambda i=i: simulate(
                chosen,
                fixed=fixed,
                n_points=points,
                noise_cm=noise,
                noise_reach_cm=noise_reach,
                n_views=views,
                n_spheres=spheres,
                sphere_diameter_cm=sphere_diameter,
                outlier_share=outliers,
                random_orientation=not upright,
                seed=seed + i,
            )
        )
        name = f"phytomer_{i + 1:04d}"
        or_exit(lambda made=made, name=name: _write_simulated(made, chosen, folder, name))
        tables.append(trait_table(name, measure(made.organs, method="truth")))
    or_exit(lambda: write_text(folder / "truth.csv", table_text(pd.concat(tables))))
    out.print(f"{number} phytomers in {folder}, their true traits in {folder / 'truth.csv'}", highlight=False)


@app.command("demo")
def demo_command(folder: OutOption = Path("demo"), seed: Seed = 7) -> None:
    """Simulate a noisy, partly hidden phytomer, fit it, and show estimate beside truth.

    Needs no data and no screen; the picture to look at is DIR/phytomer_0001/fit.png.
    """
    or_exit(lambda: prepare_folder(folder))
    species = load_species()
    made = simulate(species, n_spheres=2, seed=seed)
    cloud_file = folder / "phytomer_0001.ply"
    or_exit(lambda: _write_simulated(made, species, folder, "phytomer_0001", labels=False))
    out.print(
        f"Simulated a phytomer: {len(made.points)} points, 0.5 cm noise, two 6 cm spheres cut out, "
        f"random pose.\nMeasuring it: phytofit fit {cloud_file} --units cm --out {folder}",
        highlight=False,
    )
    cloud = or_exit(lambda: read_cloud(cloud_file, "cm"))
    result = or_exit(lambda: _fit_with_progress(cloud, cloud.name, {"species": species, "seed": seed}))
    where = or_exit(lambda: save_fit(result, cloud, folder))
    table = Table(title="Estimate beside truth")
    for column in ("trait", "estimate", "95 % interval", "truth", "unit"):
        table.add_column(column, justify="left" if column in ("trait", "unit") else "right")
    for estimate, truth in zip(result.traits, measure(made.organs), strict=True):
        table.add_row(estimate.name, f"{estimate.value:.2f}", _interval(estimate), f"{truth.value:.2f}", estimate.unit)
    out.print(table)
    _print_remarks(result)
    out.print(f"The model on the points: {where / 'fit.png'}", highlight=False)


@app.command("recipe")
def recipe_command() -> None:
    """Print every setting with its default, as JSON; each result's fit.json stores its own under "settings"."""
    out.print_json(json.dumps(recipe()))


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
