"""Hand measures as people keep them: names of columns, units, numbers, encodings, dialects, workbooks."""

import os
import runpy
import subprocess
import sys
import unicodedata
from datetime import date
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from openpyxl import Workbook, load_workbook

import phytofit
from phytofit.errors import InputError
from phytofit.validation import headers
from phytofit.validation.headers import ColumnError, measured
from phytofit.validation.numbers import decimal_mark, number_of

AWKWARD = Path(__file__).parents[1] / "../shared/data/awkward"
EXACT = 1e-12


def cm(text):
    """What a measure of 1 in a column of this name is in the unit of results, or None."""
    found = measured(text)
    return found if found is None or found.ignored else (found.trait, found.factor, found.unit)


def read(tmp_path, content, name="hand.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return phytofit.read_measures(path)


def values(table):
    return {(row.cloud, row.trait): round(row.value, 9) for row in table.itertuples()}


def workbook(path, **sheets):
    book = Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


HAND = {("a", "leaf_length"): 47.9, ("a", "leaf_angle"): 79.0, ("b", "leaf_length"): 72.0}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Leaf length in mm", ("leaf_length", 0.1, "cm")),
        ("Leaf length in (mm)", ("leaf_length", 0.1, "cm")),
        ("Leaf length (in mm)", ("leaf_length", 0.1, "cm")),
        ("Leaf length in cm in greenhouse", ("leaf_length", 1.0, "cm")),
        ("leaf_length_in", ("leaf_length", 2.54, "cm")),
        ("Length [in]", ("leaf_length", 2.54, "cm")),
        ("Blade length, M. Smith (cm)", ("leaf_length", 1.0, "cm")),
        ("leaf_length_m", ("leaf_length", 100.0, "cm")),
        ("LeafLengthMM", ("leaf_length", 0.1, "cm")),
        ("leaf length 2 (cm)", ("leaf_length", 1.0, "cm")),
        ("leaf_length_2_cm", ("leaf_length", 1.0, "cm")),
        ("Leaf length from base to tip, millimetres", ("leaf_length", 0.1, "cm")),
        ("Leaf width at 10 cm (mm)", ("leaf_width", 0.1, "cm")),
        ("Leaf angle in degrees", ("leaf_angle", 1.0, "deg")),
        ("Leaf angle (º)", ("leaf_angle", 1.0, "deg")),
        ("Leaf angle (insertion, °)", ("leaf_insertion_angle", 1.0, "deg")),
        ("leaf_angle", ("leaf_angle", None, "deg")),
        ("Leaf area (cm²)", ("leaf_area", 1.0, "cm²")),
        ("leaf_area_m2", ("leaf_area", 1e4, "cm²")),
        ("Leaf area in square inches", ("leaf_area", 2.54**2, "cm²")),
        ("leaf curvature °/cm", ("leaf_curvature", 1.0, "deg/cm")),
        ("Culm dia. (mm)", ("stem_diameter", 0.1, "cm")),
        ("stem width mm", ("stem_diameter", 0.1, "cm")),
        ("Number of leaves", ("leaf_count", None, "1")),
        ("remarks", None),
    ],
)
def test_a_column_is_a_trait_in_a_unit(name, expected):
    assert cm(name) == expected


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Leaf length mm (cm)", "several units, mm and cm"),
        ("Leaf length in cm or inches", "several units, cm and inch"),
        ("Leaf angle (cm)", "'cm' is no unit of leaf_angle"),
        ("Leaf area (cm)", "'cm' is no unit of leaf_area"),
        ("Leaf length (furlong)", "'furlong' is no unit known"),
        ("leaf length x width (cm)", "names length and width"),
        ("Leaf length (0.1 mm)", "a number before its unit"),
        ("Leaf length (x 10 cm)", "a number before its unit"),
    ],
)
def test_a_name_that_can_be_read_in_several_ways_is_refused(name, said):
    with pytest.raises(ColumnError, match=said):
        measured(name)


@pytest.mark.parametrize(
    "name",
    [
        *("sheath length (cm)", "Leaf length SD (cm)", "leaf tip angle", "length/width ratio"),
        *("Blattlänge (cm)", "leaf angle from horizontal (deg)", "Leaf elevation angle"),
    ],
)
def test_what_only_looks_like_a_trait_is_not_read_and_said(tmp_path, name):
    table = read(tmp_path, f"cloud,leaf_width_cm,{name}\na,4.5,3\n")
    assert values(table) == {("a", "leaf_width"): 4.5}
    (note,) = table.attrs["notes"]
    assert name in note


def test_units_do_not_turn_on_how_strings_hash():
    """The same in three processes with other hashes; of the module alone, so that each takes a tenth of a second."""
    names = ["Leaf length in mm", "leaf angle in degrees (at 8 cm)", "stem diameter in in", "Leaf length mm in cm m"]
    program = (
        f"import runpy; m = runpy.run_path({headers.__file__!r})\n"
        f"for name in {names!r}:\n"
        "    try: print(m['measured'](name))\n"
        "    except ValueError as error: print(error)\n"
    )
    said = {
        subprocess.run(
            [sys.executable, "-S", "-c", program],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("0", "1", "2")
    }
    assert len(said) == 1
    assert said.pop().count("factor=0.1") == 1


def test_one_unit_by_its_name_plural_and_sign():
    ways = runpy.run_path(headers.__file__)["FACTORS"]
    for word, (factor, unit) in ways.items():
        trait = {"cm": "leaf_length", "cm²": "leaf_area", "deg": "leaf_angle"}.get(unit)
        if trait:
            assert cm(f"{trait} ({word})") == (trait, factor, unit)
            assert cm(f"{trait} [{word.upper()}]") == (trait, factor, unit)


@pytest.mark.parametrize(
    ("cells", "separator", "numbers"),
    [
        (["47.9", "1,234.5", "1,234"], ",", [47.9, 1234.5, 1234.0]),
        (["47,9", "1.234,5", "1.234"], ";", [47.9, 1234.5, 1234.0]),
        (["12.345", "13.000"], ",", [12.345, 13.0]),
        (["12,345", "13,000"], ";", [12.345, 13.0]),
        (["47,9", "79.5"], ";", [47.9, 79.5]),
        (["1 234,5", "1\u202f234,5", "1'234.5", "1,234,567"], ",", [1234.5, 1234.5, 1234.5, 1234567.0]),
        (["4,79E+01", "+5", ".5", "5.", "0,125"], "\t", [47.9, 5.0, 0.5, 5.0, 0.125]),
        (["４７.９"], ",", [47.9]),
    ],
)
def test_numbers_with_points_commas_and_thousands(cells, separator, numbers):
    mark = decimal_mark(cells, separator)
    assert [number_of(cell, mark) for cell in cells] == pytest.approx(numbers, rel=EXACT)


@pytest.mark.parametrize(
    ("cells", "separator"), [(["1,234"], ","), (["1,5", "1.5", "1,234"], ";"), (["1,234", "1.234"], ";")]
)
def test_a_number_that_can_be_read_in_two_ways_is_refused(cells, separator):
    with pytest.raises(ValueError, match=r"1[,.]234"):
        decimal_mark(cells, separator)


@given(st.floats(1e-3, 1e6), st.sampled_from(["us", "german", "swiss", "french"]))
def test_a_number_survives_the_way_it_is_written(value, way):
    """Against Python's own formatting: with thousands, in four styles; two decimals, which leave no doubt."""
    text = f"{value:,.2f}"
    styles = {"us": text, "german": text.translate(str.maketrans(",.", ".,")), "swiss": text.replace(",", "’"),
              "french": text.translate(str.maketrans(",.", "\u00a0,"))}  # fmt: skip
    cell = styles[way]
    assert number_of(cell, decimal_mark([cell], ",")) == pytest.approx(round(value, 2), rel=EXACT)


@pytest.mark.parametrize(
    "cell",
    ["inf", "-inf", "1e400", "1_000", "-5", "0", "47*", "<5", "1,23,456", "4 7", "0x10", "47.9 mm", "bent", "TRUE"],
)
def test_what_is_no_positive_finite_number_is_refused_with_its_place(tmp_path, cell):
    with pytest.raises(InputError, match="row 3, column 'leaf_length_cm'") as caught:
        read(tmp_path, f'cloud,leaf_length_cm\na,5\nb,"{cell}"\n')
    assert cell in str(caught.value)


@pytest.mark.parametrize(
    "cell",
    ["", " ", "NA", "n/a", "N.A.", "#N/A", "nan", "NaN", "-nan(ind)", "n.d.", "n. d.", "n/d", "-", "–", ".", "NULL"],
)
def test_missing_values_are_none(tmp_path, cell):
    table = read(tmp_path, f"cloud,leaf_length_cm,leaf_angle\na,47.9,79\nb,72,{cell}\n")
    assert values(table) == HAND


def test_a_unit_may_stand_in_the_cell_or_in_the_row_below(tmp_path):
    assert values(read(tmp_path, "cloud,leaf_length_mm,leaf_angle\na,479 mm,79°\nb,720mm,\n")) == HAND
    assert values(read(tmp_path, "Plant,Leaf length,Leaf angle\n,(mm),deg\na,479,79\nb,720,\n")) == HAND
    with pytest.raises(InputError, match="several units, cm and mm"):
        read(tmp_path, "Plant,Leaf length cm,Leaf angle\n,(mm),deg\na,479,79\n")


GRID = [["Plant", "Leaf length (cm)", "Leaf angle (°)", "Müller"], ["a", "47,9", "79", "x"], ["b", "72,0", "", ""]]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_encodings_and_separators(tmp_path, encoding, separator):
    text = "\r\n".join(separator.join(row) for row in GRID) + "\r\n"
    assert values(read(tmp_path, text.encode(encoding))) == HAND


def test_what_spreadsheets_do_to_a_table(tmp_path):
    """A line that says the separator, titles and comments above, blank rows, trailing separators, a Mac's line ends."""
    rows = [";".join(row) for row in GRID]
    assert values(read(tmp_path, "sep=;\r\n" + "\r\n".join(rows))) == HAND
    assert values(read(tmp_path, '"sep=,"\n' + "cloud,leaf_length_cm,leaf angle\na,47.9,79\nb,72,\n")) == HAND
    assert values(read(tmp_path, "Greenhouse, May\n\n# by hand\n" + "\n\n".join(f"{row};;" for row in rows))) == HAND
    assert values(read(tmp_path, "\r".join(rows).encode("mac-roman"))) == HAND
    assert values(read(tmp_path, 'cloud, leaf_length_cm, leaf angle\na, "47,9", 79\nb, 72,\n')) == HAND
    named_rows = read(tmp_path, '"","cloud","leaf_length_cm","leaf angle"\n"1","a",47.9,79\n"2","b",72,NA\n')  # of R
    assert values(named_rows) == HAND
    assert named_rows.attrs["notes"] == ()
    merged = read(tmp_path, "cloud,leaf_length_cm,,leaf angle\na,47.9,48.1,79\nb,72,,\n")
    assert values(merged) == HAND
    assert merged.attrs["notes"] == ("column 3 is not read: it has no name",)
    quoted = "cloud,leaf_length_cm,leaf_angle\n" + '"a","47,9","79"\n"b","72",""\n'
    assert values(read(tmp_path, quoted)) == HAND


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "found nothing"),
        ("cloud,leaf_length_cm\n", "no rows"),
        ("cloud,leaf_length_cm\na,\nb,NA\n", "every cell is empty or NA"),
        ("leaf_length_cm\n5\n", "one of the cloud"),
        ("cloud,weight\na,3\n", "one for each trait"),
        ("cloud,sheath_length_cm\na,3\n", "none of its columns is read"),
        ("cloud,leaf_length\na,3\n", "has no unit"),
        ("cloud,trait,value,unit\na,leaf_length,3,furlong\n", "row 2: expected a unit of leaf_length"),
        ("cloud,trait,value,unit\na,leaf_length,3,deg\n", "row 2: expected a unit of leaf_length"),
        ("cloud,leaf_length_cm,leaf_angle\na,47,9,79\n", "row 2: found 4 cells under 3 columns"),
        ("cloud,leaf_length_cm\n,5\n", "row 2, column 'cloud': expected the name of a cloud"),
        ("cloud,leaf,leaf_length_cm\na,flag,5\n", "row 2, column 'leaf': expected a whole number"),
        ("cloud,leaf_angle\na,181\n", "from 0 to 180 degrees"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "old Excel file"),
        (b"%PDF-1.7\n", "PDF"),
        (b"<html><table>", "page or XML"),
        (b"PK\x03\x04 and no more", "can't be read as an .xlsx workbook"),
        (bytes(range(256)) * 9, "binary data"),
        ('cloud,leaf_length_cm\na,"' + "5" * 200_000, "quotation mark"),
        ('cloud,leaf_length_cm\na,5\nb,"6\nc,7\n', "row 3 goes on to the end of the file.*quotation mark"),
        ("ID,length cm,ID,length cm\na,5,b,6\n", "columns 1 and 3 are both called 'ID', and differ"),
    ],
)
def test_what_is_no_table_of_measures_is_said(tmp_path, content, said):
    with pytest.raises(InputError, match=said) as caught:
        read(tmp_path, content)
    assert str(tmp_path / "hand.csv") in str(caught.value)
    assert len(str(caught.value)) < 400


def test_no_message_quotes_a_whole_file(tmp_path):
    with pytest.raises(InputError) as caught:
        read(tmp_path, "x" * 100_000 + "\n")
    assert len(str(caught.value)) < 400
    with pytest.raises(InputError) as caught:
        read(tmp_path, "cloud,leaf_length_cm\na," + "x" * 100_000 + "\n")
    assert len(str(caught.value)) < 400


def test_a_path_that_is_no_file_is_said(tmp_path):
    for path, said in ((tmp_path / "none.csv", "no such file"), (tmp_path, "can't be read"), ("a\0b", "can't be read")):
        with pytest.raises(InputError, match=said):
            phytofit.read_measures(path)


def test_columns_of_plant_and_leaf(tmp_path):
    table = read(tmp_path, "cloud,plant,leaf no.,leaf_length_cm\ns,2,03,5\n")
    assert table[["cloud", "plant", "rank"]].to_numpy().tolist() == [["s", "2", "3"]]
    table = read(tmp_path, "Plant,Leaf,Leaf length (cm)\np,1.0,5\np,,6\n")
    assert table[["cloud", "plant", "rank"]].to_numpy().tolist() == [["p", "", "1"], ["p", "", ""]]
    table = read(tmp_path, "ID,plant,leaf_length_cm\n7,Prima,5\n")  # a name, and no number of a plant in a cloud
    assert table[["cloud", "plant"]].to_numpy().tolist() == [["7", ""]]
    assert table.attrs["notes"] == ("clouds are named by column 'ID'; 'plant' is not read",)


def test_a_workbook_is_read(tmp_path):
    """Numbers as they are, whatever they look like as text; the sheet that has the columns, with a title."""
    rows = [["Measured in May"], [], ["ID", "Leaf length (mm)", "Leaf angle", "Stem diameter (cm)"],
            [3, 479, 79.5, 1.234], ["b", "72,5", None, "#N/A"], [date(2024, 3, 1), 80, None, None]]  # fmt: skip
    path = workbook(tmp_path / "hand.xlsx", Notes=[["by", "Müller"]], May=rows)
    table = phytofit.read_measures(path)
    assert values(table) == {
        ("3", "leaf_length"): 47.9,
        ("3", "leaf_angle"): 79.5,
        ("3", "stem_diameter"): 1.234,
        ("b", "leaf_length"): 7.25,
        ("2024-03-01", "leaf_length"): 8.0,
    }
    path = workbook(tmp_path / "two.xlsx", May=[["ID", "length cm"], ["a", 5]], June=[["ID", "length cm"], ["a", 6]])
    table = phytofit.read_measures(path)
    assert values(table) == {("a", "leaf_length"): 5.0}
    assert "sheet 'June' is not read" in table.attrs["notes"][0]
    book = load_workbook(path)
    book["May"].sheet_state, book.active = "hidden", 1
    book.save(path)
    assert values(phytofit.read_measures(path)) == {("a", "leaf_length"): 6.0}


@pytest.mark.parametrize(
    ("sheets", "said"),
    [
        ({"Notes": [["by", "me"]], "May": [["ID", "weight"]]}, "none of its sheets ('Notes', 'May')"),
        ({"A": [["ID", "length cm"], ["a", "=2*3"]]}, "the formula '=2*3' has no result"),
        ({"A": [["ID", "length cm"], ["a", True]]}, "row 2, column 'length cm': expected a number"),
        ({"A": [["ID", "length cm"], ["a", date(2024, 7, 4)]]}, "got '2024-07-04'"),
        ({"A": [["ID", "length cm"], ["a", "#REF!"]]}, "got '#REF!'"),
    ],
)
def test_what_is_wrong_with_a_workbook_is_said(tmp_path, sheets, said):
    with pytest.raises(InputError) as caught:
        phytofit.read_measures(workbook(tmp_path / "hand.xlsx", **sheets))
    assert said in str(caught.value)


def test_a_table_of_results_is_read_as_a_spreadsheet_saves_it_again(tmp_path):
    """Semicolons, decimal commas, another order of the columns, no column plant; or a workbook."""
    text = "trait;cloud;value;low;high;unit;flags;rank\nleaf_area;3;1.234,5;1.200;;cm²;tip;1,0\n"
    (tmp_path / "traits.csv").write_text(text, encoding="cp1252")
    (row,) = phytofit.read_results(tmp_path).to_dict("records")
    assert (row["value"], row["low"], row["unit"], row["rank"], row["plant"]) == (1234.5, 1200.0, "cm²", "1", "")
    assert pd.isna(row["high"])
    names = ["cloud", "plant", "organ", "rank", "trait", "value", "unit", "low", "high", "quality", "flags", "method"]
    rows = [names, ["0003", 2, "leaf", 1, "leaf_area", 1234.5, "cm2", 1200.0, None, "check", None, "m"]]
    found = phytofit.read_results(workbook(tmp_path / "traits.xlsx", traits=rows))
    (new,) = found.to_dict("records")
    assert (new["cloud"], new["value"], new["unit"], new["plant"], new["flags"]) == ("0003", 1234.5, "cm²", "2", "")
    assert (new["quality"], row["quality"], row["flags"]) == ("check", "", "tip")  # the older one does not say


@pytest.mark.skipif(not AWKWARD.is_dir(), reason="no data")
def test_measures_as_peoples_tools_write_them():
    for name in (
        "21_truth_windows_1252/truth",
        "21_truth_windows_1252/truth_utf8",
        "23_truth_sep_line/truth",
        "25_truth_utf16/truth",
    ):
        assert values(phytofit.read_measures(AWKWARD / f"{name}.csv")) == {
            ("0003", "leaf_length"): 47.9,
            ("0003", "leaf_angle"): 79.0,
            ("0007", "leaf_length"): 72.0,
            ("0007", "leaf_angle"): 62.0,
        }
    right = values(phytofit.read_measures(AWKWARD / "22_truth_missing_values/truth_empty.csv"))
    assert len(right) == 4
    for path in sorted((AWKWARD / "22_truth_missing_values").iterdir()):
        assert values(phytofit.read_measures(path)) == right, path.name
    decomposed = phytofit.read_measures(AWKWARD / "24_truth_nfd_name/truth.csv")["cloud"]
    assert all(name == unicodedata.normalize("NFC", name) for name in decomposed)


@pytest.mark.skipif(not AWKWARD.is_dir(), reason="no data")
def test_damaged_measures_are_refused_or_missing():
    said = {"-5": "more than 0", "1_000": "got '1_000'", "1e400": "finite", "inf": "got 'inf'"}
    for name, text in said.items():
        with pytest.raises(InputError, match=text):
            phytofit.read_measures(AWKWARD / f"damaged/truth_{name}.csv")
    assert phytofit.read_measures(AWKWARD / "damaged/truth_nan.csv")["cloud"].tolist() == [
        "phytomer_0002",
        "phytomer_0003",
    ]
    with pytest.raises(InputError, match="names of columns"):
        phytofit.read_measures(AWKWARD / "damaged/quoted_header.csv")
