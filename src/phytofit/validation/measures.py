"""Hand measures, and tables of results, as people keep them: CSV of any dialect, or a workbook."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from phytofit.errors import InputError
from phytofit.text import one_line
from phytofit.validation.headers import (
    CLOUD_NAMES,
    KIND_OF,
    UNITLESS,
    ColumnError,
    Measured,
    cloud_column,
    is_rank,
    measured,
    trait_name,
    unit_named,
)
from phytofit.validation.numbers import decimal_mark, is_missing, number_of
from phytofit.validation.sheets import Cell, quoted, text_of
from phytofit.validation.tables import Table, listed, read_table

__all__ = ["read_measures", "read_results"]

MEASURE_COLUMNS = ["cloud", "plant", "rank", "trait", "value", "unit"]
RESULT_COLUMNS = ("cloud", "trait", "value", "unit", "low", "high", "flags")  # and quality, in newer ones
RESULT_FILES = ("traits.csv", "traits.xlsx")
NUMBERS = ("value", "low", "high")
NO_UNIT = (1.0, "")
SIGNED = ("leaf_curvature",)
WIDEST = {"leaf_azimuth": 360.0}  # degrees; of the other angles a half turn
HALF_TURN = 180.0


class _Entry(NamedTuple):
    """A cell with a measure: where it is, and what it is of, in ``factor`` times a unit."""

    row: int
    column: int
    trait: str
    factor: float
    unit: str


def read_measures(path: str | Path) -> pd.DataFrame:
    """Hand measures from a CSV file or a workbook (.xlsx), as a table: cloud, plant, rank, trait, value, unit.

    ``plant`` and ``rank`` are empty where they are not given.  The table's ``attrs["notes"]`` say which columns and
    sheets were not read.

    Either one row for each cloud, with a column for each trait whose name says the unit (``leaf_length_cm``, ``Leaf
    length (mm)``, ``angle [deg]``; angles may go without); or one row for each cloud and trait, with columns cloud,
    trait, value and unit, as ``phytofit simulate`` writes its truth.  A column ``rank`` (or ``leaf``) counts a plant's
    leaves from the base; a column ``plant`` beside ``cloud`` counts the plants of a cloud.  Empty cells and NA are no
    measures.  Rows above the names of the columns are skipped, and the row below them may hold the units.

    Raises
    ------
    InputError
        If the file can't be read or has no such columns; if a column's name can be read in several ways; or if a cell
        holds no number, or one that is not finite or not positive.  The message names the row and the column.
    """
    path = Path(path)
    expected = (
        f"names of columns: one of the cloud ({', '.join(CLOUD_NAMES[:4])}), and one for each trait with its unit, "
        "such as leaf_length_cm or 'Leaf angle (deg)'"
    )
    table, notes = read_table(path, _is_header, expected)
    table = _with_units_below(table)
    clouds = cloud_column(table.names)
    _check_one_table(table, clouds)
    try:
        entries, unread = _tidy(table) if _is_tidy(table.names) else _wide(table, clouds[0])
    except ColumnError as error:
        raise InputError(f"{table.where}: {error}") from None
    if len(clouds) > 1 and (others := [table.names[i] for i in clouds[1:] if not _says_which(table, i)]):
        unread.append(f"clouds are named by column {quoted(table.names[clouds[0]])}; {listed(others)} is not read")
    for i, name in enumerate(table.names):
        if i > 0 and not name and not all(is_missing(row[i]) for row in table.rows):  # the first may number the rows
            unread.append(f"column {i + 1} is not read: it has no name")
    made = _measures(table, clouds[0], entries)
    made.attrs["notes"] = (*notes, *unread)
    return made


def read_results(path: str | Path) -> pd.DataFrame:
    """The table of a folder of results, ``traits.csv`` or ``traits.xlsx`` in it, or that file, also if a spreadsheet
    saved it again.

    Columns are found by their names; ``plant``, ``rank`` and ``quality`` are empty where they are missing.

    Raises
    ------
    InputError
        If there is no such table, or its values are no numbers.
    """
    path = Path(path)
    file = next((path / name for name in RESULT_FILES if (path / name).is_file()), path)
    if not file.is_file():
        raise InputError(f"{path}: expected a folder of results, with {' or '.join(RESULT_FILES)} in it, or that file")
    table, _ = read_table(file, _is_tidy, "the columns of a result (cloud, trait, value, unit)")
    column = {name.casefold(): i for i, name in reversed(list(enumerate(table.names)))}
    missing = [name for name in RESULT_COLUMNS if name not in column]
    if missing:
        raise InputError(f"{table.where}: expected the columns of a result, and {', '.join(missing)} are missing")
    made = pd.DataFrame({name: [text_of(row[i]) for row in table.rows] for name, i in column.items()})
    numbers = _values(table, {(row, column[name]): NO_UNIT for name in NUMBERS for row in range(len(table.rows))})
    made[list(NUMBERS)] = np.reshape(numbers, (len(NUMBERS), -1)).T
    if "quality" not in made:
        made["quality"] = ""  # a table of an earlier version
    for name in ("plant", "rank"):
        cells = [row[column[name]] for row in table.rows] if name in column else [""] * len(table.rows)
        made[name] = [_count(cell) or text_of(cell) for cell in cells]
    made["unit"] = [(unit_named(unit) or (1.0, unit))[1] for unit in made["unit"]]
    return made[made["value"].notna()].reset_index(drop=True)


def _check_one_table(table: Table, clouds: Sequence[int]) -> None:
    """InputError if there are several columns of clouds of one name, and they differ: tables side by side."""
    first = clouds[0]
    for i in clouds[1:]:
        same = table.names[i].casefold() == table.names[first].casefold()
        if same and any(text_of(row[i]) != text_of(row[first]) for row in table.rows):
            raise InputError(
                f"{table.where}: columns {first + 1} and {i + 1} are both called {quoted(table.names[i])}, and differ; "
                "put tables that are side by side one below the other"
            )


def _is_header(names: Sequence[str]) -> bool:
    """Whether these are the names of columns of hand measures: one of the cloud, and one of a trait."""
    return bool(cloud_column(names)) and (_is_tidy(names) or any(_holds_trait(name) for name in names))


def _is_tidy(names: Sequence[str]) -> bool:
    lower = [name.casefold() for name in names]
    return bool(cloud_column(names)) and "trait" in lower and "value" in lower


def _holds_trait(name: str) -> bool:
    try:
        return measured(name) is not None
    except ColumnError:
        return True


def _with_units_below(table: Table) -> Table:
    """The table with the units in the names of its columns, where they are in the row below these."""
    row = [text_of(cell).strip("()[]") for cell in table.rows[0]]
    units = [
        i for i, cell in enumerate(row) if _holds_trait(table.names[i]) and not cell.isdigit() and unit_named(cell)
    ]
    if not units or any(cell and i not in units and _holds_trait(table.names[i]) for i, cell in enumerate(row)):
        return table
    names = [f"{name} [{row[i]}]" if i in units else name for i, name in enumerate(table.names)]
    return table.below()._replace(names=names)


def _tidy(table: Table) -> tuple[list[_Entry], list[str]]:
    """The measures of a table with one row for each trait."""
    lower = [name.casefold() for name in table.names]
    trait_at, value_at = lower.index("trait"), lower.index("value")
    unit_at = lower.index("unit") if "unit" in lower else None
    entries = []
    for i, row in enumerate(table.rows):
        if is_missing(row[value_at]):
            continue
        trait, written = trait_name(text_of(row[trait_at])), "" if unit_at is None else text_of(row[unit_at])
        kind = KIND_OF.get(trait, "")
        found = unit_named(written) or ((1.0, kind) if kind in UNITLESS and not written else None)
        if found is None or (kind and found[1] not in (kind, kind.replace("cm", "rel"))):
            raise ColumnError(
                f"row {table.first + i}: expected a unit of {trait}, such as {kind or 'cm'}, got {quoted(written)}"
            )
        entries.append(_Entry(i, value_at, trait, *found))
    return entries, []


def _wide(table: Table, cloud: int) -> tuple[list[_Entry], list[str]]:
    """The measures of a table with a column for each trait, and which columns are not read."""
    found: dict[int, Measured] = {}
    unread = []
    for j, name in enumerate(table.names):
        said = None if j == cloud or _says_which(table, j) else measured(name)
        if said is None:
            continue
        if said.ignored:
            unread.append(f"column {quoted(name)} is not read: {said.ignored}")
        elif said.factor is None and said.unit not in UNITLESS:
            raise ColumnError(f"column {name!r} has no unit; write it behind, as in {said.trait}_{said.unit}")
        else:
            found[j] = said
    if not found:
        raise ColumnError(f"none of its columns is read: {'; '.join(unread)}")
    entries = [
        _Entry(i, j, said.trait, said.factor or 1.0, said.unit)
        for j, said in found.items()
        for i, row in enumerate(table.rows)
        if not is_missing(row[j])
    ]
    return entries, unread


def _says_which(table: Table, column: int) -> bool:
    """Whether a column counts leaves or plants."""
    return is_rank(table.names[column]) or _counts_plants(table, column)


def _counts_plants(table: Table, column: int) -> bool:
    """Whether a column is the number of a plant in its cloud: beside one that names the cloud, and whole numbers."""
    return (
        cloud_column(table.names)[0] != column
        and table.names[column].casefold() in ("plant", "plant number")
        and all(is_missing(row[column]) or _count(row[column]) for row in table.rows)
    )


def _count(cell: Cell) -> str:
    """The whole number in a cell, as in 2, 02, 2.0, leaf 2; empty if it has none."""
    found = re.fullmatch(r"(?:leaf|plant|[lp])?[ ._-]*0*(\d{1,9})(?:[.,]0*)?", text_of(cell).casefold())
    return found[1] if found else ""


def _measures(table: Table, cloud: int, entries: Sequence[_Entry]) -> pd.DataFrame:
    columns = range(len(table.names))
    plant = next((i for i in columns if _counts_plants(table, i)), None)
    rank = next((i for i in columns if i != cloud and is_rank(table.names[i])), None)
    units = {(entry.row, entry.column): (entry.factor, entry.unit) for entry in entries}
    rows = []
    for entry, number in zip(entries, _values(table, units), strict=True):
        row = table.rows[entry.row]
        name = unicodedata.normalize("NFC", one_line(text_of(row[cloud])))
        if not name:
            raise InputError(
                f"{table.at(entry.row, cloud)}: expected the name of a cloud beside its measures, found none; of "
                "merged cells only the first has it"
            )
        value = entry.factor * number
        if wrong := _wrong_with(entry.trait, value, entry.unit):
            raise InputError(f"{table.at(entry.row, entry.column)}: {wrong}; got {quoted(row[entry.column])}")
        which = [_which(table, entry.row, column) for column in (plant, rank)]
        rows.append((name, *which, entry.trait, value, entry.unit))
    if not rows:
        raise InputError(f"{table.where}: expected measures, and every cell is empty or NA")
    return pd.DataFrame(rows, columns=MEASURE_COLUMNS)


def _which(table: Table, row: int, column: int | None) -> str:
    """Which plant or leaf a row is of; empty where it does not say."""
    cell = "" if column is None else table.rows[row][column]
    if is_missing(cell):
        return ""
    assert column is not None
    if not (count := _count(cell)):
        raise InputError(
            f"{table.at(row, column)}: expected a whole number that counts leaves from the base; got {quoted(cell)}"
        )
    return count


def _wrong_with(trait: str, value: float, unit: str) -> str:
    """What can't be true of a trait's value; empty if it may be."""
    widest = WIDEST.get(trait, HALF_TURN)
    if unit == "deg" and not 0.0 <= value <= widest:
        return f"expected an angle from 0 to {widest:g} degrees"
    if unit != "deg" and trait in KIND_OF and trait not in SIGNED and value <= 0.0:
        return "expected more than 0, or an empty cell where nothing was measured"
    return ""


def _values(table: Table, places: Mapping[tuple[int, int], tuple[float, str]]) -> list[float]:
    """The numbers in cells, given by row and column, each with the unit that may stand behind it; NaN where a cell is
    empty or NA.  InputError, with the row and the column, where one is no finite number."""
    cells = {place: _without_unit(table.rows[place[0]][place[1]], unit) for place, unit in places.items()}
    try:
        mark = decimal_mark((cell for cell in cells.values() if not is_missing(cell)), table.separator)
    except ValueError as error:
        raise InputError(f"{table.where}: {error}; write all numbers with one decimal mark") from None
    numbers = []
    for place, cell in cells.items():
        try:
            numbers.append(np.nan if is_missing(cell) else number_of(cell, mark))
        except ValueError as error:
            raise InputError(f"{table.at(*place)}: {error}; got {quoted(table.rows[place[0]][place[1]])}") from None
    return numbers


def _without_unit(cell: Cell, unit: tuple[float, str]) -> Cell:
    """A cell without its unit, if that is the one of its column."""
    found = re.fullmatch(r"(.*\d[.,]?)\s*([^\s\d.,]+[23²]?)", cell.strip()) if isinstance(cell, str) else None
    return found[1] if found and unit_named(found[2]) == unit else cell
