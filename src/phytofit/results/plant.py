"""What a reconstruction looks like on disk: plant.ply, reconstruction.json and reconstruction.png, all or none."""

import json
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from phytofit.errors import OutputError
from phytofit.formats import write_cloud
from phytofit.plots import plot_reconstruction
from phytofit.reconstruct.depth import Reconstruction

__all__ = ["save_reconstruction"]


def save_reconstruction(result: Reconstruction, folder: str | Path) -> Path:
    """Write into the folder plant.ply (cm, z up, normals, ``n_views`` a point), reconstruction.json and
    reconstruction.png; those of an earlier run are replaced once all three are made.

    Raises
    ------
    OutputError
        If they can't be written there; then nothing is.
    """
    folder = Path(folder)
    part = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=".reconstruction.part-", dir=folder))
        write_cloud(part / "plant.ply", result.cloud, {"n_views": result.n_views.astype(np.int32)})
        text = json.dumps(_as_json(result), indent=1) + "\n"
        (part / "reconstruction.json").write_text(text, encoding="utf-8", newline="")
        figure = plot_reconstruction(result, title=result.cloud.name)
        figure.savefig(part / "reconstruction.png", dpi=150, metadata={"Software": None})
        for file in sorted(part.iterdir()):
            file.replace(folder / file.name)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(
            f"{folder}: results can't be written there ({error.strerror}); name another folder with --out"
        ) from None
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
    return folder


def _as_json(result: Reconstruction) -> dict[str, Any]:
    """What reconstruction.json holds; no times, so that the same run gives the same bytes."""
    turn = result.turn
    camera = result.camera
    n_seen = np.bincount(result.n_views, minlength=len(result.files) + 1)[1:]
    return {
        "phytofit": version("phytofit"),
        "input": result.cloud.name,
        "camera": {
            "name": camera.name,
            **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
            "distortion": list(camera.distortion),
        },
        "unit": "cm",
        "n_points": len(result.cloud),
        "points_seen_by": {str(n): int(count) for n, count in enumerate(n_seen, start=1)},
        "turntable": None
        if turn is None
        else {
            "step_deg": result.step_deg,
            "axis_direction": turn.up.tolist(),
            "axis_point_cm": turn.point.tolist(),
            "frame": "first view's camera: x right, y down, z forward",
        },
        "views": [
            {
                "file": file,
                "angle_deg": None if turn is None else float(np.degrees(turn.angles[i])),
                "pose": result.poses[i].tolist(),
            }
            for i, file in enumerate(result.files)
        ],
        "pairs": [
            {
                "first": result.files[pair.first],
                "second": result.files[pair.second],
                "overlap": pair.overlap,
                "residual_cm": pair.residual_cm if np.isfinite(pair.residual_cm) else None,
            }
            for pair in result.pairs
        ],
        "residual_cm": result.residual_cm if result.pairs else None,
        "loop": None if result.loop is None else {"rotation_deg": result.loop[0], "shift_cm": result.loop[1]},
        "contradicted_share": result.contradicted,
        "rejected": [{"file": view.file, "reason": view.reason} for view in result.rejected],
        "flags": list(result.flags),
        "settings": result.settings,
    }
