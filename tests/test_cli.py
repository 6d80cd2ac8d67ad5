"""The command line as a user meets it: tables, files, one line an error, exit codes; nothing half-written."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
import trimesh
from typer.testing import CliRunner

import phytofit
from phytofit.cli import app
from phytofit.io import COLUMNS, result_names

FAST = ["--method", "paper", "--samples", "60", "--points", "500", "--generations", "3"]
FILES = {"fit.json", "traits.csv", "model.ply", "fit.png"}
BESIDE = {"traits.csv", "phytofit.log"}


def run(*arguments):
    return CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}).invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """Two simulated clouds, written by `phytofit simulate`."""
    folder = tmp_path_factory.mktemp("simulated")
    done = run("simulate", "-n", "2", "--points", "1500", "--noise", "0.2", "--set", "leaf_length=50", "--out", folder)
    assert done.exit_code == 0, done.output
    return folder


def test_fewer_simulated_clouds_take_the_place_of_more(tmp_path):
    """No cloud stands beside a table that does not know it; what is the user's stays."""
    (tmp_path / "phytomers.txt").write_text("mine")
    for number in (3, 1):
        assert run("simulate", "-n", number, "--points", "200", "--out", tmp_path).exit_code == 0
    assert {p.name for p in tmp_path.iterdir()} - {"phytofit.log"} == {
        "phytomer_0001.ply",
        "phytomer_0001.json",
        "truth.csv",
        "phytomers.txt",
    }


def test_simulate_writes_clouds_and_their_truth(clouds):
    names = {p.name for p in clouds.iterdir()}
    expected = {f"phytomer_000{i}.{end}" for i in (1, 2) for end in ("ply", "json")}
    assert names == expected | {"truth.csv", "phytofit.log"}
    truth = json.loads((clouds / "phytomer_0001.json").read_text())
    assert truth["parameters"]["leaf_length"] == 50.0
    table = pd.read_csv(clouds / "truth.csv")
    assert list(table.columns) == COLUMNS
    row = table[(table.cloud == "phytomer_0001") & (table.trait == "leaf_length")].iloc[0]
    assert row.value == pytest.approx(truth["traits"]["leaf_length"], rel=1e-5)
    assert row.method == "truth"
    cloud = phytofit.read_cloud(clouds / "phytomer_0001.ply", "cm")
    assert len(cloud) == 1500
    assert set(np.unique(cloud.labels)) == {1, 2}


@pytest.fixture(scope="module")
def measured(clouds, tmp_path_factory):
    """A cloud that can't be read and two that can, measured at once: the folder of the results, and what was said."""
    folder = tmp_path_factory.mktemp("measured")
    bad = folder / "bad.ply"
    bad.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9999\nproperty float x\nend_header\n1\n")
    both = (clouds / "phytomer_0001.ply", clouds / "phytomer_0002.ply")
    return folder / "out", run("fit", bad, *both, "-u", "cm", *FAST, "--threads", 2, "-o", folder / "out")


def test_fit_measures_several_clouds_and_writes_everything(measured):
    folder, done = measured
    assert "leaf_length" in done.output
    assert {p.name for p in folder.iterdir()} == {"phytomer_0001", "phytomer_0002", *BESIDE, "failed.csv"}
    for name in ("phytomer_0001", "phytomer_0002"):
        assert {p.name for p in (folder / name).iterdir()} == FILES
        stored = json.loads((folder / name / "fit.json").read_text())
        assert stored["cloud"] == name
        assert stored["parameters"]["leaf_length"] == {
            "value": pytest.approx(50.0, abs=8.0),
            "low": None,
            "high": None,
            "unit": "cm",
        }
        assert len(stored["history"]) == 3
        assert stored["settings"]["fit"]["n_samples"] == 60
        assert stored["settings"]["fit"]["species"] == "sorghum"
        assert stored["phytofit"]
        assert len(stored["input"]["sha256"]) == 64
        table = pd.read_csv(folder / name / "traits.csv")
        assert list(table.columns) == COLUMNS
        assert table[["low", "high"]].isna().all().all()
        assert set(table.method) == {"paper"}
        image = matplotlib.image.imread(folder / name / "fit.png")
        assert image.shape[0] > 600
        assert image[..., :3].std() > 0.05  # not blank
    together = pd.read_csv(folder / "traits.csv")
    assert list(together.cloud.unique()) == ["phytomer_0001", "phytomer_0002"]


def test_one_bad_cloud_does_not_stop_the_others(measured):
    folder, done = measured
    assert done.exit_code == 1
    assert "2 of 3 clouds measured" in done.output
    assert done.stderr.startswith("cloud 1 of 3: bad\nerror: bad.ply: ")
    failed = pd.read_csv(folder / "failed.csv")
    assert failed["cloud"].tolist() == ["bad"]
    assert "bad.ply" in failed["reason"][0]
    assert "bad.ply" in (folder / "phytofit.log").read_text()


def test_fit_by_default_writes_intervals_and_the_same_bytes_with_one_and_two_threads(clouds, tmp_path):
    for threads in (1, 2):
        done = run("fit", clouds / "phytomer_0001.ply", "-u", "cm", "--threads", threads, "-o", tmp_path / str(threads))
        assert done.exit_code == 0, done.output
    assert "95 % interval" in done.output
    assert "cm on the stem" in done.output
    folder = tmp_path / "1" / "phytomer_0001"
    table = pd.read_csv(folder / "traits.csv")
    assert (table.low < table.value).all()
    assert (table.value < table.high).all()
    assert set(table.method) == {"likelihood, 95 % sandwich interval"}
    stored = json.loads((folder / "fit.json").read_text())
    length = stored["parameters"]["leaf_length"]
    assert length["low"] < length["value"] < length["high"]
    assert stored["noise"]["leaf"] == pytest.approx(0.2, abs=0.03)
    assert stored["share"]["outliers"] < 0.02
    for name in FILES:
        assert (folder / name).read_bytes() == (tmp_path / "2" / "phytomer_0001" / name).read_bytes(), name


def test_paper_gives_the_same_bytes_with_one_and_two_threads(measured, clouds, tmp_path):
    assert run("fit", clouds / "phytomer_0001.ply", "-u", "cm", *FAST, "--threads", 1, "-o", tmp_path).exit_code == 0
    for name in FILES:
        a, b = ((folder / "phytomer_0001" / name).read_bytes() for folder in (tmp_path, measured[0]))
        assert a == b, name


def test_a_second_run_adds_to_the_table_replaces_results_as_a_whole_and_keeps_what_is_the_users(
    measured, clouds, tmp_path
):
    """The cloud that is new is in millimetres and far from the origin, and its model is there, too."""
    folder = tmp_path / "out"
    shutil.copytree(measured[0], folder)
    (folder / "phytomer_0001" / "note.txt").write_text("mine")
    (folder / "phytomer_0001" / "traits.csv").write_text("changed")
    cloud = phytofit.read_cloud(clouds / "phytomer_0001.ply", "cm")
    trimesh.PointCloud(cloud.points * 10.0 + [500.0, -300.0, 200.0]).export(tmp_path / "in_mm.ply")
    again = clouds / "phytomer_0001.ply"
    asked = ["--mesh", "obj", "--convergence"]
    assert run("fit", tmp_path / "in_mm.ply", "-u", "mm", *FAST, *asked, "-o", folder).exit_code == 0
    assert {p.name for p in (folder / "in_mm").iterdir()} == FILES | {"model.obj", "convergence.png"}
    assert run("fit", again, "-u", "cm", *FAST, "--seed", "1", "--xlsx", "-o", folder).exit_code == 0
    together = pd.read_csv(folder / "traits.csv")
    assert list(together.cloud.unique()) == ["in_mm", "phytomer_0001", "phytomer_0002"]
    assert len(pd.read_excel(folder / "traits.xlsx")) == len(together)
    assert json.loads((folder / "phytomer_0001" / "fit.json").read_text())["seed"] == 1
    assert {p.name for p in (folder / "phytomer_0001").iterdir()} == FILES | {"note.txt", "traits.yours.csv"}
    assert (folder / "phytomer_0001" / "note.txt").read_text() == "mine"
    assert (folder / "phytomer_0001" / "traits.yours.csv").read_text() == "changed"
    read = phytofit.read_cloud(tmp_path / "in_mm.ply", "mm")
    for model in ("model.ply", "model.obj"):
        bounds = trimesh.load(folder / "in_mm" / model).bounds
        np.testing.assert_allclose(bounds, np.array([read.points.min(0), read.points.max(0)]) * 10.0, atol=60.0)
    assert {p.name for p in folder.iterdir()} == {
        *("phytomer_0001", "phytomer_0002", "in_mm", "failed.csv", "traits.xlsx"),
        *BESIDE,
    }


BAD_CLOUDS = {
    "missing.ply": (None, "no such file"),
    "empty.ply": (b"", "empty"),
    "text.ply": (b"this is no ply at all\n" * 50, "text.ply"),
    "nan.xyz": (b"nan nan nan\n" * 200, "nan.xyz"),
    "flat.txt": (b"1.0 2.0\n" * 200, "found 2"),
    "few.xyz": (b"1 2 3\n4 5 6\n", "100"),
    "same.xyz": (b"1 2 3\n" * 200, "same.xyz"),
    "what.docx": (b"PK", ".docx"),
}


def test_bad_clouds_get_one_line_each_and_exit_code_2(tmp_path):
    for name, (content, _) in BAD_CLOUDS.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
    done = run("fit", *(tmp_path / name for name in BAD_CLOUDS), "--units", "cm", *FAST, "-o", tmp_path / "out")
    assert done.exit_code == 2
    lines = [line for line in done.stderr.splitlines() if not line.startswith("cloud ")]
    assert len(lines) == len(BAD_CLOUDS)
    for line, (name, (_, text)) in zip(lines, BAD_CLOUDS.items(), strict=True):
        assert line.startswith("error: ")
        assert name in line
        assert text in line
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"failed.csv", "phytofit.log"}


def test_an_empty_folder_and_a_bare_stem_are_refused(tmp_path):
    folder = tmp_path / "scan.ply"
    folder.mkdir()
    done = run("fit", folder, "-u", "cm", "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "an empty folder" in done.stderr
    random = np.random.default_rng(0)
    angle = random.uniform(0, 2 * np.pi, 2000)
    stem = np.stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), random.uniform(0, 30, 2000)], axis=1)
    np.savetxt(tmp_path / "stem.xyz", stem)
    done = run("fit", tmp_path / "stem.xyz", "-u", "cm", *FAST, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "stem.xyz: no stem with a leaf was found" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--units", "inch"], "inch"),
        ([], "no unit given"),
        (["--units", "mm"], "cm"),
        (["--units", "cm", "--up", "north"], "'--up': expected x, y, z"),
        (["--units", "cm", "--species", "nowhere.toml"], "nowhere.toml"),
        (["--units", "cm", "--samples", "-3"], "samples"),
        (["--units", "cm", "--points", "7"], "points"),
        (["--units", "cm", "--generations", "0"], "generations"),
        (["--units", "cm", "--method", "guess"], "method"),
        (["--units", "cm", "--distance", "taxicab"], "distance"),
        (["--units", "cm", "--labels", "organ"], "organ"),
    ],
)
def test_bad_settings_get_one_line_and_exit_code_2(clouds, tmp_path, arguments, text):
    done = run("fit", clouds / "phytomer_0001.ply", *arguments, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert text in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out" / "phytomer_0001").exists()


def test_results_can_not_be_written_into_a_file(clouds, tmp_path):
    (tmp_path / "file").write_text("mine")
    done = run("fit", clouds / "phytomer_0001.ply", "-u", "cm", *FAST, "-o", tmp_path / "file")
    assert done.exit_code == 2
    assert "results can't be written there" in done.stderr
    assert (tmp_path / "file").read_text() == "mine"


def test_names_that_collide_take_the_parent_folder():
    paths = [Path("a/x.ply"), Path("b/x.ply"), Path("b/y.ply")]
    assert result_names(paths) == ["a_x", "b_x", "y"]
    assert result_names([Path("a/x.ply"), Path("a/x.pcd")]) == ["a_x_ply", "a_x_pcd"]
    assert len(set(result_names([Path("a/x.ply"), Path("a/x.ply")]))) == 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--noise", "-1"], "noise"),
        (["--noise", "nan"], "noise"),
        (["--outliers", "1.5"], "outliers"),
        (["--sphere-diameter", "0"], "--sphere-diameter': expected above 0, got 0"),
        (["--set", "leaf_length"], "NAME=NUMBER"),
        (["--set", "leaf_size=3"], "leaf_size"),
        (["--set", "leaf_length=-4"], "leaf_length"),
        (["--points", "0"], "points"),
    ],
)
def test_bad_simulations_are_refused(tmp_path, arguments, text):
    done = run("simulate", *arguments, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert text in done.stderr
    assert {path.name for path in tmp_path.rglob("*")} <= {"out", "phytofit.log"}


def test_recipe_prints_every_setting_as_json():
    done = run("recipe")
    assert done.exit_code == 0
    recipe = json.loads(done.output)
    assert recipe["method_paper"]["n_points"] == 5000
    assert recipe["method_likelihood"]["n_points"] == 10_000
    assert recipe["method_paper"]["n_samples"] == 500
    assert recipe["method_paper"]["n_generations"] == 10
    assert recipe["method_likelihood"]["n_samples"] == 60
    assert recipe["fit"]["elite_fraction"] == 0.1
    assert recipe["objective"]["tilts_deg"]


def test_help_teaches():
    top, fit = run("--help").output, run("fit", "--help").output
    for command in ("fit", "simulate", "demo", "recipe"):
        assert command in top
    assert "phytofit fit leaf.ply --units cm" in fit
    assert "--up" in fit


def test_demo_as_installed_prints_estimate_beside_truth(tmp_path):
    """The real thing in a process of its own, without a screen."""
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "phytofit", "demo", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=240,
        env=environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Estimate beside truth" in done.stdout
    rows = [line.split("│") for line in done.stdout.splitlines() if "│" in line]
    shown = {row[1].strip(): (float(row[2]), float(row[4])) for row in rows}
    estimate, truth = shown["leaf_length"]
    assert estimate == pytest.approx(truth, abs=1.0)
    assert (tmp_path / "phytomer_0001" / "fit.png").stat().st_size > 20_000
