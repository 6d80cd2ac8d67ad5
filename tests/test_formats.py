"""Files written by other libraries, or composed byte by byte, against what is read of them; and no surprise ends."""

import io
import struct
import sys
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from pypcd4 import pypcd4

from clouds_as_files import DIALECTS, ascii_ply, e57, las, obj, text
from phytofit.cloud import PointCloud, read_cloud
from phytofit.errors import CloudError, UnitError

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real clouds in ../shared/data")

FLOAT32 = 2.0**-23  # relative step of single precision
TEXT = (".xyz", ".txt", ".csv", ".pts", ".asc")
SCALE_CM = {"mm": 0.1, "cm": 1.0, "m": 100.0}
ROUNDING_CM = 1e-12

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


# the same cloud in every format


def test_every_dialect_holds_the_same_points(folder: Path) -> None:
    points, wrong = np.round(random.uniform(-20, 20, (N, 3)), 5), {}
    for name, dialect in DIALECTS.items():
        unit = dialect.unit or "cm"
        path = put(folder / f"a{dialect.suffix}", dialect.write(points / SCALE_CM[unit]))
        cloud = read_cloud(path, None if dialect.unit else "cm")
        off = np.abs(cloud.points - points).max() if len(cloud) == N else np.inf
        if cloud.unit != unit or cloud.labels is not None or off > dialect.error * SCALE_CM[unit] + ROUNDING_CM:
            wrong[name] = (cloud.unit, cloud.labels_from, off)
    assert not wrong


def test_a_stated_unit_counts_more_than_the_files(tmp_path: Path) -> None:
    cloud = read_cloud(put(tmp_path / "a.csv", text(POINTS, ",", head="X [mm],Y [mm],Z [mm]\n")), "cm")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == ("the file says that its unit is mm, but it was read in cm",)
    np.testing.assert_allclose(read_cloud(put(tmp_path / "a.las", las(POINTS)), "cm").points, POINTS, atol=1.1e-5)


def test_files_that_several_scans_were_joined_in_say_so(tmp_path: Path) -> None:
    for name in ("PTS of scans", "E57, scans with poses"):
        path = put(tmp_path / f"a{DIALECTS[name].suffix}", DIALECTS[name].write(POINTS))
        assert "scans, read as one cloud" in read_cloud(path, "cm").notes[0]


def test_a_count_that_is_too_small_is_said(tmp_path: Path) -> None:
    for head in ("119\n", "//X Y Z\n119\n"):
        cloud = read_cloud(put(tmp_path / "a.pts", text(POINTS, head=head)), "cm")
        np.testing.assert_array_equal(cloud.points, POINTS)
        assert cloud.notes == ("the file declares 119 points and holds 120: which is right?",)


# labels


def labelled(name: str, values: np.ndarray = LABELS) -> dict[str, bytes]:
    """The cloud with a column of that name, in each format that can name it."""
    rows = np.column_stack([POINTS, values])
    header = f"ply\nformat ascii 1.0\nelement vertex {N}\n" + "".join(
        f"property float {n}\n" for n in ("x", "y", "z", name)
    )
    fields = f"VERSION 0.7\nFIELDS x y z {name}\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS {N}\nDATA ascii\n"
    return {
        ".ply": text(rows, head=header + "end_header\n"),
        ".pcd": text(rows, head=fields),
        ".csv": text(rows, ",", head=f"x,y,z,{name}\n"),
        ".txt": text(rows, "\t", head=f"//X\tY\tZ\t{name}\n"),
        ".xyz": text(rows, head=f"# x y z {name}\n{N}\n"),
    }


@pytest.mark.parametrize("name", ["label", "Label", "LABEL", "scalar_label", "scalar_Label"])
def test_a_column_called_label_is_used_and_said(tmp_path: Path, name: str) -> None:
    for suffix, content in labelled(name).items():
        cloud = read_cloud(put(tmp_path / f"a{suffix}", content), "cm")
        np.testing.assert_array_equal(cloud.labels, LABELS)
        assert cloud.labels_from == name
        assert cloud.notes == (f"labels of property '{name}' (1 stem, 2.. leaves): 90 of 120 points",)
        without = read_cloud(put(tmp_path / f"a{suffix}", content), "cm", label_property=None)
        assert (without.labels, without.labels_from, without.notes) == (None, None, ())


@pytest.mark.parametrize("name", ["intensity", "Intensity", "classification", "scalar_Intensity", "labelled"])
def test_a_column_of_another_name_is_never_taken_for_labels(tmp_path: Path, name: str) -> None:
    for suffix, content in labelled(name).items():
        path = put(tmp_path / f"a{suffix}", content)
        assert (read_cloud(path, "cm").labels, read_cloud(path, "cm").notes) == (None, ())
        asked = read_cloud(path, "cm", label_property=name)
        np.testing.assert_array_equal(asked.labels, LABELS)
        assert asked.labels_from == name
        with pytest.raises(
            CloudError,
            match=rf"^a{suffix}: no property 'Leaf' with labels, found '[xX]', '[yY]', '[zZ]', '{name}'; choo",
        ):
            read_cloud(path, "cm", label_property="Leaf")


def test_a_column_without_a_name_is_used_only_by_its_number(tmp_path: Path) -> None:
    for suffix in TEXT:
        path = put(tmp_path / f"a{suffix}", text(np.column_stack([POINTS, LABELS])))
        assert read_cloud(path, "cm").labels is None
        assert read_cloud(path, "cm").notes == ("column 4 has no name: not used",)
        np.testing.assert_array_equal(read_cloud(path, "cm", label_property="4").labels, LABELS)


def test_which_of_several_columns_is_the_label(tmp_path: Path) -> None:
    rows = np.column_stack([POINTS, LABELS, LABELS[::-1]])
    exact = put(tmp_path / "a.csv", text(rows, ",", head="x,y,z,label,scalar_label\n"))
    assert read_cloud(exact, "cm").labels_from == "label"
    twice = put(tmp_path / "b.csv", text(rows, ",", head="x,y,z,Label,LABEL\n"))
    with pytest.raises(CloudError, match=r"^b.csv: columns 'Label', 'LABEL' could all be label; rename all but one$"):
        read_cloud(twice, "cm")
    same = put(tmp_path / "c.csv", text(rows[:, [0, 1, 2, 3, 3]], ",", head="x,y,z,Label,LABEL\n"))
    np.testing.assert_array_equal(read_cloud(same, "cm").labels, LABELS)


def test_points_without_a_label_are_unknown(tmp_path: Path) -> None:
    content = labelled("label", np.where(LABELS == 0, np.nan, LABELS))
    for suffix in (".ply", ".csv"):
        np.testing.assert_array_equal(read_cloud(put(tmp_path / f"a{suffix}", content[suffix]), "cm").labels, LABELS)
    halves = put(tmp_path / "a.csv", labelled("label", LABELS / 2)[".csv"])
    with pytest.raises(CloudError, match=r"^a.csv: found the label 0.5 of property 'label', expected whole numbers"):
        read_cloud(halves, "cm")


# PLY

CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
SYNONYMS = dict(zip(CODES, ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), strict=True))
CODES |= {SYNONYMS[kind]: code for kind, code in CODES.items()}
ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

Element = tuple[str, list[tuple[str, ...]], list[list[Any]]]  # name, properties as in the header, rows


def composed_ply(encoding: str, elements: list[Element], newline: str = "\n", extra: tuple[str, ...] = ()) -> bytes:
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


@settings(deadline=None, max_examples=25)
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
    content = composed_ply(encoding, [*around[:at], vertex, *around[at:]], newline, extra)
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
    cloud = read_cloud(
        put(tmp_path / "a.ply", composed_ply("binary_big_endian", [vertex, faces])), "cm", sample_faces=10_000
    )
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


@settings(deadline=None, max_examples=25)
@given(
    names=st.permutations([*COLUMNS, "plant id", ""]),
    separator=st.sampled_from([",", ";", ", ", "\t"]),
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


@pytest.mark.parametrize(
    ("columns", "what"),
    [
        (COLORS, "colors"),
        (NORMALS, "normals"),
        (np.column_stack([np.full(N, -700), COLORS]), "colors"),
        (np.column_stack([LABELS, NORMALS]), None),
        (5.0 * NORMALS, None),
    ],
    ids=["colours", "normals", "intensity and colours", "four others", "three others"],
)
def test_columns_without_names_are_what_only_they_can_be(tmp_path: Path, columns: np.ndarray, what: str | None) -> None:
    rows = [[*p, *more] for p, more in zip(POINTS, columns.tolist(), strict=True)]
    cloud = read_cloud(put(tmp_path / "a.txt", "".join(" ".join(map(str, row)) + "\n" for row in rows)), "cm")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.labels is None
    for key, expected in (("colors", COLORS), ("normals", NORMALS)):
        if key == what:
            np.testing.assert_array_equal(getattr(cloud, key), expected)
        else:
            assert getattr(cloud, key) is None
    assert bool(cloud.notes) == (what is None)


SPELLED = [
    "nan",
    "NaN",
    "-nan(ind)",
    "nan(snan)",
    "1.#QNAN",
    "-1.#IND00",
    "1.#INF",
    "inf",
    "-Infinity",
    "NA",
    "#N/A",
    "1e999",
    "NAN",
    "Null",
    "∞",
    "*****",
    "#VALUE!",
    "(null)",
]


def test_rows_that_are_not_finite_are_dropped_however_it_is_spelled(tmp_path: Path) -> None:
    more = "".join(f"1 {word} 2\n" for word in SPELLED)
    n, note = len(SPELLED), f"{len(SPELLED)} non-finite points dropped"
    for name, content in {
        "a.txt": text(POINTS) + more.encode(),
        "a.csv": text(POINTS, ";", head="x;y;z\n") + "".join(f'1;"{word}";2\n' for word in SPELLED).encode(),
        "a.ply": ascii_ply(POINTS).replace(b"vertex 120", b"vertex %d" % (N + n)) + more.encode(),
    }.items():
        with pytest.warns(UserWarning, match=rf"^{name}: {note}$") as caught:
            cloud = read_cloud(put(tmp_path / name, content), "cm")
        assert (len(caught), cloud.notes) == (1, (note,))
        np.testing.assert_array_equal(cloud.points, POINTS)


@pytest.mark.parametrize("word", ["NA", "n/a", "NULL", "-", "1,#QNAN", "nan", "***"])
def test_the_first_row_may_be_missing(tmp_path: Path, word: str) -> None:
    path = put(tmp_path / "a.xyz", f"{word} {word} {word}\n".encode() + text(POINTS))
    with pytest.warns(UserWarning, match=r"^a\.xyz: 1 non-finite point dropped$"):
        cloud = read_cloud(path, "cm")
    np.testing.assert_array_equal(cloud.points, POINTS)


def test_columns_that_may_all_be_coordinates_are_refused(tmp_path: Path) -> None:
    count = np.arange(N)
    for first, number in (([LABELS], 1), ([count // 9, count], 1), ([count, count // 9], 2)):
        path = put(tmp_path / "a.xyz", text(np.column_stack([*first, POINTS])))
        with pytest.raises(
            CloudError, match=rf"^a\.xyz: which columns are x y z\? none has a name, and column {number} "
        ):
            read_cloud(path, "cm")


def test_numbers_of_a_text_file_are_read_exactly(tmp_path: Path) -> None:
    points = random.uniform(-20, 20, (N, 3))
    text = "".join(f"{x!r} {y:+.17e} {z!r}\n" for x, y, z in points.tolist())
    np.testing.assert_array_equal(read_cloud(put(tmp_path / "a.txt", text), "cm").points, points)


# LAS and LAZ


def full_las(points_m: np.ndarray, point_format: int = 3, version: str = "1.2", compress: bool = False) -> bytes:
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
    content = full_las(POINTS / 100 + corner, point_format, version, compress)
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
        cloud = read_cloud(put(tmp_path / "a.laz", full_las(points, point_format, version, True)))
        np.testing.assert_allclose(cloud.points, 100 * points, atol=1.1e-3)


def test_las_composed_by_hand(tmp_path: Path) -> None:
    header = bytearray(227)
    header[:4], header[24:26] = b"LASF", b"\1\2"
    struct.pack_into("<HIIBHI", header, 94, 227, 227, 0, 0, 20, N)
    struct.pack_into("<6d", header, 131, 1e-5, 1e-5, 1e-5, 0.25, 0.5, 0)
    whole = np.rint((POINTS / 100 - [0.25, 0.5, 0]) * 1e5).astype(int).tolist()
    path = put(tmp_path / "a.las", bytes(header) + b"".join(struct.pack("<3i8x", *row) for row in whole))
    np.testing.assert_allclose(read_cloud(path).points, POINTS, atol=1.1e-3)


# E57 and OBJ


def test_e57_colours_and_points_that_the_sensor_did_not_see(tmp_path: Path) -> None:
    cloud = read_cloud(put(tmp_path / "a.e57", e57(POINTS / 100, colors=COLORS)))
    np.testing.assert_array_equal(cloud.colors, COLORS)
    seen = np.arange(N) % 7 != 0
    file = pye57.E57(str(tmp_path / "b.e57"), mode="w")
    data = {f"cartesian{axis}": np.where(seen, POINTS[:, i] / 100, 0.0) for i, axis in enumerate("XYZ")}
    file.write_scan_raw(data | {"cartesianInvalidState": np.where(seen, 0, 2).astype(np.uint8)})
    file.close()
    cloud = read_cloud(tmp_path / "b.e57", plausible_cm=(1, 100))
    np.testing.assert_allclose(cloud.points, POINTS[seen], atol=1e-5)


def test_e57_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path / "a.e57", e57(POINTS / 100))
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pye57", None)
        without.delitem(sys.modules, "phytofit.cloud.e57", raising=False)
        with pytest.raises(
            CloudError, match=r"^a.e57: E57 files need the package pye57: pip install 'phytofit\[e57\]'$"
        ):
            read_cloud(path)
        sys.modules.pop("phytofit.cloud.e57")


def test_obj_colours_faces_and_their_numbers(tmp_path: Path) -> None:
    square = np.array([[0.0, 0, 0], [30, 0, 0], [30, 30, 0], [0, 30, 0]])
    for faces in ("f 1 2 3 4\n", "f -4/1/2 -3//7 \\\n -2 -1\n"):
        path = put(tmp_path / "a.obj", obj(square, " 1 0.5 0", faces))
        cloud = read_cloud(path, "cm", sample_faces=4000)
        np.testing.assert_allclose(cloud.points.mean(axis=0), [15, 15, 0], atol=0.5)
        assert cloud.colors is not None
        assert cloud.colors[0].tolist() == [255, 128, 0]
    mesh = put(tmp_path / "b.obj", obj(POINTS, faces="f 1 2 3\n"))
    assert read_cloud(mesh, "cm").notes == ("a mesh of 1 faces: its vertices are the points",)


# real files


@needs_data
def test_the_same_phytomer_as_ply_and_pcd() -> None:
    folder = DATA / "sodhi2018" / "greenhouse"
    ply_cloud, pcd_cloud = read_cloud(folder / "0006.ply", "cm"), read_cloud(folder / "0006.pcd", "cm")
    np.testing.assert_allclose(ply_cloud.points, pcd_cloud.points, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(ply_cloud.colors, pcd_cloud.colors)
    assert len(ply_cloud) == 4718


@needs_data
def test_real_ply_files_against_trimesh() -> None:
    for name in ("sodhi2018/field/01_3257-2_frame0043", "corn_leaf_area/01", "robovision_mvs_scene/reference"):
        path = DATA / f"{name}.ply"
        raw = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
        expected = np.stack([np.ravel(raw[axis]) for axis in "xyz"], axis=1)
        expected = expected[np.sort(np.unique(expected, axis=0, return_index=True)[1])]  # exact copies are one point
        np.testing.assert_allclose(read_cloud(path, "none").points, expected, rtol=2 * FLOAT32, err_msg=name)


@needs_data
def test_real_sizes_units_and_labels() -> None:
    assert len(read_cloud(DATA / "prbonn_maize_seedling" / "03-13.ply", "mm")) == 338_450  # 424 points twice
    for path in sorted((DATA / "trackplant3d").glob("*/*.txt"))[::8]:
        cloud, expected = read_cloud(path, "none", label_property="4"), np.loadtxt(path)
        expected = expected[np.sort(np.unique(expected[:, :3], axis=0, return_index=True)[1])]
        np.testing.assert_array_equal(cloud.points, expected[:, :3])
        np.testing.assert_array_equal(cloud.labels, expected[:, 3])
    with pytest.raises(
        UnitError, match=r"^0015_occl1\.ply: the cloud is 842.9 cm across .*if in mm it is 84.3 cm; state"
    ):
        read_cloud(DATA / "sodhi2018" / "greenhouse" / "0015_occl1.ply", "cm")


@needs_data
def test_real_mesh_sampled_by_area() -> None:
    path = DATA / "mccormick2016_turntable" / "segmentedMesh.ply"
    mesh = trimesh.load(path, process=False)
    cloud = read_cloud(path, "mm", sample_faces=5000)
    centroid = (mesh.triangles_center * mesh.area_faces[:, None]).sum(axis=0) / mesh.area
    np.testing.assert_allclose(cloud.points.mean(axis=0), centroid / 10, atol=1)
    assert cloud.colors is not None
    assert len(np.unique(cloud.colors, axis=0)) == 9
