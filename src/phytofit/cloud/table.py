"""What every reader returns: the columns of a file, by name."""

from collections.abc import Collection
from typing import Any, NamedTuple, TypeAlias

from numpy.typing import NDArray

__all__ = ["COLOR", "NORMAL", "XYZ", "Columns", "FileError", "Table", "key_of"]

XYZ, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
ALIASES = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz", "r": "red", "g": "green", "b": "blue"}
Columns: TypeAlias = dict[str, NDArray[Any]]  # (n,) each, by name


class Table(NamedTuple):
    """What a file holds of its n points, in its own unit."""

    columns: Columns  # at least those wanted
    names: list[str]  # of all the columns there are
    polygons: Collection[NDArray[Any]] = ()  # rows of a face's corners, each


class FileError(Exception):
    """The text of a CloudError, without the file's name."""


def key_of(name: str) -> str:
    """The one name of what files call by several."""
    return ALIASES.get(name.lower(), name.lower())
