"""The table in a file: where its columns' names stand, and the rows below them."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from phytofit.errors import InputError
from phytofit.validation.sheets import Cell, Sheet, quoted, read_sheets, text_of

__all__ = ["Table", "listed", "read_table"]

COLUMNS_SHOWN = 12  # in a message, of a table that may have hundreds


class Table(NamedTuple):
    """Names of the columns, and rows of as many cells; ``first`` is the number of the first row in the file."""

    where: str
    names: list[str]
    rows: list[list[Cell]]
    first: int
    separator: str

    def at(self, row: int, column: int | None = None) -> str:
        """Where a cell is, or a row, for a message."""
        named = "" if column is None else f", column {quoted(self.names[column])}"
        return f"{self.where}: row {self.first + row}{named}"

    def below(self) -> "Table":
        """The table without its first row."""
        return self._replace(rows=self.rows[1:], first=self.first + 1)


def read_table(path: Path, is_header: Callable[[Sequence[str]], bool], expected: str) -> tuple[Table, list[str]]:
    """The first table in a file whose columns have such names, in whatever row of whatever sheet; and a note on each
    other sheet that has one, which is not read.

    Raises InputError, with what was `expected`, if there is none, or nothing below the names.
    """
    sheets = read_sheets(path)
    found = [(sheet, i) for sheet in sheets for i in _headers(sheet, is_header)]
    if not found:
        raise InputError(f"{path}: expected {expected}, {_got(sheets)}")
    sheet, i = found[0]
    others = [other.name for other, _ in found[1:] if other.name != sheet.name]
    where = f"{path}, sheet {quoted(sheet.name)}" if len(sheets) > 1 and sheet.name else str(path)
    names = [text_of(cell) for cell in sheet.rows[i]]
    while names and not names[-1]:
        names.pop()
    table = Table(where, names, [list(row) for row in sheet.rows[i + 1 :]], i + 2, sheet.separator)
    for number, row in enumerate(table.rows):
        beyond = [cell for cell in row[len(names) :] if text_of(cell)]
        if beyond:
            raise InputError(
                f"{table.at(number)}: found {len(row)} cells under {len(names)} columns; with decimal commas, put "
                "semicolons between the columns"
            )
        table.rows[number] = row[: len(names)] + [""] * (len(names) - len(row))
    if not any(text_of(cell) for row in table.rows for cell in row):
        raise InputError(f"{where}: expected rows below the names of the columns, found no rows")
    return table, [
        f"sheet {quoted(name)} is not read: sheet {quoted(sheet.name)} is the first with such columns"
        for name in dict.fromkeys(others)
    ]


def listed(names: Sequence[str]) -> str:
    """Names for a message, not all of many."""
    shown = ", ".join(quoted(name) for name in names[:COLUMNS_SHOWN])
    return f"{shown} and {len(names) - COLUMNS_SHOWN} more" if len(names) > COLUMNS_SHOWN else shown


def _headers(sheet: Sheet, is_header: Callable[[Sequence[str]], bool]) -> Iterator[int]:
    for i, row in enumerate(sheet.rows):
        if is_header([text_of(cell) for cell in row]):
            yield i
            return


def _got(sheets: Sequence[Sheet]) -> str:
    """What a file has instead: the first row that has something, by the separator that makes most of it."""
    rows = [next((row for row in sheet.rows if any(text_of(cell) for cell in row)), []) for sheet in sheets]
    names = [text_of(cell) for cell in max(rows, key=len, default=[]) if text_of(cell)]
    if not names:
        return "found nothing"
    named = [sheet.name for sheet in sheets if sheet.name]
    where = f" in none of its sheets ({listed(named)})" if len(named) > 1 else ""
    return f"found {listed(names)}" if not where else f"found them{where}"
