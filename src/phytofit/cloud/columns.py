"""Text in columns: XYZ, TXT, CSV, PTS, ASC, whatever parts the columns, marks decimals and names them."""

import csv
import io
import itertools
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from phytofit.cloud.encoding import decoded
from phytofit.cloud.numerals import MISSING, is_number, plain_numbers
from phytofit.cloud.table import COLOR, NORMAL, XYZ, FileError, Table, keys_of, listed, names_points, quoted

__all__ = ["read"]

LINE = re.compile(r"^[ \t]*(?=\S).*", re.MULTILINE)
COMMENT = re.compile(r"^[ \t]*(?:#|//|/\*|%|!|\*(?=[ \t])|;(?=[ \t]+[^\W\d])).*", re.MULTILINE)
RULE = re.compile(r"[-=_+|:;,\s]*[-=_]{2}[-=_+|:;,\s]*")  # a line drawn under the names
COUNT = re.compile(r"^[ \t]*(\d{1,18})[ \t;,]*$", re.MULTILINE)
SEPARATOR_LINE = re.compile(r'"?sep=.?"?', re.IGNORECASE)  # the first line of some spreadsheets' exports
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?", re.ASCII)
QUOTED_COMMA = re.compile(r'"([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)"', re.ASCII)
IN_BRACKETS = re.compile(r"[\[(][^\])]*[\])]")
UNIT = re.compile(r"\bx(?:\s*[\[(]\s*(mm|cm|m)\s*[\])]|_(mm|cm|m)\b)", re.IGNORECASE)
MOST_COLUMNS = 1000
ROWS_LOOKED_AT = 100  # to tell whether their first words name them


class _Head(NamedTuple):
    """What stands above the rows."""

    names: str | None  # the line that names x, y and z
    is_comment: bool  # whether that line is one
    unit: str | None  # that a row of units under it states
    counts: list[int]  # of points, as PTS and CloudCompare write them
    title: str | None  # the last line that is none of these
    start: int  # of the rows, in the text


def read(data: bytes, wanted: Collection[str]) -> Table:
    """The columns of a text file; without names they are x, y, z, and those that only colours or normals can be."""
    text = decoded(data)
    if "\0" in text:
        raise FileError("holds binary data, expected text with x y z on each line; is the suffix right?")
    if ";" not in text:
        text = text.replace("|", ";")
    head = _head(text)
    separator, body = _with_decimal_points(plain_numbers(COMMENT.sub("", text[head.start :])))
    n_most = _n_columns(body, separator)
    body = _without_trailing(body, separator)
    n_columns = _n_columns(body, separator)
    _check_columns(n_columns, n_most, head)
    names = _names(head, separator, n_columns, n_most, has_row_names=_has_row_names(body, separator))
    is_pts, body, notes = _without_counts(body, head.counts)
    if head.names and not head.is_comment:
        body = re.sub(
            rf"^[ \t]*{re.escape(head.names)}[ \t]*$", "", body, flags=re.MULTILINE
        )  # files joined end to end
    rows = _Rows(body, separator, names or [str(i + 1) for i in range(n_columns)], 1 + text.count("\n", 0, head.start))
    if names is None:
        values = rows.parsed(
            {i for i, word in enumerate(rows.first()) if is_number(word) or (word and word.lower() in MISSING)}
        )
        names, unnamed = _guessed_names(values, n_columns, is_pts=is_pts)
        notes += unnamed
    else:
        values = rows.parsed({i for i, name in enumerate(names) if keys_of(name) & {*wanted}})
    unit = UNIT.search(head.names or "")
    return Table(
        [(name, values[i]) for i, name in enumerate(names) if i in values],
        names,
        unit=(unit[1] or unit[2]).lower() if unit else head.unit,
        notes=notes,
    )


def _n_columns(body: str, separator: str | None) -> int:
    row = LINE.search(body)
    return len(_words(row[0], separator)) if row else 0


def _check_columns(n_columns: int, n_most: int, head: _Head) -> None:
    if n_most > MOST_COLUMNS:
        raise FileError(f"expected columns x y z and a few more, found {n_most}; is it a table of points?")
    if n_columns == 0 and not head.counts:
        what = f"found {quoted(head.title)}" if head.title else "was the export interrupted?"
        raise FileError(f"holds no rows, expected x y z on each line; {what}")
    if n_columns < 3:
        raise FileError(f"expected at least 3 columns (x y z), found {n_columns or 1}; is this a 2-D export?")


def _head(text: str) -> _Head:
    names, is_comment, unit, title, counts = None, True, None, None, list[int]()
    for line in LINE.finditer(text):
        content = line[0].strip()
        if COMMENT.match(content):
            content = content.lstrip("#/%!*; \t")
            names = content if is_comment and _names_points(content) else names
        elif SEPARATOR_LINE.fullmatch(content) or RULE.fullmatch(content):
            pass
        elif not is_comment and (units := _units(content)):
            unit = units[0]
        elif count := COUNT.fullmatch(content):
            counts.append(int(count[1]))
        elif not is_comment or _is_row(content):
            return _Head(names, is_comment, unit, counts, title, line.start())
        elif _names_points(content):
            names, is_comment = content, False
        else:
            title = content
    return _Head(names, is_comment, unit, counts, title, len(text))


def _is_row(line: str) -> bool:
    """Whether a line begins with three numbers, some of which may be missing."""
    words = re.split(r"[;,\s]+", plain_numbers(line).replace('"', ""), maxsplit=3)[:3]
    return any(words) and all(is_number(word) or word.lower() in MISSING for word in words)


def _units(line: str) -> list[str]:
    """The units in a line of nothing else."""
    words = [word.strip("\"'[]()").lower() for word in re.split(r"[;,\s]+", line)]
    return [word for word in words if word] if {*words} <= {"mm", "cm", "m", ""} else []


def _names_points(line: str) -> bool:
    lower = line.lower()
    return ({"x", "y", "z"} <= {*lower} or "points" in lower) and any(
        names_points(_words(line, mark)) for mark in (";", ",", "\t", None)
    )


def _words(line: str, separator: str | None) -> list[str]:
    if separator is None:
        words = re.findall(r'"[^"]*"|\S+', line)
    else:
        words = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [word.strip(" \t\"'") for word in words]


def _with_decimal_points(body: str) -> tuple[str | None, str]:
    """What parts the columns, None for blanks, and the rows with points for decimal commas."""
    body = QUOTED_COMMA.sub(r'"\1.\2"', body)
    first = LINE.search(body)
    with_comma = re.search(r"^.*,.*", body, re.MULTILINE)
    if first is None or ";" in first[0]:
        return ";", body.replace(",", ".")
    if with_comma is None:
        return _blank(body, first[0]), body
    words = with_comma[0].split()
    if len(words) < 3:
        return ",", body
    if all(DECIMAL_COMMA.fullmatch(word) for word in words if "," in word):
        return _blank(body, first[0]), body.replace(",", ".")
    cells = [word.removesuffix(",") for word in words]
    decimals = [cell for cell in cells if "," in cell]
    if decimals and cells[:-1] == [word[:-1] for word in words[:-1]] and all(map(DECIMAL_COMMA.fullmatch, decimals)):
        return ";", re.sub(r",(?=[ \t]|$)", ";", body, flags=re.MULTILINE).replace(",", ".")
    return ",", body


def _blank(body: str, row: str) -> str | None:
    """A tab where each row has as many, so that a cell may be empty or hold blanks; else any blanks."""
    cells = row.split("\t")
    if len(cells) < 3 or any(len(cell.split()) > 1 and all(map(is_number, cell.split())) for cell in cells):
        return None
    is_regular = body.count("\t") == (len(cells) - 1) * sum(bool(line.strip()) for line in body.split("\n"))
    return "\t" if is_regular else None


def _without_trailing(body: str, separator: str | None) -> str:
    marks = f"[ \t{separator or ''}]"
    return re.sub(f"(?<!{marks}){marks}+$|^{marks}+$", "", body, flags=re.MULTILINE)


def _has_row_names(body: str, separator: str | None) -> bool:
    """Whether the first column numbers or names the rows, as in tables of R, or is empty."""
    rows = [row[0] for row in itertools.islice(LINE.finditer(body), ROWS_LOOKED_AT)]
    first = [next(iter(_words(row, separator)), "") for row in rows]
    if not rows or not is_number(first[0]) or (rows[0].lstrip().startswith('"') and rows[0].count('"') == 2):
        return True
    return len(rows) > 1 and any(first == [str(i + begin) for i in range(len(rows))] for begin in (0, 1))


def _names(head: _Head, separator: str | None, n_least: int, n_most: int, *, has_row_names: bool) -> list[str] | None:
    """The names of so many columns; None if there are none.  That of the rows' own names may be missing.

    FileError if a row of names does not fit.  A comment that does not is only a comment.
    """
    for line in (head.names, IN_BRACKETS.sub("", head.names)) if head.names else ():
        for mark in (separator, ";", ",", "\t", None):
            words = _words(line, mark)
            n_named = max((i + 1 for i, word in enumerate(words) if word), default=0)
            if n_named <= n_most and n_least <= len(words) and names_points(words):
                return words[: max(n_named, n_least)]
            if has_row_names and len(words) + 1 == n_least and names_points(words):
                return ["", *words]
    if head.names and not head.is_comment:
        n_named = len(_words(head.names, separator))
        raise FileError(f"found {n_named} column names over {n_least} columns; name each column")
    titles = _words(head.title or "", separator)
    if head.names is None and n_least <= len(titles) <= n_most:
        raise FileError(f"no property x, y, z, found {listed(titles)}; name them so")
    return None


def _without_counts(body: str, counts: Sequence[int]) -> tuple[bool, str, tuple[str, ...]]:
    """Whether rows are counted, as in PTS, where each scan begins with its count; the rows without; what to say."""
    marks = list(COUNT.finditer(body))
    if not marks and not counts:
        return False, body, ()
    starts, ends = [0, *(mark.end() for mark in marks)], [*(mark.start() for mark in marks), len(body)]
    found = [len(LINE.findall(body, start, end)) for start, end in zip(starts, ends, strict=True)]
    n_scans = sum(n > 0 for n in found)
    declared = [(count, found[0]) for count in counts]
    declared += [(int(mark[1]), n) for mark, n in zip(marks, found[1:], strict=True)]
    notes: tuple[str, ...] = (f"{n_scans} scans, read as one cloud",) if n_scans > 1 else ()
    for count, n in declared:
        if n < count not in (sum(found), n_scans):
            raise FileError(f"truncated: it declares {count} points and holds {n}; copy it again, or correct the count")
        if n > count not in (sum(found), n_scans):
            notes += (f"the file declares {count} points and holds {n}: which is right?",)
    return True, COUNT.sub("", body), notes


class _Rows(NamedTuple):
    """Rows of as many columns as there are names, and the first one's line in the file."""

    body: str
    separator: str | None
    names: list[str]
    first_line: int

    def first(self) -> list[str]:
        """The words of the first row."""
        row = LINE.search(self.body)
        return _words(row[0], self.separator) if row else []

    def parsed(self, of_numbers: Collection[int]) -> dict[int, NDArray[np.float64]]:
        """The columns of numbers, by their place; NaN where a row has none."""
        width = (self.separator or " ").join("0" * len(self.names))  # the first line says how many columns there are
        try:
            frame = pd.read_csv(
                io.StringIO(f"{width}\n{self.body}"),
                sep=self.separator or r"\s+",
                header=None,
                dtype={i: np.float64 if i in of_numbers else str for i in range(len(self.names))},
                skipinitialspace=True,
                na_values=[spelling for word in MISSING for spelling in (word, word.upper(), word.capitalize())],
            )
        except ValueError:
            self._check(of_numbers)
            raise
        return {i: frame[i].to_numpy()[1:] for i in of_numbers}

    def _check(self, of_numbers: Collection[int]) -> None:
        """Raise FileError for the first row that is too long, and the first word that is no number."""
        for line, row in enumerate(self.body.split("\n"), self.first_line):
            words = _words(row, self.separator)
            if len(words) > len(self.names):
                raise FileError(f"line {line} has {len(words)} columns, expected {len(self.names)}; export it again")
            for i, word in enumerate(words):
                if i in of_numbers and not is_number(word) and word.lower() not in MISSING:
                    column = quoted(self.names[i])
                    raise FileError(f"line {line} holds {quoted(word)} in column {column}, expected a number")


def _guessed_names(
    values: dict[int, NDArray[np.float64]], n_columns: int, *, is_pts: bool
) -> tuple[list[str], tuple[str, ...]]:
    """Names of columns that have none, by what they hold, and what to say of it; their numbers where it is not clear.

    Whole numbers may be labels, intensities, or anything: they are never taken for labels.
    """
    at = min(values, default=0)
    n = len(values.get(at, ()))
    is_numbered = n_columns > at + 3 and any(np.array_equal(values[at], np.arange(n) + first) for first in (0, 1))
    at += is_numbered
    names = [str(i + 1) for i in range(n_columns)]
    names[at : at + 3] = XYZ
    notes: tuple[str, ...] = ()
    if is_numbered:
        notes = (f"column {at} numbers the rows: x y z are columns {at + 1} to {at + 3}",)
    _check_coordinates(values, at)
    more = [values[i][np.isfinite(values[i])] for i in range(at + 3, n_columns) if i in values]
    is_color = [bool((v == np.rint(v)).all() and (v >= 0).all() and (v <= 255).all()) for v in more[-3:]]
    is_known = len(more) == 4 and all(is_color)
    if len(more) in (3, 4) and all(is_color):
        names[-3:] = COLOR
    elif len(more) == 3 and all((np.abs(v) <= 1).all() for v in more):
        names[-3:] = NORMAL
    unnamed = [name for name in names[at + 3 :] if name.isdigit()]
    if unnamed and not is_known and not (is_pts and len(unnamed) == 1):
        which = (
            f"column {unnamed[0]} has no name" if len(unnamed) == 1 else f"columns {', '.join(unnamed)} have no names"
        )
        notes += (f"{which}: not used",)
    return names, notes


def _check_coordinates(values: dict[int, NDArray[np.float64]], at: int) -> None:
    """FileError if the columns from `at` on can't be x y z: words, or whole numbers beside others, while those that
    follow are all alike."""
    if not values.keys() >= {at, at + 1, at + 2}:
        raise FileError("expected x y z in the first columns, found words among them; put their names in a line above")
    is_whole = {i: bool((v[np.isfinite(v)] == np.rint(v[np.isfinite(v)])).all()) for i, v in values.items()}
    if len({is_whole[at + i] for i in range(3)}) == 1:
        return
    if any(not any(is_whole.get(i + j, True) for j in range(3)) for i in (at + 1, at + 2)):
        odd = next(i for i in range(at, at + 3) if is_whole[i])
        raise FileError(
            f"which columns are x y z? none has a name, and column {odd + 1} holds whole numbers only, unlike those "
            "beside it; put their names in a line above"
        )
