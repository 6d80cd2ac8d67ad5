"""Clouds that are written come back, in the unit and the frame they were read in; and nothing is half written."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from phytofit.cloud import PointCloud, from_points, read_cloud, write_cloud
from phytofit.errors import OutputError

random = np.random.default_rng(0)
N = 120
POINTS = np.round(random.uniform(-20, 20, (N, 3)), 3)
FULL = {"labels": np.arange(N) % 4, "colors": random.integers(0, 256, (N, 3)), "normals": random.uniform(-1, 1, (N, 3))}


@pytest.mark.parametrize("suffix", [".ply", ".xyz"])
@pytest.mark.parametrize(
    ("units", "corner", "full"), [("mm", 0.0, True), ("cm", 4.5e7, False), ("m", 4.5e7, True), ("none", 0.0, False)]
)
def test_what_is_written_is_in_the_inputs_frame(
    tmp_path: Path, suffix: str, units: str, corner: float, full: bool
) -> None:
    points = POINTS / {"mm": 0.1, "cm": 1, "m": 100, "none": 1}[units] + corner
    cloud = from_points(points, units, **(FULL if full else {}))  # type: ignore[arg-type]
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
    path = tmp_path / "out.ply"
    path.write_text("old")
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
    (tmp_path / "file").touch()
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
