"""Files of results: names, tables and meshes that other programs open; what is the user's stays."""

import os
import unicodedata
import zipfile
from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from phytofit import from_points, load_species, simulate
from phytofit.errors import OutputError, SettingError
from phytofit.io import (
    FolderTable,
    read_table,
    replacing,
    result_names,
    table_text,
    trait_table,
    whole_files,
    whole_folder,
    write_failures,
    write_mesh,
    write_table,
    write_workbook,
)
from phytofit.models import mesh
from phytofit.traits import Trait

FORMULA = "=1+1|' /C calc'!A0"
PARTS = st.sampled_from(["a", "A", "x.y", "traits.csv", "..", ".", "", "-o", "é", "é", "=c", "[/]", "$x$", "n" * 300])
COLUMNS = ["cloud", "trait", "value"]


def area(value=1.25):
    return Trait("leaf", 1, "leaf_area", value, "cm²", None, 2.0, flags=("tip_unseen", "width_holes"), method="40° off")


@given(st.lists(st.tuples(PARTS, PARTS, st.sampled_from([".ply", ".PLY", ".xyz"])), min_size=1, max_size=8))
def test_no_two_results_get_the_same_folder_on_any_system(files):
    names = result_names([Path(folder or "top") / f"{stem}{end}" for folder, stem, end in files])
    alike = {unicodedata.normalize("NFC", name).casefold() for name in (*names, "traits.csv", "failed.csv")}
    assert len(alike) == len(names) + 2
    for name in names:
        assert Path(name).name == name
        assert not name.startswith((".", "-"))
        assert len(name.encode()) < 230


def test_a_table_is_ascii_but_for_names_and_comes_back(tmp_path):
    plain = trait_table("maize", [area()])
    write_table(tmp_path / "traits.csv", plain)
    assert (tmp_path / "traits.csv").read_bytes().isascii()
    back = read_table(tmp_path / "traits.csv")
    assert back["unit"].tolist() == ["cm²"]
    assert "40 deg" in back["method"][0]
    assert back["flags"][0] == "tip_unseen;width_holes"
    named = trait_table("Möhre", [area()])
    write_table(tmp_path / "traits.csv", named)
    assert (tmp_path / "traits.csv").read_bytes().startswith(b"\xef\xbb\xbf")  # or a spreadsheet shows MÃ¶hre
    for read in (read_table, pd.read_csv):
        assert read(tmp_path / "traits.csv")["cloud"].tolist() == ["Möhre"]


def test_no_cell_is_a_formula(tmp_path):
    table = trait_table(FORMULA, [area(-3.5)])
    write_table(tmp_path / "traits.csv", table)
    cells = pd.read_csv(tmp_path / "traits.csv").iloc[0]
    assert cells["cloud"] == f"'{FORMULA}"
    assert cells["value"] == -3.5
    assert read_table(tmp_path / "traits.csv")["cloud"].tolist() == [FORMULA]
    for _ in range(2):
        write_workbook(tmp_path / "traits.xlsx", table)
    with zipfile.ZipFile(tmp_path / "traits.xlsx") as book:  # the same table, the same bytes
        assert {entry.date_time[0] for entry in book.infolist()} == {1980}
        assert b"dcterms:" not in book.read("docProps/core.xml")
    sheet = openpyxl.load_workbook(tmp_path / "traits.xlsx").active
    kinds = {sheet.cell(1, c).value: sheet.cell(2, c) for c in range(1, sheet.max_column + 1)}
    assert (kinds["cloud"].data_type, kinds["cloud"].value) == ("s", FORMULA)
    assert (kinds["value"].data_type, kinds["value"].value) == ("n", -3.5)
    assert kinds["unit"].value == "cm²"
    assert kinds["low"].value is None


def test_names_that_look_like_numbers_or_nothing_stay_names(tmp_path):
    names = ["0003", "1e5", "NA", "nan"]
    write_table(tmp_path / "traits.csv", pd.DataFrame({"cloud": names, "value": [1.0] * 4}))
    assert read_table(tmp_path / "traits.csv")["cloud"].tolist() == names


def test_the_table_over_all_is_of_what_lies_there_now(tmp_path):
    table = FolderTable(tmp_path, "traits.csv", "fit.json", COLUMNS)

    def result(name, text, mark=True):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "traits.csv").write_text(text)
        if mark:
            (tmp_path / name / "fit.json").write_text("{}")

    table.write()
    assert not (tmp_path / "traits.csv").exists()
    result("b", "cloud,trait,value\nb,leaf_length,2.50\n")
    result("a", "cloud,trait,value\na,leaf_length,1\n")
    result("other", "cloud,trait,value\nx,y,9\n", mark=False)
    table.write()
    assert (tmp_path / "traits.csv").read_text() == "cloud,trait,value\na,leaf_length,1\nb,leaf_length,2.50\n"
    result("b", "cloud,trait,value,unit\nb,leaf_length,4,cm\n")
    table.write()
    assert table.whole()["value"].tolist() == [1, 4]
    for name in ("a", "b"):
        (tmp_path / name / "fit.json").unlink()
    table.write()
    assert (tmp_path / "traits.csv").read_text() == "cloud,trait,value\n"


def test_a_table_of_the_users_is_not_written_over(tmp_path):
    (tmp_path / "traits.csv").write_text("plot;height\n1;2\n")
    with pytest.raises(OutputError, match=r"traits\.csv: it is there already"):
        FolderTable(tmp_path, "traits.csv", "fit.json", COLUMNS)
    with pytest.raises(OutputError, match="it is there already"):
        write_table(tmp_path / "traits.csv", trait_table("a", [area()]))
    (tmp_path / "traits.xlsx").write_bytes(b"mine")
    with pytest.raises(OutputError, match="it is there already"):
        write_workbook(tmp_path / "traits.xlsx", trait_table("a", [area()]))
    assert (tmp_path / "traits.xlsx").read_bytes() == b"mine"


def test_failures_stay_until_the_file_is_tried_again(tmp_path):
    a, b = Path("in/a.ply"), Path("in/b.ply")
    write_failures(tmp_path, {"a": (a, "empty"), "b": (b, "=flat")}, [a, b])
    write_failures(tmp_path, {}, [a])
    assert pd.read_csv(tmp_path / "failed.csv").to_numpy().tolist() == [["b", "in/b.ply", "'=flat"]]
    assert write_failures(tmp_path, {}, [b]) is None
    assert not (tmp_path / "failed.csv").exists()


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_a_mesh_names_its_organs_and_lies_where_the_cloud_did(tmp_path, kind):
    made = simulate(load_species(), n_points=400, seed=1)
    cloud = from_points(made.points * 10.0 + 500.0, "mm")
    write_mesh(tmp_path / f"model.{kind}", made.organs, cloud)
    scene = trimesh.load_scene(tmp_path / f"model.{kind}")
    if kind == "glb":
        assert set(scene.geometry) == {"stem", "leaf"}
    else:
        lines = [line.split() for line in (tmp_path / "model.obj").read_text().splitlines()]
        assert [line[1] for line in lines if line[:1] == ["g"]] == ["stem", "leaf"]
        assert sum(line[:1] == ["f"] for line in lines) == sum(len(mesh([organ]).faces) for organ in made.organs)
    axis = np.concatenate([organ.axis for organ in made.organs])
    low, high = axis.min(axis=0) - 5.0, axis.max(axis=0) + 5.0
    ends = np.array([cloud.to_input_frame(end[np.newaxis])[0] for end in (low, high)])
    assert (scene.bounds[0] >= ends.min(axis=0)).all()
    assert (scene.bounds[1] <= ends.max(axis=0)).all()
    assert np.ptp(scene.bounds, axis=0).max() > 100.0  # mm
    with pytest.raises(SettingError, match=r"mesh: expected one of ply, obj, glb, got 'stl'"):
        write_mesh(tmp_path / "model.stl", made.organs, cloud)


def test_a_folder_that_is_no_result_is_not_replaced(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "precious.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"holds no fit\.json"), whole_folder(tmp_path, "a", "fit.json"):
        pass
    (tmp_path / "b").write_text("mine")
    with pytest.raises(OutputError, match=r"holds no fit\.json"), whole_folder(tmp_path, "b", "fit.json"):
        pass
    assert (tmp_path / "a" / "precious.txt").read_text() == (tmp_path / "b").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


def test_a_result_behind_a_link_is_replaced_there(tmp_path):
    there = tmp_path / "elsewhere" / "a"
    there.parent.mkdir()
    for text in ("old", "new"):
        with whole_folder(tmp_path, "a", "fit.json") as part:
            (part / "fit.json").write_text(text)
        if text == "old":
            (tmp_path / "a").rename(there)
            (tmp_path / "a").symlink_to(there)
    assert (tmp_path / "a").is_symlink()
    assert (there / "fit.json").read_text() == "new"


def test_too_long_names_and_what_is_no_folder_are_said(tmp_path):
    for folder in (tmp_path / ("n" * 300), Path(os.devnull), Path(os.devnull) / "x"):
        with pytest.raises(OutputError, match="can't be written"):
            replacing.prepare_folder(folder)


def test_what_another_program_is_writing_is_left_alone(tmp_path):
    with whole_files(tmp_path) as part:
        (part / "a").write_text("half")
        replacing.prepare_folder(tmp_path)
        assert (part / "a").exists()
    assert (tmp_path / "a").read_text() == "half"


def test_table_text_rounds_and_leaves_what_is_missing_empty():
    assert table_text(pd.DataFrame({"a": [1.23456789, np.nan], "b": ["x", None]})) == "a,b\n1.23457,x\n,\n"
