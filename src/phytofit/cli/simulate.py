"""The command that makes clouds whose truth is known."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from phytofit.cli.console import app, or_exit, tell
from phytofit.cli.options import (
    NoiseOption,
    NoiseReachOption,
    OutliersOption,
    OutOption,
    Seed,
    SpeciesOption,
    SphereDiameterOption,
    SpheresOption,
    ViewsOption,
)
from phytofit.cli.settings import defaults_of, entries_of
from phytofit.errors import SettingError

if TYPE_CHECKING:
    from phytofit.species import Species

__all__ = ["simulate_command"]

SPECIES = defaults_of("species", "load_species")["species"]
STEM_ABOVE = "|".join(entries_of("species", "STEM_ABOVE"))
SIMULATE = defaults_of("simulation", "simulate")


@app.command("simulate")
def simulate_command(
    folder: OutOption = Path("simulated"),
    number: Annotated[int, typer.Option("--number", "-n", help="How many phytomers.", min=1)] = 1,
    species: SpeciesOption = SPECIES,
    parameters: Annotated[
        list[str] | None,
        typer.Option("--set", help="NAME=VALUE fixes a parameter that is else drawn from the species' range."),
    ] = None,
    stem_above: Annotated[
        str,
        typer.Option(metavar=STEM_ABOVE, help="The stem above the leaf: as long as below it, not there, or drawn too."),
    ] = SIMULATE["stem_above"],
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
    from phytofit.results import prepare_folder, save_simulated
    from phytofit.simulation import simulate
    from phytofit.species import load_species

    chosen = or_exit(lambda: load_species(species))
    fixed = or_exit(lambda: _parse_parameters(parameters or [], chosen))
    or_exit(lambda: prepare_folder(folder))
    made = (
        simulate(
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
        for i in range(number)
    )
    or_exit(lambda: save_simulated(made, chosen, folder))
    tell(f"{number} phytomers in {folder}, their true traits in {folder / 'truth.csv'}")


def _parse_parameters(texts: list[str], species: "Species") -> dict[str, float]:
    fixed = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            fixed[name] = float(value)
        except ValueError:
            raise SettingError(f"--set {text}: expected NAME=NUMBER, for example leaf_length=60") from None
        species.space.index(name)
    return fixed
