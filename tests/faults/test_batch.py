"""Many clouds: whatever becomes of one, the others are measured, and their names do no harm."""

import math
from dataclasses import replace

import pandas as pd
import pytest
from commands import World, run
from typer.testing import CliRunner

from phytofit import cli, from_points, write_cloud

HOSTILE = ("[red]x", "$x$", "=1+1", "-o", "..", "...", ".", "traits.csv", "a\nb", "\x1b[31mred", "\udcff", "A", "a",
           "n" * 240, "Möhre", "[", "a\\")  # fmt: skip


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.fixture
def folder(world, tmp_path, monkeypatch):
    world.patch(monkeypatch)
    world.lay_out(tmp_path)
    return tmp_path


def invoke(*arguments):
    runner = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"})
    return runner.invoke(cli.app, [str(argument) for argument in arguments])


def broken(world, name):
    """What comes of a cloud, by its name: an error of the program, a trait that is no number, or a fit."""
    if name == "breaks":
        raise ZeroDivisionError("by\nzero [/]")
    fitted = replace(world.fits[0])
    if name == "odd":
        fitted.__dict__["traits"] = [replace(trait, value=math.nan) for trait in fitted.traits]
    return fitted


def test_whatever_one_cloud_raises_the_others_go_on(world, folder, monkeypatch):
    monkeypatch.setattr("phytofit.fitting.fit", lambda cloud, **how: broken(world, cloud.name))
    cloud = from_points(world.points, "cm")
    for name in ("breaks", "odd", "good"):
        write_cloud(folder / f"{name}.ply", cloud)
    files = [folder / f"{name}.ply" for name in ("breaks", "odd", "good")]
    done = invoke("fit", *files, "--units", "cm", "--out", folder / "out")
    assert done.exit_code == 1, done.output
    errors = [line for line in done.stderr.splitlines() if "error: " in line]
    assert len(errors) == 2
    assert "breaks.ply" in errors[0]
    assert "ZeroDivisionError: by zero [/]" in errors[0]
    assert "odd.ply" in errors[1]
    assert "not a number" in errors[1]
    assert "Traceback" not in done.output
    assert pd.read_csv(folder / "out" / "traits.csv")["cloud"].unique().tolist() == ["good"]
    assert pd.read_csv(folder / "out" / "failed.csv")["cloud"].tolist() == ["breaks", "odd"]
    assert not (folder / "out" / "odd").exists()
    log = (folder / "out" / "phytofit.log").read_text()
    assert "Traceback" in log
    assert "ZeroDivisionError" in log
    assert invoke("fit", *files[:2], "--units", "cm", "--out", folder / "none").exit_code == 2


def test_whatever_one_leaf_raises_the_others_go_on(world, folder, monkeypatch):
    done = iter((ValueError("it\nbroke"), None, None))

    def fit(cloud, **how):
        error = next(done)
        if error is not None:
            raise error
        return world.fits[0]

    monkeypatch.setattr("phytofit.pipeline.plant.fit", fit)
    made = run(world, "run", folder, 0)
    assert "Traceback" not in made.output
    table = pd.read_csv(folder / "out" / "traits.csv")
    lengths = table[table["trait"] == "leaf_length"]
    assert lengths["rank"].tolist() == [1, 2, 3]
    assert lengths["flags"].iloc[0] == "not_fitted"
    assert "leaf 1: not fitted: an internal error of phytofit, ValueError: it broke" in made.output


def test_hostile_names_are_shown_stored_and_found_harmlessly(world, folder):
    cloud = from_points(world.points, "cm")
    inputs, out = folder / "in", folder / "out"
    inputs.mkdir()
    (out / "mine").mkdir(parents=True)
    (out / "mine" / "note.txt").write_text("mine")
    for name in HOSTILE:
        write_cloud(folder / "a.ply", cloud)
        (folder / "a.ply").rename(inputs / f"{name}.ply")
    done = invoke("fit", *(inputs / f"{name}.ply" for name in HOSTILE), "--units", "cm", "--xlsx", "--out", out)
    assert done.exit_code == 0, done.output
    assert "\x1b" not in done.output
    for shown in ("[red]x", "$x$", "=1+1", r"\x1b[31mred", r"\udcff", "a b"):
        assert shown.replace("\\", "") in done.output.replace("\\", ""), shown
    folders = {path.name for path in out.iterdir() if path.is_dir()}
    assert len(folders) == len(HOSTILE) + 1
    assert (out / "mine" / "note.txt").read_text() == "mine"
    table = pd.read_csv(out / "traits.csv")
    assert table["cloud"].nunique() == len(HOSTILE)
    assert not table["cloud"].str.startswith(("=", "+", "-", "@")).any()
    rows = "".join(f'"{name}",50\n' for name in ("[red]x", "$x$", "=1+1", "Möhre", "-o"))
    (folder / "truth.csv").write_text(f"cloud,leaf_length_cm\n{rows}", encoding="utf-8")
    found = invoke("validate", out, "--truth", folder / "truth.csv", "--out", folder / "validation")
    assert found.exit_code == 0, found.output
    pairs = pd.read_csv(folder / "validation" / "pairs.csv")
    assert len(pairs) == 5, found.output


def test_a_file_of_the_users_in_the_way_is_not_written_over(world, folder):
    for name in ("plant.ply", "traits.csv", "leaves.csv", "plant.png", "validation.html", "phytomer_0001.ply"):
        (folder / "out").mkdir(exist_ok=True)
        (folder / "out" / name).write_text("mine, all; mine")
    for command in ("fit", "segment", "run", "reconstruct", "validate", "simulate", "demo"):
        done = run(world, command, folder, 0)
        assert done.exit_code in (1, 2), done.output
        assert "it is there already" in done.stderr, command
    for path in (folder / "out").iterdir():
        assert path.name == "phytofit.log" or path.is_dir() or path.read_text() == "mine, all; mine", path


def test_results_of_plants_and_of_leaves_do_not_mix(world, folder):
    assert run(world, "run", folder, 0).exit_code == 0
    before = (folder / "out" / "traits.csv").read_bytes()
    done = run(world, "fit", folder, 0)
    assert done.exit_code == 2
    assert "whole plant" in done.stderr
    assert (folder / "out" / "traits.csv").read_bytes() == before
