"""What all commands share: the program, its two streams, options, and how an error is told."""

import warnings
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from phytofit.cloud import PointCloud, read_cloud
from phytofit.errors import PhytofitError
from phytofit.parsing import AXES
from phytofit.species import species_names

__all__ = [
    "NoiseOption",
    "NoiseReachOption",
    "OutOption",
    "OutliersOption",
    "Seed",
    "SpeciesOption",
    "SphereDiameterOption",
    "SpheresOption",
    "ThreadsOption",
    "UnitsOption",
    "UpOption",
    "ViewsOption",
    "app",
    "complain",
    "err",
    "or_exit",
    "out",
    "read_quietly",
]

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    help="Plant traits from 3D point clouds, by fitting parametric plant models.\n\n"
    "Start with `phytofit demo`; then `phytofit fit leaf.ply --units cm`.",
)
out = Console()
err = Console(stderr=True)

Seed = Annotated[int, typer.Option(help="The same seed gives the same result.", min=0)]
SpeciesOption = Annotated[
    str, typer.Option(help=f"A species that comes with phytofit ({', '.join(species_names())}), or a TOML file.")
]
ThreadsOption = Annotated[int | None, typer.Option(help="Threads to work with; all cores by default.")]
UnitsOption = Annotated[
    str | None, typer.Option("--units", "-u", help="Unit of the coordinates: cm, mm, m; none: relative lengths.")
]
UpOption = Annotated[str | None, typer.Option(help=f"Upward direction where it is known: {', '.join(AXES)}.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.", file_okay=True)]
NoiseOption = Annotated[float, typer.Option(help="Gaussian noise a coordinate, cm.")]
NoiseReachOption = Annotated[
    float, typer.Option(help="How far neighbours share their noise, as in fused and stereo clouds, cm; 0: independent.")
]
ViewsOption = Annotated[
    int | None, typer.Option(help="Cameras around the plant, which see what is not hidden; by default from everywhere.")
]
SpheresOption = Annotated[int, typer.Option(help="Spheres removed from each.")]
SphereDiameterOption = Annotated[float, typer.Option(help="Their diameter, cm.")]
OutliersOption = Annotated[float, typer.Option(help="Share of outliers added.")]


def complain(error: Exception | str) -> None:
    err.print(f"[bold red]error:[/] {' '.join(str(error).split())}", highlight=False, soft_wrap=True)


def or_exit(call: Any) -> Any:
    """What the call returns; or one line and exit code 2."""
    try:
        return call()
    except PhytofitError as error:
        complain(error)
        raise typer.Exit(2) from None


def read_quietly(path: Path, units: str | None, labels: str, **how: Any) -> PointCloud:
    """The cloud in a file, whose warnings stand in its notes, which are printed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read_cloud(path, units, label_property=labels, **how)
