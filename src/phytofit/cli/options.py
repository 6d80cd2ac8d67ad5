"""Options that several commands share, and how each kind of option is checked."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from phytofit.bundled import species_names
from phytofit.cli.messages import meant
from phytofit.cli.settings import entries_of, value_of
from phytofit.errors import SettingError
from phytofit.text import one_line

__all__ = [
    "STEMS_ABOVE",
    "CameraOption",
    "DepthUnitOption",
    "LabelsOption",
    "MeshOption",
    "NoiseOption",
    "NoiseReachOption",
    "OutOption",
    "OutliersOption",
    "PatternOption",
    "PosesOption",
    "Seed",
    "SpacingOption",
    "SpeciesOption",
    "SphereDiameterOption",
    "SpheresOption",
    "StepOption",
    "ThreadsOption",
    "UnitsOption",
    "UpOption",
    "ViewsOption",
    "WorkbookOption",
    "choice",
    "numeric",
    "only",
]

MOST_POINTS = 10_000_000  # some GB of memory; no scanner gives more of one plant
MOST_SEED = 2**53  # up to which every number is exact in JSON
MOST_THREADS = 1024


def numeric(
    help: str,  # noqa: A002  (typer's name)
    *names: str,
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
    below: float = math.inf,
) -> Any:
    """An option that is a finite number in a range."""
    lows = [f"{least:,g}"] if least > -math.inf else [f"above {above:,g}"] if above > -math.inf else []
    highs = [f"{most:,}"] if most < math.inf else [f"below {below:,g}"] if below < math.inf else []
    expected = " to ".join([*lows, *highs]) or "a finite number"
    if lows and not highs:
        expected = lows[0] if above > least else f"{lows[0]} or more"

    def check(value: float | None) -> float | None:
        if value is None or (least <= value <= most and above < value < below and math.isfinite(value)):
            return None if value is None else value + 0  # -0.0 becomes 0.0
        raise typer.BadParameter(f"expected {expected}, got {value:g}")

    return typer.Option(*names, help=help, callback=check)


def choice(help: str, *names: str, among: Sequence[str], file: str = "", **more: Any) -> Any:  # noqa: A002
    """An option that is one of some words; or, with `file`, also a path with that ending."""

    def check(given: str | list[str] | None) -> str | list[str] | None:
        for value in given if isinstance(given, list) else filter(None, [given]):
            if value not in among and not (file and (value.lower().endswith(file) or os.path.isfile(value))):
                others = f", or a {file[1:].upper()} file" if file else ""
                said = f"expected {', '.join(among)}{others}, got {one_line(value)!r}"
                raise typer.BadParameter(f"{said}{meant(value, [*among])}")
        return given

    def complete(incomplete: str) -> list[str]:
        return [name for name in among if name.startswith(incomplete)]

    return typer.Option(*names, help=help, callback=check, autocompletion=complete, **more)


def only(context: typer.Context, options: Sequence[str], why: str) -> None:
    """SettingError if one of these options was given, which would change nothing."""
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in options and source is not None and source.name == "COMMANDLINE":
            raise SettingError(f"{max(parameter.opts, key=len)}: {why}")


AXES = [*entries_of("parsing", "AXES")]
CAMERAS = [*entries_of("reconstruct.cameras", "PRESETS")]
UNITS = [*entries_of("cloud.units", "SCALE_CM")]
DEPTH_UNITS = [unit for unit in UNITS if unit != "none"]
SPECIES = species_names()
MESHES = value_of("io.models", "MESHES")
STEMS_ABOVE = "The stem above the leaf: equal (as long as below it), none (not there) or free (of a length of its own)"

Seed = Annotated[int, numeric("The same seed gives the same result.", least=0, most=MOST_SEED)]
SpeciesOption = Annotated[
    str,
    choice(
        f"A species that comes with phytofit ({', '.join(SPECIES)}), or a TOML file of your own.",
        among=SPECIES,
        file=".toml",
    ),
]
ThreadsOption = Annotated[
    int | None, numeric("Threads to work with; all cores by default.", least=1, most=MOST_THREADS)
]
UnitsOption = Annotated[
    str | None,
    choice(
        f"Unit of the coordinates: {', '.join(UNITS[:-1])}; or {UNITS[-1]}, for lengths relative to each other. "
        "Required, except for LAS, LAZ and E57, which are in metres.",
        "--units",
        "-u",
        among=UNITS,
    ),
]
UpOption = Annotated[
    str | None, choice(f"Which way is up in the cloud, where that is known: {', '.join(AXES)}.", among=AXES)
]
MeshOption = Annotated[
    list[str] | None,
    choice(
        f"Write the model as {' or '.join(MESHES[1:])} beside {MESHES[0]}; repeat the option for both. In OBJ and "
        "GLB each organ is a named part.",
        "--mesh",
        among=MESHES,
    ),
]
WorkbookOption = Annotated[bool, typer.Option("--xlsx", metavar="", help="Write the table as traits.xlsx too.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results.")]
NoiseOption = Annotated[float, numeric("Standard deviation of the noise of each coordinate, cm.", least=0)]
NoiseReachOption = Annotated[
    float,
    numeric(
        "Distance over which neighbouring points share noise, cm, as in fused and stereo clouds; 0: independent.",
        least=0,
    ),
]
ViewsOption = Annotated[
    int | None,
    numeric(
        "Cameras around the plant, each seeing only what is not hidden; by default every surface is seen.",
        least=1,
        most=1000,
    ),
]
SpheresOption = Annotated[int, numeric("Spheres that are removed from each cloud.", least=0, most=1000)]
SphereDiameterOption = Annotated[float, numeric("Their diameter, cm.", above=0)]
OutliersOption = Annotated[float, numeric("Share of outliers that are added, 0 to 1.", least=0, below=1)]
CameraOption = Annotated[
    str,
    choice(
        f"The depth camera: {', '.join(CAMERAS)}; or a TOML file with fx fy cx cy width height (pixels) and, where "
        "needed, depth_scale, unit, near and far, distortion = \\[k1, k2, p1, p2, k3].",
        "--camera",
        "-c",
        among=CAMERAS,
        file=".toml",
        show_default=False,
    ),
]
StepOption = Annotated[
    float | None,
    numeric(
        "How far the turntable turns between two images, degrees, roughly; it is estimated either way.",
        least=-180,
        most=180,
    ),
]
DepthUnitOption = Annotated[
    str | None,
    choice(
        "Unit of the numbers in the depth images: mm, cm or m; by default the camera's.",
        "--depth-unit",
        among=DEPTH_UNITS,
    ),
]
PosesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Known viewpoints instead of a turntable, JSON: "
        '{"unit": "cm", "views": [{"file": "a.png", "pose": 4x4 camera to world, z up}]}.',
    ),
]
PatternOption = Annotated[str, typer.Option(help="Which files of the folder are depth images.")]
SpacingOption = Annotated[
    float | None,
    numeric(
        "Distance between the cloud's points, cm; by default that of neighbouring pixels on the plant.",
        above=0,
    ),
]
LabelsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Take stem and leaves from this property of the file (1 stem, 2 and up leaves) instead of finding them: "
        "label, in a corrected plant.ply.",
    ),
]
