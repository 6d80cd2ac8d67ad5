"""Files of results: whole or not at all, with names that do not collide."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phytofit.cloud import PointCloud
from phytofit.errors import OutputError

__all__ = ["input_of", "prepare_folder", "result_names", "table_text", "whole_file", "whole_folder", "write_text"]

DIGITS = 6  # significant, in tables; fit.json has all


def result_names(paths: Sequence[Path]) -> list[str]:
    """A name for each cloud: its file's stem; names that collide take the parent folder's name in front, then the
    file's ending behind, then a number."""
    folders = [path.resolve().parent.name for path in paths]
    names = [path.stem for path in paths]
    for longer in (
        [f"{folder}_{path.stem}" for folder, path in zip(folders, paths, strict=True)],
        [f"{folder}_{path.name.replace('.', '_')}" for folder, path in zip(folders, paths, strict=True)],
        [f"{folder}_{path.stem}_{i}" for i, (folder, path) in enumerate(zip(folders, paths, strict=True), start=1)],
    ):
        names = [long if names.count(name) > 1 else name for name, long in zip(names, longer, strict=True)]
    return names


def input_of(cloud: PointCloud) -> dict[str, Any]:
    """What a result says of its input: the file, its unit, and the SHA-256 of the file, or of the points where there is
    none."""
    data = np.ascontiguousarray(cloud.points).tobytes() if cloud.source is None else cloud.source.read_bytes()
    return {
        "file": None if cloud.source is None else cloud.source.name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "unit": cloud.unit,
    }


def prepare_folder(folder: Path) -> Path:
    """Make sure that results can be written to the folder; OutputError if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"{folder}: results can't be written there ({error.strerror}); name another folder with --out"
        ) from None
    return folder


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden file to write into, which becomes ``path`` when all is written."""
    part = path.with_name(f".{path.name}.part-{os.getpid()}")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: can't be written ({error.strerror})") from None
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a whole file or nothing."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8", newline="")


def table_text(table: pd.DataFrame) -> str:
    """The table as CSV, `DIGITS` significant digits, empty where there is no value."""
    text: str = table.to_csv(index=False, float_format=f"%.{DIGITS}g", lineterminator="\n")
    return text


@contextmanager
def whole_folder(folder: Path, name: str, mark: str) -> Iterator[Path]:
    """A hidden folder to write into; when all is written it becomes ``folder/name``, in the place of an older one.

    Raises OutputError where there is a folder of that name without the file `mark`, which is no result of ours.
    """
    folder = prepare_folder(folder)
    target = folder / name
    if target.exists() and not (target / mark).is_file() and not (target.is_dir() and not any(target.iterdir())):
        raise OutputError(f"{target}: it is there already, and holds no {mark} of an earlier run; name another --out")
    part = Path(tempfile.mkdtemp(prefix=f".{name}.part-", dir=folder))
    try:
        part.chmod(0o755)
        yield part
        if target.exists():
            shutil.rmtree(target)
        part.rename(target)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{target}: the result can't be written ({error.strerror})") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
