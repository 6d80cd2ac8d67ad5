"""One cloud in every format and dialect that people's tools write: for tests of reading, of traits, and of damage."""

import io
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import laspy
import numpy as np
import pye57
import trimesh
from pypcd4 import pypcd4


class Dialect(NamedTuple):
    suffix: str
    write: Callable[[np.ndarray], bytes]  # points (n, 3) in the unit of the file -> the file
    error: float = 0.0  # by which what is read may be off, in that unit
    unit: str | None = None  # that the file itself states


def rows(
    points: np.ndarray,
    separator: str,
    *,
    begin: str = "",
    more: str = "",
    end: str = "\n",
    number: Callable[[float], str] = repr,
) -> str:
    """Rows of numbers, each after and before more columns, if any."""
    return "".join(begin + separator.join(map(number, row)) + more + end for row in points.tolist())


def comma(value: float) -> str:
    return repr(value).replace(".", ",")


def text(points: np.ndarray, separator: str = " ", *, head: str = "", encoding: str = "utf-8", **how: Any) -> bytes:
    return (head + rows(points, separator, **how)).encode(encoding)


def quoted(value: float) -> str:
    return f'"{comma(value)}"'


def scans(points: np.ndarray, **how: Any) -> bytes:
    """PTS of three scans, each under its count."""
    return b"".join(f"{len(part)}\n".encode() + text(part, **how) for part in np.array_split(points, 3))


def with_empty_lines(points: np.ndarray) -> bytes:
    lines = text(points).split(b"\n")
    return b"\n\n".join(lines[:20]) + b"\n  \n# in between\n" + b"\n".join(lines[20:])


def mixed_blanks(points: np.ndarray) -> bytes:
    gaps = [" ", "\t", "   ", " \t "]
    return "".join(
        gaps[i % 4].join(map(repr, row)) + gaps[i % 3] + "\n" for i, row in enumerate(points.tolist())
    ).encode()


def table_of_r(points: np.ndarray) -> bytes:
    """As write.table writes it: the rows have names, and their column has none."""
    lines = rows(points, " ", more=" 3").splitlines()
    return b'"x" "y" "z" "intensity"\n' + "".join(f'"{i}" {row}\n' for i, row in enumerate(lines, 1)).encode()


def numbered(points: np.ndarray) -> bytes:
    return "".join(f"{i} {x!r} {y!r} {z!r}\n" for i, (x, y, z) in enumerate(points.tolist(), 1)).encode()


TEXT = {
    "blanks": Dialect(".xyz", text),
    "no-break blanks": Dialect(".txt", lambda p: text(p, "\u00a0")),
    "mixed blanks": Dialect(".asc", mixed_blanks),
    "commas": Dialect(".csv", lambda p: text(p, ",")),
    "commas, blanks": Dialect(".csv", lambda p: text(p, ", ")),
    "semicolons": Dialect(".csv", lambda p: text(p, ";")),
    "tabs": Dialect(".txt", lambda p: text(p, "\t")),
    "CRLF": Dialect(".txt", lambda p: text(p, end="\r\n")),
    "CR": Dialect(".txt", lambda p: text(p, end="\r")),
    "no end of line": Dialect(".xyz", lambda p: text(p).rstrip()),
    "empty lines": Dialect(".xyz", with_empty_lines),
    "trailing comma": Dialect(".csv", lambda p: text(p, ",", more=",")),
    "trailing semicolons": Dialect(".csv", lambda p: text(p, ";", more=";;", end="\r\n", head="X;Y;Z;;\r\n")),
    "trailing tab": Dialect(".txt", lambda p: text(p, "\t", more="\t")),
    "decimal comma, semicolons": Dialect(".csv", lambda p: text(p, ";", head="X;Y;Z\r\n", end="\r\n", number=comma)),
    "decimal comma, tabs": Dialect(".txt", lambda p: text(p, "\t", number=comma)),
    "decimal comma, blanks": Dialect(".xyz", lambda p: text(p, "  ", number=comma)),
    "decimal comma, commas": Dialect(".csv", lambda p: text(p, ", ", number=comma)),
    "decimal comma, quotes": Dialect(".csv", lambda p: text(p, ",", head='"x","y","z"\n', number=quoted)),
    "UTF-8 mark": Dialect(".csv", lambda p: text(p, ",", head="\ufeffx,y,z\n")),
    "UTF-16": Dialect(".txt", lambda p: text(p, "\t", head="X\tY\tZ\r\n", end="\r\n", encoding="utf-16")),
    "UTF-16 BE": Dialect(".csv", lambda p: text(p, ";", head="\ufeffx;y;z\n", encoding="utf-16-be", number=comma)),
    "UTF-16 LE without a mark": Dialect(".txt", lambda p: text(p, encoding="utf-16-le")),
    "UTF-32": Dialect(".txt", lambda p: text(p, encoding="utf-32")),
    "Windows-1252": Dialect(".txt", lambda p: text(p, head="# Ähre, 3 m² – Größe\nx y z\n", encoding="cp1252")),
    "comments": Dialect(".txt", lambda p: text(p, head="# scanned\n// at noon\n% twice\n" + 3000 * "# more\n")),
    "names in a comment": Dialect(".txt", lambda p: text(p[:, [1, 2, 0]], head="# made by hand\n# y z x\n")),
    "a comment that speaks of x y z": Dialect(
        ".txt", lambda p: text(p, head="# x y and z are in the unit of the scan\n")
    ),
    "CloudCompare": Dialect(
        ".txt",
        lambda p: text(
            p, ";", head=f"//X;Y;Z;Rf;Gf;Bf;Illuminance (PCV);Nx;Ny;Nz\n{len(p)}\n", more=";1.0;0.0;0.5;0.72;0;0;1"
        ),
    ),
    "CloudCompare, blanks": Dialect(".asc", lambda p: text(p, head="//X Y Z Intensity\n", more=" 2")),
    "names with units": Dialect(".csv", lambda p: text(p, ",", head='"X [mm]","Y [mm]","Z [mm]"\n'), unit="mm"),
    "names with units, blanks": Dialect(".txt", lambda p: text(p, head="X (m) Y (m) Z (m)\n"), unit="m"),
    "names with units, underscores": Dialect(".csv", lambda p: text(p, ",", head="x_cm,y_cm,z_cm\n"), unit="cm"),
    "units under the names": Dialect(
        ".csv", lambda p: text(p, ";", head="X;Y;Z\n[mm];[mm];[mm]\n", number=comma), unit="mm"
    ),
    "ParaView": Dialect(".csv", lambda p: text(p, ",", head='"Points:0","Points:1","Points:2"\n')),
    "names that are quoted": Dialect(".txt", lambda p: text(p, head='"x" "y" "z" "plant id"\n', more=' "A 7"')),
    "a title": Dialect(".csv", lambda p: text(p, ",", head="Leaf of maize\nX,Y,Z\n")),
    "sep=": Dialect(".csv", lambda p: text(p, ";", head="sep=;\nX;Y;Z\n", number=comma)),
    "bars": Dialect(".txt", lambda p: text(p, "|", head="X|Y|Z\n", number=comma)),
    "leading commas": Dialect(".csv", lambda p: text(p, ",", begin=",")),
    "leading tabs": Dialect(".txt", lambda p: text(p, "\t", head="\tX\tY\tZ\t\n", begin="\t", more="\t")),
    "UTF-16 LE, other letters first": Dialect(
        ".csv", lambda p: text(p, ";", head="Höhe;x;y;z\n", begin="7;", encoding="utf-16-le")
    ),
    "UTF-16 BE, other letters first": Dialect(
        ".csv", lambda p: text(p, ";", head="Ωmega;x;y;z\n", begin="7;", encoding="utf-16-be")
    ),
    "R": Dialect(".txt", table_of_r),
    "one name twice": Dialect(".csv", lambda p: text(p[:, [0, 1, 2, 0]], ",", head="x,y,z,x\n")),
    "comments of other programs": Dialect(
        ".txt", lambda p: text(p[:, [2, 1, 0]], head="/* exported */\n! in the field\n* by hand\n; Z Y X\n")
    ),
    "a line under the names": Dialect(".txt", lambda p: text(p, head="x y z\n-----------\ncm cm cm\n"), unit="cm"),
    "files joined": Dialect(".csv", lambda p: text(p[:50], ",", head="x,y,z\n") + text(p[50:], ",", head="x,y,z\n")),
    "files joined, each with a mark": Dialect(
        ".csv", lambda p: b"".join(text(part, ",", head="\ufeffx,y,z\n") for part in (p[:50], p[50:]))
    ),
    "pages and DOS's end of a file": Dialect(".txt", lambda p: text(p[:50]) + b"\f\n" + text(p[50:]) + b"\x1a"),
    "Fortran": Dialect(".txt", lambda p: text(p, number=lambda v: f"{v:.16E}".replace("E", "D"))),
    "PTS": Dialect(".pts", lambda p: text(p, head=f"{len(p)}\n", more=" -1200 255 0 0")),
    "PTS in TXT": Dialect(".txt", lambda p: text(p, head=f"{len(p)}\r\n", more=" -700", end="\r\n")),
    "PTS of scans": Dialect(".pts", lambda p: scans(p, more=" -1200 255 0 0")),
    "PTS of scans, both counts": Dialect(".pts", lambda p: b"3\n%d\n" % len(p) + scans(p, more=" -1200")),
    "numbered rows": Dialect(".txt", numbered),
    "a frame's index": Dialect(".csv", lambda p: b",x,y,z\n" + numbered(p).replace(b" ", b",")),
    "five columns": Dialect(".xyz", lambda p: text(p, more=" 17 0.25")),
    "missing in other columns": Dialect(".csv", lambda p: text(p, ",", head="x,y,z,note,height\n", more=",,")),
}


def ply(points: np.ndarray, kind: str = "<f8", newline: bytes = b"\n", more: bytes = b"", before: bytes = b"") -> bytes:
    """Binary PLY of doubles or singles, with more properties of one byte each."""
    encoding = b"binary_little_endian" if kind[0] == "<" else b"binary_big_endian"
    names = [b"property " + (b"double " if kind[2] == "8" else b"float ") + name for name in (b"x", b"y", b"z")]
    more_names = [b"property uchar " + name for name in more.split(b"|") if name]
    header = [b"ply", b"format " + encoding + b" 1.0", *before.split(b"|")[: 1 if before else 0]]
    header += [b"element vertex %d" % len(points), *names, *more_names, b"end_header", b""]
    bytes_of_rows = [row.astype(kind).tobytes() + b"\7" * len(more_names) for row in points]
    return newline.join(header) + before.partition(b"|")[2] + b"".join(bytes_of_rows)


def ascii_ply(points: np.ndarray, end: str = "\n", encoding: str = "utf-8", **how: Any) -> bytes:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {name}\n" for name in "xyz") + "end_header\n"
    return text(points, head=head.replace("\n", end), end=end, encoding=encoding, **how)


def pcd(points: np.ndarray, encoding: str) -> bytes:
    file = io.BytesIO()
    pypcd4.PointCloud.from_points(points, ("x", "y", "z"), (np.float64,) * 3).save(file, pypcd4.Encoding(encoding))
    return file.getvalue()


def ascii_pcd(points: np.ndarray, **how: Any) -> bytes:
    n = len(points)
    head = "VERSION .7\nFIELDS x y z rgb rgb\nSIZE 4 4 4 4 4\nTYPE F F F F F\n"
    head += f"WIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA ascii\n"
    return text(points, head=head, more=" 4.2108e+06 0", **how)


def las(
    points: np.ndarray, point_format: int = 3, version: str = "1.2", *, compress: bool = False, scale: float = 1e-5
) -> bytes:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [scale] * 3, np.floor(points.min(axis=0))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    file = io.BytesIO()
    data.write(file, do_compress=compress)
    return file.getvalue()


def e57(*parts: np.ndarray, pose: bool = False, colors: np.ndarray | None = None) -> bytes:
    """E57 of one scan for each part; with a pose, each scan in a frame of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "cloud.e57")
        file = pye57.E57(path, mode="w")
        for part in parts:
            how: dict[str, Any] = {}
            local = part
            if pose:  # a quarter turn about z
                how = {
                    "rotation": np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]),
                    "translation": np.array([0.3, -2.0, 1.0]),
                }
                moved = part - how["translation"]
                local = np.stack([moved[:, 1], -moved[:, 0], moved[:, 2]], axis=1)
            data = {f"cartesian{axis}": np.ascontiguousarray(local[:, i]) for i, axis in enumerate("XYZ")}
            if colors is not None:
                data |= {
                    f"color{name}": colors[:, i].astype(np.uint8) for i, name in enumerate(("Red", "Green", "Blue"))
                }
            file.write_scan_raw(data, **how)
        file.close()
        return Path(path).read_bytes()


def obj(points: np.ndarray, more: str = "", faces: str = "") -> bytes:
    return (
        "# made by hand\no plant\n" + "".join(f"v {x!r} {y!r} {z!r}{more}\n" for x, y, z in points.tolist()) + faces
    ).encode()


def mesh_bytes(points: np.ndarray, **how: Any) -> bytes:
    """As trimesh writes them, with a face between every three points."""
    faces = np.arange(len(points) // 3 * 3).reshape(-1, 3)
    made: Any = trimesh.Trimesh(points, faces, process=False).export(**how)
    return made.encode() if isinstance(made, str) else made


def header_of_lists(points: np.ndarray) -> bytes:
    """PLY with a list before the vertices and one among their properties."""
    header = b"ply\nformat binary_little_endian 1.0\nelement view 2\nproperty list uchar int seen\n"
    header += (
        b"element vertex %d\nproperty float x\nproperty list uchar short seen\nproperty float y\nproperty float z\n"
    )
    lists = struct.pack("<B2i", 2, 7, 8) + struct.pack("<B", 0)
    body = b"".join(struct.pack("<fB2h2f", x, 2, 1, -1, y, z) for x, y, z in points)
    return header % len(points) + b"end_header\n" + lists + body


SINGLE = 2.0**-22  # relative: a step of single precision, twice
BINARY = {
    "PLY": Dialect(".ply", ply),
    "PLY, singles": Dialect(".ply", lambda p: ply(p, "<f4"), SINGLE * 30),
    "PLY, big endian": Dialect(".ply", lambda p: ply(p, ">f8")),
    "PLY, CRLF": Dialect(".ply", lambda p: ply(p, newline=b"\r\n")),
    "PLY, CR": Dialect(".ply", lambda p: ply(p, newline=b"\r")),
    "PLY, one name twice": Dialect(".ply", lambda p: ply(p, more=b"scalar_field|scalar_field")),
    "PLY, a name with a blank": Dialect(".ply", lambda p: ply(p, more=b"scalar_Scalar field|")),
    "PLY, text": Dialect(".ply", ascii_ply),
    "PLY, text, CRLF": Dialect(".ply", lambda p: ascii_ply(p, "\r\n")),
    "PLY, text, CR": Dialect(".ply", lambda p: ascii_ply(p, "\r")),
    "PLY, text, decimal comma": Dialect(".ply", lambda p: ascii_ply(p, number=comma)),
    "PLY, text, UTF-8 mark": Dialect(".ply", lambda p: ascii_ply(p, encoding="utf-8-sig")),
    "PLY, text, UTF-16": Dialect(".ply", lambda p: ascii_ply(p, encoding="utf-16")),
    "PLY, lists": Dialect(".ply", header_of_lists, SINGLE * 30),
    "PLY, mesh": Dialect(".ply", lambda p: mesh_bytes(p, file_type="ply"), SINGLE * 30),
    "PCD, text": Dialect(".pcd", ascii_pcd),
    "PCD, text, tabs, CRLF": Dialect(".pcd", lambda p: ascii_pcd(p, separator="\t", end="\r\n")),
    "PCD, text, no POINTS": Dialect(".pcd", lambda p: ascii_pcd(p).replace(b"POINTS %d\n" % len(p), b"")),
    "PCD, binary": Dialect(".pcd", lambda p: pcd(p, "binary")),
    "PCD, compressed": Dialect(".pcd", lambda p: pcd(p, "binary_compressed")),
    "LAS 1.2": Dialect(".las", las, 1e-5, "m"),
    "LAS 1.4": Dialect(".las", lambda p: las(p, 7, "1.4"), 1e-5, "m"),
    "LAZ 1.2": Dialect(".laz", lambda p: las(p, compress=True), 1e-5, "m"),
    "LAZ 1.4": Dialect(".laz", lambda p: las(p, 7, "1.4", compress=True), 1e-5, "m"),
    "E57": Dialect(".e57", e57, SINGLE * 30, "m"),
    "E57, scans with poses": Dialect(".e57", lambda p: e57(*np.array_split(p, 2), pose=True), SINGLE * 30, "m"),
    "OBJ": Dialect(".obj", obj),
    "OBJ, colours": Dialect(".obj", lambda p: obj(p, " 0.5 1.0 0.25")),
    "OBJ, mesh": Dialect(".obj", lambda p: mesh_bytes(p, file_type="obj", digits=12), 1e-10),
}
DIALECTS = TEXT | BINARY
