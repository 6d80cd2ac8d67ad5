"""What a user gives to be measured: files, folders, globs; and what is no cloud, with the command that takes it."""

import glob
import os
import re
from collections.abc import Sequence
from pathlib import Path

from phytofit.errors import InputError
from phytofit.text import one_line

__all__ = ["check_images", "cloud_files", "holds_images"]

IMAGES = (".png", ".tif", ".tiff", ".npy")  # that may hold depth
PHOTOS = (".jpg", ".jpeg", ".heic", ".bmp", ".gif", ".webp", ".cr2", ".nef", ".dng")  # that can't
TEXT = (".csv", ".txt", ".asc", ".xyz", ".pts")  # that may be a table of anything
LINES = 100  # of a text file, among which is its first point or its header
NUMBER = r"[-+]?\d[\d.,eE+-]*"
POINT = re.compile(rf"\s*{NUMBER}[\s;,]+{NUMBER}[\s;,]+{NUMBER}")
HEADER = re.compile(r"\W*x\W+y\W+z\b", re.IGNORECASE)
FROM_DEPTH = "for depth images: phytofit run FOLDER --camera NAME"
FROM_PHOTOS = (
    "photos hold no depth: make a point cloud from them first (COLMAP, Metashape, ...), then phytofit run CLOUD"
)


def cloud_files(given: Sequence[str]) -> tuple[list[Path], list[Path]]:
    """The clouds among what was given, and what was skipped in folders because it is no cloud.

    A folder stands for the clouds in it, a glob for what matches it; hidden files are left out of both.  What was named
    itself is taken, whatever it is; InputError where it is a picture or a result, or where there is no cloud at all.
    """
    clouds: list[Path] = []
    skipped: list[Path] = []
    for text in given:
        path = Path(text)
        if os.path.isdir(path):
            inside = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
            found = [entry for entry in inside if _is_cloud(entry)]
            if not found:
                raise InputError(f"{one_line(path)}: {_instead_of_clouds(path, inside)}")
            clouds += found
            skipped += [entry for entry in inside if entry.is_file() and entry not in found]
        elif not os.path.exists(path) and glob.has_magic(text):
            names = sorted(glob.glob(text))  # noqa: PTH207  (it knows absolute patterns)
            matches = [Path(name) for name in names if not Path(name).name.startswith(".")]
            found = [match for match in matches if _is_cloud(match)]
            if not found:
                found_instead = "no cloud among what matches" if matches else "nothing matches"
                raise InputError(f"{one_line(text)}: {found_instead}; check the path and the pattern")
            clouds += found
            skipped += [match for match in matches if match not in found]
        else:
            _check_kind(path)
            clouds.append(path)
    return clouds, skipped


def holds_images(folder: Path, *, with_camera: bool = False) -> bool:
    """Whether a folder is one of images, rather than of clouds; where it holds both, a camera says that it is."""
    if not os.path.isdir(folder):
        return False
    names = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    images, clouds = (_suffix(name) in (*IMAGES, *PHOTOS) for name in names), map(_is_cloud, names)
    return any(images) and (with_camera or not any(clouds))


def check_images(folder: Path) -> None:
    """InputError where what was given as a folder of depth images is something else."""
    shown = one_line(folder)
    if os.path.isfile(folder):
        if _is_cloud(folder):
            raise InputError(f"{shown}: a point cloud, which needs no reconstruction; use phytofit run {shown}")
        raise InputError(f"{shown}: a file, expected the folder that holds the depth images")
    if not os.path.isdir(folder):
        raise InputError(f"{shown}: no such folder; check the path")
    inside = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    suffixes = {_suffix(entry) for entry in inside}
    if suffixes & {*IMAGES}:
        return
    if suffixes & {*PHOTOS}:
        raise InputError(f"{shown}: {FROM_PHOTOS}")
    if any(_is_cloud(entry) for entry in inside):
        raise InputError(f"{shown}: holds point clouds, expected depth images; use phytofit run or phytofit fit")


def _check_kind(path: Path) -> None:
    shown = one_line(path)
    if _suffix(path) in PHOTOS:
        raise InputError(f"{shown}: a photo, expected a point cloud; {FROM_PHOTOS}")
    if _suffix(path) in IMAGES and os.path.exists(path):
        raise InputError(f"{shown}: an image, expected a point cloud; {FROM_DEPTH}")


def _instead_of_clouds(folder: Path, inside: Sequence[Path]) -> str:
    """What a folder without clouds is, and what to do with it."""
    names = {entry.name for entry in inside}
    suffixes = {_suffix(entry) for entry in inside}
    if "fit.json" in names or any((entry / "fit.json").is_file() for entry in inside):
        return "holds results of phytofit fit; give the clouds that they were measured from"
    if names & {"segmentation", "segmentation.json"} or any(
        (entry / "segmentation.json").is_file() for entry in inside
    ):
        return "holds results of a whole plant; its leaves are in the folder phytomers of its segmentation"
    if suffixes & {*IMAGES}:
        return f"holds images, expected point clouds; {FROM_DEPTH}"
    if suffixes & {*PHOTOS}:
        return FROM_PHOTOS
    return "no point clouds in this folder; check the path" if inside else "an empty folder; check the path"


def _is_cloud(path: Path) -> bool:
    """Whether a file that nobody named is taken for a cloud: by its suffix, and text by its first lines."""
    from phytofit.cloud import READERS

    if _suffix(path) not in READERS or not path.is_file() or path.name in ("model.ply",):
        return False
    if _suffix(path) not in TEXT:
        return True
    try:
        with path.open("rb") as file:
            start = file.read(20_000)
    except OSError:
        return True  # reading it will say what is wrong
    lines = start.replace(b"\0", b"").decode("latin-1").splitlines()[:LINES]
    return any(POINT.match(line) or HEADER.match(line) for line in lines)


def _suffix(path: Path) -> str:
    return path.suffix.lower()
