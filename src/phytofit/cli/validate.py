"""The command that says how good results are: against hand measures, or in a simulation of the user's sensor."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from phytofit.cli.console import command, err, out, progress_line, remark, results_in, say, show
from phytofit.cli.options import (
    MOST_POINTS,
    NoiseOption,
    NoiseReachOption,
    OutliersOption,
    OutOption,
    Seed,
    SpeciesOption,
    SphereDiameterOption,
    SpheresOption,
    ThreadsOption,
    ViewsOption,
    numeric,
    only,
)
from phytofit.cli.settings import defaults_of
from phytofit.errors import InputError, NoPhytomerError
from phytofit.text import for_terminal

if TYPE_CHECKING:
    import pandas as pd

    from phytofit.species import Species
    from phytofit.validation import Agreement
    from phytofit.validation.trials import Trial

__all__ = ["validate_command"]

SHOWN = ("n", "bias", "RMSE", "R", "CCC", "covered")  # of an agreement, on the screen
SIMULATE = defaults_of("simulation", "simulate")
OF_SIMULATION = [  # options that describe a sensor, and what is simulated
    *("points", "noise", "noise_reach", "views", "spheres", "sphere_diameter", "outliers"),
    *("number", "within", "within_deg", "species", "seed", "threads"),
]
SPECIES = defaults_of("species", "load_species")["species"]


@command("validate")
def validate_command(
    context: typer.Context,
    results: Annotated[
        Path | None,
        typer.Argument(help="Folder of results of phytofit fit or run, or a traits.csv or .xlsx.", show_default=False),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Hand measures, CSV or .xlsx: a row for each cloud, columns like leaf_length_cm, 'Leaf angle (deg)'."
        ),
    ] = None,
    simulated: Annotated[
        bool,
        typer.Option("--simulate", metavar="", help="Simulate phytomers and your sensor instead of reading results."),
    ] = False,
    points: Annotated[
        int, numeric("Number of points that your sensor records on a phytomer.", least=1, most=MOST_POINTS)
    ] = SIMULATE["n_points"],
    noise: NoiseOption = SIMULATE["noise_cm"],
    noise_reach: NoiseReachOption = SIMULATE["noise_reach_cm"],
    views: ViewsOption = SIMULATE["n_views"],
    spheres: SpheresOption = SIMULATE["n_spheres"],
    sphere_diameter: SphereDiameterOption = SIMULATE["sphere_diameter_cm"],
    outliers: OutliersOption = SIMULATE["outlier_share"],
    number: Annotated[
        int, numeric("How many phytomers for each setting of the sensor.", "--number", "-n", least=3, most=9999)
    ] = 30,
    within: Annotated[float, numeric("How near the truth lengths should be, %.", least=0)] = 5.0,
    within_deg: Annotated[float, numeric("How near the truth the leaf angle should be, degrees.", least=0)] = 3.0,
    species: SpeciesOption = SPECIES,
    seed: Seed = SIMULATE["seed"],
    threads: ThreadsOption = None,
    folder: OutOption = Path("validation"),
) -> None:
    """Compare results with hand measures, or predict how accurate your sensor would be.

    With --truth: results beside hand measures; bias, errors, correlation, concordance, limits of agreement, coverage.
    With --simulate: phytomers drawn from the species' ranges, scanned with your noise, points, cameras and occlusion,
    and fitted; the same numbers, and how many points and how many cameras you need. The options from --points to
    --threads are for --simulate.

    Prints a table and writes DIR/validation.html (the same with plots, in one file), DIR/validation.csv (the
    statistics) and DIR/pairs.csv (each cloud and trait); with --simulate also DIR/needs.csv.

    Examples:

        phytofit validate results --truth measurements.csv

        phytofit validate --simulate --noise 0.3 --points 2000 --views 3 --spheres 1
    """
    from phytofit.simulation import simulate
    from phytofit.species import load_species

    if simulated in (truth is not None, results is not None):
        raise InputError(
            "expected a folder of results with --truth measurements.csv, or --simulate without either; "
            "see phytofit validate --help"
        )
    if results is not None and truth is not None:
        only(context, OF_SIMULATION, "for --simulate; leave it out with --truth")
        _against_the_hand(results, truth, folder)
        return
    sensor: dict[str, Any] = {
        "n_points": points,
        "noise_cm": noise,
        "noise_reach_cm": noise_reach,
        "n_views": views,
        "n_spheres": spheres,
        "sphere_diameter_cm": sphere_diameter,
        "outlier_share": outliers,
    }
    chosen = load_species(species)
    checked = {**sensor, "n_spheres": min(spheres, 0)}  # how many points spheres leave differs from leaf to leaf
    simulate(chosen, seed=seed, **checked)
    with results_in(folder):
        trials = _tried(sensor, chosen, number, seed, threads)
        base = trials["the sensor"][0]
        if base.comparison.pairs.empty:
            raise NoPhytomerError(
                f"none of the {number} simulated clouds could be fitted: {base.comparison.unmatched[0]}"
            )
        _tell(base, {name: made for name, made in trials.items() if name != "the sensor"}, within, within_deg, folder)


def _against_the_hand(results: Path, truth: Path, folder: Path) -> None:
    from phytofit.report import agreement_page
    from phytofit.validation import agreement, compare, listed, read_measures, read_results

    measures = read_measures(truth)
    given = read_results(results)
    comparison = compare(measures, given)
    found = agreement(comparison.pairs)
    if not found:
        raise InputError(
            f"{truth}: none of its clouds and traits has a result in {results}; expected names such as "
            f"{listed(given['cloud'].unique().tolist())}, found {listed(measures['cloud'].unique().tolist())}"
        )
    with results_in(folder):
        for text in (*comparison.notes, *comparison.unmatched):
            remark("note", text)
        page = agreement_page(comparison, found, f"Results in {results.name} against {truth.name}")
        _write(folder, comparison.pairs, found, page)
        _show(found, f"{results} against {truth.name}")
        for a in found:
            if a.outliers:
                remark("note", f"{a.trait} is far off in {', '.join(a.outliers)}")
        say(f"With plots: {folder / 'validation.html'}")


def _tried(
    sensor: Mapping[str, Any], species: "Species", number: int, seed: int, threads: int | None
) -> "dict[str, dict[int, Trial]]":
    """The sensor as it was described (under 0), and with other numbers of points and of cameras."""
    from phytofit.validation.trials import N_POINTS, N_VIEWS, trial, vary

    steps = {
        "n_points": sorted({*N_POINTS, sensor["n_points"]}),
        "n_views": sorted({*N_VIEWS, *((sensor["n_views"],) if sensor["n_views"] else ())}),
    }
    runs = 1 + sum(value != sensor[name] for name, values in steps.items() for value in values)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(
        *columns, TimeRemainingColumn(), console=err, transient=True, disable=not err.is_terminal or out.quiet
    ) as bar:
        task = bar.add_task("simulated phytomers", total=runs * number)

        def done() -> None:
            if bar.tasks[0].completed % number == 0:
                progress_line(f"simulated phytomers: sensor {round(bar.tasks[0].completed / number) + 1} of {runs}")
            bar.advance(task)

        base = trial(sensor, species, number=number, seed=seed, threads=threads, progress=done)
        if base.comparison.pairs.empty:
            return {"the sensor": {0: base}}
        return {
            "the sensor": {0: base},
            "points": vary(base, "n_points", steps["n_points"], species, seed=seed, threads=threads, progress=done),
            "cameras": vary(base, "n_views", steps["n_views"], species, seed=seed, threads=threads, progress=done),
        }


def _tell(
    base: "Trial", trials: "Mapping[str, Mapping[int, Trial]]", percent: float, degrees: float, folder: Path
) -> None:
    import pandas as pd

    from phytofit.report import trial_page
    from phytofit.validation import agreement
    from phytofit.validation.trials import ENOUGH, needed, trial_table

    found = agreement(base.comparison.pairs)
    needs = pd.concat([trial_table(name, made, percent, degrees) for name, made in trials.items()])
    answers = []
    for name, made in trials.items():
        for trait, (least, most) in needed(made, percent, degrees).items():
            near = f"{degrees:g}°" if "angle" in trait else f"{percent:g} %"
            said = f"{trait.replace('_', ' ')} within {near} of the truth in nine of ten: "
            if least is not None:
                answers.append(f"{said}with {least:,} {name if least > 1 else name[:-1]} or more")
            elif most >= ENOUGH:
                answers.append(f"{said}{base.n} phytomers can't tell; raise --number")
            else:
                answers.append(f"{said}not with up to {max(made):,} {name} (at best in {100 * most:.0f} %)")
    title = f"{base.n} simulated phytomers, {_described(base.sensor)}"
    page = trial_page(base, needs, answers, percent, degrees, title)
    _write(folder, base.comparison.pairs, found, page, needs=needs)
    _show(found, title)
    for text in (*base.comparison.unmatched, *answers):
        say(text)
    say(f"With plots: {folder / 'validation.html'}")


def _described(sensor: Mapping[str, Any]) -> str:
    parts = [f"{sensor['n_points']:,} points", f"{sensor['noise_cm']:g} cm noise"]
    if sensor["noise_reach_cm"]:
        parts[-1] += f" shared over {sensor['noise_reach_cm']:g} cm"
    parts.append("seen from everywhere" if sensor["n_views"] is None else f"{sensor['n_views']} cameras")
    if sensor["n_spheres"]:
        parts.append(f"{sensor['n_spheres']} x sphere of {sensor['sphere_diameter_cm']:g} cm removed")
    if sensor["outlier_share"]:
        parts.append(f"{100 * sensor['outlier_share']:g} % outliers")
    return ", ".join(parts)


def _write(
    folder: Path, pairs: "pd.DataFrame", found: "Sequence[Agreement]", page: str, **others: "pd.DataFrame"
) -> None:
    import pandas as pd

    from phytofit.report import save_validation

    statistics = pd.DataFrame(found).assign(outliers=["; ".join(a.outliers) for a in found])
    save_validation(folder, {"pairs": pairs, "validation": statistics, **others}, page)


def _show(found: "Sequence[Agreement]", title: str) -> None:
    from phytofit.report import agreement_table

    shown = agreement_table(found)
    table = Table(title=for_terminal(title), box=SIMPLE_HEAD, pad_edge=False)
    for column in ("trait", *SHOWN):
        table.add_column(column, justify="left" if column == "trait" else "right", no_wrap=True)
    for name, row in zip(shown.index, shown[list(SHOWN)].to_numpy(), strict=True):
        table.add_row(str(name), *row)
    show(table)
    graded = [sum(numbers) for numbers in zip(*((a.n, a.good, a.check, a.poor) for a in found), strict=True)]
    if any(graded[1:]):
        say("of {} values, {} are good, {} to be checked, {} poor: do not use".format(*graded))
    else:
        say("the results do not say how good they are: they are of an earlier version of phytofit")
