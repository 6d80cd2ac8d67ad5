"""Depth images: read, checked, freed of flying pixels, turned into points with normals."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.spatial import cKDTree

from phytofit.cloud import SCALE_CM
from phytofit.errors import InputError
from phytofit.reconstruct.cameras import Camera

__all__ = ["DepthView", "depth_files", "drop_flying_pixels", "read_views", "surface_normals", "view_points"]

FloatArray = NDArray[np.float64]
SUFFIXES = (".png", ".tif", ".tiff", ".npy")
DEEP_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")  # Pillow's names of images with 16 bits and more
PLAUSIBLE_CM = (10.0, 1000.0)  # median depth of an image that shows a plant


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth image: ``depth`` (height, width) in cm, 0 where nothing came back; ``file`` is its name."""

    file: str
    depth: FloatArray


def depth_files(folder: Path, pattern: str = "*") -> list[Path]:
    """The depth images of a folder in the order of the numbers in their names; InputError if there is none."""
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {found}, expected a folder of depth images")
    try:
        files = [path for path in folder.glob(pattern) if path.suffix.lower() in SUFFIXES and path.is_file()]
    except (NotImplementedError, ValueError) as error:  # an absolute pattern, or none
        raise InputError(
            f"--pattern {pattern}: expected one such as 'depth_*.png', within the folder ({error})"
        ) from None
    if not files:
        raise InputError(f"{folder}: no depth images found (pattern {pattern!r}), expected {', '.join(SUFFIXES)} files")
    return sorted(files, key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts]


def read_views(files: Sequence[Path], camera: Camera, *, unit: str | None = None) -> list[DepthView]:
    """Read depth images: 16-bit PNG or TIFF, or NPY.

    Parameters
    ----------
    files
        In the order in which they were taken.
    camera
        The size of the images has to be the camera's; it says what a stored step is, too.
    unit
        What a stored depth of 1 is: mm, cm or m; by default the camera's.

    Raises
    ------
    InputError
        If a file can't be read, is no depth image, has another size, or its depths are not those of a plant.
    """
    if unit is not None and unit not in ("mm", "cm", "m"):
        raise InputError(f"--depth-unit {unit}: expected mm, cm or m")
    step_cm = camera.step_cm if unit is None else SCALE_CM[unit]
    stored = [_stored(path) for path in files]
    shapes = [image.shape for image in stored]
    for path, shape in zip(files, shapes, strict=True):
        if shape != shapes[0]:
            raise InputError(
                f"{path.name}: found {shape[1]} x {shape[0]} pixels, expected {shapes[0][1]} x {shapes[0][0]} as in "
                f"{files[0].name}; all views have to come from one camera at one resolution"
            )
        if shape != (camera.height, camera.width):
            raise InputError(
                f"{path.name}: found {shape[1]} x {shape[0]} pixels, expected {camera.width} x {camera.height} of the "
                f"camera {camera.name}; name the right camera with --camera"
            )
    views = []
    for path, image in zip(files, stored, strict=True):
        with np.errstate(invalid="ignore", over="ignore"):
            depth = np.nan_to_num(image.astype(float), nan=0.0, posinf=0.0, neginf=0.0) * step_cm
        if (depth < 0).any():
            raise InputError(f"{path.name}: found negative depths, expected distances, and 0 where nothing came back")
        views.append(DepthView(path.name, depth))
    _check_range(views, unit or camera.unit)
    return views


def _stored(path: Path) -> NDArray[Any]:
    try:
        if path.suffix.lower() == ".npy":
            image = np.load(path, allow_pickle=False)
        else:
            with Image.open(path) as opened:
                if opened.mode not in DEEP_MODES:
                    raise InputError(
                        f"{path.name}: found an image of 8 bits or colours ({opened.mode}), expected 16-bit depth; "
                        "export depth without scaling to grey levels, or choose files with --pattern 'Depth*.png'"
                    )
                image = np.array(opened)
    except InputError:
        raise
    except (OSError, ValueError, EOFError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise InputError(f"{path.name}: can't be read ({error}); expected a 16-bit PNG or TIFF, or NPY") from None
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        raise InputError(
            f"{path.name}: found an array of shape {image.shape} and type {image.dtype}, "
            "expected (height, width) of 16-bit whole numbers or floats"
        )
    return np.asarray(image)


def _check_range(views: Sequence[DepthView], unit: str) -> None:
    seen = [view.depth[view.depth > 0] for view in views]
    everything = np.concatenate(seen)
    if not len(everything):
        raise InputError("all views are empty (all depths 0); was depth recorded?")
    median = float(np.median(everything))
    low, high = PLAUSIBLE_CM
    if not low <= median <= high:
        raise InputError(
            f"{views[0].file} and the others: median depth {median:.3g} cm if stored in {unit}, expected "
            f"{low:g} to {high:g} cm; say --depth-unit mm, cm or m"
        )


def drop_flying_pixels(
    depth: FloatArray, camera: Camera, *, steepest_deg: float = 80.0, noise_share: float = 0.004, n_linked: int = 4
) -> FloatArray:
    """The depth image (height, width) with 0 where a pixel hangs between two surfaces.

    Two neighbours are linked if their depths differ by no more than on a plane that is seen `steepest_deg` from its
    normal, plus noise of `noise_share` of the depth; a pixel stays if at least `n_linked` of its 8 neighbours, or two
    opposite ones, are linked.
    """
    pitch = np.tan(np.radians(steepest_deg)) / np.sqrt(camera.fx * camera.fy) + noise_share
    padded = np.pad(depth, 1)
    rows, columns = depth.shape
    linked = []
    for dv, du in ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)):
        other = padded[1 + dv : 1 + dv + rows, 1 + du : 1 + du + columns]
        nearer = np.minimum(depth, other)
        linked.append((other > 0) & (np.abs(other - depth) <= pitch * np.hypot(dv, du) * nearer))
    around = np.stack(linked)
    keep = (around.sum(axis=0) >= n_linked) | (around[:4] & around[4:]).any(axis=0)
    return np.where(keep, depth, 0.0)


def view_points(depth: FloatArray, rays: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Points (n, 3), cm, in the camera's frame, of the pixels of a mask (height, width), row by row."""
    z = depth[mask]
    return np.column_stack([rays[mask] * z[:, None], z])


def surface_normals(
    points: FloatArray, *, n_neighbors: int = 16, reach_cm: float = 1.5
) -> tuple[FloatArray, FloatArray]:
    """Unit normals (n, 3) towards the camera at the origin, and how flat (n,) each point's surroundings are.

    A normal is the direction of least spread of the at most `n_neighbors` nearest points within `reach_cm`; flatness
    is 1 for a plane and 0 for a line or a ball.  Points with fewer than 5 neighbours get flatness 0.
    """
    if len(points) < 5:
        return np.tile([0.0, 0.0, -1.0], (len(points), 1)), np.zeros(len(points))
    k = min(n_neighbors, len(points))
    distances, index = cKDTree(points).query(points, k=k, distance_upper_bound=reach_cm)
    near = np.isfinite(distances)
    around = points[np.where(near, index, 0)]
    weight = near[:, :, None] / near.sum(axis=1)[:, None, None]
    centred = (around - (around * weight).sum(axis=1, keepdims=True)) * np.sqrt(weight)
    values, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    normals = vectors[:, :, 0]
    normals = np.where((np.sum(normals * points, axis=1) > 0)[:, None], -normals, normals)
    flat = (values[:, 1] - values[:, 0]) / np.maximum(values[:, 2], 1e-12)
    return normals, np.where(near.sum(axis=1) >= 5, flat.clip(0.0, 1.0), 0.0)
