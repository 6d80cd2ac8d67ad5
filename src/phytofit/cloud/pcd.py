"""PCD, as text, binary and compressed."""

import io
import re
import struct
from collections.abc import Collection
from typing import Any

import numpy as np
import pypcd4.pypcd4

from phytofit.cloud.table import FileError, Table

__all__ = ["read"]


def read(data: bytes, wanted: Collection[str]) -> Table:
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise FileError(f"not a PCD file, or truncated: starts with {data[:16]!r}, has no line 'DATA'")
    lines = [line.decode("latin-1").split() for line in data[: end.start()].splitlines()]
    header = {words[0]: words[1:] for words in lines if words}
    if not {"FIELDS", "SIZE", "TYPE", "POINTS"} <= {key for key, values in header.items() if values}:
        raise FileError(f"its PCD header holds {[*header]}, expected FIELDS, SIZE, TYPE and POINTS; export it again")
    fields, sizes, n_points = header["FIELDS"], header["SIZE"], int(header["POINTS"][0])
    counts = header.get("COUNT", ["1"] * len(fields))
    n_bytes = n_points * sum(int(size) * int(count) for size, count in zip(sizes, counts, strict=True))
    body, encoding = data[end.end() :], end[1].decode().lower()
    if encoding == "ascii":  # pypcd4 wants single spaces
        texts = [b" ".join(line.split()) for line in body.splitlines() if line.strip()]
        body, is_whole = b"\n".join(texts), len(texts) == n_points and 8 * len(body) >= n_bytes
    elif encoding == "binary":
        is_whole = len(body) >= n_bytes
    else:  # LZF needs 3 bytes or more for 264
        n_packed, n_unpacked = struct.unpack("<II", body[:8].ljust(8, b"\0"))
        is_whole = len(body) >= 8 + n_packed and 100 * n_packed >= n_unpacked == n_bytes
    if not is_whole or n_points == 0:
        raise FileError(f"truncated: it declares {n_points} points, that is not what follows; copy it again")
    # With a header of our own: pypcd4 insists on COUNT and on version 0.7, and renames fields.
    numbered = " ".join(f"f{i}" for i in range(len(fields)))
    own = f"VERSION 0.7\nFIELDS {numbered}\nSIZE {' '.join(sizes)}\nTYPE {' '.join(header['TYPE'])}\n"
    own += f"COUNT {' '.join(counts)}\nWIDTH {n_points}\nHEIGHT 1\nPOINTS {n_points}\nDATA {encoding}\n"
    file: Any = io.BytesIO(own.encode() + body)
    rows = np.atleast_1d(pypcd4.pypcd4.PointCloud.from_fileobj(file).pc_data)
    columns = {name: rows[f"f{i}"] for i, name in enumerate(fields) if counts[i] == "1"}
    for packed in columns.keys() & {"rgb", "rgba"}:
        bits = columns.pop(packed).copy().view(np.uint32)
        columns |= {"red": bits >> 16 & 255, "green": bits >> 8 & 255, "blue": bits & 255}
    return Table(columns, fields)
