"""A plant's cloud or images to the traits of its leaves, stage by stage, and not twice."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from phytofit import NoPhytomerError, fit, from_points, read_cloud, write_cloud
from phytofit.cli import app
from phytofit.errors import InputError, OutputError, SettingError
from phytofit.io import COLUMNS, read_segmentation
from phytofit.pipeline import plant_traits, run
from phytofit.pipeline.stages import done, is_edited, key_of, up_to_date
from phytofit.segmentation import segment
from phytofit.version import state_of_the_code
from test_segmentation import leaf_axis, plant

SCAN = Path(__file__).parents[1] / ".." / "shared" / "data" / "mccormick2016_turntable"
STEM_RADIUS = 1.0  # cm, of that plant
LENGTH = 0.15  # relative; of a leaf cut at its collar, whose stem is short


class Known(NamedTuple):
    """A plant's points (n, 3), and of its leaves the azimuths, deg, and the lengths from the stem's surface, cm."""

    points: np.ndarray
    azimuths: np.ndarray
    lengths: list[float]


def printed(value):
    """As the tables have it, with six significant digits."""
    return float(f"{value:.6g}")


def known_plant():
    points, _, azimuths, collars = plant(n_leaves=3)
    axes = [
        leaf_axis(foot, np.deg2rad(azimuth), last=i == len(collars) - 1)[0]
        for i, (foot, azimuth) in enumerate(zip(collars, azimuths, strict=True))
    ]
    lengths = [np.linalg.norm(np.diff(axis, axis=0), axis=1).sum() for axis in axes]
    inside = [np.argmax(np.linalg.norm((axis - axis[0])[:, :2], axis=1) > STEM_RADIUS) for axis in axes]
    part = [np.linalg.norm(np.diff(axis[: i + 1], axis=0), axis=1).sum() for axis, i in zip(axes, inside, strict=True)]
    return Known(points, azimuths, [whole - hidden for whole, hidden in zip(lengths, part, strict=True)])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A plant of which all is known, as a file, and its run."""
    folder = tmp_path_factory.mktemp("plant")
    known = known_plant()
    write_cloud(folder / "plant.ply", from_points(known.points, "cm"))
    stages = []
    result = run(folder / "plant.ply", folder / "out", units="cm", up="z", progress=lambda *said: stages.append(said))
    return folder, known, result, stages


@pytest.fixture(scope="module")
def first_fit(made):
    """The fit of the plant's first leaf, for tests of what becomes of a fit."""
    return fit(made[2].segmentations[0].phytomers()[0], up="z", threads=1)


def refuse(phytomer, **how):
    raise NoPhytomerError("no stem with a leaf was found")


def test_every_leaf_has_its_traits_and_the_plant_its_own(made):
    folder, known, _, stages = made
    table = pd.read_csv(folder / "out" / "traits.csv")
    assert list(table.columns) == COLUMNS
    n = len(known.lengths)
    assert table.loc[table["trait"] == "leaf_count", "value"].item() == n
    lengths = table[table["trait"] == "leaf_length"].set_index("rank")["value"]
    assert sorted(lengths.index) == list(range(1, n + 1))
    for rank, true in enumerate(known.lengths[:-1], start=1):  # the innermost is partly in the whorl
        assert lengths[rank] == pytest.approx(true, rel=LENGTH)
    assert set(table["organ"]) == {"plant", "leaf", "internode"}
    assert not (table["trait"] == "stem_length").any()  # where it was cut decides it
    assert stages[0] == ("segment", 0, 1)
    assert stages[-1] == ("fit", n, n)
    assert (folder / "out" / "plant.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_up_to_date_is_not_done_again_and_what_changed_is(made):
    folder, known, first, _ = made
    out = folder / "out"
    names = {f"leaf_{rank:02d}" for rank in range(1, len(known.lengths) + 1)}
    fitted = {path.name for path in (out / "leaves").iterdir()}
    again = run(folder / "plant.ply", out, units="cm", up="z")
    assert set(again.skipped) == {"segment"} | fitted
    assert fitted <= names
    pd.testing.assert_frame_equal(again.table, first.table)
    one = sorted(fitted)[0]
    (out / "leaves" / one / "stage.json").unlink()  # as if it had been stopped there
    assert set(run(folder / "plant.ply", out, units="cm", up="z").skipped) == {"segment"} | fitted - {one}


@pytest.mark.long
def test_what_is_damaged_is_made_again_and_what_was_edited_is_not_lost(made, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(made[0], folder)
    out = folder / "out"
    (out / "leaves" / "leaf_01" / "traits.csv").unlink()
    assert "leaf_01" not in run(folder / "plant.ply", out, units="cm", up="z").skipped
    cloud = out / "segmentation" / "plant.ply"
    edited = read_cloud(cloud, "cm", plausible_cm=(0.0, 500.0))
    write_cloud(cloud, edited.take(np.arange(len(edited) - 1)))
    before = cloud.read_bytes()
    with pytest.raises(InputError, match="name the property that holds them, label"):
        run(folder / "plant.ply", out, units="cm", up="z")
    assert cloud.read_bytes() == before


def test_results_never_replace_what_is_not_theirs(made, tmp_path):
    (tmp_path / "out" / "segmentation").mkdir(parents=True)
    (tmp_path / "out" / "segmentation" / "precious.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"no segmentation\.json of an earlier run"):
        run(made[0] / "plant.ply", tmp_path / "out", units="cm", up="z")
    assert (tmp_path / "out" / "segmentation" / "precious.txt").read_text() == "mine"


@pytest.mark.long
def test_with_another_setting_the_stages_that_follow_from_it_are_done_again(made, tmp_path):
    shutil.copytree(made[0], tmp_path / "copy")
    again = run(tmp_path / "copy" / "plant.ply", tmp_path / "copy" / "out", units="cm", up="z", seed=1)
    assert again.skipped == ("segment",)


def test_a_leaf_that_can_t_be_fitted_keeps_its_length_and_is_not_tried_again(made, first_fit, tmp_path, monkeypatch):
    shutil.copytree(made[0], tmp_path / "copy")
    out = tmp_path / "copy" / "out"
    tried = []

    def seldom(phytomer, **how):
        tried.append(phytomer.name)
        return first_fit if how["seed"] == 2 and phytomer.name.endswith("leaf_01") else refuse(phytomer)

    monkeypatch.setattr("phytofit.pipeline.plant.fit", seldom)
    first, again, other = (
        run(tmp_path / "copy" / "plant.ply", out, units="cm", up="z", seed=seed, threads=1) for seed in (1, 1, 2)
    )
    leaves = len(first.segmentations[0].leaves)
    assert len(tried) == 2 * leaves
    assert again.skipped == ("segment", *(f"leaf_{rank:02d}" for rank in range(1, leaves + 1)))
    pd.testing.assert_frame_equal(first.table, again.table)
    assert sum("not fitted: no stem with a leaf" in one.remark.text for one in again.remarks) == leaves
    lengths = again.table[again.table["trait"] == "leaf_length"]["value"].tolist()
    assert lengths == [printed(leaf.length) for leaf in first.segmentations[0].leaves]
    assert (out / "leaves" / "leaf_01" / "fit.json").exists()  # with another seed it could be fitted
    assert sum(one.remark.code == "not_fitted" for one in other.remarks) == leaves - 1


def test_a_fit_that_leaves_most_of_the_points_out_is_not_the_leaf(made, first_fit, tmp_path, monkeypatch):
    shutil.copytree(made[0], tmp_path / "copy")

    bad = replace(first_fit, estimate=replace(first_fit.estimate, share=np.array([0.1, 0.3, 0.6])))
    monkeypatch.setattr("phytofit.pipeline.plant.fit", lambda phytomer, **how: bad)
    found = run(tmp_path / "copy" / "plant.ply", tmp_path / "copy" / "out", units="cm", up="z", seed=1, threads=1)
    lengths = found.table[found.table["trait"] == "leaf_length"]
    assert lengths["value"].tolist() == [printed(leaf.length) for leaf in found.segmentations[0].leaves]
    assert lengths["flags"].str.split(";").map(lambda codes: codes[0] == "not_fitted").all()
    assert set(lengths["quality"]) == {"check"}
    said = {one.remark.text for one in found.remarks if one.remark.code == "not_fitted"}
    assert said == {"not fitted: the model does not explain 60 % of the points"}


def test_meshes_and_a_workbook_are_written_where_they_are_asked_for(made, first_fit, tmp_path, monkeypatch):
    monkeypatch.setattr("phytofit.pipeline.plant.fit", lambda phytomer, **how: first_fit)
    arguments = ["run", str(made[0] / "plant.ply"), "-u", "cm", "--up", "z", "--out", str(tmp_path)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    first = {path.name for path in (tmp_path / "leaves" / "leaf_01").iterdir()}
    assert first == {"fit.json", "fit.png", "model.ply", "stage.json", "traits.csv"}
    assert not (tmp_path / "traits.xlsx").exists()
    done = CliRunner().invoke(app, [*arguments, "--mesh", "obj", "--mesh", "glb", "--xlsx"])
    assert "up to date, skipped: segment" in done.output
    for leaf in (tmp_path / "leaves").iterdir():
        assert {path.name for path in leaf.iterdir()} == first | {"model.obj", "model.glb"}
    table = pd.read_csv(tmp_path / "traits.csv")
    assert pd.read_excel(tmp_path / "traits.xlsx")["value"].tolist() == pytest.approx(table["value"].tolist())
    with pytest.raises(SettingError, match="mesh: expected one of ply, obj, glb, got 'stl'"):
        run(made[0] / "plant.ply", tmp_path, units="cm", up="z", meshes="stl")


def test_corrected_labels_are_taken_over(made, tmp_path, monkeypatch):
    monkeypatch.setattr("phytofit.pipeline.plant.fit", refuse)
    folder, known, _, _ = made
    corrected = read_cloud(folder / "out" / "segmentation" / "plant.ply", "cm", plausible_cm=(0.0, 500.0))
    last = corrected.labels.max()
    without = corrected.take(np.flatnonzero(corrected.labels != last))
    write_cloud(tmp_path / "corrected.ply", without)
    result = run(tmp_path / "corrected.ply", tmp_path / "out", units="cm", up="z", labels="label")
    assert len(result.segmentations[0].leaves) == len(known.lengths) - 1


def test_two_plants_in_one_cloud_are_both_measured(tmp_path, monkeypatch):
    monkeypatch.setattr("phytofit.pipeline.plant.fit", refuse)
    points, *_ = plant(n_leaves=3, n_points=4000)
    both = np.concatenate([points, 0.7 * points + np.array([0.0, 60.0, 0.0])])
    write_cloud(tmp_path / "two.ply", from_points(both, "cm"))
    out, stages = tmp_path / "out", []
    made = run(tmp_path / "two.ply", out, units="cm", up="z", progress=lambda *said: stages.append(said))
    assert [len(found.cloud) for found in made.segmentations] == [4000, 4000]
    assert "2 plants were found, numbered along y" in made.notes
    table = pd.read_csv(out / "traits.csv")
    heights = table[table["trait"] == "plant_height"].set_index("plant")["value"]
    assert heights[2] == pytest.approx(0.7 * heights[1], rel=0.02)
    assert set(table["cloud"]) == {"two"}
    assert table[table["trait"] == "leaf_length"].groupby("plant")["rank"].apply(list).to_dict() == {
        1: [1, 2, 3],
        2: [1, 2, 3],
    }
    assert {path.name for path in out.iterdir()} == {"plant_1", "plant_2", "traits.csv", "plant.png", "plants.png"}
    assert ("fit", 4, 6) in stages
    assert ("not_fitted", 2, 1) in {(one.remark.code, one.plant, one.rank) for one in made.remarks}
    again = run(tmp_path / "two.ply", out, units="cm", up="z")
    assert again.skipped == ("segment", *(f"plant {i}: leaf_0{k}" for i in (1, 2) for k in (1, 2, 3)))
    pd.testing.assert_frame_equal(again.table, made.table)
    write_cloud(tmp_path / "two.ply", from_points(points, "cm"))  # one of them is gone
    run(tmp_path / "two.ply", out, units="cm", up="z")
    assert {path.name for path in out.iterdir()} >= {"segmentation", "leaves", "traits.csv", "plant.png"}
    assert not list(out.glob("plant_*"))


@pytest.mark.parametrize(
    "text",
    [
        "null",
        "[]",
        5000 * "[",
        "",
        '{"made": 3}',
        '{"phytofit": "0", "made": []}',
        '{"made": {"plant.ply": 3}}',
        "\0\xff",
    ],
)
def test_a_record_of_another_shape_is_none(text, tmp_path):
    (tmp_path / "stage.json").write_bytes(text.encode("latin-1"))
    (tmp_path / "plant.ply").write_text("x")
    key = key_of("segment", [], {})
    assert not up_to_date(tmp_path, key)
    assert not is_edited(tmp_path, "plant.ply")


def test_what_made_nothing_is_not_up_to_date(tmp_path):
    key = key_of("segment", [], {})
    (tmp_path / "stage.json").write_text(json.dumps({**key, "made": {}}))
    assert not up_to_date(tmp_path, key)
    (tmp_path / "plant.ply").write_text("x")
    done(tmp_path, key, ("plant.ply",))
    assert up_to_date(tmp_path, key)
    (tmp_path / "plant.ply").write_text("y")
    assert not up_to_date(tmp_path, key)
    assert is_edited(tmp_path, "plant.ply")


def test_another_state_of_the_code_or_another_setting_is_another_key(tmp_path, monkeypatch):
    (tmp_path / "a.py").write_text("x = 1\n")
    before = state_of_the_code((tmp_path,))
    (tmp_path / "a.py").write_text("x = 2\n")
    assert state_of_the_code((tmp_path,)) != before
    key = key_of("fit", [], {"seed": 0, "ranges": (1.0, np.float64(2.0))})
    assert key == json.loads(json.dumps(key))
    assert key != key_of("fit", [], {"seed": 1, "ranges": (1.0, np.float64(2.0))})
    monkeypatch.setattr("phytofit.pipeline.stages.state_of_the_code", lambda: "another")
    assert key != key_of("fit", [], {"seed": 0, "ranges": (1.0, np.float64(2.0))})


def test_a_segmentation_comes_back_as_it_was_written(made):
    folder, _, result, _ = made
    back = read_segmentation(folder / "out" / "segmentation")
    mine = result.segmentations[0]
    np.testing.assert_array_equal(back.labels, mine.labels)
    np.testing.assert_array_equal(back.stem_path, mine.stem_path)
    assert [leaf.rank for leaf in back.leaves] == [leaf.rank for leaf in mine.leaves]
    for a, b in zip(back.leaves, mine.leaves, strict=True):
        np.testing.assert_array_equal(a.midrib, b.midrib)
        assert (a.azimuth, a.length, a.flags) == (b.azimuth, b.length, b.flags)


def test_a_damaged_segmentation_is_named(tmp_path):
    (tmp_path / "segmentation.json").write_text("{}")
    with pytest.raises(InputError, match=r"segmentation\.json: expected what phytofit segment writes"):
        read_segmentation(tmp_path)


def test_phyllotaxy_follows_from_azimuths():
    """Leaves of the plant stand on alternate sides: each diverges by the angle at which it was put there."""
    known = known_plant()
    found = segment(from_points(known.points, "cm"), up="z")
    traits = {(t.rank, t.name): t.value for t in plant_traits(found)}
    for rank in range(2, len(found.leaves)):  # the innermost is partly in the whorl
        true = abs((known.azimuths[rank - 1] - known.azimuths[rank - 2] + 180.0) % 360.0 - 180.0)
        assert traits[rank, "divergence_angle"] == pytest.approx(true, abs=15.0)
        assert traits[rank, "collar_distance"] == pytest.approx(
            traits[rank, "collar_height"] - traits[rank - 1, "collar_height"], abs=1.0
        )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["images"], "needs --camera"),
        (["plant.ply", "--camera", "kinect-v2"], "--camera: for a folder of depth images"),
        (["nothing.ply", "--units", "cm"], "nothing.ply"),
        (["plant.ply"], "unit"),
        (["images", "--camera", "kinect-v2"], "view.png"),
        (["images", "--camera", "kinect-v2", "--pattern", "/x/*.png"], "pattern: expected one such as"),
        (["out", "--camera", "kinect-v2"], "can't hold the results"),
    ],
)
def test_the_command_says_what_is_wrong(made, tmp_path, monkeypatch, arguments, said):
    (tmp_path / "images").mkdir()
    (tmp_path / "out").mkdir()
    for folder in ("images", "out"):
        (tmp_path / folder / "view.png").write_bytes(b"no image")
    shutil.copy(made[0] / "plant.ply", tmp_path)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["run", *arguments, "--out", "out"])
    assert done.exit_code == 2
    assert "error:" in done.output
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "out" / "traits.csv").exists()


@pytest.mark.long
@pytest.mark.skipif(not SCAN.is_dir(), reason=f"{SCAN} is absent")
def test_a_real_scan_becomes_a_table(tmp_path):
    done = CliRunner().invoke(app, ["run", str(SCAN), "--camera", "kinect-v2", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    table = pd.read_csv(tmp_path / "traits.csv")
    count = table.loc[table["trait"] == "leaf_count", "value"].item()
    assert 7 <= count <= 10  # eight in the mesh, and a small dry one
    assert json.loads((tmp_path / "reconstruction" / "reconstruction.json").read_text())["flags"] == []


def test_a_camera_makes_a_folder_of_images_and_a_cloud_one_of_images(tmp_path):
    folder = tmp_path / "scan"
    folder.mkdir()
    (folder / "view_0.png").write_bytes(b"no image")
    write_cloud(folder / "mesh.ply", from_points(np.random.default_rng(0).random((200, 3)) * 30.0, "cm"))
    done = CliRunner().invoke(app, ["run", str(folder), "--camera", "kinect-v2", "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert "view_0.png" in done.output
    assert "point cloud" not in done.output
