"""Files of results: their names, which do not collide, and what they hold."""

import hashlib
import itertools
import json
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phytofit.cloud import PointCloud
from phytofit.errors import CloudError
from phytofit.io.replacing import file_hash, whole_file
from phytofit.text import for_file_name, one_line

__all__ = ["OURS", "files_made", "input_of", "is_our_picture", "json_text", "result_names", "write_text"]

OURS = {"Software": "phytofit"}  # what a picture says, beside which no record stands
RESERVED = (  # what commands write beside the folders of results
    *("traits.csv", "traits.xlsx", "leaves.csv", "leaves.xlsx", "failed.csv", "phytofit.log", "truth.csv", "plant.png"),
    *("reconstruction", "segmentation", "leaves"),
)


def result_names(paths: Sequence[Path]) -> list[str]:
    """A name for each cloud that a folder can have on any system: its file's stem; names that collide, also but for
    case, take the parent folder's name in front, then the file's ending behind, then a number."""
    folders = [path.resolve().parent.name for path in paths]
    names = [path.stem for path in paths]
    for longer in (
        [f"{folder}_{path.stem}" for folder, path in zip(folders, paths, strict=True)],
        [f"{folder}_{path.name.replace('.', '_')}" for folder, path in zip(folders, paths, strict=True)],
    ):
        n_alike = Counter(_alike(name) for name in (*names, *RESERVED))
        names = [long if n_alike[_alike(name)] > 1 else name for name, long in zip(names, longer, strict=True)]
    n_alike = Counter(_alike(name) for name in (*names, *RESERVED))
    taken, unique = set(n_alike), []
    for name in map(for_file_name, names):
        numbered = (f"{name}_{i}" for i in itertools.count(1))
        alone = n_alike[_alike(name)] == 1
        unique.append(name if alone else next(it for it in numbered if _alike(it) not in taken))
        taken.add(_alike(unique[-1]))
    return unique


def _alike(name: str) -> str:
    """The same for names that some file system takes for one: that ignores case, or how an umlaut is composed."""
    return unicodedata.normalize("NFC", for_file_name(name)).casefold()


def input_of(cloud: PointCloud) -> dict[str, Any]:
    """What a result says of its input: the file, its unit, and the SHA-256 of the file, or of the points where there is
    none.  CloudError if the file can't be read any more."""
    if cloud.source is None:
        found = hashlib.sha256(np.ascontiguousarray(cloud.points).tobytes()).hexdigest()
    else:
        found = file_hash(cloud.source) or ""
        if not found:
            raise CloudError(f"{cloud.source}: it can't be read any more; leave it in its place until it is measured")
    return {
        "file": None if cloud.source is None else one_line(cloud.source.name),
        "sha256": found,
        "unit": cloud.unit,
    }


def files_made(folder: Path) -> dict[str, str | None]:
    """SHA-256 of each file in a folder, by its path there: what a result's record says of the others."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): file_hash(path) for path in files}


def is_our_picture(path: Path) -> bool:
    """Whether a PNG says that phytofit made it."""
    with path.open("rb") as file:
        return b"Software\0phytofit" in file.read(1000)


def json_text(said: Mapping[str, Any]) -> str:
    """JSON that every reader takes: ASCII, and no numbers that are not finite (ValueError)."""
    return json.dumps(said, indent=1, allow_nan=False) + "\n"


def write_text(path: Path, text: str) -> None:
    """Write a whole file or nothing."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8", newline="")
