"""Depth images in files: found, read, checked; and what is no distance told from what is one."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phytofit.cloud import READERS, SCALE_CM
from phytofit.errors import InputError, SettingError
from phytofit.reconstruct.cameras import UNITS, Camera
from phytofit.silence import silenced
from phytofit.small_files import shortened

__all__ = ["DepthView", "depth_files", "read_views"]

FloatArray = NDArray[np.float64]
SUFFIXES = (".png", ".tif", ".tiff", ".npy")
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".webp", ".heic", ".bmp", ".gif", ".cr2", ".nef", ".arw", ".dng")
DEEP_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")  # Pillow's names of images with 16 bits and more
PLAUSIBLE_CM = (10.0, 1000.0)  # median depth of an image that shows a plant
NO_RETURN = (65535.0, 65536.0)  # the largest 16-bit value, and the next: what converters to floats write
LEAST_INSIDE = 0.05  # share of the depths that lie within the camera's range, at least, if its unit is right
MOST_HEADER = 4096  # bytes of an NPY file's header; those of images have about 120
PHOTOGRAPHS = "photographs can't be measured yet: make a cloud of them with another program, and give phytofit that"


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth image: ``depth`` (height, width) in cm, 0 where nothing came back; ``file`` is its name."""

    file: str
    depth: FloatArray


def depth_files(folder: Path, pattern: str = "*") -> list[Path]:
    """The depth images of a folder in the order of the numbers in their names; InputError if there is none.

    Hidden files, such as the ``._name.png`` that macOS leaves on other disks, are none.
    """
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "no such folder"
        cloud = folder.exists() and folder.suffix.lower() in READERS
        what = "; it looks like a cloud: segment it, no camera is needed" if cloud else ""
        raise InputError(f"{folder}: {found}, expected a folder of depth images{what}")
    try:
        there = [path for path in folder.glob(pattern) if path.is_file() and not path.name.startswith(".")]
    except (NotImplementedError, ValueError, IndexError, OSError) as error:  # an absolute pattern, or none
        raise SettingError(
            f"pattern: expected one such as 'depth_*.png', within the folder, got {shortened(repr(pattern))} ({error})"
        ) from None
    files = [path for path in there if path.suffix.lower() in SUFFIXES]
    if not files:
        raise InputError(f"{folder}: no depth images found (pattern {shortened(repr(pattern))}){_instead(there)}")
    return sorted(files, key=_natural)


def _instead(there: Sequence[Path]) -> str:
    """What there is in place of depth images."""
    expected = f"expected {', '.join(SUFFIXES)} files with 16 bits"
    photos = [path for path in there if path.suffix.lower() in PHOTO_SUFFIXES]
    clouds = [path for path in there if path.suffix.lower() in READERS]
    if photos:
        return f", but {len(photos)} photographs such as {photos[0].name}; {PHOTOGRAPHS}"
    if clouds:
        return (
            f", but {len(clouds)} clouds such as {clouds[0].name}; clouds are segmented as they are, without a camera"
        )
    return f", {expected}; the folder is empty" if not there else f" among {len(there)} files, {expected}"


def _natural(path: Path) -> tuple[list[tuple[int, str, str]], str]:
    """Numbers count as numbers, however long: by their digits without leading zeros."""
    parts = re.split("([0-9]+)", path.name)
    return [(len(p.lstrip("0")), p.lstrip("0"), "") if i % 2 else (0, "", p) for i, p in enumerate(parts)], path.name


def read_views(
    files: Sequence[Path], camera: Camera, *, unit: str | None = None
) -> tuple[list[DepthView], tuple[str, ...]]:
    """Read depth images: 16-bit PNG or TIFF, or NPY; and notes on what was taken for no distance.

    0 and what is not finite are no distances; nor are the largest value that a whole number of the file's type can
    have, 65535 and 65536, what is nearer or farther than the camera sees, the only negative value, and the most common
    of all values where that is the largest, or beyond what the camera sees.

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
    if unit is not None and unit not in UNITS:
        raise SettingError(f"unit: expected mm, cm or m, got {shortened(repr(unit))}")
    step_cm = camera.step_cm if unit is None else SCALE_CM[unit]
    stored = [_stored(path, camera) for path in files]
    is_full = [_is_full(image) for image in stored]
    n_full = sum(int(full.sum()) for full in is_full)
    low, high = camera.range_cm
    none = _no_return(
        [image[~full] for image, full in zip(stored, is_full, strict=True)], low / step_cm, high / step_cm
    )
    depths, n_none = [], 0
    for path, image, full in zip(files, stored, is_full, strict=True):
        n_none += int((image == none).sum())
        with np.errstate(invalid="ignore", over="ignore"):
            depth = np.nan_to_num(image.astype(float), nan=0.0, posinf=0.0, neginf=0.0) * step_cm
        depth[full | (image == none)] = 0.0
        if (depth < 0).any():
            raise InputError(f"{path.name}: found negative depths, expected distances, and 0 where nothing came back")
        depths.append(depth)
    n_beyond = _check_range(files, depths, camera, unit or camera.unit)
    for depth in depths:
        depth[(depth < low) | (depth > high)] = 0.0
    n_pixels = len(files) * camera.width * camera.height
    notes = []
    if n_full:
        notes.append(f"{_percent(n_full, n_pixels)} of the pixels hold the largest possible value: no return")
    if n_none:
        notes.append(f"{_percent(n_none, n_pixels)} of the pixels hold {none:g}: no return")
    if n_beyond:
        seen = f"{low:g} to {high:g} cm"
        notes.append(f"{_percent(n_beyond, n_pixels)} of the pixels are left out: outside the camera's range, {seen}")
    return [DepthView(path.name, depth) for path, depth in zip(files, depths, strict=True)], tuple(notes)


def _is_full(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Where an image holds the largest value that its type can have, or what that becomes in others."""
    full: NDArray[np.bool_] = np.isin(image, NO_RETURN)
    return full if image.dtype.kind == "f" else full | (image == np.iinfo(image.dtype).max)


def _no_return(images: Sequence[NDArray[Any]], low: float, high: float) -> float:
    """The value that stands for no distance in these images, NaN if there is none: the only negative one; or that which
    is more common than any other, and is beyond what the camera sees (`low` to `high`, as stored), or the largest."""
    values, counts = np.unique(
        np.concatenate([image[np.isfinite(image) & (image != 0)] for image in images]), return_counts=True
    )
    if np.count_nonzero(values < 0) == 1:
        return float(values[0])
    if len(values) < 2 or np.count_nonzero(counts == counts.max()) > 1:
        return np.nan
    common = values[counts.argmax()]
    return float(common) if common == values[-1] or not low <= common <= high else np.nan


def _percent(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.2g} %"


def _stored(path: Path, camera: Camera) -> NDArray[Any]:
    """What a file holds (height, width); InputError if that is no depth image of this camera."""
    try:
        with silenced(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _read_npy(path, camera) if path.suffix.lower() == ".npy" else _read_image(path, camera)
    except InputError:
        raise
    except Exception as error:  # libraries raise anything at damaged bytes
        reason = str(error) if isinstance(error, (OSError, ValueError)) and str(error) else type(error).__name__
    raise InputError(
        f"{path.name}: can't be read ({shortened(reason)}); expected a 16-bit PNG or TIFF, or NPY"
    ) from None


def _read_image(path: Path, camera: Camera) -> NDArray[Any]:
    with Image.open(path) as opened:
        if opened.mode in ("L", "1"):
            raise InputError(
                f"{path.name}: found an image of 8 bits, expected distances of 16 bits; export depth without "
                "scaling it to grey levels"
            )
        if opened.mode not in DEEP_MODES:
            raise InputError(
                f"{path.name}: found a colour image ({opened.mode}), expected 16-bit distances; choose the "
                f"depth images by their names, if there are any; {PHOTOGRAPHS}"
            )
        _check_size(path, opened.size, camera)
        return np.array(opened)


def _read_npy(path: Path, camera: Camera) -> NDArray[Any]:
    """An array whose header is believed only as far as there is data."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        if version[0] not in (1, 2):
            raise ValueError(f"version {version[0]} of NPY")
        read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = read(file, max_header_size=MOST_HEADER)
        if len(shape) != 2 or dtype.kind not in "uif" or not 2 <= dtype.itemsize <= 8:
            raise InputError(
                f"{path.name}: found an array of shape {shortened(shape)} and type {shortened(dtype)}, "
                "expected (height, width) of whole numbers with 16 bits or more, or of floats"
            )
        _check_size(path, (shape[1], shape[0]), camera)
        data = file.read(shape[0] * shape[1] * dtype.itemsize)
    if len(data) < shape[0] * shape[1] * dtype.itemsize:
        raise ValueError("its data end early")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C").copy()


def _check_size(path: Path, size: tuple[int, int], camera: Camera) -> None:
    """InputError if an image's width and height are not the camera's."""
    if size != (camera.width, camera.height):
        raise InputError(
            f"{path.name}: found {size[0]} x {size[1]} pixels, expected {camera.width} x {camera.height} of the camera "
            f"{camera.name}; all views have to come from it, at its resolution"
        )


def _check_range(files: Sequence[Path], depths: Sequence[FloatArray], camera: Camera, unit: str) -> int:
    """How many depths lie beyond what the camera sees; InputError if so many do that the unit is wrong."""
    everything = np.concatenate([depth[depth > 0] for depth in depths])
    if not len(everything):
        raise InputError(f"{files[0].name} and the others: no pixel holds a distance; was depth recorded?")
    (least, most), (low, high) = PLAUSIBLE_CM, camera.range_cm
    median = float(np.median(everything))
    n_beyond = int(((everything < low) | (everything > high)).sum())
    if not least <= median <= most or n_beyond > (1.0 - LEAST_INSIDE) * len(everything):
        seen = f"{max(low, least) if median < least else low:g} to {min(high, most):g} cm"
        raise InputError(
            f"{files[0].name} and the others: the median depth is {median:.3g} cm if it is stored in steps of "
            f"{camera.depth_scale if unit == camera.unit else 1:g} {unit}, expected {seen}; state the unit of depths "
            "(mm, cm or m), or in a camera file depth_scale, which is 0.1 for steps of 0.1 mm"
        )
    return n_beyond
