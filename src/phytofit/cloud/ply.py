"""PLY, as text and binary."""

import re
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phytofit.cloud.numerals import numbers
from phytofit.cloud.table import FileError, Table, listed, quoted

__all__ = ["read"]

PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
PLY_TYPES |= {"float": "f4", "double": "f8"}
PLY_TYPES |= {np.dtype(code).name: code for code in ("f2", "i8", "u8", *PLY_TYPES.values())}


class _Property(NamedTuple):
    name: str
    kind: np.dtype[Any]
    counter: np.dtype[Any] | None  # type of a list's length


class _Element(NamedTuple):
    n_rows: int
    properties: list[_Property]


def read(data: bytes, wanted: Collection[str]) -> Table:
    """The columns of the element ``vertex``, and the faces."""
    # Not by trimesh: of a truncated text file it returns what is left, and it refuses binary lists of unequal
    # lengths (quads among triangles), a comment before the line `format`, blank lines, and Latin-1 comments.
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    line_end = start[1] if start else b"\n"
    end = re.search(rb"(?:\n|\r)end_header[ \t]*(?:%b|\Z)" % line_end, data)
    if start is None or end is None:
        expected = "a first line 'ply' and a line 'end_header'"
        raise FileError(
            f"not a PLY file, or truncated: expected {expected}, it starts with {quoted(data[:16].decode('latin-1'))}"
        )
    is_text, elements = _header(data[: end.start()])
    body, at, found = data[end.end() :], 0, {}
    if is_text:  # read as if it were a binary file of doubles
        body = numbers(body.split()).tobytes()
    for name, element in elements.items():
        found[name], at = _rows(body, at, name, element)
    if body[at:].strip():
        raise FileError("holds more than its header declares; edited, or sent as text? export it again")
    if "vertex" not in found:
        raise FileError(f"no element 'vertex', found {listed(found)}; is it a point cloud?")
    columns = [(name, rows) for name, rows in found["vertex"] if isinstance(rows, np.ndarray)]
    faces = dict(found.get("face", ()))
    return Table(columns, [name for name, _ in columns], faces.get("vertex_indices", faces.get("vertex_index", ())))


def _header(header: bytes) -> tuple[bool, dict[str, _Element]]:
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
            case ["property", "list", counter, kind, *name] if name and {counter, kind} <= types.keys():
                element.properties.append(_Property(" ".join(name), types[kind], types[counter]))
            case ["property", kind, *name] if name and kind in types:
                element.properties.append(_Property(" ".join(name), types[kind], None))
            case _:
                raise FileError(f"its PLY header has a wrong line, {quoted(line.decode('latin-1'))}; export it again")
    return is_text, elements


def _rows(body: bytes, at: int, name: str, element: _Element) -> tuple[list[tuple[str, Any]], int]:
    """An element's columns, for lists a list of arrays, and where the next element starts; names may come twice."""
    n_rows, properties = element
    least = sum((kind if counter is None else counter).itemsize for _, kind, counter in properties)
    room = (len(body) - at) // least if least else n_rows
    if room < n_rows:
        raise FileError(f"truncated: it declares {n_rows} rows of {quoted(name)}, holds {room}; copy it again")
    if properties and all(counter is None for _, _, counter in properties):
        rows = np.frombuffer(body, [(f"p{i}", kind) for i, (_, kind, _) in enumerate(properties)], n_rows, at)
        return [(key, rows[f"p{i}"]) for i, (key, _, _) in enumerate(properties)], at + rows.nbytes
    columns: list[list[NDArray[Any]]] = [[] for _ in properties]
    for _ in range(n_rows if properties else 0):
        for (key, kind, counter), column in zip(properties, columns, strict=True):
            length = 1.0
            if counter is not None:
                start, at = at, at + counter.itemsize
                length = float(np.frombuffer(body, counter, 1, start)[0]) if at <= len(body) else -1
            if length < 0 or not length.is_integer() or at + length * kind.itemsize > len(body):
                raise FileError(f"truncated or damaged in {quoted(key)} of {quoted(name)}; export or copy it again")
            column.append(np.frombuffer(body, kind, int(length), at))
            at += int(length) * kind.itemsize
    return [
        (key, column if counter is not None else np.ravel(column))
        for (key, _, counter), column in zip(properties, columns, strict=True)
    ], at
