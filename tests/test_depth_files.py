"""Depth images and camera files as devices and people write them: read, or refused with the true cause."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import phytofit
from phytofit.errors import InputError, SettingError, SpeciesError
from phytofit.reconstruct import Camera
from phytofit.reconstruct.depth import read_poses
from phytofit.reconstruct.depth_files import depth_files, read_views

DATA = Path(__file__).parents[2] / "shared" / "data"
DAMAGED = DATA / "awkward" / "damaged"
CAMERA = Camera(40.0, 40.0, 15.5, 11.5, 32, 24, name="small")
FAR = replace(CAMERA, near=300.0, far=4500.0)


def image(seed=0):
    """Depths (24, 32) of a surface 60 to 100 cm away, mm, without a return in the upper rows."""
    made = np.random.default_rng(seed).integers(600, 1000, (24, 32)).astype(np.uint16)
    made[:4] = 0
    return made


def read_one(folder, stored, name="a.npy", camera=CAMERA, **how):
    np.save(folder / name, stored) if name.endswith("npy") else Image.fromarray(stored).save(folder / name)
    (view,), notes = read_views([folder / name], camera, **how)
    return view.depth, notes


@pytest.mark.parametrize("none", [65535, 65536.0, np.nan, np.inf, -np.inf, 0, 20_000])
@pytest.mark.parametrize("kind", [np.uint16, np.float32, np.float64, np.int32])
def test_what_is_no_return_counts_as_none_whatever_stands_for_it(none, kind, tmp_path):
    if not (np.isfinite(none) and none == np.array(none).astype(kind)) and kind not in (np.float32, np.float64):
        return  # it can't be stored
    stored = image().astype(kind)
    expected = np.where(stored > 0, stored / 10.0, 0.0)
    stored[stored == 0] = none
    depth, notes = read_one(tmp_path, stored, camera=FAR if none == 20_000 else CAMERA)
    assert depth == pytest.approx(expected)
    assert bool(notes) == (none in (65535, 65536.0, 20_000))
    assert all("17 % of the pixels" in note for note in notes)


@pytest.mark.parametrize(
    ("none", "unit"),
    [(-1, "mm"), (-9999, "mm"), (65.535, "m"), (32.767, "m"), (65534, "mm"), (3.4e38, "mm"), (4095, "mm"), (1, "mm")],
)
@pytest.mark.parametrize("name", ["a.npy", "a.tif"])
def test_what_most_pixels_hold_is_no_distance_where_it_can_be_none(none, unit, name, tmp_path):
    stored = image().astype(np.float32)
    stored[:18] = 0
    expected = stored / 10.0
    stored /= 1000 if unit == "m" else 1
    stored[:18] = none
    depth, notes = read_one(tmp_path, stored, name, camera=FAR, unit=unit)
    assert depth == pytest.approx(expected, abs=1e-4)
    assert notes == (f"75 % of the pixels hold {np.float32(none):g}: no return",)


def test_one_negative_value_is_no_distance_however_rare(tmp_path):
    stored = image().astype(np.float32)
    stored[10, 10] = -1
    depth, _ = read_one(tmp_path, stored)
    assert depth[10, 10] == 0.0
    assert np.count_nonzero(depth) == 20 * 32 - 1


@pytest.mark.parametrize("kind", [np.int16, np.uint16, np.int32])
def test_the_largest_value_of_a_type_is_no_distance(kind, tmp_path):
    stored = image().astype(kind)
    stored[-1] = np.iinfo(kind).max
    depth, _ = read_one(tmp_path, stored)
    assert not depth[-1].any()
    assert depth[4:-1].all()


def test_depths_beyond_the_stated_range_are_left_out_and_the_note_says_so(tmp_path):
    depth, notes = read_one(tmp_path, image(), camera=replace(CAMERA, near=700.0, far=900.0))
    inside = (image() >= 700) & (image() <= 900)
    assert ((depth > 0) == inside).all()
    (note,) = notes
    assert "outside the camera's range, 70 to 90 cm" in note


def test_steps_of_a_tenth_of_a_millimetre(tmp_path):
    """They need a camera file, and the message says which line of it."""
    stored = (image().astype(np.uint32) * 10).astype(np.uint16)
    with pytest.raises(InputError, match=r"steps of 1 mm.*depth_scale, which is 0.1 for steps of 0.1 mm"):
        read_one(tmp_path, stored, camera=FAR)
    assert read_one(tmp_path, stored, camera=replace(FAR, depth_scale=0.1))[0] == pytest.approx(image() / 10.0)


def test_hidden_files_of_another_system_are_not_read(tmp_path):
    Image.fromarray(image()).save(tmp_path / "view_1.png")
    (tmp_path / "._view_1.png").write_bytes(b"\0\5\26\7Mac OS X")
    assert [path.name for path in depth_files(tmp_path)] == ["view_1.png"]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["a.jpg", "b.JPG"], "2 photographs such as .*photographs can't be measured yet"),
        (["leaf.ply"], "1 clouds such as leaf.ply; clouds are segmented as they are"),
        (["notes.odt"], "among 1 files, expected .png"),
        ([], "the folder is empty"),
    ],
)
def test_a_folder_without_depth_images_says_what_it_holds(names, said, tmp_path):
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=said):
        depth_files(tmp_path)


def test_a_cloud_in_place_of_a_folder(tmp_path):
    (tmp_path / "plant.ply").touch()
    with pytest.raises(InputError, match="is a file, expected a folder of depth images; it looks like a cloud"):
        depth_files(tmp_path / "plant.ply")


@pytest.mark.parametrize(
    ("stored", "name", "said"),
    [
        (np.zeros((24, 32, 3), np.uint8), "a.png", "a colour image .RGB.*photographs can't be measured"),
        (np.zeros((24, 32), np.uint8), "a.png", "an image of 8 bits"),
        (np.ones((12, 32), np.uint16), "a.png", "found 32 x 12 pixels, expected 32 x 24 of the camera small"),
        (np.ones((24, 32, 1), np.uint16), "a.npy", "an array of shape .24, 32, 1."),
        (np.ones((24, 32), bool), "a.npy", "type bool"),
        (-image().astype(float), "a.npy", "negative depths"),
        (np.zeros((24, 32), np.uint16), "a.npy", "no pixel holds a distance"),
    ],
)
def test_what_is_no_depth_image_is_named(stored, name, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read_one(tmp_path, stored, name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('width = "32"', "width = '32': input should be a valid integer"),
        ("width = 32.9", "width = 32.9"),
        ("width = inf", "width = inf"),
        ("width = 99999999999", "width = 99999999999"),
        ("fx = true", "fx = True: input should be a valid number"),
        (f"fx = 1{300 * '0'}", "fx = 1000"),
        (f"fx = {5000 * '9'}", "more than 4300 digits"),
        (f"unit = {5000 * '['}", "brackets within brackets"),
        ("fx = 1_e", "not a TOML file"),
        ("fy = nan", "fy = nan"),
        ('unit = "inch"', "unit mm, cm or m, got 'inch'"),
        ("near = 5000\nfar = 400", "near < far"),
        ("distortion = [1, 2, 3, 4, 5, 6]", "distortion"),
        ("focal = 3", "focal is unknown"),
    ],
)
def test_a_camera_file_that_can_t_be_right_is_refused_in_a_line(text, said, tmp_path):
    keys = {line.split(" = ")[0] for line in text.splitlines()}
    whole = {"fx": "40.0", "fy": "40.0", "cx": "16.0", "cy": "12.0", "width": "32", "height": "24"}
    lines = [f"{key} = {value}" for key, value in whole.items() if key not in keys]
    (tmp_path / "c.toml").write_text("\n".join([*lines, text]))
    with pytest.raises(InputError, match=said) as error:
        phytofit.load_camera(str(tmp_path / "c.toml"))
    assert len(str(error.value)) < 500


def test_a_camera_file_may_say_how_far_it_sees(tmp_path):
    (tmp_path / "c.toml").write_text("fx=40\nfy=40\ncx=16\ncy=12\nwidth=32\nheight=24\nunit='m'\nnear=0.3\nfar=2\n")
    assert phytofit.load_camera(str(tmp_path / "c.toml")).range_cm == (30.0, 200.0)


@pytest.mark.parametrize(
    "text",
    [
        5000 * "[",
        "null",
        "[]",
        '{"unit": "cm", "views": 3}',
        '{"unit": "cm", "views": [{"file": "a.png", "pose": [1' + 400 * "0" + "]}]}",
        '{"unit": ["cm"], "views": []}',
        json.dumps({"unit": "cm", "views": [{"file": "a.png", "pose": (2.0 * np.eye(4)).tolist()}]}),
        "\x00",
    ],
)
def test_a_file_of_poses_that_can_t_be_right_is_refused_in_a_line(text, tmp_path):
    (tmp_path / "poses.json").write_text(text)
    with pytest.raises(InputError, match=r"poses.json: ") as error:
        read_poses(tmp_path / "poses.json", ["a.png"])
    assert len(str(error.value)) < 500


def test_a_turntable_s_step_and_known_poses_exclude_each_other(tmp_path):
    with pytest.raises(SettingError, match="step_deg"):
        phytofit.reconstruct(tmp_path, CAMERA, step_deg=30.0, poses=tmp_path / "p.json")


@pytest.mark.skipif(not DAMAGED.is_dir(), reason="no data in ../shared/data")
def test_the_damaged_small_files_are_refused(tmp_path, capfd):
    refused = {
        "cam_*.toml": lambda path: phytofit.load_camera(str(path)),
        "poses_*.json": lambda path: read_poses(path, ["a.png"]),
        "depth_*.npy": lambda path: read_views([path], CAMERA),
    }
    for pattern, read in refused.items():
        for path in sorted(DAMAGED.glob(pattern)):
            with pytest.raises(InputError, match=path.name) as error:
                read(path)
            assert len(str(error.value)) < 600
            assert "\n" not in str(error.value)
    for path in sorted(DAMAGED.glob("species_*.toml")):
        if path.stem == "species_name":
            assert "\x1b" not in phytofit.load_species(path).name
            continue
        with pytest.raises(SpeciesError, match=path.name) as error:
            phytofit.load_species(path)
        assert len(str(error.value)) < 600
    assert capfd.readouterr() == ("", "")


def test_an_array_that_declares_more_than_the_file_holds(tmp_path):
    np.save(tmp_path / "a.npy", image())
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole[:-100])
    with pytest.raises(InputError, match="its data end early"):
        read_views([tmp_path / "a.npy"], CAMERA)
    shutil.copy(tmp_path / "a.npy", tmp_path / "b.npy")
    (tmp_path / "b.npy").write_bytes(whole.replace(b"32)", b"9999999999999)"))
    with pytest.raises(InputError, match=r"b\.npy"):
        read_views([tmp_path / "b.npy"], CAMERA)
