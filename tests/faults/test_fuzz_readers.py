"""Damaged clouds in every format: read, or refused in one line."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from damage import N_LONG, N_SHORT, assert_reads_or_refuses

from clouds_as_files import BINARY, TEXT, Dialect, obj, text
from phytofit.cloud import read_cloud
from phytofit.errors import CloudError

POINTS = np.round(np.random.default_rng(0).uniform(-20, 20, (120, 3)), 3)
LABELLED = np.column_stack([POINTS, np.arange(120) % 4])
MORE = {
    "labels": Dialect(".csv", lambda p: text(LABELLED, ",", head="x,y,z,label\n")),
    "labels in a comment": Dialect(".txt", lambda p: text(LABELLED, head="//X Y Z label\n120\n")),
    "faces": Dialect(".obj", lambda p: obj(p, faces="f 1 2 3\nf 2/1 3/1 -1/1\n")),
}
KINDS = {suffix: [d for d in (TEXT | BINARY | MORE).values() if d.suffix == suffix] for suffix in (
    ".ply", ".pcd", ".las", ".laz", ".e57", ".obj", ".xyz", ".txt", ".csv", ".pts", ".asc"
)}  # fmt: skip


def fuzz(suffix: str, folder: Path, capfd: pytest.CaptureFixture[str], n: int) -> None:
    valid = [(f"cloud{i}{suffix}", dialect.write(POINTS)) for i, dialect in enumerate(KINDS[suffix])]

    meshes = {name for name, content in valid if b"\nf 1 2 3\n" in content or b"element face" in content}

    def read(path: Path) -> None:
        for sample_faces in (None, 150) if path.name in meshes else (None,):
            cloud = read_cloud(path, "none", sample_faces=sample_faces)
            assert len(cloud) >= 100
            assert np.isfinite(cloud.points).all()

    assert_reads_or_refuses(read, valid, folder, capfd, n)


@pytest.mark.parametrize("suffix", KINDS)
def test_damaged_clouds_are_read_or_refused(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    fuzz(suffix, tmp_path, capfd, N_SHORT)


@pytest.mark.long
@pytest.mark.parametrize("suffix", KINDS)
def test_many_damaged_clouds_are_read_or_refused(
    suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fuzz(suffix, tmp_path, capfd, N_LONG)


def test_a_cloud_under_the_suffix_of_another_format(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for suffix in KINDS:
        for dialects in KINDS.values():
            (tmp_path / f"a{suffix}").write_bytes(dialects[0].write(POINTS))
            with suppress(CloudError):
                read_cloud(tmp_path / f"a{suffix}", "none")
    assert capfd.readouterr() == ("", "")
