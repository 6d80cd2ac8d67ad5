"""Reading and writing the files point clouds come in: PLY, PCD, LAS and LAZ, and text in columns.

Every reader turns bytes into a :class:`Table` of named columns, and :func:`read_cloud` makes the cloud of it.
What a file declares about itself is checked against its size before anything is allocated.
"""

import io
import logging
import re
import struct
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from uuid import uuid4

import laspy
import lazrs
import numpy as np
import pandas as pd
import pypcd4.pypcd4
from numpy.typing import NDArray

from phytofit.cloud import PointCloud, from_points
from phytofit.errors import CloudError, OutputError

__all__ = ["READERS", "read_cloud", "write_cloud"]

logging.getLogger("laspy").addHandler(logging.NullHandler())  # or it prints what is raised here anyway

XYZ, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
ALIASES = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz", "r": "red", "g": "green", "b": "blue"}
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
PLY_TYPES |= {"float": "f4", "double": "f8"}
PLY_TYPES |= {np.dtype(code).name: code for code in ("f2", "i8", "u8", *PLY_TYPES.values())}
Columns: TypeAlias = dict[str, NDArray[Any]]  # (n,) each, by name


class Table(NamedTuple):
    """What a file holds of its n points, in its own unit."""

    columns: Columns  # at least those wanted
    names: list[str]  # of all the columns there are
    polygons: Collection[NDArray[Any]] = ()  # rows of a face's corners, each


class _FileError(Exception):
    """The text of a CloudError, without the file's name."""


def read_cloud(
    path: str | Path,
    units: str | None = None,
    *,
    label_property: str = "label",
    sample_faces: int | None = None,
    plausible_cm: tuple[float, float] = (10.0, 250.0),
) -> PointCloud:
    """Read a point cloud; the file's suffix says the format (see :data:`READERS`).

    Parameters
    ----------
    path
        The file.
    units
        Unit of its coordinates: ``mm``, ``cm``, ``m``, or ``none`` for relative lengths.  LAS and LAZ are in
        ``m`` unless told otherwise; for the others None raises the error that shows the size in each unit.
    label_property
        Name of the property or column that holds the labels; only ``label`` may be missing.
    sample_faces
        Take so many points, drawn uniformly from the area of the faces (PLY), instead of the vertices; the
        draw is always the same.  Label, colour and normal are those of the nearest corner.
    plausible_cm
        The least and the greatest size that is believed, cm.

    Raises
    ------
    CloudError
        If the file can't be read, isn't what its suffix says, is damaged, or holds too few points.
    UnitError
        If the unit is missing or doesn't fit the cloud's size.
    """
    path = Path(path)
    data = _file_bytes(path)
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise CloudError(f"{path.name}: unknown suffix {suffix!r}, expected one of {', '.join(READERS)}")
    if not data:
        raise CloudError(f"{path.name}: the file is empty; was the export interrupted?")
    label_key = _key(label_property)
    try:
        with np.errstate(all="ignore"):  # a wrong number is a finding, not a warning
            table = READERS[suffix](data, {*XYZ, *NORMAL, *COLOR, label_key})
            columns = {_key(name): column for name, column in table.columns.items()}
            needed = XYZ if label_property == "label" else (*XYZ, label_property)
            if missing := [name for name in needed if _key(name) not in columns]:
                raise _FileError(f"no property {', '.join(missing)}, found {table.names}; name them so")
            if sample_faces is not None:
                columns = _sampled(columns, table.polygons, sample_faces)
            triples = [names for names in (XYZ, NORMAL, COLOR) if columns.keys() >= {*names}]
            stacked = {names: np.stack([columns[name] for name in names], axis=1) for names in triples}
    except _FileError as error:
        raise CloudError(f"{path.name}: {error}") from error
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # the libraries raise anything, and a panic in lazrs is not even an Exception
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise CloudError(f"{path.name}: can't be read as {suffix} ({said}); damaged or misnamed?") from error
    return from_points(
        stacked[XYZ],
        "m" if units is None and suffix in (".las", ".laz") else units,
        labels=columns.get(label_key),
        normals=stacked.get(NORMAL),
        colors=stacked.get(COLOR),
        name=path.stem,
        source=path,
        plausible_cm=plausible_cm,
    )


def write_cloud(path: str | Path, cloud: PointCloud, extra: Columns | None = None) -> None:
    """Write a cloud, in the unit and the frame it was read in: all of it, or nothing.

    The suffix says the format: ``.ply`` (binary, little endian) or ``.xyz`` (text under a line of names).  `extra` are
    more columns (n,), by name: 32-bit integers or doubles.

    Raises
    ------
    OutputError
        If the suffix is another one, or the file can't be written there.
    """
    path = Path(path)
    columns: Columns = dict(zip(XYZ, cloud.to_input_frame(cloud.points).T, strict=True))
    if cloud.labels is not None:
        columns["label"] = cloud.labels.astype(np.int32)
    if cloud.normals is not None:
        columns |= zip(NORMAL, cloud.normals.T, strict=True)
    if cloud.colors is not None:
        columns |= zip(COLOR, cloud.colors.T, strict=True)
    columns |= extra or {}
    frame = pd.DataFrame(columns)
    if path.suffix.lower() == ".ply":
        rows = frame.to_records(index=False)
        kinds = {"f": "double", "i": "int", "u": "uchar"}
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        lines += [f"property {kinds[column.dtype.kind]} {name}" for name, column in columns.items()]
        content = "\n".join([*lines, "end_header", ""]).encode() + rows.astype(rows.dtype.newbyteorder("<")).tobytes()
    elif path.suffix.lower() == ".xyz":
        content = frame.to_csv(sep=" ", index=False, lineterminator="\n").encode()
    else:
        raise OutputError(f"{path.name}: can't write {path.suffix!r} files, expected .ply or .xyz")
    temporary = path.with_name(f".{uuid4().hex}{path.suffix}")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: can't be written ({error}); choose a folder you can write to") from error
    finally:
        with suppress(OSError, ValueError):
            temporary.unlink()


def _file_bytes(path: Path) -> bytes:
    try:
        if path.is_file():
            return path.read_bytes()
        found = "is a folder" if path.is_dir() else "no such file"
    except (OSError, ValueError, MemoryError) as error:
        raise CloudError(f"{path}: can't be read ({error}); check its permissions and its size") from error
    raise CloudError(f"{path}: {found}, expected a file of points; check the path")


def _key(name: str) -> str:
    return ALIASES.get(name.lower(), name.lower())


class _Element(NamedTuple):
    n_rows: int
    properties: list[tuple[str, np.dtype[Any], np.dtype[Any] | None]]  # name, type, type of a list's length


def _read_ply(data: bytes, wanted: Collection[str]) -> Table:
    # Not by trimesh: of a truncated text file it returns what is left, and it refuses binary lists of unequal
    # lengths (quads among triangles), a comment before the line `format`, blank lines, and Latin-1 comments.
    end = re.search(rb"^end_header[ \t]*(\r?\n|\Z)", data, re.MULTILINE)
    if end is None or not re.match(rb"ply[ \t]*\r?\n", data):
        expected = "a first line 'ply' and a line 'end_header'"
        raise _FileError(f"not a PLY file, or truncated: expected {expected}, it starts with {data[:16]!r}")
    is_text, elements = _ply_header(data[: end.start()])
    body, at, found = data[end.end() :], 0, {}
    if is_text:  # read as if it were a binary file of doubles
        body = np.fromiter(map(float, body.split()), dtype=np.float64).tobytes()
    for name, element in elements.items():
        found[name], at = _ply_rows(body, at, name, element)
    if body[at:].strip():
        raise _FileError("holds more than its header declares; edited, or sent as text? export it again")
    if "vertex" not in found:
        raise _FileError(f"no element 'vertex', found {[*found]}; is it a point cloud?")
    columns = {name: rows for name, rows in found["vertex"].items() if isinstance(rows, np.ndarray)}
    faces = found.get("face", {})
    return Table(columns, [*columns], faces.get("vertex_indices", faces.get("vertex_index", ())))


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
                raise _FileError(f"its PLY header has a wrong line, {line[:40]!r}; export it again")
    return is_text, elements


def _ply_rows(body: bytes, at: int, name: str, element: _Element) -> tuple[dict[str, Any], int]:
    """Return an element's columns, for lists a list of arrays, and where the next element starts."""
    n_rows, properties = element
    least = sum((kind if counter is None else counter).itemsize for _, kind, counter in properties)
    room = (len(body) - at) // least if least else n_rows
    if room < n_rows:
        raise _FileError(f"truncated: it declares {n_rows} rows of {name!r}, holds {room}; copy it again")
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
                raise _FileError(f"truncated or damaged in {key!r} of {name!r}; export or copy it again")
            columns[key].append(np.frombuffer(body, kind, int(length), at))
            at += int(length) * kind.itemsize
    return columns | {key: np.ravel(columns[key]) for key, _, counter in properties if counter is None}, at


def _sampled(columns: Columns, polygons: Collection[NDArray[Any]], n_points: int) -> Columns:
    groups: dict[int, list[NDArray[Any]]] = {}
    for polygon in polygons:
        groups.setdefault(len(polygon), []).append(polygon)
    fans = [np.empty((0, 3), dtype=np.int64)]
    for n_corners, group in groups.items():
        fans += [np.array(group)[:, [0, i, i + 1]].astype(np.int64) for i in range(1, n_corners - 1)]
    triangles = np.concatenate(fans)
    corners = np.stack([columns[name] for name in XYZ], axis=1).astype(np.float64)[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    areas[~np.isfinite(areas)] = 0
    if not 0 < areas.sum() < np.inf:
        raise _FileError("no faces with an area to sample; leave sample_faces out to read its vertices")
    random = np.random.default_rng(0)
    chosen = random.choice(len(triangles), n_points, p=areas / areas.sum())
    root, part = np.sqrt(random.random(n_points)), random.random(n_points)
    weights = np.stack([1 - root, root * (1 - part), root * part], axis=1)
    nearest = triangles[chosen, weights.argmax(axis=1)]
    x, y, z = np.einsum("nk,nkd->dn", weights, corners[chosen])
    return {name: column[nearest] for name, column in columns.items()} | {"x": x, "y": y, "z": z}


def _read_pcd(data: bytes, wanted: Collection[str]) -> Table:
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise _FileError(f"not a PCD file, or truncated: starts with {data[:16]!r}, has no line 'DATA'")
    lines = [line.decode("latin-1").split() for line in data[: end.start()].splitlines()]
    header = {words[0]: words[1:] for words in lines if words}
    if not {"FIELDS", "SIZE", "TYPE", "POINTS"} <= {key for key, values in header.items() if values}:
        raise _FileError(f"its PCD header holds {[*header]}, expected FIELDS, SIZE, TYPE and POINTS; export it again")
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
        raise _FileError(f"truncated: it declares {n_points} points, that is not what follows; copy it again")
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


def _read_las(data: bytes, wanted: Collection[str]) -> Table:
    if not data.startswith(b"LASF"):
        raise _FileError(f"not a LAS file: it starts with {data[:16]!r}, expected 'LASF'")
    n_vlrs, n_evlrs = (struct.unpack_from("<I", data.ljust(375, b"\0"), at)[0] for at in (100, 243))
    if 54 * n_vlrs + (60 * n_evlrs if data[25] >= 4 else 0) > len(data):
        raise _FileError(f"damaged: its LAS header declares {n_vlrs} more headers; copy it again")
    with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as file:
        if not _holds_points(data, file.header):
            raise _FileError(f"truncated: it declares {file.header.point_count} points; copy it again")
        las = file.read()
    names = [*XYZ, *(name for name in las.point_format.dimension_names if name not in ("X", "Y", "Z"))]
    return Table({name: np.asarray(las[name]) for name in names if _key(name) in wanted}, names)


def _holds_points(data: bytes, header: laspy.LasHeader) -> bool:
    """Say whether the declared points can be there: lazrs allocates them unseen, and aborts Python if that fails."""
    at, n_points, n_bytes = header.offset_to_point_data, header.point_count, header.point_format.size
    if not header.are_points_compressed:
        return bool(at + n_points * n_bytes <= len(data))
    table_at = struct.unpack_from("<q", data, at)[0]
    table_at = struct.unpack_from("<q", data, len(data) - 8)[0] if table_at == -1 else table_at
    n_chunks = struct.unpack_from("<I", data, table_at + 4)[0]
    if n_chunks * n_bytes > len(data) or n_points > 8 * len(data):  # no real point takes less than a bit
        return False
    vlr = header.vlrs.get("LasZipVlr")[0].record_data
    source = io.BytesIO(data)
    source.seek(at)
    chunks = lazrs.read_chunk_table(source, lazrs.LazVlr(vlr))
    items = struct.iter_unpack("<3H", vlr[34:])
    n_layers = sum({10: 9, 11: 1, 12: 2, 13: 1, 14: size}.get(kind, 0) for kind, size, _ in items)
    at += 8
    for _ in chunks if n_layers else ():  # a point, the number of points, the sizes of the layers, the layers
        at += n_bytes + 4
        at += 4 * n_layers + sum(struct.unpack_from(f"<{n_layers}I", data, at))
    return bool(at <= len(data) and sum(n for n, _ in chunks) >= n_points)


def _read_text(data: bytes, wanted: Collection[str]) -> Table:
    if b"\0" in data:
        raise _FileError("holds binary data, expected text with x y z on each line; is the suffix right?")
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    row = re.compile(rb"^[ \t]*(?!#|//)(?=\S).*", re.MULTILINE)
    first, n_points = row.search(data), None
    if first and re.fullmatch(rb"\s*\d{1,18}\s*", first[0]) and (second := row.search(data, first.end())):
        first, n_points = second, int(first[0])  # PTS
    if first is None:
        raise _FileError("holds no rows, expected x y z on each line; was the export interrupted?")
    separator = next((mark for mark in ";," if mark.encode() in first[0]), None)
    words = [word.strip(" \t\"'") for word in first[0].decode("latin-1").split(separator)]
    if len(words) < 3:
        raise _FileError(f"expected at least 3 columns (x y z), found {len(words)}; is this a 2-D export?")
    if len(words) > 1000:
        raise _FileError(f"expected columns x y z and a few more, found {len(words)}; is it a table of points?")
    names, start = words, first.end()
    if all(re.fullmatch(r"(?i)[-+.\de]+|[-+]?(nan|inf)", word) for word in words):
        names, start = [], first.start()
    frame = pd.read_csv(
        io.BytesIO(re.sub(rb"^[ \t]*(#|//).*", b"", data[start:], flags=re.MULTILINE)),
        sep=separator or r"\s+",
        header=None,
        dtype={i: np.float64 if not names or _key(names[i]) in wanted else str for i in range(len(words))},
        encoding="latin-1",
        skipinitialspace=True,
    )
    names = names or _guessed_names(frame, n_points is not None)
    if len(names) != frame.shape[1]:
        raise _FileError(f"found {len(names)} column names over {frame.shape[1]} columns; name each column")
    if n_points not in (None, len(frame)):
        raise _FileError(f"truncated: its first line declares {n_points} points, found {len(frame)}")
    return Table({name: frame[i].to_numpy() for i, name in enumerate(names) if _key(name) in wanted}, names)


def _guessed_names(frame: pd.DataFrame, is_pts: bool) -> list[str]:
    values = frame.iloc[:, 3:].to_numpy()
    values = values[np.isfinite(values)]
    is_whole = (values == np.rint(values)).all()
    is_color = is_whole and ((values >= 0) & (values <= 255)).all()
    more = {3: (), 4: ("label",) if is_whole else ("intensity",), 6: COLOR if is_color else NORMAL}
    if is_pts:
        more |= {4: ("intensity",), 7: ("intensity", *COLOR)}
    if (n := frame.shape[1]) not in more:
        expected = "3 (x y z), 4 (and label) or 6 (and red green blue, or nx ny nz)"
        raise _FileError(f"found {n} columns without names, expected {expected}; name them in the first line")
    return [*XYZ, *more[n]]


READERS: dict[str, Callable[[bytes, Collection[str]], Table]] = {
    **{".ply": _read_ply, ".pcd": _read_pcd, ".las": _read_las, ".laz": _read_las},
    **dict.fromkeys((".xyz", ".txt", ".csv", ".pts", ".asc"), _read_text),
}
"""Readers by suffix: bytes and the keys of the columns wanted -> Table."""
