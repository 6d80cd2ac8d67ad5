"""What every reader returns: the columns of a file, by the names it gives them."""

import re
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from phytofit.text import one_line

__all__ = [
    "COLOR",
    "NORMAL",
    "XYZ",
    "Columns",
    "FileError",
    "Table",
    "key_of",
    "keys_of",
    "listed",
    "names_points",
    "quoted",
]

XYZ, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
ALIASES = {f"normal{gap}{axis}": f"n{axis}" for gap in ("", "_") for axis in XYZ}
ALIASES |= {f"{prefix}{letter}": name for name in COLOR for prefix, letter in (("", name[0]), ("diffuse_", name))}
ALIASES |= {f"{name[0]}f": name for name in COLOR} | {f"points{gap}{i}": XYZ[i] for gap in ":_" for i in range(3)}
UNIT_OF_NAME = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$|(?<=^[xyz])_(mm|cm|m)$")
OF_CLOUDCOMPARE = re.compile(r"^scalar[_ ]")  # which it writes before the name of every scalar field
LONGEST_QUOTE, LONGEST_LIST = 40, 10  # characters and names that a message shows
Columns: TypeAlias = dict[str, NDArray[Any]]  # (n,) each, by name


class FileError(Exception):
    """The text of a CloudError, without the file's name."""


class Table(NamedTuple):
    """What a file holds of its n points, in its own unit."""

    columns: Sequence[tuple[str, NDArray[Any]]]  # name as in the file and values (n,); at least those wanted
    names: Sequence[str]  # of all the columns there are
    polygons: Collection[NDArray[Any]] = ()  # rows of a face's corners, each
    unit: str | None = None  # of its lengths, where the file says it
    notes: tuple[str, ...] = ()

    def column(self, wanted: str) -> tuple[str, NDArray[Any]] | None:
        """The column of that name, and what the file calls it; else the one that means the same; else None.

        Of several the first, but FileError if they differ and what is measured depends on them.
        """
        for way in (str, key_of, _key_without_prefix):
            found = [pair for pair in self.columns if way(pair[0]) == way(wanted)]
            if wanted not in (*NORMAL, *COLOR) and any(
                not np.array_equal(found[0][1], values, equal_nan=True) for _, values in found[1:]
            ):
                raise FileError(
                    f"columns {listed(name for name, _ in found)} could all be {wanted}; rename all but one"
                )
            if found:
                return found[0]
        return None


def key_of(name: str) -> str:
    """The one name of what files call by several: in lower case, without the unit."""
    plain = UNIT_OF_NAME.sub("", name.strip().lower())
    return ALIASES.get(plain, plain)


def keys_of(name: str) -> set[str]:
    """All names that a column can be asked for by."""
    return {name, key_of(name), _key_without_prefix(name)}


def _key_without_prefix(name: str) -> str:
    return key_of(OF_CLOUDCOMPARE.sub("", name.strip().lower()))


def names_points(names: Iterable[str]) -> bool:
    """Whether x, y and z are among the names."""
    return {key_of(name) for name in names} >= {*XYZ}


def quoted(text: object) -> str:
    """What a file holds, in a message: one line, in quotes, and not too long."""
    line = one_line(text)
    return f"'{line}'" if len(line) <= LONGEST_QUOTE else f"'{line[:LONGEST_QUOTE]}…'"


def listed(names: Iterable[str]) -> str:
    """Names from a file, in a message: the first of them."""
    shown = [quoted(name) for name in names]
    more = f" and {len(shown) - LONGEST_LIST} more" if len(shown) > LONGEST_LIST else ""
    return ", ".join(shown[:LONGEST_LIST]) + more or "none"
