"""PCD, as text, binary and compressed."""

import io
import re
import struct
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import pypcd4.pypcd4
from numpy.typing import NDArray

from phytofit.cloud.numerals import numbers
from phytofit.cloud.table import COLOR, FileError, Table, listed, quoted

__all__ = ["read"]


class _Header(NamedTuple):
    fields: list[str]
    types: list[str]
    sizes: list[int]
    counts: list[int]
    n_points: int
    encoding: str


def read(data: bytes, wanted: Collection[str]) -> Table:
    """The fields of one number each; packed colours as three."""
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise FileError(
            f"not a PCD file, or truncated: starts with {quoted(data[:16].decode('latin-1'))}, has no line 'DATA'"
        )
    header = _header(data[: end.start()], end[1].decode().lower())
    columns = (_of_text if header.encoding == "ascii" else _of_bytes)(data[end.end() :], header)
    for _, bits in [pair for pair in columns if pair[0] in ("rgb", "rgba")]:
        packed = bits.copy().view(np.uint32)
        columns += zip(COLOR, (packed >> 16 & 255, packed >> 8 & 255, packed & 255), strict=True)
    return Table([(name, values) for name, values in columns if name not in ("rgb", "rgba")], header.fields)


def _header(text: bytes, encoding: str) -> _Header:
    lines = [line.decode("latin-1").split() for line in text.splitlines()]
    found = {words[0]: words[1:] for words in lines if words}
    if "POINTS" not in found and {"WIDTH", "HEIGHT"} <= {key for key, values in found.items() if values}:
        found["POINTS"] = [str(int(found["WIDTH"][0]) * int(found["HEIGHT"][0]))]
    if not {"FIELDS", "SIZE", "TYPE", "POINTS"} <= {key for key, values in found.items() if values}:
        raise FileError(
            f"its PCD header holds {listed(found)}, expected FIELDS, SIZE, TYPE and POINTS; export it again"
        )
    fields, counts = found["FIELDS"], found.get("COUNT") or ["1"] * len(found["FIELDS"])
    if not len(fields) == len(found["TYPE"]) == len(found["SIZE"]) == len(counts):
        raise FileError("its PCD header has FIELDS, SIZE, TYPE and COUNT of unequal lengths; export it again")
    sizes, n_points = [int(size) for size in found["SIZE"]], int(found["POINTS"][0])
    return _Header(fields, found["TYPE"], sizes, [int(count) for count in counts], n_points, encoding)


def _of_text(body: bytes, header: _Header) -> list[tuple[str, NDArray[Any]]]:
    values, width = numbers(body.split()), sum(header.counts)
    _check_whole(header, len(values) == header.n_points * width)
    places = np.cumsum([0, *header.counts[:-1]])
    kinds = [np.dtype(f"{kind.lower()}{size}") for kind, size in zip(header.types, header.sizes, strict=True)]
    rows = values.reshape(-1, width)
    return [  # colours are packed in the bits of the declared type, the others keep all digits
        (name, rows[:, at].astype(kind) if name in ("rgb", "rgba") else rows[:, at])
        for name, at, kind, count in zip(header.fields, places, kinds, header.counts, strict=True)
        if count == 1
    ]


def _of_bytes(body: bytes, header: _Header) -> list[tuple[str, NDArray[Any]]]:
    fields, types, sizes, counts, n_points, encoding = header
    n_bytes = n_points * sum(size * count for size, count in zip(sizes, counts, strict=True))
    if encoding == "binary":
        is_whole = len(body) >= n_bytes
    else:  # LZF needs 3 bytes or more for 264
        n_packed, n_unpacked = struct.unpack("<II", body[:8].ljust(8, b"\0"))
        is_whole = len(body) >= 8 + n_packed and 100 * n_packed >= n_unpacked == n_bytes
    _check_whole(header, is_whole)
    # With a header of our own: pypcd4 insists on COUNT and on version 0.7, and renames fields.
    numbered = " ".join(f"f{i}" for i in range(len(fields)))
    own = f"VERSION 0.7\nFIELDS {numbered}\nSIZE {' '.join(map(str, sizes))}\nTYPE {' '.join(types)}\n"
    own += f"COUNT {' '.join(map(str, counts))}\nWIDTH {n_points}\nHEIGHT 1\nPOINTS {n_points}\nDATA {encoding}\n"
    file: Any = io.BytesIO(own.encode() + body)
    rows = np.atleast_1d(pypcd4.pypcd4.PointCloud.from_fileobj(file).pc_data)
    return [(name, rows[f"f{i}"]) for i, name in enumerate(fields) if counts[i] == 1]


def _check_whole(header: _Header, is_whole: bool) -> None:
    if not is_whole or header.n_points <= 0:
        raise FileError(f"truncated: it declares {header.n_points} points, but another number follows; copy it again")
