"""The command that shows what phytofit does, without any data."""

from pathlib import Path

from rich.table import Table

from phytofit.cli.console import command, results_in, say, show
from phytofit.cli.fit import fit_in_view
from phytofit.cli.options import OutOption, Seed
from phytofit.cli.progress import Items
from phytofit.cli.tables import graded, print_remarks

__all__ = ["demo_command"]


@command("demo")
def demo_command(folder: OutOption = Path("demo"), seed: Seed = 7) -> None:
    """Simulate a noisy, partly hidden phytomer, fit it, and show estimate beside truth.

    Needs no data and no screen; the picture to look at is DIR/phytomer_0001/fit.png.

    Example:

        phytofit demo --out demo
    """
    from phytofit.cloud import read_cloud
    from phytofit.io import save_fit, save_simulated
    from phytofit.results import Placed
    from phytofit.simulation import simulate
    from phytofit.species import load_species
    from phytofit.traits import measure

    with results_in(folder):
        species = load_species()
        made = simulate(species, n_spheres=2, seed=seed)
        cloud_file = save_simulated([made], species, folder, with_labels=False, table=False)[0]
        say(f"Simulated a phytomer: {len(made.points)} points, 0.5 cm noise, two 6 cm spheres cut out, random pose.")
        say(f"Measuring it: phytofit fit {cloud_file} --units cm --out {folder}")
        cloud = read_cloud(cloud_file, "cm")
        with Items(1, "cloud").item(0, cloud.name) as told:
            result = fit_in_view(cloud, {"species": species, "seed": seed}, told)
        where = save_fit(result, cloud, folder)
        table = Table(title="Estimate beside truth")
        for column in ("trait", "estimate", "95 % interval", "truth", "unit", "quality"):
            table.add_column(column, justify="left" if column in ("trait", "unit", "quality") else "right")
        for estimate, truth in zip(result.traits, measure(made.organs), strict=True):
            numbers = (f"{estimate.value:.2f}", estimate.interval, f"{truth.value:.2f}")
            table.add_row(estimate.name, *numbers, estimate.unit, graded(estimate.quality))
        show(table)
        print_remarks(result.notes, map(Placed, result.remarks))
        say(f"The model on the points: {where / 'fit.png'}")
