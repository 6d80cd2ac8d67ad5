"""Damaged hand measures and tables of results: read, or refused in one line; what is read can be true."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from damage import N_LONG, N_SHORT, assert_reads_or_refuses
from openpyxl import Workbook

import phytofit

GRID = [
    ["Plant", "Leaf length (cm)", "Leaf angle (°)", "Stem diameter in mm", "Observer"],
    ["0003", "47,9", "79", "35,6", "Ä"],
    ["0007", "72,0", "NA", "1.234,5", "B"],
    ["Prüfglied 3", "51,25", "62", "", "C"],
]
ROWS = ["cloud,plant,organ,rank,trait,value,unit,low,high,quality,flags,method"]
ROWS += [
    f"{name},1,leaf,{rank},leaf_area,{10.5 * rank},cm2,,{12.5 * rank},check,tip_unseen,m"
    for name in "ab"
    for rank in (1, 2)
]


def joined(separator: str, end: str = "\r\n") -> str:
    return end.join(separator.join(row) for row in GRID) + end


def workbook() -> bytes:
    book = Workbook()
    book.active.append(["Greenhouse"])
    book.active.append(["ID", "Leaf length (mm)", "Leaf angle"])
    book.active.append([3, 479.5, 79])
    book.active.append(["b", "72,5", "#N/A"])
    with io.BytesIO() as made:
        book.save(made)
        return made.getvalue()


BOOK = workbook()
SHEET = "xl/worksheets/sheet1.xml"
MEASURES = [
    ("semicolons.csv", joined(";").encode("cp1252")),
    ("sep.csv", ("sep=;\r\n" + joined(";")).encode("utf-8-sig")),
    ("tabs.txt", joined("\t").encode("utf-16")),
    ("commas.csv", b'cloud,rank,leaf_length_cm\na,1,47.9\nb,2,1234.5\n"c, d",3,5e1\n'),
    ("tidy.csv", "\n".join(ROWS).encode()),
    ("book.xlsx", BOOK),
]


def read_measures(path: Path) -> None:
    table = phytofit.read_measures(path)
    assert len(table)
    assert np.isfinite(table["value"]).all()
    assert (table["value"] >= 0.0).all()
    assert (table["cloud"] != "").all()


def read_results(path: Path) -> None:
    table = phytofit.read_results(path)
    assert np.isfinite(table["value"]).all()
    assert not np.isinf(table[["low", "high"]]).any(axis=None)


def read_book_of(path: Path) -> None:
    """A workbook whose sheet is the file: damage that a checksum does not find."""
    book = path.with_name(f"{path.name}.xlsx")
    with zipfile.ZipFile(io.BytesIO(BOOK)) as whole, zipfile.ZipFile(book, "w") as made:
        for name in whole.namelist():
            made.writestr(name, path.read_bytes() if name == SHEET else whole.read(name))
    read_measures(book)


def fuzz(folder: Path, capfd: pytest.CaptureFixture[str], n: int) -> None:
    with zipfile.ZipFile(io.BytesIO(BOOK)) as book:
        sheet = book.read(SHEET)
    assert_reads_or_refuses(read_measures, MEASURES, folder, capfd, n)
    assert_reads_or_refuses(read_results, [("traits.csv", "\n".join(ROWS).encode())], folder, capfd, n // 5)
    assert_reads_or_refuses(read_book_of, [("sheet.xml", sheet)], folder, capfd, n // 5)


def test_damaged_measures_are_read_or_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    fuzz(tmp_path, capfd, N_SHORT)


@pytest.mark.long
def test_many_damaged_measures_are_read_or_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    fuzz(tmp_path, capfd, N_LONG)
