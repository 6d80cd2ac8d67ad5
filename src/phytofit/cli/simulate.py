"""The command that makes clouds whose truth is known."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from phytofit.cli.console import command, results_in, say
from phytofit.cli.messages import meant
from phytofit.cli.options import (
    MOST_POINTS,
    STEMS_ABOVE,
    NoiseOption,
    NoiseReachOption,
    OutliersOption,
    OutOption,
    Seed,
    SpeciesOption,
    SphereDiameterOption,
    SpheresOption,
    ViewsOption,
    choice,
    numeric,
    only,
)
from phytofit.cli.progress import Items
from phytofit.cli.settings import defaults_of, entries_of
from phytofit.errors import SettingError

if TYPE_CHECKING:
    from phytofit.species import Species

__all__ = ["simulate_command"]

SPECIES = defaults_of("species", "load_species")["species"]
STEM_ABOVE = [*entries_of("species", "STEM_ABOVE")]
SIMULATE, PLANTS = defaults_of("simulation", "simulate"), defaults_of("simulation", "simulate_plant")
FOR_PHYTOMERS = ["parameters", "stem_above", "spheres", "sphere_diameter"]


@command("simulate")
def simulate_command(
    context: typer.Context,
    folder: OutOption = Path("simulated"),
    number: Annotated[int, numeric("How many phytomers, or plants.", "--number", "-n", least=1, most=9999)] = 1,
    plant: Annotated[
        bool, typer.Option("--plant", metavar="", help="Whole plants, of all ages: a stem with its leaves.")
    ] = False,
    leaves: Annotated[
        int | None, numeric("Of each plant in the end; otherwise drawn.", "--leaves", least=1, most=100)
    ] = None,
    unfolded: Annotated[
        int | None, numeric("How many of them have unfolded; otherwise drawn.", "--unfolded", least=1, most=100)
    ] = None,
    species: SpeciesOption = SPECIES,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="Fix a parameter, which is otherwise drawn from the species' range."
        ),
    ] = None,
    stem_above: Annotated[
        str,
        choice(
            f"{STEMS_ABOVE}.",
            among=STEM_ABOVE,
        ),
    ] = SIMULATE["stem_above"],
    points: Annotated[
        int | None,
        numeric(
            f"Points on each, before spheres are removed; {SIMULATE['n_points']}, of plants {PLANTS['n_points']}.",
            least=1,
            most=MOST_POINTS,
        ),
    ] = None,
    noise: NoiseOption = SIMULATE["noise_cm"],
    noise_reach: NoiseReachOption = SIMULATE["noise_reach_cm"],
    views: ViewsOption = SIMULATE["n_views"],
    spheres: SpheresOption = SIMULATE["n_spheres"],
    sphere_diameter: SphereDiameterOption = SIMULATE["sphere_diameter_cm"],
    outliers: OutliersOption = SIMULATE["outlier_share"],
    upright: Annotated[
        bool, typer.Option("--upright", metavar="", help="Stem along +z, leaf towards +x; else a random pose.")
    ] = False,
    seed: Seed = SIMULATE["seed"],
) -> None:
    """Draw phytomers, or with --plant whole plants, of a species and scan them: clouds whose truth is known.

    Phytomers are drawn from the species' ranges, plants from its grammar. Writes DIR/phytomer_0001.ply (cm, with
    labels: 1 stem, 2 leaf), phytomer_0001.json (its truth) and so on; of plants, DIR/plant_0001.ply (labels: 1 stem, 2
    the lowest leaf, 3 the next), plant_0001_mesh.ply and plant_0001.json; DIR/truth.csv, the true traits, over all.

    Examples:

        phytofit simulate --number 10 --noise 0.5 --spheres 1 --set leaf_length=60 --out simulated

        phytofit simulate --plant --number 3 --views 6 --out plants
    """
    from phytofit.io import save_simulated, save_simulated_plants
    from phytofit.simulation import simulate, simulate_plant
    from phytofit.species import load_species

    if not spheres:
        only(context, ["sphere_diameter"], "it changes nothing without --spheres; leave it out")
    if plant:
        only(context, FOR_PHYTOMERS, "it is for phytomers; leave it or --plant out")
    else:
        only(context, ["leaves", "unfolded"], "it is for whole plants; add --plant or leave it out")
    chosen = load_species(species)
    fixed = _parse_parameters(parameters or [], chosen)
    scan: dict[str, Any] = {
        "noise_cm": noise,
        "noise_reach_cm": noise_reach,
        "n_views": views,
        "outlier_share": outliers,
        "random_orientation": not upright,
    } | ({} if points is None else {"n_points": points})
    kind = "plant" if plant else "phytomer"
    with results_in(folder):
        items = Items(1, kind)
        with items.item(0, f"simulated {kind}s") as told:

            def seeds() -> Iterator[int]:
                for i in range(number):
                    told(f"{i + 1} of {number}", i / number)
                    yield seed + i

            if plant:
                plants = (
                    simulate_plant(chosen, n_leaves=leaves, n_collars=unfolded, **scan, seed=one) for one in seeds()
                )
                save_simulated_plants(plants, folder)
            else:
                of_phytomer: dict[str, Any] = {
                    "n_spheres": spheres,
                    "sphere_diameter_cm": sphere_diameter,
                    "stem_above": stem_above,
                }
                phytomers = (simulate(chosen, fixed=fixed, **of_phytomer, **scan, seed=one) for one in seeds())
                save_simulated(phytomers, chosen, folder)
        say(f"{number} {kind}{'s' if number > 1 else ''} in {folder}, true traits in {folder / 'truth.csv'}")


def _parse_parameters(texts: list[str], species: "Species") -> dict[str, float]:
    fixed = {}
    names = list(species.space.names)
    for text in texts:
        name, _, value = text.partition("=")
        if name not in names:
            raise SettingError(f"--set {text}: expected one of {', '.join(names)}, got {name!r}{meant(name, names)}")
        try:
            fixed[name] = float(value)
        except ValueError:
            raise SettingError(f"--set {text}: expected NAME=NUMBER, for example leaf_length=60") from None
        if not math.isfinite(fixed[name]):
            raise SettingError(f"--set {text}: expected a finite number")
    return fixed
