"""Numbers as people write them: decimal commas, thousands, missing values; nothing is guessed."""

import math
import re
import unicodedata
from collections.abc import Iterable

from phytofit.validation.sheets import Cell

__all__ = ["decimal_mark", "is_missing", "number_of"]

MISSING = (  # as they are when case-folded
    *("", "na", "n/a", "n.a.", "n.a", "#n/a", "#n/v", "#nv", "<na>", "#div/0!"),
    *("nan", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "none", "null", "nil"),
    *("n.d.", "n.d", "nd", "n/d", "n/m", "n.m.", "n.m", "nm", "k.a.", "missing", "no data"),
    *(
        "not available",
        "not measured",
        "not determined",
        "-",
        "--",
        "---",
        "–",
        "—",
        ".",
        "..",
        "...",
        "*",
        "?",
        "/",
        "x",
    ),
)
THOUSANDS = re.compile(r"\d{1,3}(?:([.,])\d{3})(?:\1\d{3})*")
PLAIN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d{1,9})?")


def is_missing(cell: Cell) -> bool:
    """Whether a cell says, in one of the ways in use, that there is no value."""
    return _plain(cell).replace(". ", ".") in MISSING if isinstance(cell, str) else math.isnan(cell)


def decimal_mark(cells: Iterable[Cell], separator: str) -> str | None:
    """The decimal mark of a table, by those of its numbers that can be read in one way only; None if none says it.

    A table whose columns are separated by semicolons has decimal commas, unless a number says otherwise.

    Raises ValueError if some numbers have commas and others points, and one more can be read either way.
    """
    marks: dict[str, str] = {}
    either: dict[str, str] = {}
    for cell in cells:
        if isinstance(cell, str) and (number := _ungrouped(cell)):
            mark, open_to = _mark_of(number)
            if mark:
                marks.setdefault(mark, cell.strip())
            elif open_to:
                either.setdefault(open_to, cell.strip())
    if len(marks) == 1:
        return next(iter(marks))
    if marks and either:
        cell = next(iter(either.values()))
        raise ValueError(f"{cell!r} has a decimal mark or separates thousands, and other cells have both marks")
    if "," in either and separator == ";" and "." not in either:
        return ","
    if "," in either and not marks:
        raise ValueError(_either(either[","]))
    return None


def number_of(cell: Cell, mark: str | None = None) -> float:
    """The number in a cell, by the table's decimal mark where it can be read in two ways.

    Raises ValueError, with what was expected, where there is none or where it is not finite.
    """
    if not isinstance(cell, str):
        value = cell
    else:
        text = _ungrouped(cell)
        own, open_to = _mark_of(text)
        decimal = own or mark or "."
        if open_to == "," and not mark:
            raise ValueError(f"expected a number that can be read in one way: {_either(text)}")
        if own or open_to:
            text = text.replace("." if decimal == "," else ",", "").replace(",", ".")
        if not PLAIN.fullmatch(text):
            raise ValueError("expected a number, or NA where there is none")
        value = float(text)
    if not math.isfinite(value):
        raise ValueError("expected a finite number")
    return value


def _either(number: str) -> str:
    return f"{number} may mean {number.replace(',', '.')} or {number.replace(',', '')}"


def _plain(cell: str) -> str:
    return unicodedata.normalize("NFKC", cell).strip().removeprefix("'").casefold().replace("−", "-")


def _ungrouped(cell: str) -> str:
    """The text of a number without blanks or apostrophes between thousands."""
    return re.sub(r"(?<=\d)[ '’](?=\d{3}(?!\d))", "", _plain(cell))


def _mark_of(number: str) -> tuple[str, str]:
    """The decimal mark that a number in itself shows to be meant; else the mark that may be one, or separate
    thousands; both empty where it has none."""
    body = re.sub(r"e[+-]?\d+$", "", number).lstrip("+-")
    marks = [c for c in body if c in ",."]
    if not marks or not re.fullmatch(r"[\d.,]+", body):
        return "", ""
    last, others = marks[-1], set(marks[:-1])
    if others == {last} and THOUSANDS.fullmatch(body):  # 1,234,567
        return "." if last == "," else ",", ""
    if len(others) == 1 and last not in others:  # 1,234.5
        whole = body[: body.rindex(last)]
        return (last, "") if THOUSANDS.fullmatch(whole) else ("", "")
    if others:
        return "", ""
    if THOUSANDS.fullmatch(body) and not body.startswith("0"):
        return "", last
    return last, ""
