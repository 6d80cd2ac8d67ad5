"""The command that makes clouds whose truth is known."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    from phytofit.simulation import SimulatedPhytomer
    from phytofit.species import Species

__all__ = ["simulate_command"]

SPECIES = defaults_of("species", "load_species")["species"]
STEM_ABOVE = [*entries_of("species", "STEM_ABOVE")]
SIMULATE = defaults_of("simulation", "simulate")


@command("simulate")
def simulate_command(
    context: typer.Context,
    folder: OutOption = Path("simulated"),
    number: Annotated[int, numeric("How many phytomers.", "--number", "-n", least=1, most=9999)] = 1,
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
        int, numeric("Points on each, before spheres are removed.", least=1, most=MOST_POINTS)
    ] = SIMULATE["n_points"],
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
    """Draw phytomers from a species' ranges and scan them: clouds with their true parameters and traits.

    Writes DIR/phytomer_0001.ply (cm, with labels), phytomer_0001.json (its truth) and so on; DIR/truth.csv over all.

    Example:

        phytofit simulate --number 10 --noise 0.5 --spheres 1 --set leaf_length=60 --out simulated
    """
    from phytofit.io import save_simulated
    from phytofit.simulation import simulate
    from phytofit.species import load_species

    if not spheres:
        only(context, ["sphere_diameter"], "it changes nothing without --spheres; leave it out")
    chosen = load_species(species)
    fixed = _parse_parameters(parameters or [], chosen)
    with results_in(folder):
        phytomers = Items(1, "phytomer")
        with phytomers.item(0, "simulated phytomers") as told:

            def drawn() -> Iterator["SimulatedPhytomer"]:
                for i in range(number):
                    told(f"{i + 1} of {number}", i / number)
                    yield simulate(
                        chosen,
                        fixed=fixed,
                        stem_above=stem_above,
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

            save_simulated(drawn(), chosen, folder)
        say(f"{number} {'phytomers' if number > 1 else 'phytomer'} in {folder}, true traits in {folder / 'truth.csv'}")


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
