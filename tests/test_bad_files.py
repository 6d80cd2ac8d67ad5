"""Files that can't be read: one line says which, what was found, what was expected, and what to do."""

import re
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from clouds_as_files import ascii_ply, e57, las, obj, ply, text
from phytofit.cloud import READERS, read_cloud
from phytofit.errors import CloudError, UnitError

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real clouds in ../shared/data")

N = 120
POINTS = np.round(np.random.default_rng(0).uniform(-20, 20, (N, 3)), 3)
XYZ_TEXT = text(POINTS).decode()
ASCII_PLY, BINARY_PLY = ascii_ply(POINTS), ply(POINTS, "<f4")
FACES = b"element face 2\nproperty list uchar int vertex_indices\nend_header\n"
MESH = BINARY_PLY.replace(b"end_header\n", FACES) + struct.pack("<B3iB3i", 3, 0, 1, 2, 3, 1, 2, 3)
LAS, LAZ = las(POINTS / 100), las(POINTS / 100, 7, "1.4", compress=True)
LAZ_START = struct.unpack_from("<I", LAZ, 96)[0]
LAZ_TABLE = struct.unpack_from("<q", LAZ, LAZ_START)[0]
E57 = e57(POINTS / 100)


def put(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def edited(content: bytes, old: str, new: str) -> bytes:
    assert old.encode() in content
    return content.replace(old.encode(), new.encode(), 1)


def patched(content: bytes, kind: str, at: int, *values: float) -> bytes:
    changed = bytearray(content)
    struct.pack_into(kind, changed, at, *values)
    return bytes(changed)


def pcd_header(encoding: str, n_points: int = N, count: str = "COUNT 1 1 2 1 1\n") -> str:
    return (
        f"VERSION 0.7\nFIELDS z _ vfh/2 y x\nSIZE 4 1 2 4 8\nTYPE F U I F F\n{count}"
        f"WIDTH {n_points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n_points}\nDATA {encoding}\n"
    )


ERRORS = [
    ("a.stl", b"solid", "a.stl: unknown suffix '.stl', expected one of .ply, .pcd, .las, .laz, .e57, .obj, .xyz,"),
    ("a", b"x", "a: unknown suffix '', expected one of .ply"),
    *((f"a{suffix}", b"", f"a{suffix}: the file is empty; was the export interrupted?") for suffix in READERS),
    # content that is not what the suffix says
    ("a.ply", XYZ_TEXT, "a.ply: not a PLY file, or truncated: expected a first line 'ply' and a line 'end_header'"),
    ("a.pcd", XYZ_TEXT, "a.pcd: not a PCD file, or truncated: starts with '"),
    ("a.las", XYZ_TEXT, "a.las: not a LAS file: it starts with '"),
    ("a.obj", XYZ_TEXT, "a.obj: holds no vertices, expected lines 'v x y z'; is it an OBJ file?"),
    ("a.e57", XYZ_TEXT, "a.e57: can't be read as .e57 ("),
    ("a.txt", BINARY_PLY, "a.txt: is PLY by its content; name it .ply"),
    ("a.ply", LAS, "a.ply: is LAS by its content; name it .las"),
    ("a.xyz", E57, "a.xyz: is E57 by its content; name it .e57"),
    ("a.txt", b"1 2 3\n\0\0", "a.txt: holds binary data, expected text with x y z on each line; is the suffix right?"),
    ("._a.ply", b"\0\5\x16\7\0\2\0\0Mac OS X", "._a.ply: is a macOS resource file that lies beside the cloud, not a"),
    ("a.ply", b"PK\3\4", "a.ply: is an archive; unpack it first"),
    ("a.ply", b"<!DOCTYPE html>", "a.ply: is a web page or XML, not a cloud; was it downloaded as the file itself?"),
    ("a.ply", b"version https://git-lfs.github.com/spec/v1", "a.ply: is a Git LFS pointer; fetch the file itself"),
    # PLY
    ("a.ply", ASCII_PLY[:60], "a.ply: not a PLY file, or truncated: expected a first line 'ply' and a line 'end_"),
    ("a.ply", ASCII_PLY[:900], "a.ply: truncated: it declares 120 rows of 'vertex', holds "),
    ("a.ply", BINARY_PLY[:900], "a.ply: truncated: it declares 120 rows of 'vertex', holds "),
    ("a.ply", MESH[:-3], "a.ply: truncated or damaged in 'vertex_indices' of 'face'; export or copy it again"),
    ("a.ply", BINARY_PLY + b"\0", "a.ply: holds more than its header declares; edited, or sent as text?"),
    ("a.ply", ASCII_PLY + b"1", "a.ply: holds more than its header declares; edited, or sent as text?"),
    (
        "a.ply",
        edited(ASCII_PLY, "vertex", "camera"),
        "a.ply: no element 'vertex', found 'camera'; is it a point cloud?",
    ),
    ("a.ply", edited(ASCII_PLY, "float y", "float why"), "a.ply: no property y, found 'x', 'why', 'z'; name"),
    ("a.ply", edited(ASCII_PLY, "float y", "float x"), "a.ply: columns 'x', 'x' could all be x; rename all but one"),
    ("a.ply", edited(ASCII_PLY, "float y", "real y"), "a.ply: its PLY header has a wrong line, 'property real y';"),
    ("a.ply", edited(ASCII_PLY, "\n-", "\n-1_0"), "a.ply: found '-1_0"),
    ("a.ply", ASCII_PLY[:-200] + b"x" + ASCII_PLY[-200:], "a.ply: found '"),
    # PCD
    ("a.pcd", pcd_header("ascii"), "a.pcd: truncated: it declares 120 points, but another number follows; copy it"),
    ("a.pcd", pcd_header("binary") + 500 * "x", "a.pcd: truncated: it declares 120 points, but another number follo"),
    ("a.pcd", pcd_header("binary_compressed") + "abc", "a.pcd: truncated: it declares 120 points, but another"),
    ("a.pcd", pcd_header("binary")[:70], "a.pcd: not a PCD file, or truncated: starts with 'VERSION"),
    ("a.pcd", "FIELDS x\nDATA ascii\n1\n", "a.pcd: its PCD header holds 'FIELDS', expected FIELDS, SIZE, TYPE"),
    (
        "a.pcd",
        pcd_header("ascii", count="COUNT 1 1\n"),
        "a.pcd: its PCD header has FIELDS, SIZE, TYPE and COUNT of uneq",
    ),
    # LAS
    ("a.las", LAS[:900], "a.las: truncated: it declares 120 points; copy it again"),
    ("a.las", LAS[:50], "a.las: "),
    ("a.laz", LAZ[:900], "a.laz: can't be read as .laz ("),
    ("a.las", patched(LAS, "<I", 107, 0), "a.las: its LAS 1.2 header declares 0 points, yet "),
    (
        "a.las",
        patched(patched(las(POINTS, 3, "1.4"), "<I", 107, 120), "<Q", 247, 0),
        "a.las: its LAS 1.4 header declares 0 points, and 120 in the field for versions before 1.4, yet 4080 bytes of",
    ),
    (
        "a.las",
        patched(las(POINTS, 3, "1.4"), "<I", 107, 77),
        "a.las: its LAS 1.4 header declares 120 points, and 77 in",
    ),
    ("a.las", patched(LAS, "<d", 139, np.nan), "a.las: its LAS header has the scales and offsets 1e-05, nan, 1e-05,"),
    (
        "a.las",
        patched(LAS, "<B", 104, 11),
        "a.las: its LAS header has version 1.2 and point format 11, expected 1.0 to",
    ),
    (
        "a.las",
        patched(LAS, "<B", 25, 5),
        "a.las: its LAS header has version 1.5 and point format 3, expected 1.0 to 1.4",
    ),
    # E57 and OBJ
    (
        "a.e57",
        E57[:-1000],
        "a.e57: can't be read as .e57 (size in file header not same as actual (ErrorBadFileLength));",
    ),
    ("a.e57", patched(E57, "<d", 1500, 7.0), "a.e57: can't be read as .e57 ("),
    (
        "a.obj",
        obj(POINTS) + b"v 1 2\n",
        "a.obj: its vertices have 2 and 3 numbers, expected 3 (x y z) or 6 (and a colour)",
    ),
    ("a.obj", obj(POINTS) + b"v 1 2 z\n", "a.obj: found 'z', expected a number; edited, or damaged?"),
    ("a.obj", obj(POINTS, faces="f 1 2 121\n"), "a.obj: a face has corners beyond its 120 vertices; truncated?"),
    # text
    ("plant_07.txt", "1 2\n3 4\n", "plant_07.txt: expected at least 3 columns (x y z), found 2; is this a 2-D export?"),
    ("a.csv", "x,y\n3,4\n", "a.csv: expected at least 3 columns (x y z), found 2; is this a 2-D export?"),
    ("a.txt", "7\n8\n", "a.txt: expected at least 3 columns (x y z), found 1; is this a 2-D export?"),
    ("a.txt", "# nothing\n\n", "a.txt: holds no rows, expected x y z on each line; was the export interrupted?"),
    ("a.txt", "a leaf of maize\n", "a.txt: holds no rows, expected x y z on each line; found 'a leaf of maize'"),
    ("a.csv", "east,north,up\n1,2,3\n", "a.csv: no property x, y, z, found 'east', 'north', 'up'; name them so"),
    ("a.csv", "x,y,z\n1,2,3,4\n", "a.csv: found 3 column names over 4 columns; name each column"),
    ("a.csv", "x,x,y,z\n1,2,3,4\n", "a.csv: columns 'x', 'x' could all be x; rename all but one"),
    ("a.txt", "# c\n1 2 3\n1 2 3 4\n", "a.txt: line 3 has 4 columns, expected 3; export it again"),
    ("a.txt", XYZ_TEXT + "1 2 leaf\n", "a.txt: line 121 holds 'leaf' in column '3', expected a number"),
    ("a.csv", "x;y;z\n1;2;3\n1_000;2;3\n", "a.csv: line 3 holds '1_000' in column 'x', expected a number"),
    ("a.csv", "x;y;z\n1,5;2;3\n1.000,5;2;3\n", "a.csv: line 3 holds '1.000.5' in column 'x', expected a number"),
    ("a.pts", f"121\n{XYZ_TEXT}", "a.pts: truncated: it declares 121 points and holds 120; copy it again, or correct"),
    ("a.txt", f"//X Y Z\n130\n{XYZ_TEXT}", "a.txt: truncated: it declares 130 points and holds 120; copy it"),
    ("a.pts", f"{XYZ_TEXT}99\n1 2 3\n", "a.pts: truncated: it declares 99 points and holds 1; copy it again"),
    ("a.txt", "1 " * 2000, "a.txt: expected columns x y z and a few more, found 2000; is it a table of points?"),
    ("a.csv", "x,y,z," + "n" * 999 + "\n1,2,3,4,5\n", "a.csv: found 4 column names over 5 columns; name each column"),
    # clouds
    ("a.txt", "nan nan nan\n" * N, "a.txt: none of its 120 points is finite; was the scan empty?"),
    ("a.txt", XYZ_TEXT[: len(XYZ_TEXT) // 2], "a.txt: found "),
    ("a.txt", "1 2 3\n" * N, "a.txt: all 120 points are equal; was it exported with too few digits?"),
    ("a\x1b[31m\n.txt", "1 2\n", "a\\x1b[31m .txt: expected at least 3 columns"),
]


@pytest.mark.parametrize(("name", "content", "message"), ERRORS)
def test_every_error_says_what_to_do(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, content: bytes | str, message: str
) -> None:
    with pytest.raises(CloudError, match="^" + re.escape(message)) as caught:
        read_cloud(put(tmp_path / name, content), "cm")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300
    assert capfd.readouterr() == ("", "")


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


def test_the_unit_must_be_known(tmp_path: Path) -> None:
    sizes = r"[\d.]+ cm across if in cm, [\d.]+ cm if in mm, [\d.]+ cm if in m"
    ending = r"state its unit: mm, cm, m, or none for relative lengths$"
    for suffix, content in ((".ply", ASCII_PLY), (".txt", XYZ_TEXT), (".obj", obj(POINTS))):
        path = put(tmp_path / f"leaf{suffix}", content)
        with pytest.raises(UnitError, match=rf"^leaf{suffix}: no unit given; the cloud is {sizes}; {ending}"):
            read_cloud(path)
        with pytest.raises(UnitError, match=rf"^leaf{suffix}: unknown unit 'inch'; {ending}"):
            read_cloud(path, "inch")
        with pytest.raises(
            UnitError, match=rf"^leaf{suffix}: the cloud is .* if in m, .*; if in cm it is .* cm; {ending}"
        ):
            read_cloud(path, "m")
        assert read_cloud(path, "m", plausible_cm=(1, 1e5)).unit == "m"
        assert read_cloud(path, "none").unit == "none"


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.ply", ASCII_PLY), ("a.txt", XYZ_TEXT), ("a.obj", obj(POINTS, faces="f 1 1 1\n"))],
)
def test_no_faces_to_sample(tmp_path: Path, name: str, content: bytes | str) -> None:
    with pytest.raises(CloudError, match=r"^a\.\w+: no faces with an area to sample; leave sample_faces out to read"):
        read_cloud(put(tmp_path / name, content), "cm", sample_faces=500)


# what a file declares must not be believed: no hang, no huge allocation

BELIEVED = [
    ("a.ply", edited(BINARY_PLY, "vertex 120", "vertex 4000000000")),
    ("a.ply", edited(ASCII_PLY, "vertex 120", "vertex 999999999999999999")),
    ("a.ply", edited(MESH, "face 2", "face 999999999999999999")),
    ("a.ply", edited(MESH, "face 2", "face 9" + "9" * 5000)),
    ("a.ply", MESH.replace(b"list uchar", b"list uint")),
    ("a.ply", ASCII_PLY + b" 1e400 -1 nan"),
    ("a.ply", ASCII_PLY.replace(b"property float x", b"property list int int q\nproperty float x")),
    ("a.pcd", pcd_header("binary", 10**15) + "x" * 999),
    ("a.pcd", pcd_header("ascii", 10**15) + "1 2 3\n"),
    ("a.pcd", pcd_header("ascii", 1, "COUNT 1 1 999999999 1 1\n") + "1 2 3\n"),
    ("a.pcd", pcd_header("binary", 0, "COUNT 1 1 999999999 1 1\n")),
    ("a.pcd", pcd_header("binary_compressed", 2 * 10**8).encode() + struct.pack("<II", 5, 42 * 10**8) + b"abcde"),
    ("a.las", patched(LAS, "<I", 107, 2**32 - 1)),
    ("a.las", patched(LAS, "<I", 100, 2**32 - 1)),
    ("a.las", patched(las(POINTS / 100, 6, "1.4"), "<I", 243, 2**32 - 1)),
    ("a.pts", f"{10**17}\n{XYZ_TEXT}"),
    ("a.laz", patched(LAZ, "<Q", 247, 2**60)),
    ("a.laz", patched(LAZ, "<I", LAZ_TABLE + 4, 2**32 - 1)),
    *(("a.laz", patched(LAZ, "<I", LAZ_START + 8 + 36 + 4 + 4 * layer, 2**32 - 1)) for layer in range(12)),
    ("a.txt", "1" * 10**6 + " 2 3\n"),
    ("a.csv", "," * 10**6),
    ("a.csv", "1,2,3" + "," * 10**6 + "4\n"),
    ("a.txt", "x y z " * 10**5 + "\n1 2 3\n"),
    ("a.obj", obj(POINTS) + b"v " + b"1 " * 10**5),
]


def test_counts_are_checked_before_they_are_believed(tmp_path: Path) -> None:
    for name, content in BELIEVED:
        path = put(tmp_path / name, content)
        tracemalloc.start()
        try:
            with pytest.raises(CloudError):
                read_cloud(path, "cm")
            assert tracemalloc.get_traced_memory()[1] < 100e6
        finally:
            tracemalloc.stop()


@needs_data
def test_damaged_files_kept_as_samples() -> None:
    folder = DATA / "awkward" / "damaged"
    with pytest.raises(CloudError, match=r"^underscore.ply: found '-14_407', expected a number; edited, or damaged\?$"):
        read_cloud(folder / "underscore.ply", "cm")
    with pytest.raises(CloudError, match=r"^truth_1_000.csv: .*, expected x y z") as caught:
        read_cloud(folder / "truth_1_000.csv", "cm")
    assert len(str(caught.value)) < 150
    assert len(read_cloud(folder / "quoted_header.csv", "cm")) == 120
