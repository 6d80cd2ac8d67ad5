"""PLY, as text and binary."""

import re
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from phytofit.cloud.table import FileError, Table

__all__ = ["read"]

PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
PLY_TYPES |= {"float": "f4", "double": "f8"}
PLY_TYPES |= {np.dtype(code).name: code for code in ("f2", "i8", "u8", *PLY_TYPES.values())}


def read(data: bytes, wanted: Collection[str]) -> Table:
    # Not by trimesh: of a truncated text file it returns what is left, and it refuses binary lists of unequal
    # lengths (quads among triangles), a comment before the line `format`, blank lines, and Latin-1 comments.
    end = re.search(rb"^end_header[ \t]*(\r?\n|\Z)", data, re.MULTILINE)
    if end is None or not re.match(rb"ply[ \t]*\r?\n", data):
        expected = "a first line 'ply' and a line 'end_header'"
        raise FileError(f"not a PLY file, or truncated: expected {expected}, it starts with {data[:16]!r}")
    is_text, elements = _ply_header(data[: end.start()])
    body, at, found = data[end.end() :], 0, {}
    if is_text:  # read as if it were a binary file of doubles
        body = np.fromiter(map(float, body.split()), dtype=np.float64).tobytes()
    for name, element in elements.items():
        found[name], at = _ply_rows(body, at, name, element)
    if body[at:].strip():
        raise FileError("holds more than its header declares; edited, or sent as text? export it again")
    if "vertex" not in found:
        raise FileError(f"no element 'vertex', found {[*found]}; is it a point cloud?")
    columns = {name: rows for name, rows in found["vertex"].items() if isinstance(rows, np.ndarray)}
    faces = found.get("face", {})
    return Table(columns, [*columns], faces.get("vertex_indices", faces.get("vertex_index", ())))


class _Element(NamedTuple):
    n_rows: int
    properties: list[tuple[str, np.dtype[Any], np.dtype[Any] | None]]  # name, type, type of a list's length


def _ply_header(header: bytes) -> tuple[bool, dict[str, _Element]]:
    is_text, types, elements = False, dict[str, np.dtype[Any]](), dict[str, _Element]()
    element = _Element(0, [])
    for line in header.splitlines()[1:]:
        match line.decode("latin-1").split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", encoding, _] if encoding in PLY_ORDERS:
                is_text = encoding == "ascii"
                codes = dict.fromkeys(PLY_TYPES, "f8") if is_text else PLY_TYPES
                types = {kind: np.dtype(PLY_ORDERS[encoding] + code) for kind, code in codes.items()}
            case ["element", name, n_rows] if re.fullmatch("[0-9]{1,18}", n_rows) and name not in elements:
                elements[name] = element = _Element(int(n_rows), [])
            case ["property", kind, name] if kind in types:
                element.properties.append((name, types[kind], None))
            case ["property", "list", counter, kind, name] if {counter, kind} <= types.keys():
                element.properties.append((name, types[kind], types[counter]))
            case _:
                raise FileError(f"its PLY header has a wrong line, {line[:40]!r}; export it again")
    return is_text, elements


def _ply_rows(body: bytes, at: int, name: str, element: _Element) -> tuple[dict[str, Any], int]:
    """Return an element's columns, for lists a list of arrays, and where the next element starts."""
    n_rows, properties = element
    least = sum((kind if counter is None else counter).itemsize for _, kind, counter in properties)
    room = (len(body) - at) // least if least else n_rows
    if room < n_rows:
        raise FileError(f"truncated: it declares {n_rows} rows of {name!r}, holds {room}; copy it again")
    if properties and all(counter is None for _, _, counter in properties):
        rows = np.frombuffer(body, [(key, kind) for key, kind, _ in properties], n_rows, at)
        return {key: rows[key] for key, _, _ in properties}, at + rows.nbytes
    columns: dict[str, Any] = {key: [] for key, _, _ in properties}
    for _ in range(n_rows if properties else 0):
        for key, kind, counter in properties:
            length = 1.0
            if counter is not None:
                start, at = at, at + counter.itemsize
                length = float(np.frombuffer(body, counter, 1, start)[0]) if at <= len(body) else -1
            if length < 0 or not length.is_integer() or at + length * kind.itemsize > len(body):
                raise FileError(f"truncated or damaged in {key!r} of {name!r}; export or copy it again")
            columns[key].append(np.frombuffer(body, kind, int(length), at))
            at += int(length) * kind.itemsize
    return columns | {key: np.ravel(columns[key]) for key, _, counter in properties if counter is None}, at
