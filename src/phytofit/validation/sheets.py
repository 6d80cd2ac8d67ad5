"""Tables as people keep them: the cells of a text file in any encoding and dialect, or of a workbook's sheets."""

import csv
import io
import re
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from datetime import date, datetime, time
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from phytofit.errors import InputError
from phytofit.text import one_line

__all__ = ["Cell", "Sheet", "quoted", "read_sheets", "text_of"]

Cell: TypeAlias = str | float  # a number only where the file says that it is one
SEPARATORS = (";", "\t", ",", "|")
BYTE_ORDER_MARKS = (  # the longer first: that of UTF-16 begins that of UTF-32
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
FOREIGN = (  # how files begin that spreadsheets write and that are no table we read
    (b"\xd0\xcf\x11\xe0", "an old Excel file (.xls), or one with a password; save it as .xlsx without one, or as CSV"),
    (b"%PDF", "a PDF file; export the table as CSV or .xlsx"),
    (b"<", "a page or XML file; open it in a spreadsheet and save it as CSV or .xlsx"),
    (b"{\\rtf", "a text document; copy its table to a spreadsheet and save it as CSV or .xlsx"),
)
MOST_UNPACKED = 500_000_000  # bytes of a workbook, some millions of cells; more is a mistake or an attack
SHOWN = 40  # characters of a cell in a message


class Sheet(NamedTuple):
    """Cells by row, as the file has them: rows may differ in length.  ``separator`` is that of text, else empty."""

    name: str
    rows: list[list[Cell]]
    separator: str


def read_sheets(path: Path) -> list[Sheet]:
    """The sheets of a workbook (XLSX), hidden ones last; of a text file its cells by each separator that may be meant.

    Raises InputError if the file can't be read, or is neither.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: can't be read ({getattr(error, 'strerror', error)})") from None
    for begin, said in FOREIGN:
        if data.removeprefix(b"\xef\xbb\xbf").lstrip()[:8].lower().startswith(begin):
            raise InputError(f"{path}: expected a CSV or .xlsx table, found {said}")
    if data.startswith(b"PK"):
        return _workbook(data, path)
    text = _decoded(data)
    if text is None:
        raise InputError(f"{path}: expected a CSV or .xlsx table, found binary data; is it the right file?")
    try:
        return [Sheet("", _rows(body, separator), separator) for separator, body in _dialects(text)]
    except csv.Error as error:
        raise InputError(f"{path}: can't be read as CSV ({error}); is a quotation mark not closed?") from None


def quoted(cell: Cell) -> str:
    """A cell for a message: in one line, and not all of a long one."""
    text = one_line(text_of(cell))
    return repr(text if len(text) <= SHOWN else f"{text[:SHOWN]}…")


def text_of(cell: Cell) -> str:
    """A cell as text; a whole number without a decimal point, as it is shown."""
    if isinstance(cell, str):
        return cell.strip()
    return str(int(cell)) if abs(cell) < 1e15 and cell == int(cell) else repr(cell)


def _decoded(data: bytes) -> str | None:
    """The text of a file: by its byte order mark; UTF-16 without one by its zeros; UTF-8; or what Windows, and a Mac
    that ends lines by carriage returns alone, wrote before it.  None where it is no text."""
    encoding = next((name for mark, name in BYTE_ORDER_MARKS if data.startswith(mark)), None)
    if encoding is None and b"\0" in data:
        even, odd = data[::2].count(0), data[1::2].count(0)
        if max(even, odd) < 0.25 * len(data):  # of text in Latin letters one half is zeros
            return None
        encoding = "utf-16-be" if even > odd else "utf-16-le"
    mac = b"\r" in data and b"\n" not in data
    for name in (encoding,) if encoding else ("utf-8", "mac-roman" if mac else "cp1252", "latin-1"):
        try:
            text = data.decode(name)
        except UnicodeDecodeError:
            continue
        return None if "\0" in text else text
    return None


def _dialects(text: str) -> Iterator[tuple[str, str]]:
    """Separators that may be meant, and the text that they separate; only one where a first line ``sep=;`` says it."""
    said = re.match(r'"?sep=(.)"?[;,\t]*(?:\r\n|\r|\n|$)', text, re.IGNORECASE)
    if said:
        yield said[1], "\n" + text[said.end() :]  # the row keeps its place in the count
    else:
        yield from ((separator, text) for separator in SEPARATORS)


def _rows(text: str, separator: str) -> list[list[Cell]]:
    rows: list[list[Cell]] = [
        list(row) for row in csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)
    ]
    if text.count('"') % 2 and any("\n" in str(cell) for row in rows[-1:] for cell in row):
        raise csv.Error(f"row {len(rows)} goes on to the end of the file")
    return rows


def _workbook(data: bytes, path: Path) -> list[Sheet]:
    from openpyxl import load_workbook  # noqa: PLC0415  (takes its time, and few measures are workbooks)

    def opened(values: bool) -> Any:
        return load_workbook(io.BytesIO(data), read_only=True, data_only=values)

    def shown_first(sheets: Any) -> Any:
        return sorted(sheets, key=lambda sheet: sheet.sheet_state != "visible")

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if any("opendocument" in name or name == "content.xml" for name in archive.namelist()):
                raise InputError(f"{path}: expected a CSV or .xlsx table, found an OpenDocument file; save it as .xlsx")
            if sum(entry.file_size for entry in archive.infolist()) > MOST_UNPACKED:
                raise InputError(f"{path}: unpacks to more than {MOST_UNPACKED // 1_000_000} MB; is it a workbook?")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what a workbook has beside its cells
            found = [Sheet(sheet.title, _cells(sheet), "") for sheet in shown_first(opened(True).worksheets)]
            formulas = {sheet.title: _cells(sheet) for sheet in opened(False).worksheets}
    except InputError:
        raise
    except Exception as error:  # whatever a parser of foreign files stumbles over
        raise InputError(f"{path}: can't be read as an .xlsx workbook ({_why(error)}); is it damaged?") from None
    for sheet in found:
        _check_computed(sheet, formulas[sheet.name], path)
    if not found:
        raise InputError(f"{path}: expected a sheet with a table, found a workbook without one")
    return found


def _cells(sheet: Any) -> list[list[Cell]]:
    sheet.reset_dimensions()  # what some programs write of them is wrong
    rows = [[_cell(value) for value in row] for row in sheet.iter_rows(values_only=True)]
    while rows and not any(cell != "" for cell in rows[-1]):
        rows.pop()
    return rows


def _cell(value: object) -> Cell:
    if value is None:
        return ""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, datetime) and value.time() == time():
        value = value.date()
    return value.isoformat() if isinstance(value, date | time) else str(value)


def _check_computed(sheet: Sheet, formulas: Sequence[Sequence[Cell]], path: Path) -> None:
    """InputError where a cell is a formula that no spreadsheet has computed yet: it would look empty."""
    for number, (row, written) in enumerate(zip(sheet.rows, formulas, strict=False), start=1):
        for value, formula in zip(row, written, strict=False):
            if value == "" and isinstance(formula, str) and formula.startswith("="):
                raise InputError(
                    f"{path}: sheet {quoted(sheet.name)}, row {number}: the formula {quoted(formula)} has no result; "
                    "open the file in a spreadsheet and save it"
                )


def _why(error: Exception) -> str:
    return quoted(f"{type(error).__name__}: {error}")
