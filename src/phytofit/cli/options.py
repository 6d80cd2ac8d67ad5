"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from phytofit.bundled import species_names
from phytofit.cli.settings import entries_of

__all__ = [
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
    "SpeciesOption",
    "SphereDiameterOption",
    "SpheresOption",
    "StepOption",
    "ThreadsOption",
    "UnitsOption",
    "UpOption",
    "ViewsOption",
    "WorkbookOption",
]

AXES = ", ".join(entries_of("parsing", "AXES"))
CAMERAS = ", ".join(entries_of("reconstruct.cameras", "PRESETS"))

Seed = Annotated[int, typer.Option(help="The same seed gives the same result.", min=0)]
SpeciesOption = Annotated[
    str, typer.Option(help=f"A species that comes with phytofit ({', '.join(species_names())}), or a TOML file.")
]
ThreadsOption = Annotated[int | None, typer.Option(help="Threads to work with; all cores by default.")]
UnitsOption = Annotated[
    str | None, typer.Option("--units", "-u", help="Unit of the coordinates: cm, mm, m; none: relative lengths.")
]
UpOption = Annotated[str | None, typer.Option(help=f"Upward direction where it is known: {AXES}.")]
MeshOption = Annotated[
    list[str] | None,
    typer.Option(help="The model also as obj or glb, each organ a named part; repeat for both."),
]
WorkbookOption = Annotated[bool, typer.Option("--xlsx", help="The table also as traits.xlsx.")]
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


CameraOption = Annotated[
    str,
    typer.Option(
        "--camera",
        "-c",
        show_default=False,
        help=f"{CAMERAS}; or a TOML file with fx fy cx cy width height (pixels) and, if need be, "
        "depth_scale, unit, distortion = [k1, k2, p1, p2, k3].",
    ),
]
StepOption = Annotated[
    float | None, typer.Option(help="The turntable's nominal step, degrees; the true one is estimated either way.")
]
DepthUnitOption = Annotated[
    str | None,
    typer.Option("--depth-unit", help="What a stored depth of 1 is: mm, cm or m; by default the camera's, mm."),
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
LabelsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Take stem and leaves from this property (1 stem, 2.. leaves) instead of finding them: "
        "`label` in a corrected plant.ply.",
    ),
]
