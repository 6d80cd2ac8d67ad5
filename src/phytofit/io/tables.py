"""Tables of results: CSV that spreadsheets, R and pandas open alike, and XLSX; one over all results in a folder.

CSV is plain ASCII as far as phytofit's own words go: cm2, deg.  Only where a name holds other letters does a file begin
with a byte order mark, without which a spreadsheet takes them for others; pandas reads both alike.
"""

import io
import os
import re
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd
from pandas.api.types import is_numeric_dtype

from phytofit.errors import OutputError
from phytofit.io.replacing import check_made, translated, whole_file
from phytofit.text import for_table, from_table, one_line

__all__ = ["FolderTable", "check_table", "read_table", "table_text", "write_failures", "write_table", "write_workbook"]

DIGITS = 6  # significant, in tables; fit.json has all
NAMES = ("cloud", "file", "reason")  # columns of text from outside
ASCII = str.maketrans({"²": "2", "°": " deg", "–": "-", "×": "x", "…": "..."})
FAILURES = ["cloud", "file", "reason"]
AUTHOR = "phytofit"  # of a workbook
NO_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest that a ZIP file can state


def table_text(table: pd.DataFrame) -> str:
    """The table as CSV, `DIGITS` significant digits, empty where there is no value; no cell is a formula."""
    text: str = _plain(table).to_csv(index=False, float_format=f"%.{DIGITS}g", lineterminator="\n")
    return text


def write_table(path: Path, table: pd.DataFrame | str, columns: Sequence[str] = ()) -> None:
    """Write a table, or the text of one, as CSV: all of it or nothing; OutputError if that can't be done, or if there
    is a file of that name that is no such table, by its `columns`."""
    text = table if isinstance(table, str) else table_text(table)
    check_table(path, columns or text.partition("\n")[0].split(","))
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8" if text.isascii() else "utf-8-sig", newline="")


def read_table(file: Path | io.StringIO) -> pd.DataFrame:
    """A table that :func:`write_table` wrote, with its units and names as they were."""
    table = pd.read_csv(  # 0003 and NA are names
        file, encoding="utf-8-sig", dtype=dict.fromkeys(NAMES, str), keep_default_na=False, na_values=[""]
    )
    for column in _texts(table):
        table[column] = table[column].map(from_table, na_action="ignore")
    if "unit" in table:
        table["unit"] = table["unit"].replace("cm2", "cm²")
    return table


def check_table(path: Path, columns: Sequence[str]) -> None:
    """OutputError if there is something of that name that is no such table: most of its columns are among `columns`."""

    def is_ours(there: Path) -> bool:
        with there.open(encoding="utf-8-sig", errors="replace") as file:
            found = file.readline(100_000).strip().split(",")
        return 2 * sum(name in columns for name in found) > len(found)

    check_made(path, is_ours)


class FolderTable:
    """The table over all results that lie in a folder, each in a folder of its own, in the order of their names.

    `file` is the table of each result and of all of them, `mark` the file that a result holds, `columns` all that the
    tables may have.
    """

    def __init__(self, folder: Path, file: str, mark: str, columns: Sequence[str]) -> None:
        self.path = folder / file
        self._mark = mark
        self._columns = columns
        self._read: dict[str, tuple[tuple[int, int], pd.DataFrame, str]] = {}
        check_table(self.path, columns)

    def write(self) -> None:
        """Write it as the results are now, if there are any; those that changed are read again.  OutputError if that
        can't be done."""
        text = self._text()
        if self._read or self.path.exists():
            write_table(self.path, text, self._columns)

    def whole(self) -> pd.DataFrame:
        """The table itself; OutputError if a result can't be read."""
        return read_table(io.StringIO(self._text()))

    def _text(self) -> str:
        found = list(self._results())
        headers = {text.partition("\n")[0] for _, text in found} or {",".join(self._columns)}
        if len(headers) > 1:  # of another unit, or another version
            return table_text(pd.concat([table for table, _ in found], ignore_index=True))
        return f"{headers.pop()}\n" + "".join(text.partition("\n")[2] for _, text in found)

    def _results(self) -> Iterable[tuple[pd.DataFrame, str]]:
        folder, file = self.path.parent, self.path.name
        try:
            names = sorted(e.name for e in os.scandir(folder) if e.is_dir() and not e.name.startswith("."))
            for name in names:
                path = folder / name / file
                if not (folder / name / self._mark).is_file() or not path.is_file():
                    continue
                state = path.stat()
                now = (state.st_mtime_ns, state.st_ino)
                if name not in self._read or self._read[name][0] != now:
                    text = path.read_text(encoding="utf-8-sig").replace("\r\n", "\n")
                    text = text if text.endswith("\n") else text + "\n"
                    table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
                    self._read[name] = (now, table, text)
                yield self._read[name][1:]
            for gone in self._read.keys() - set(names):
                del self._read[gone]
        except (OSError, ValueError) as error:
            raise OutputError(
                f"{path}: can't be read for {self.path} ({error}); delete this result, or measure it again"
            ) from None


def write_failures(folder: Path, failed: dict[str, tuple[Path, str]], tried: Iterable[Path]) -> Path | None:
    """Write ``failed.csv``: cloud, file and reason of each cloud that could not be measured.

    Those of earlier runs stay, but for files that were tried again.  The path, or None if none is left, and no file.
    """
    path = folder / "failed.csv"
    check_table(path, FAILURES)
    rows = pd.DataFrame([(name, str(file), why) for name, (file, why) in failed.items()], columns=FAILURES)
    with translated(path, "can't be written", "delete it"):
        if path.is_file():
            before = _failures_before(path)
            again = {for_table(file) for file in tried}
            rows = pd.concat([before[~before["file"].isin(again)], rows], ignore_index=True)
        if rows.empty:
            path.unlink(missing_ok=True)
            return None
    write_table(path, rows)
    return path


def _failures_before(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path, dtype=str, keep_default_na=False, encoding="utf-8-sig")[FAILURES]
    except (KeyError, ValueError):
        raise OutputError(f"{path}: expected the columns {', '.join(FAILURES)}; delete it") from None


def write_workbook(path: Path, table: pd.DataFrame) -> None:
    """Write a table as XLSX: numbers as numbers, text as text and never a formula; the same table, the same bytes."""
    from openpyxl import Workbook  # noqa: PLC0415  (half a second, for those who ask for it)
    from openpyxl.styles import Font  # noqa: PLC0415

    book = Workbook()
    book.properties.creator = AUTHOR
    sheet = book.active
    sheet.title = path.stem[:31]
    sheet.freeze_panes = "A2"
    for r, row in enumerate([list(table.columns), *table.astype(object).to_numpy().tolist()], start=1):
        for c, value in enumerate(row, start=1):
            if isinstance(value, str):
                cell = sheet.cell(r, c, one_line(value)[:32_767])  # what a cell may hold
                cell.data_type = "s"
                cell.font = Font(bold=r == 1)
            elif not pd.isna(value):
                sheet.cell(r, c, value)
    check_made(path, _is_our_workbook)
    made = io.BytesIO()
    with whole_file(path) as part:
        book.save(made)  # by way of temporary files
        part.write_bytes(_without_times(made.getvalue()))


def _plain(table: pd.DataFrame) -> pd.DataFrame:
    """All text of a table as a spreadsheet takes it."""
    plain = table.copy()
    for column in _texts(table):
        text = table[column].map(for_table, na_action="ignore")
        plain[column] = text if column in NAMES else text.map(lambda cell: cell.translate(ASCII), na_action="ignore")
    return plain


def _texts(table: pd.DataFrame) -> list[str]:
    return [name for name, kind in zip(table.columns, table.dtypes, strict=True) if not is_numeric_dtype(kind)]


def _is_our_workbook(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as book:
            return AUTHOR.encode() in book.read("docProps/core.xml")
    except (KeyError, zipfile.BadZipFile):
        return False


def _without_times(content: bytes) -> bytes:
    """A workbook without the times at which it was made."""
    with zipfile.ZipFile(io.BytesIO(content)) as book, io.BytesIO() as made:
        with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as timeless:
            for entry in book.infolist():
                data = book.read(entry)
                if entry.filename == "docProps/core.xml":
                    data = re.sub(rb"<dcterms:(created|modified).*?</dcterms:\1>", b"", data)
                timeless.writestr(zipfile.ZipInfo(entry.filename, NO_TIME), data, zipfile.ZIP_DEFLATED)
        return made.getvalue()
