"""The command that shows what phytofit does, without any data."""

from pathlib import Path

from rich.table import Table

from phytofit.cli.console import app, or_exit, out, tell
from phytofit.cli.fit import fit_with_progress
from phytofit.cli.options import OutOption, Seed
from phytofit.cli.tables import interval, print_remarks

__all__ = ["demo_command"]


@app.command("demo")
def demo_command(folder: OutOption = Path("demo"), seed: Seed = 7) -> None:
    """Simulate a noisy, partly hidden phytomer, fit it, and show estimate beside truth.

    Needs no data and no screen; the picture to look at is DIR/phytomer_0001/fit.png.
    """
    from phytofit.cloud import read_cloud
    from phytofit.results import prepare_folder, save_fit, save_simulated
    from phytofit.simulation import simulate
    from phytofit.species import load_species
    from phytofit.traits import measure

    or_exit(lambda: prepare_folder(folder))
    species = load_species()
    made = simulate(species, n_spheres=2, seed=seed)
    cloud_file = or_exit(lambda: save_simulated([made], species, folder, with_labels=False, table=False))[0]
    tell(f"Simulated a phytomer: {len(made.points)} points, 0.5 cm noise, two 6 cm spheres cut out, random pose.")
    tell(f"Measuring it: phytofit fit {cloud_file} --units cm --out {folder}")
    cloud = or_exit(lambda: read_cloud(cloud_file, "cm"))
    result = or_exit(lambda: fit_with_progress(cloud, cloud.name, {"species": species, "seed": seed}))
    where = or_exit(lambda: save_fit(result, cloud, folder))
    table = Table(title="Estimate beside truth")
    for column in ("trait", "estimate", "95 % interval", "truth", "unit"):
        table.add_column(column, justify="left" if column in ("trait", "unit") else "right")
    for estimate, truth in zip(result.traits, measure(made.organs), strict=True):
        table.add_row(estimate.name, f"{estimate.value:.2f}", interval(estimate), f"{truth.value:.2f}", estimate.unit)
    out.print(table)
    print_remarks(result)
    tell(f"The model on the points: {where / 'fit.png'}")
