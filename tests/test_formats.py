"""Files written by other libraries, or composed byte by byte, against what is read of them; and no surprise ends."""

import io
import os
import re
import struct
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pypcd4 import pypcd4

from phytofit.cloud import READERS, PointCloud, from_points, read_cloud, write_cloud
from phytofit.errors import CloudError, OutputError, UnitError

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real clouds in ../shared/data")

FLOAT32 = 2.0**-23  # relative step of single precision
TEXT = (".xyz", ".txt", ".csv", ".pts", ".asc")

random = np.random.default_rng(0)
N = 120
POINTS = np.round(random.uniform(-20, 20, (N, 3)), 3).astype(np.float32).astype(np.float64)
LABELS = np.arange(N) % 4
COLORS = random.integers(0, 256, (N, 3))
NORMALS = np.round(random.uniform(-1, 1, (N, 3)), 2)

COLUMNS = {
    **dict(zip(("x", "y", "z"), POINTS.T, strict=True)),
    "label": LABELS,
    **dict(zip(("red", "green", "blue"), COLORS.T, strict=True)),
    **dict(zip(("nx", "ny", "nz"), NORMALS.T, strict=True)),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("clouds")


def put(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assert_full(cloud: PointCloud) -> None:
    np.testing.assert_allclose(cloud.points, POINTS, rtol=FLOAT32)
    np.testing.assert_array_equal(cloud.labels, LABELS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    np.testing.assert_allclose(cloud.normals, NORMALS, rtol=FLOAT32)


# PLY

CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
SYNONYMS = dict(zip(CODES, ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), strict=True))
CODES |= {SYNONYMS[kind]: code for kind, code in CODES.items()}
ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

Element = tuple[str, list[tuple[str, ...]], list[list[Any]]]  # name, properties as in the header, rows


def ply(encoding: str, elements: list[Element], newline: str = "\n", extra: tuple[str, ...] = ()) -> bytes:
    """Compose a PLY file; a value that is a list belongs to a list property."""
    header = ["ply", *extra, f"format {encoding} 1.0"]
    body = b""
    for name, properties, rows in elements:
        header += [f"element {name} {len(rows)}", *extra, *("property " + " ".join(p) for p in properties)]
        for row in rows:
            words = []
            for (*kinds, _), value in zip(properties, row, strict=True):
                values, types = [value], kinds
                if isinstance(value, list):
                    values, types = [len(value), *value], [kinds[1], *[kinds[2]] * len(value)]
                if encoding == "ascii":
                    words += [str(v) for v in values]
                else:
                    body += struct.pack(ENCODINGS[encoding] + "".join(CODES[kind] for kind in types), *values)
            body += (" ".join(words) + newline).encode() if encoding == "ascii" else b""
    return newline.join([*header, "end_header", ""]).encode("latin-1") + body


CAMERA: Element = ("camera", [("float", "view_px"), ("int", "viewportx")], [[0.5, 640]])
FACES: Element = ("face", [("list", "uchar", "int", "vertex_indices")], [[[0, 1, 2]], [[1, 2, 3, 4]], [[]]])
XYZ_PROPERTIES = [("float", "x"), ("float", "y"), ("float", "z")]
XYZ: Element = ("vertex", XYZ_PROPERTIES, POINTS.tolist())


@st.composite
def vertex_elements(draw: st.DrawFn) -> Element:
    """All columns in any order, of any type that holds them, with other properties and lists among them."""
    reals = ["float", "double", "float32", "float64"]
    kinds = dict.fromkeys(("x", "y", "z", "nx", "ny", "nz", "confidence"), reals)
    kinds |= {name: ["uchar", "uint8", "ushort", "int", "float"] for name in ("red", "green", "blue")}
    kinds["label"] = [*CODES]
    names = draw(st.permutations([*kinds, "views", "neighbours"]))
    properties, columns = [], []
    for name in names:
        if name == "views":
            properties.append(("list", draw(st.sampled_from(["uchar", "int"])), "ushort", name))
            columns.append([[7] * (i % 3) for i in range(N)])
        elif name == "neighbours":
            properties.append(("list", "uchar", draw(st.sampled_from(["uchar", "float"])), name))
            columns.append([[1, 2] for _ in range(N)])
        else:
            kind = draw(st.sampled_from(kinds[name]))
            properties.append((kind, name))
            values = COLUMNS.get(name, np.full(N, 0.25)).tolist()
            columns.append(values if CODES[kind] in "fd" else [int(value) for value in values])
    return "vertex", properties, [list(row) for row in zip(*columns, strict=True)]


@settings(deadline=None, max_examples=60)
@given(
    vertex=vertex_elements(),
    encoding=st.sampled_from([*ENCODINGS]),
    newline=st.sampled_from(["\n", "\r\n"]),
    around=st.permutations([CAMERA, FACES, ("empty", [("int", "a"), ("list", "int", "int", "b")], [])]),
    at=st.integers(0, 3),
    extra=st.sampled_from([(), ("comment by Universit\xe9 \x85 end_header", "obj_info element vertex 9", "")]),
)
def test_ply_in_any_order_of_any_type(
    folder: Path, vertex: Element, encoding: str, newline: str, around: list[Element], at: int, extra: tuple[str, ...]
) -> None:
    content = ply(encoding, [*around[:at], vertex, *around[at:]], newline, extra)
    assert_full(read_cloud(put(folder / "any.ply", content), "cm"))


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_as_trimesh_writes_it(tmp_path: Path, encoding: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=10)
    mesh.visual.vertex_colors = random.integers(0, 256, (len(mesh.vertices), 4))
    cloud = read_cloud(put(tmp_path / "ball.ply", mesh.export(file_type="ply", encoding=encoding)), "cm")
    np.testing.assert_allclose(cloud.points, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors, mesh.visual.vertex_colors[:, :3])
    assert (cloud.name, cloud.source) == ("ball", tmp_path / "ball.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_points_sampled_from_faces(tmp_path: Path, encoding: str) -> None:
    box = trimesh.creation.box(extents=[30, 20, 10])
    box.visual.vertex_colors = np.where(box.vertices[:, :1] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
    path = put(tmp_path / "box.ply", box.export(file_type="ply", encoding=encoding))
    cloud = read_cloud(path, "cm", sample_faces=20_000)
    np.testing.assert_array_equal(cloud.points, read_cloud(path, "cm", sample_faces=20_000).points)
    on = np.isclose(np.abs(cloud.points), [15, 10, 5], atol=1e-6)
    assert on.any(axis=1).all()
    areas = np.array([20 * 10, 30 * 10, 30 * 20])
    np.testing.assert_allclose(on.mean(axis=0), areas / areas.sum(), atol=0.02)
    inside = np.where(on, np.nan, cloud.points / [15, 10, 5])
    np.testing.assert_allclose(np.nanvar(inside, axis=0), 1 / 3, atol=0.02)  # uniform in [-1, 1]
    assert cloud.colors is not None
    assert (cloud.colors[:, 0] > 0)[cloud.points[:, 0] > 14].all()


def test_polygons_are_sampled_whole(tmp_path: Path) -> None:
    corners = [[0.0, 0, 0], [30, 0, 0], [30, 30, 0], [15, 45, 0], [0, 30, 0], [0, 0, 10], [np.nan, 0, 0]]
    vertex: Element = ("vertex", XYZ_PROPERTIES, corners)
    faces: Element = (FACES[0], FACES[1], [[[0, 1, 2, 3, 4]], [[0, 1, 5]], [[0, 1, 6]], [[0, 1]]])
    cloud = read_cloud(put(tmp_path / "a.ply", ply("binary_big_endian", [vertex, faces])), "cm", sample_faces=10_000)
    flat = cloud.points[np.abs(cloud.points[:, 2]) < 1e-9]
    assert len(flat) / 10_000 == pytest.approx(1125 / (1125 + 150), abs=0.02)
    assert (flat[:, 1] > 30).mean() == pytest.approx(225 / 1125, abs=0.02)


# PCD


def packed(colors: np.ndarray) -> np.ndarray:
    red, green, blue = colors.astype(np.uint32).T
    return red << 16 | green << 8 | blue


@pytest.mark.parametrize(
    ("encoding", "color_type"),
    [  # not ascii with float32: pypcd4 writes 10 decimals of it, so it writes black
        ("ascii", np.uint32),
        ("binary", np.uint32),
        ("binary", np.float32),
        ("binary_compressed", np.uint32),
        ("binary_compressed", np.float32),
    ],
)
def test_pcd_as_pypcd4_writes_it(tmp_path: Path, encoding: str, color_type: Any) -> None:
    names = ("x", "y", "z", "rgb", "normal_x", "normal_y", "normal_z", "label")
    types = (np.float32, np.float32, np.float32, color_type, np.float64, np.float32, np.float32, np.uint8)
    columns = [*POINTS.T, packed(COLORS).view(color_type), *NORMALS.T, LABELS]
    pypcd4.PointCloud.from_points(columns, names, types).save(tmp_path / "a.pcd", pypcd4.Encoding(encoding))
    assert_full(read_cloud(tmp_path / "a.pcd", "cm"))


def pcd_header(encoding: str, n_points: int = N, count: str = "COUNT 1 1 2 1 1\n", version: str = "0.7") -> str:
    return (
        f"# .PCD v{version}\nVERSION {version}\nFIELDS z _ vfh/2 y x\nSIZE 4 1 2 4 8\nTYPE F U I F F\n{count}"
        f"WIDTH {n_points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n_points}\nDATA {encoding}\n"
    )


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_composed_by_hand(tmp_path: Path, encoding: str) -> None:
    x, y, z = POINTS.T
    if encoding == "ascii":
        body = "".join(f"{z[i]}\t1  2 3 {y[i]} {x[i]} \r\n" for i in range(N)).encode()
    elif encoding == "binary":
        body = b"".join(struct.pack("<fBhhfd", z[i], 1, 2, 3, y[i], x[i]) for i in range(N))
    else:  # field after field, as LZF literals of 32 bytes at most
        plain = np.float32(z).tobytes() + bytes(N) + bytes(4 * N) + np.float32(y).tobytes() + x.tobytes()
        runs = [plain[i : i + 32] for i in range(0, len(plain), 32)]
        lzf = b"".join(bytes([len(run) - 1]) + run for run in runs)
        body = struct.pack("<II", len(lzf), len(plain)) + lzf
    cloud = read_cloud(put(tmp_path / "a.pcd", pcd_header(encoding).encode() + body), "cm")
    np.testing.assert_allclose(cloud.points, POINTS, rtol=FLOAT32)


def test_pcd_colors_as_pcl_writes_them(tmp_path: Path) -> None:
    header = f"VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nPOINTS {N}\nDATA ascii\n"
    lines = "".join(f"{x} {y} {z} {c:.9g}\n" for (x, y, z), c in zip(POINTS, packed(COLORS).view("f4"), strict=True))
    np.testing.assert_array_equal(read_cloud(put(tmp_path / "a.pcd", header + lines), "cm").colors, COLORS)


def test_old_pcd_without_count(tmp_path: Path) -> None:
    lines = "".join(f"{z} 0 0 {y} {x}\n" for x, y, z in POINTS)
    cloud = read_cloud(put(tmp_path / "a.pcd", pcd_header("ascii", count="", version="0.5") + lines), "cm")
    np.testing.assert_array_equal(cloud.points, POINTS)


# text


def table(names: tuple[str, ...], separator: str) -> str:
    return "\n".join(separator.join(str(COLUMNS[name][i]) for name in names) for i in range(N)) + "\n"


XYZ_NAMES, RGB_NAMES, NORMAL_NAMES = ("x", "y", "z"), ("red", "green", "blue"), ("nx", "ny", "nz")


@pytest.mark.parametrize("suffix", TEXT)
@pytest.mark.parametrize("separator", [" ", "   ", "\t", ",", ", ", ";", "; "])
@pytest.mark.parametrize("more", [(), ("label",), RGB_NAMES, NORMAL_NAMES], ids=str)
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_columns_without_names(folder: Path, suffix: str, separator: str, more: tuple[str, ...], newline: str) -> None:
    text = table((*XYZ_NAMES, *more), separator)
    if newline == "\n":
        text = "# x y\n//scanned\n\n" + text.replace("\n", "\n  # in between\n\n", 1)
    cloud = read_cloud(put(folder / f"a{suffix}", text.replace("\n", newline)), "cm")
    np.testing.assert_array_equal(cloud.points, POINTS)
    for key, names, expected in (
        ("labels", ("label",), LABELS),
        ("colors", RGB_NAMES, COLORS),
        ("normals", NORMAL_NAMES, NORMALS),
    ):
        if more == names:
            np.testing.assert_array_equal(getattr(cloud, key), expected)
        else:
            assert getattr(cloud, key) is None


@settings(deadline=None, max_examples=40)
@given(
    names=st.permutations([*COLUMNS, "plant id", ""]),
    separator=st.sampled_from([",", ";", ", "]),
    bom=st.booleans(),
    quoted=st.booleans(),
    upper=st.booleans(),
)
def test_columns_with_names_in_any_order(
    folder: Path, names: list[str], separator: str, bom: bool, quoted: bool, upper: bool
) -> None:
    mark = '"' if quoted else ""
    header = separator.join(f"{mark}{name.upper() if upper else name}{mark}" for name in names)
    columns: dict[str, Any] = {**COLUMNS, "plant id": ["A 7"] * N, "": [f"{mark}{i}{mark}" for i in range(N)]}
    rows = "".join(separator.join(str(columns[name][i]) for name in names) + "\n" for i in range(N))
    path = put(folder / "named.csv", ("\ufeff" if bom else "") + f"# a note\n{header}\n{rows}")
    assert_full(read_cloud(path, "cm"))


def test_numbers_of_a_text_file_are_read_exactly(tmp_path: Path) -> None:
    points = random.uniform(-20, 20, (N, 3))
    text = "".join(f"{x!r} {y:+.17e} {z!r}\n" for x, y, z in points.tolist())
    np.testing.assert_array_equal(read_cloud(put(tmp_path / "a.txt", text), "cm").points, points)


def test_pts_with_a_count_holds_intensities(tmp_path: Path) -> None:
    rows = [" ".join(map(str, (*POINTS[i], -700 - i, *COLORS[i]))) for i in range(N)]
    cloud = read_cloud(put(tmp_path / "a.pts", "\n".join([str(N), *rows])), "cm")
    np.testing.assert_array_equal(cloud.colors, COLORS)
    np.testing.assert_array_equal(cloud.points, POINTS)
    rows = [" ".join(row.split()[:4]) for row in rows]
    assert read_cloud(put(tmp_path / "a.pts", "\n".join([str(N), *rows])), "cm").labels is None


def test_a_fourth_column_of_fractions_is_no_label(tmp_path: Path) -> None:
    text = "".join(f"{x} {y} {z} 0.{i}\n" for i, (x, y, z) in enumerate(POINTS))
    cloud = read_cloud(put(tmp_path / "a.txt", text), "cm")
    assert cloud.labels is None
    np.testing.assert_array_equal(cloud.points, POINTS)


# LAS and LAZ


def las_bytes(points_m: np.ndarray, point_format: int = 3, version: str = "1.2", compress: bool = False) -> bytes:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [1e-5] * 3, np.floor(points_m.min(axis=0))
    header.add_extra_dim(laspy.ExtraBytesParams("TreeID", np.uint16))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points_m.T
    las.TreeID, las.classification = LABELS[np.arange(len(points_m)) % N], np.full(len(points_m), 5)
    if "red" in las.point_format.dimension_names:
        las.red, las.green, las.blue = 257 * COLORS[np.arange(len(points_m)) % N].T
    file = io.BytesIO()
    las.write(file, do_compress=compress)
    return file.getvalue()


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize(("point_format", "version"), [(0, "1.2"), (3, "1.2"), (6, "1.4"), (7, "1.4"), (8, "1.4")])
@pytest.mark.parametrize("corner", [(0, 0, 0), (512_345, 5_412_345, 321)])
def test_las_is_in_metres(
    tmp_path: Path, compress: bool, point_format: int, version: str, corner: tuple[int, ...]
) -> None:
    content = las_bytes(POINTS / 100 + corner, point_format, version, compress)
    path = put(tmp_path / ("a.laz" if compress else "a.las"), content)
    cloud = read_cloud(path, label_property="treeid")
    np.testing.assert_allclose(cloud.points + cloud.offset - 100 * np.array(corner), POINTS, atol=1.1e-3)
    assert cloud.unit == "m"
    assert (np.abs(cloud.points) < 100).all()
    np.testing.assert_array_equal(cloud.labels, LABELS)
    np.testing.assert_array_equal(cloud.colors, COLORS if point_format in (3, 7, 8) else None)  # type: ignore[arg-type]
    assert read_cloud(path).labels is None
    assert set(read_cloud(path, label_property="classification").labels) == {5}  # type: ignore[arg-type]


def test_las_with_many_chunks(tmp_path: Path) -> None:
    points = random.uniform(-0.2, 0.2, (120_001, 3))
    for version, point_format in (("1.2", 3), ("1.4", 7)):
        cloud = read_cloud(put(tmp_path / "a.laz", las_bytes(points, point_format, version, True)))
        np.testing.assert_allclose(cloud.points, 100 * points, atol=1.1e-3)


def test_las_in_another_unit(tmp_path: Path) -> None:
    cloud = read_cloud(put(tmp_path / "a.las", las_bytes(POINTS)), "cm")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1.1e-5)


def test_las_composed_by_hand(tmp_path: Path) -> None:
    header = bytearray(227)
    header[:4], header[24:26] = b"LASF", b"\1\2"
    struct.pack_into("<HIIBHI", header, 94, 227, 227, 0, 0, 20, N)
    struct.pack_into("<6d", header, 131, 1e-5, 1e-5, 1e-5, 0.25, 0.5, 0)
    whole = np.rint((POINTS / 100 - [0.25, 0.5, 0]) * 1e5).astype(int).tolist()
    path = put(tmp_path / "a.las", bytes(header) + b"".join(struct.pack("<3i8x", *row) for row in whole))
    np.testing.assert_allclose(read_cloud(path).points, POINTS, atol=1.1e-3)


# writing


@pytest.mark.parametrize("suffix", [".ply", ".xyz"])
@pytest.mark.parametrize("units", ["mm", "cm", "m", "none"])
@pytest.mark.parametrize("corner", [0.0, 4.5e7])
@pytest.mark.parametrize("full", [True, False])
def test_what_is_written_is_in_the_inputs_frame(
    tmp_path: Path, suffix: str, units: str, corner: float, full: bool
) -> None:
    points = POINTS / {"mm": 0.1, "cm": 1, "m": 100, "none": 1}[units] + corner
    more = {"labels": LABELS, "colors": COLORS, "normals": NORMALS} if full else {}
    cloud = from_points(points, units, **more)  # type: ignore[arg-type]
    path = tmp_path / f"out{suffix}"
    write_cloud(path, cloud)
    assert os.listdir(tmp_path) == [path.name]  # noqa: PTH208
    if suffix == ".ply":
        raw = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    else:
        raw = np.genfromtxt(path, names=True)
    np.testing.assert_allclose(np.stack([raw[name] for name in "xyz"], axis=1), points, rtol=1e-14)
    again = read_cloud(path, units)
    np.testing.assert_allclose(again.points + again.offset, cloud.points + cloud.offset, rtol=1e-14)
    for key in ("labels", "colors", "normals"):
        if full:
            np.testing.assert_array_equal(getattr(again, key), getattr(cloud, key))
            np.testing.assert_array_equal(raw[{"labels": "label", "colors": "red", "normals": "nx"}[key]].ndim, 1)
        else:
            assert getattr(again, key) is None


def test_writing_replaces_and_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path / "out.ply", "old")
    write_cloud(path, PointCloud(POINTS))
    assert path.read_bytes().startswith(b"ply\n")

    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full_disk)
    before = path.read_bytes()
    with pytest.raises(OutputError, match=r"out.ply: can't be written \(.*No space left on device\); choose a folder"):
        write_cloud(path, PointCloud(POINTS * 2))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["out.ply"]  # noqa: PTH208


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    put(tmp_path / "file", "")
    (tmp_path / "folder.ply").mkdir()
    for path in (
        tmp_path / "none" / "a.ply",
        tmp_path / "file" / "a.ply",
        tmp_path / "folder.ply",
        tmp_path / "a\0.ply",
    ):
        with pytest.raises(OutputError, match=r"can't be written .*; choose a folder you can write to$"):
            write_cloud(path, PointCloud(POINTS))
    with pytest.raises(OutputError, match=r"^a.las: can't write '.las' files, expected .ply or .xyz$"):
        write_cloud(tmp_path / "a.las", PointCloud(POINTS))


# errors

ASCII_PLY = ply("ascii", [XYZ, CAMERA])
BINARY_PLY = ply("binary_little_endian", [XYZ, FACES])
XYZ_TEXT = table(XYZ_NAMES, " ")


def edited(content: bytes, old: str, new: str) -> bytes:
    assert old.encode() in content
    return content.replace(old.encode(), new.encode(), 1)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", b"solid", "a.stl: unknown suffix '.stl', expected one of .ply, .pcd, .las, .laz, .xyz, .txt, .csv,"),
        ("a", b"x", "a: unknown suffix '', expected one of .ply"),
        *((f"a{suffix}", b"", f"a{suffix}: the file is empty; was the export interrupted?") for suffix in READERS),
        # text in a binary file, binary in a text file
        ("a.ply", XYZ_TEXT, "a.ply: not a PLY file, or truncated: expected a first line 'ply' and a line 'end_header'"),
        ("a.pcd", XYZ_TEXT, "a.pcd: not a PCD file, or truncated: starts with b'"),
        ("a.las", XYZ_TEXT, "a.las: not a LAS file: it starts with b'"),
        ("a.laz", XYZ_TEXT, "a.laz: not a LAS file: it starts with b'"),
        ("a.txt", BINARY_PLY, "a.txt: holds binary data, expected text with x y z on each line; is the suffix right?"),
        # PLY
        ("a.ply", ASCII_PLY[:60], "a.ply: not a PLY file, or truncated: expected a first line 'ply' and a line 'end_"),
        ("a.ply", ASCII_PLY[:900], "a.ply: truncated: it declares 120 rows of 'vertex', holds "),
        ("a.ply", BINARY_PLY[:900], "a.ply: truncated: it declares 120 rows of 'vertex', holds "),
        (
            "a.ply",
            BINARY_PLY[:-3],
            "a.ply: truncated or damaged in 'vertex_indices' of 'face'; export or copy it again",
        ),
        ("a.ply", BINARY_PLY + b"\0", "a.ply: holds more than its header declares; edited, or sent as text?"),
        ("a.ply", ASCII_PLY + b"1", "a.ply: holds more than its header declares; edited, or sent as text?"),
        (
            "a.ply",
            edited(ASCII_PLY, "vertex 120", "vertex 999999999999"),
            "a.ply: truncated: it declares 999999999999 rows of 'vertex', holds ",
        ),
        ("a.ply", ply("ascii", [CAMERA]), "a.ply: no element 'vertex', found ['camera']; is it a point cloud?"),
        ("a.ply", edited(ASCII_PLY, "float y", "float why"), "a.ply: no property y, found ['x', 'why', 'z']; name"),
        (
            "a.ply",
            edited(ASCII_PLY, "float y", "real y"),
            "a.ply: its PLY header has a wrong line, b'property real y';",
        ),
        ("a.ply", edited(ASCII_PLY, "ascii", "binary"), "a.ply: its PLY header has a wrong line, b'format binary 1.0'"),
        (
            "a.ply",
            ASCII_PLY[:200] + b"x" + ASCII_PLY[200:],
            "a.ply: can't be read as .ply (could not convert string to",
        ),
        ("a.ply", ply("ascii", [("vertex", XYZ_PROPERTIES, [])]), "a.ply: found 0 points, at least 100 are needed"),
        # PCD
        ("a.pcd", pcd_header("ascii"), "a.pcd: truncated: it declares 120 points, that is not what follows; copy it"),
        ("a.pcd", pcd_header("binary") + 500 * "x", "a.pcd: truncated: it declares 120 points, that is not what follo"),
        ("a.pcd", pcd_header("binary_compressed") + "abc", "a.pcd: truncated: it declares 120 points, that is not"),
        ("a.pcd", pcd_header("binary")[:70], "a.pcd: not a PCD file, or truncated: starts with b'# .PCD v0.7"),
        ("a.pcd", "FIELDS x\nDATA ascii\n1\n", "a.pcd: its PCD header holds ['FIELDS'], expected FIELDS, SIZE, TYPE"),
        # LAS
        ("a.las", las_bytes(POINTS)[:900], "a.las: truncated: it declares 120 points; copy it again"),
        ("a.las", las_bytes(POINTS)[:50], "a.las: can't be read as .las (File is to small to be a valid LAS); damaged"),
        ("a.laz", las_bytes(POINTS, compress=True)[:900], "a.laz: can't be read as .laz ("),
        # text
        (
            "plant_07.txt",
            "1 2\n3 4\n",
            "plant_07.txt: expected at least 3 columns (x y z), found 2; is this a 2-D export?",
        ),
        ("a.csv", "x,y\n3,4\n", "a.csv: expected at least 3 columns (x y z), found 2; is this a 2-D export?"),
        ("a.txt", "7\n8\n", "a.txt: expected at least 3 columns (x y z), found 1; is this a 2-D export?"),
        ("a.txt", "# nothing\n\n", "a.txt: holds no rows, expected x y z on each line; was the export interrupted?"),
        ("a.txt", "a leaf of maize\n", "a.txt: "),
        ("a.csv", "east,north,up\n1,2,3\n", "a.csv: no property x, y, z, found ['east', 'north', 'up']; name them so"),
        ("a.txt", "1 2 3 4 5\n" * N, "a.txt: found 5 columns without names, expected 3 (x y z), 4 (and label) or 6 ("),
        ("a.csv", "x,y,z\n1,2,3,4\n", "a.csv: found 3 column names over 4 columns; name each column"),
        ("a.pts", f"121\n{XYZ_TEXT}", "a.pts: truncated: its first line declares 121 points, found 120"),
        (
            "a.txt",
            "1 2 3\n1 2 3 4\n",
            "a.txt: can't be read as .txt (Error tokenizing data. C error: Expected 3 fields",
        ),
        ("a.txt", XYZ_TEXT + "1 2 leaf\n", "a.txt: can't be read as .txt (could not convert string to float"),
        ("a.txt", "1 " * 2000, "a.txt: expected columns x y z and a few more, found 2000; is it a table of points?"),
        # clouds
        ("a.txt", "nan nan nan\n" * N, "a.txt: none of its 120 points is finite; was the scan empty?"),
        ("a.txt", "1 2 3\n" * 99, "a.txt: found 99 points, at least 100 are needed to fit; is this the whole cloud?"),
        ("a.txt", "1 2 3\n" * N, "a.txt: all 120 points are equal; was it exported with too few digits?"),
        ("a.csv", "x,y,z,label\n" + "21,2,3,1.5\n3,2,1,1\n" * N, "a.csv: found the label 1.5, expected whole numbers"),
    ],
)
def test_every_error_says_what_to_do(tmp_path: Path, name: str, content: bytes | str, message: str) -> None:
    with pytest.raises(CloudError, match="^" + re.escape(message)) as caught:
        read_cloud(put(tmp_path / name, content), "cm")
    assert "\n" not in str(caught.value)


def test_paths_that_lead_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "folder.ply").mkdir()
    for name, message in [
        ("none.ply", r"none\.ply: no such file, expected a file of points; check the path$"),
        ("none/a.ply", r"a\.ply: no such file, "),
        ("folder.ply", r"folder\.ply: is a folder, expected a file of points; check the path$"),
        ("a\0.ply", r"no such file|can't be read"),
        ("a" * 500 + ".ply", r"can't be read \(.*too long"),
    ]:
        with pytest.raises(CloudError, match=message):
            read_cloud(tmp_path / name, "cm")

    def refuse(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(CloudError, match=r"a\.ply: can't be read \(.*Permission denied\); check its permissions"):
        read_cloud(put(tmp_path / "a.ply", ASCII_PLY), "cm")


@pytest.mark.parametrize("suffix", [".ply", ".pcd", *TEXT])
def test_the_unit_must_be_said(tmp_path: Path, suffix: str) -> None:
    content = {".ply": ASCII_PLY, ".pcd": pcd_header("binary").encode() + bytes(21 * N - 8) + struct.pack("<d", 50)}
    path = put(tmp_path / f"leaf{suffix}", content.get(suffix, XYZ_TEXT.encode()))
    sizes = r"[\d.]+ cm across if in cm, [\d.]+ cm if in mm, [\d.]+ cm if in m"
    ending = r"say --units cm, mm or m \(none: relative lengths\)$"
    with pytest.raises(UnitError, match=rf"^leaf{suffix}: no unit given; the cloud is {sizes}; {ending}"):
        read_cloud(path)
    with pytest.raises(UnitError, match=rf"^leaf{suffix}: unknown unit 'inch'; {ending}"):
        read_cloud(path, "inch")


def test_a_unit_that_does_not_fit(tmp_path: Path) -> None:
    path = put(tmp_path / "leaf.txt", XYZ_TEXT)
    with pytest.raises(UnitError, match=r"^leaf.txt: the cloud is .* if in m, .*; if in cm it is .*: say --units cm"):
        read_cloud(path, "m")
    assert read_cloud(path, "m", plausible_cm=(1, 1e5)).unit == "m"
    assert read_cloud(path, "none").unit == "none"


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".txt", ".csv", ".las"])
def test_labels_under_another_name(tmp_path: Path, suffix: str) -> None:
    rows = [[*POINTS[i].tolist(), float(LABELS[i])] for i in range(N)]
    pcd = io.BytesIO()
    names, types = ("x", "y", "z", "organ"), (np.float32,) * 4
    pypcd4.PointCloud.from_points(np.array(rows), names, types).save(pcd)
    content = {
        ".ply": ply("ascii", [("vertex", [*XYZ_PROPERTIES, ("float", "organ")], rows)]),
        ".pcd": pcd.getvalue(),
        ".csv": b"x,y,z,organ\n" + "".join(",".join(map(str, row)) + "\n" for row in rows).encode(),
        ".txt": b"x y z organ\n" + "".join(" ".join(map(str, row)) + "\n" for row in rows).encode(),
        ".las": las_bytes(POINTS / 100),
    }[suffix]
    path, name = put(tmp_path / f"a{suffix}", content), "TreeID" if suffix == ".las" else "organ"
    units = "m" if suffix == ".las" else "cm"
    assert read_cloud(path, units).labels is None
    np.testing.assert_array_equal(read_cloud(path, units, label_property=name).labels, LABELS)
    with pytest.raises(
        CloudError, match=rf"^a{suffix}: no property Leaf, found \['x', 'y', 'z'.*'{name}'\]; name them"
    ):
        read_cloud(path, units, label_property="Leaf")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ASCII_PLY),
        ("a.txt", XYZ_TEXT),
        ("a.ply", ply("ascii", [XYZ, (FACES[0], FACES[1], [[[0, 0, 0]], [[1, 2]]])])),
    ],
)
def test_no_faces_to_sample(tmp_path: Path, name: str, content: bytes | str) -> None:
    with pytest.raises(
        CloudError, match=r"^a\.\w+: no faces with an area to sample; leave sample_faces out to read its"
    ):
        read_cloud(put(tmp_path / name, content), "cm", sample_faces=500)


def test_points_that_are_not_finite_are_dropped_with_one_warning(tmp_path: Path) -> None:
    text = XYZ_TEXT + "nan 1 2\n1 inf 2\n1 2 1e999\n"
    with pytest.warns(UserWarning, match=r"^a.txt: 3 non-finite points dropped$") as caught:
        cloud = read_cloud(put(tmp_path / "a.txt", text), "cm")
    assert len(caught) == 1
    assert cloud.notes == ("3 non-finite points dropped",)
    np.testing.assert_array_equal(cloud.points, POINTS)


# what a file declares must not be believed: no hang, no huge allocation

LAZ = las_bytes(POINTS / 100, 7, "1.4", True)
LAZ_START = struct.unpack_from("<I", LAZ, 96)[0]
LAZ_TABLE = struct.unpack_from("<q", LAZ, LAZ_START)[0]


def patched(content: bytes, kind: str, at: int, value: int) -> bytes:
    changed = bytearray(content)
    struct.pack_into(kind, changed, at, value)
    return bytes(changed)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", edited(BINARY_PLY, "vertex 120", "vertex 4000000000")),
        ("a.ply", edited(BINARY_PLY, "face 3", "face 999999999999999999")),
        ("a.ply", edited(BINARY_PLY, "face 3", "face 9" + "9" * 5000)),
        ("a.ply", BINARY_PLY.replace(b"list uchar", b"list uint")),
        ("a.ply", ply("ascii", [XYZ]) + b" 1e400 -1 nan"),
        ("a.ply", ASCII_PLY.replace(b"property float x", b"property list int int q\nproperty float x")),
        ("a.pcd", pcd_header("binary", 10**15) + "x" * 999),
        ("a.pcd", pcd_header("ascii", 10**15) + "1 2 3\n"),
        ("a.pcd", pcd_header("ascii", 1, "COUNT 1 1 999999999 1 1\n") + "1 2 3\n"),
        ("a.pcd", pcd_header("binary", 0, "COUNT 1 1 999999999 1 1\n")),
        ("a.pcd", pcd_header("binary_compressed", 2 * 10**8).encode() + struct.pack("<II", 5, 42 * 10**8) + b"abcde"),
        ("a.las", patched(las_bytes(POINTS / 100), "<I", 107, 2**32 - 1)),
        ("a.las", patched(las_bytes(POINTS / 100), "<I", 100, 2**32 - 1)),
        ("a.las", patched(las_bytes(POINTS / 100, 6, "1.4"), "<I", 243, 2**32 - 1)),
        ("a.laz", patched(LAZ, "<Q", 247, 2**60)),
        ("a.laz", patched(LAZ, "<I", LAZ_TABLE + 4, 2**32 - 1)),
        *(("a.laz", patched(LAZ, "<I", LAZ_START + 8 + 38 + 4 + 4 * layer, 2**32 - 1)) for layer in range(12)),
        ("a.pts", f"{10**17}\n{XYZ_TEXT}"),
        ("a.txt", "1" * 10**6 + " 2 3\n"),
        ("a.csv", "," * 10**6),
    ],
)
def test_counts_are_checked_before_they_are_believed(tmp_path: Path, name: str, content: bytes | str) -> None:
    path = put(tmp_path / name, content)
    tracemalloc.start()
    try:
        with pytest.raises(CloudError):
            read_cloud(path, "cm")
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


# any bytes at all


def read_or_refuse(path: Path, content: bytes, sample_faces: int | None = None) -> None:
    put(path, content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".* non-finite points? dropped$")
        try:
            cloud = read_cloud(path, "none", sample_faces=sample_faces)
        except (CloudError, UnitError) as error:
            said = str(error)
        else:
            said = f"{path.name}: read"
            assert len(cloud) >= 100
            assert np.isfinite(cloud.points).all()
    assert said.startswith(f"{path.name}: ")
    assert "\n" not in said


def fuzzing(max_examples: int) -> settings:
    return settings(deadline=None, max_examples=max_examples, suppress_health_check=list(HealthCheck))


@fuzzing(100)
@given(suffix=st.sampled_from([*READERS]), content=st.binary(max_size=2000))
def test_random_bytes(folder: Path, suffix: str, content: bytes) -> None:
    read_or_refuse(folder / f"bytes{suffix}", content)


def pcd_bytes(encoding: str) -> bytes:
    file = io.BytesIO()
    columns, names = [*POINTS.T, packed(COLORS).view(np.float32), LABELS], ("x", "y", "z", "rgb", "label")
    types = (np.float32, np.float32, np.float32, np.float32, np.uint32)
    pypcd4.PointCloud.from_points(columns, names, types).save(file, pypcd4.Encoding(encoding))
    return file.getvalue()


VALID = [(".ply", ply("ascii", [CAMERA, XYZ]))]
VALID += [(".ply", ply(encoding, [XYZ, FACES])) for encoding in ENCODINGS]
VALID += [(".pcd", pcd_bytes(encoding)) for encoding in ("ascii", "binary", "binary_compressed")]
VALID += [(".las", las_bytes(POINTS / 100)), (".las", las_bytes(POINTS / 100, 7, "1.4"))]
VALID += [(".laz", las_bytes(POINTS / 100, compress=True)), (".laz", LAZ)]
VALID += [(".txt", table((*XYZ_NAMES, "label"), " ").encode()), (".xyz", table((*XYZ_NAMES, *RGB_NAMES), " ").encode())]
VALID += [(".csv", (",".join(COLUMNS) + "\n" + table((*COLUMNS,), ",")).encode()), (".asc", XYZ_TEXT.encode())]
VALID += [(".pts", f"{N}\n{XYZ_TEXT}".encode())]

WORDS = [b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\0", b"999999999999", b"-1", b"nan", b"inf", b"1e308"]
WORDS += [b"\n", b"\r", b" ", b",", b";", b'"', b"#", b"//", b"list", b"uint64", b"double", b"COUNT", b"end_header\n"]
replacements = st.one_of(st.sampled_from(WORDS), st.binary(max_size=8), st.just(b""))


@fuzzing(1500)
@given(
    kind_and_content=st.sampled_from(VALID),
    edits=st.lists(st.tuples(st.floats(0, 1), st.booleans(), replacements, st.integers(0, 60)), min_size=1, max_size=4),
    end=st.one_of(st.just(1.0), st.just(1.0), st.floats(0, 1)),
    sample_faces=st.sampled_from([None, None, 150]),
)
def test_damaged_files(
    folder: Path,
    kind_and_content: tuple[str, bytes],
    edits: list[tuple[float, bool, bytes, int]],
    end: float,
    sample_faces: int | None,
) -> None:
    suffix, content = kind_and_content
    for where, in_header, new, n_removed in edits:
        at = int(where * min(len(content), 500 if in_header else len(content)))
        content = content[:at] + new + content[at + (len(new) if n_removed > 10 else n_removed) :]
    read_or_refuse(folder / f"damaged{suffix}", content[: int(end * len(content))], sample_faces)


@fuzzing(300)
@given(kind_and_content=st.sampled_from(VALID), picks=st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=4))
def test_lines_lost_or_doubled(
    folder: Path, kind_and_content: tuple[str, bytes], picks: list[tuple[float, bool]]
) -> None:
    suffix, content = kind_and_content
    lines = content.split(b"\n")
    for where, doubled in picks:
        at = int(where * (len(lines) - 1))
        lines[at : at + 1] = [lines[at]] * 2 if doubled else []
    read_or_refuse(folder / f"lines{suffix}", b"\n".join(lines))


@fuzzing(100)
@given(wrong=st.sampled_from([*READERS]), kind_and_content=st.sampled_from(VALID))
def test_valid_files_under_another_suffix(folder: Path, wrong: str, kind_and_content: tuple[str, bytes]) -> None:
    read_or_refuse(folder / f"wrong{wrong}", kind_and_content[1])


def test_the_files_that_are_damaged_are_valid_before(tmp_path: Path) -> None:
    for suffix, content in VALID:
        cloud = read_cloud(put(tmp_path / f"a{suffix}", content), "none")
        np.testing.assert_allclose(cloud.points, POINTS / (100 if suffix in (".las", ".laz") else 1), atol=1.1e-5)


# real files


@needs_data
def test_the_same_phytomer_as_ply_and_pcd() -> None:
    folder = DATA / "sodhi2018" / "greenhouse"
    ply_cloud, pcd_cloud = read_cloud(folder / "0006.ply", "cm"), read_cloud(folder / "0006.pcd", "cm")
    np.testing.assert_allclose(ply_cloud.points, pcd_cloud.points, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(ply_cloud.colors, pcd_cloud.colors)
    assert len(ply_cloud) == 4718


@needs_data
@pytest.mark.parametrize("pattern", ["sodhi2018/*/*.ply", "sodhi2018/*/*/*.ply", "*/*.ply"])
def test_real_ply_files_against_trimesh(pattern: str) -> None:
    for path in sorted(DATA.glob(pattern)):
        cloud = read_cloud(path, "none")
        raw = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
        expected = np.stack([np.ravel(raw[name]) for name in "xyz"], axis=1)
        np.testing.assert_allclose(cloud.points, expected, rtol=2 * FLOAT32, err_msg=path.name)


@needs_data
def test_real_sizes_units_and_labels() -> None:
    assert len(read_cloud(DATA / "prbonn_maize_seedling" / "03-13.ply", "mm")) == 338_874
    maize = read_cloud(DATA / "label3dmaize" / "v-12-1-l-r.txt", "mm")
    assert set(maize.labels) == set(range(1, 14))  # type: ignore[arg-type]
    for path in sorted((DATA / "trackplant3d").glob("*/*.txt")):
        cloud, expected = read_cloud(path, "none"), np.loadtxt(path)
        np.testing.assert_array_equal(cloud.points, expected[:, :3])
        np.testing.assert_array_equal(cloud.labels, expected[:, 3])
    with pytest.raises(
        UnitError, match=r"^0015_occl1\.ply: the cloud is 842.9 cm across .*if in mm it is 84.3 cm: say"
    ):
        read_cloud(DATA / "sodhi2018" / "greenhouse" / "0015_occl1.ply", "cm")
    with pytest.raises(CloudError, match=r"^ground_truth\.csv: no property x, y, z, found \['cloud', "):
        read_cloud(DATA / "sodhi2018" / "greenhouse" / "ground_truth.csv", "cm")


@needs_data
def test_real_mesh_sampled_by_area() -> None:
    path = DATA / "mccormick2016_turntable" / "segmentedMesh.ply"
    mesh = trimesh.load(path, process=False)
    cloud = read_cloud(path, "mm", sample_faces=5000)
    centroid = (mesh.triangles_center * mesh.area_faces[:, None]).sum(axis=0) / mesh.area
    np.testing.assert_allclose(cloud.points.mean(axis=0), centroid / 10, atol=1)
    assert cloud.colors is not None
    assert len(np.unique(cloud.colors, axis=0)) == 9
