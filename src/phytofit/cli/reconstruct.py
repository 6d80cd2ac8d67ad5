"""The command that makes one cloud of depth images."""

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from phytofit.cli.console import command, remark, results_in, say, show
from phytofit.cli.inputs import check_images
from phytofit.cli.options import (
    CameraOption,
    DepthUnitOption,
    OutOption,
    PatternOption,
    PosesOption,
    SpacingOption,
    StepOption,
)
from phytofit.cli.progress import Items
from phytofit.errors import InputError
from phytofit.text import for_terminal

if TYPE_CHECKING:
    from phytofit.reconstruct import Reconstruction

__all__ = ["reconstruct_command"]

STAGES = 6  # that reconstruct tells of


@command("reconstruct")
def reconstruct_command(
    images: Annotated[Path, typer.Argument(metavar="FOLDER", help="Depth images: 16-bit PNG or TIFF, or NPY.")],
    camera: CameraOption,
    step: StepOption = None,
    unit: DepthUnitOption = None,
    poses: PosesOption = None,
    pattern: PatternOption = "*",
    spacing: SpacingOption = None,
    folder: OutOption = Path("reconstruction"),
) -> None:
    """Make one cloud of a plant from depth images of it on a turntable, or from known viewpoints.

    The camera stands still and the plant turns, by about the same step between images, which are taken in the order of
    the numbers in their names. What turns is the plant; background, table and pot are removed. Axis and step are found
    from the images. Writes DIR/plant.ply (cm, z up, the number of views that saw each point), DIR/reconstruction.png
    (look at it first) and DIR/reconstruction.json (step, axis, the pose of each view, how well each pair
    fits, views left out and why).

    Examples:

        phytofit reconstruct scan --camera kinect-v2 --out plant

        phytofit reconstruct scan --camera my_camera.toml --step 30 --pattern 'depth_*.png'

        phytofit reconstruct scan --camera realsense-d4xx --poses poses.json
    """
    from phytofit.io import check_reconstruction, save_reconstruction
    from phytofit.reconstruct import reconstruct

    check_images(images)
    if images.resolve() == folder.resolve():
        raise InputError(f"{folder}: the folder of the images can't hold the results; choose another folder")
    with results_in(folder):
        check_reconstruction(folder)
        stages = itertools.count()
        with Items(1, "plant", in_stages=True).item(0, images.resolve().name) as told:
            result = reconstruct(
                images,
                camera,
                step_deg=step,
                unit=unit,
                poses=poses,
                pattern=pattern,
                spacing_cm=spacing,
                progress=lambda stage: told(stage, min(next(stages) / STAGES, 1.0)),
            )
        save_reconstruction(result, folder)
        _print(result, folder)


def _print(result: "Reconstruction", folder: Path) -> None:
    table = Table(title=for_terminal(result.cloud.name))
    for column in ("view", "angle, °", "fits", "overlap, %", "apart, cm"):
        table.add_column(column, justify="left" if column in ("view", "fits") else "right", overflow="fold")
    for i, file in enumerate(result.files):
        mine = [pair for pair in result.pairs if i in (pair.first, pair.second)]
        best = max(mine, key=lambda pair: pair.overlap, default=None)
        angle = "" if result.turn is None else f"{math.degrees(abs(result.turn.angles[i])):.1f}"
        if best is None:
            table.add_row(for_terminal(file), angle, "", "", "")
        else:
            other = result.files[best.second if best.first == i else best.first]
            table.add_row(
                for_terminal(file), angle, for_terminal(other), f"{100 * best.overlap:.0f}", f"{best.residual_cm:.2f}"
            )
    show(table)
    for view in result.rejected:
        remark("rejected", f"{view.file}: {view.reason}")
    for note in result.cloud.notes:
        remark("note", note)
    for flag in result.flags:
        remark("flag", flag)
    said = [f"{len(result.cloud)} points of {len(result.files)} views"]
    if result.step_deg is not None:
        said.append(f"step {abs(result.step_deg):.2f}°")
    if result.pairs:
        said.append(f"neighbours {result.residual_cm:.2f} cm apart (median)")
    if result.loop is not None:
        said.append(f"loop closes within {result.loop[0]:.1f}° and {result.loop[1]:.2f} cm")
    where = f"{folder / 'plant.ply'}; check it in {folder / 'reconstruction.png'}"
    say(f"{', '.join(said)}: {where}")
