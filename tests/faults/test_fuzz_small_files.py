"""Damaged cameras, poses, species, stages' records and depth images: read, or refused in one line."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from damage import N_LONG, N_SHORT, assert_reads_or_refuses
from PIL import Image

import phytofit
from phytofit.bundled import species_folder
from phytofit.pipeline.stages import is_edited, key_of, up_to_date
from phytofit.reconstruct import Camera, load_camera
from phytofit.reconstruct.depth import read_poses
from phytofit.reconstruct.depth_files import read_views

CAMERA = Camera(40.0, 40.0, 15.5, 11.5, 32, 24, name="small")
DEPTH = np.random.default_rng(0).integers(600, 1000, (24, 32)).astype(np.uint16)
TOML = b"fx = 40.0\nfy = 40.0\ncx = 16.0\ncy = 12.0\nwidth = 32\nheight = 24\nunit = 'mm'\nnear = 300\nfar = 4500.0\n"
KEY = key_of("fit", [], {})
POSES = {"unit": "cm", "views": [{"file": "a.png", "pose": np.eye(4).tolist()}]}


def encoded(kind):
    with io.BytesIO() as made:
        np.save(made, DEPTH) if kind == "NPY" else Image.fromarray(DEPTH).save(made, kind)
        return made.getvalue()


def read_record(path):
    path.replace(path.with_name("stage.json"))
    up_to_date(path.parent, KEY)
    is_edited(path.parent, "plant.ply")


KINDS = {
    "camera": (lambda path: load_camera(str(path)), [("c.toml", TOML)]),
    "poses": (lambda path: read_poses(path, ["a.png"]), [("p.json", json.dumps(POSES).encode())]),
    "species": (phytofit.load_species, [("s.toml", (species_folder() / "sorghum.toml").read_bytes())]),
    "stage": (read_record, [("r.json", json.dumps({**KEY, "made": {"plant.ply": "0"}}).encode())]),
    "depth": (
        lambda path: read_views([path], CAMERA),
        [("a.npy", encoded("NPY")), ("b.png", encoded("PNG")), ("c.tif", encoded("TIFF"))],
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_small_files_are_read_or_refused(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert_reads_or_refuses(*KINDS[kind], tmp_path, capfd, N_SHORT)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_small_files_are_read_or_refused(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert_reads_or_refuses(*KINDS[kind], tmp_path, capfd, N_LONG)
