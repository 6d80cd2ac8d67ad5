"""Which result a hand measure is compared with: pairs of the same trait of the same leaf."""

import re
import unicodedata
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from phytofit.cloud import READERS
from phytofit.errors import InputError
from phytofit.text import for_file_name, for_table

__all__ = ["PAIR_COLUMNS", "Comparison", "compare"]

PAIR_COLUMNS = ["cloud", "trait", "unit", "measured", "value", "low", "high", "quality", "flags", "n_measured"]
SEVERAL = {  # what tells results of a trait apart, and what measures need then
    "plant": "of {} plants; expected a column plant in the measures, that counts the plants of a cloud",
    "rank": "of {} leaves; expected a column rank in the measures, that counts leaves from the base",
}
TWICE = "in {} rows; expected one row for each trait"
NAMED = 5  # leaves that are named one by one in a note on all that were measured repeatedly
Row: TypeAlias = dict[Hashable, Any]


@dataclass(frozen=True)
class Comparison:
    """``pairs``: one row for each cloud and trait that both have (cloud, trait, unit, measured, value, low, high,
    quality, flags, n_measured); ``unmatched``: what has no partner, in words; ``notes``: what was measured repeatedly,
    and averaged."""

    pairs: pd.DataFrame
    unmatched: tuple[str, ...]
    notes: tuple[str, ...] = ()


def compare(measures: pd.DataFrame, results: pd.DataFrame) -> Comparison:
    """Pairs of hand measures (as `read_measures` gives them) and results (a table with the columns of ``traits.csv``,
    of which ``quality`` may be missing).

    A cloud is found by its name; else by its name without folder, file ending and case, by it without marks between
    words, or without leading zeros, where only one is like that.  Where measures have a ``rank``, of the leaf, or a
    ``plant``, it has to be the result's.  What was measured repeatedly is averaged.

    Raises
    ------
    InputError
        If a result has a trait of several leaves or plants and the measures do not say of which.
    """
    named = _by_name(measures["cloud"].unique().tolist(), results["cloud"].unique().tolist())
    given: dict[tuple[str, str], list[Row]] = {}
    for result in results.to_dict("records"):
        given.setdefault((result["cloud"], result["trait"]), []).append(result)
    lone: list[str] = []
    found: dict[tuple[str, str], tuple[Row, list[float]]] = {}
    row: Row
    for row in measures.to_dict("records"):
        cloud, trait = named.get(row["cloud"]), row["trait"]
        its = None if cloud is None else _result_of(row, given.get((cloud, trait), []))
        if its is None:
            lone.append(f"measured, no result: {_label(row['cloud'], row)}" + ("" if cloud is None else f", {trait}"))
        elif its["unit"] != row["unit"]:
            lone.append(f"measured in {row['unit']}, but the result is in {its['unit']}: {row['cloud']}, {trait}")
        else:
            of_a_leaf = _count(its, "rank") == _count(row, "rank")
            label = _label(cloud, row if of_a_leaf else {**row, "rank": ""})
            found.setdefault((label, trait), (its, []))[1].append(row["value"])
    lone += [f"result, not measured: {cloud}" for cloud in results["cloud"].unique() if cloud not in named.values()]
    ends = ("value", "low", "high", "quality", "flags")
    pairs = [
        (label, trait, its["unit"], np.mean(values), *(its.get(name, "") for name in ends), len(values))
        for (label, trait), (its, values) in found.items()
    ]
    table = pd.DataFrame(pairs, columns=PAIR_COLUMNS)
    table = table.astype({**dict.fromkeys(PAIR_COLUMNS[3:7], float), "n_measured": int})
    return Comparison(table, tuple(dict.fromkeys(lone)), (*measures.attrs.get("notes", ()), *_repeated(found)))


def _result_of(row: Row, there: Sequence[Row]) -> Row | None:
    """The result that a measure is of, among those of its cloud and trait; InputError if it may be several."""
    if plant := _count(row, "plant"):
        there = [r for r in there if (_count(r, "plant") or "1") == plant]
    of_none = [r for r in there if _count(r, "rank") in ("", "0")]  # of the stem, or of all the plant
    if rank := _count(row, "rank"):
        there = [r for r in there if _count(r, "rank") == rank] or (of_none if len(of_none) == len(there) else [])
    elif of_none:
        there = of_none
    if len(there) > 1:
        several = next((said for k, said in SEVERAL.items() if len({_count(r, k) for r in there}) > 1), TWICE)
        raise InputError(f"{row['cloud']}: the results have {row['trait']} {several.format(len(there))}")
    return there[0] if there else None


def _count(row: Row, name: str) -> str:
    """The number of a leaf or a plant in a row, as text; empty where there is none."""
    value = row.get(name, "")
    return "" if pd.isna(value) else str(value).removesuffix(".0")


def _label(cloud: str | None, row: Row) -> str:
    numbers = ((word, _count(row, key)) for word, key in (("plant", "plant"), ("leaf", "rank")))
    return f"{cloud}" + "".join(f" {word} {number}" for word, number in numbers if number not in ("", "0"))


def _repeated(found: Mapping[tuple[str, str], tuple[Row, Sequence[float]]]) -> Iterator[str]:
    """A note on each trait with repeated measures."""
    for trait in dict.fromkeys(trait for _, trait in found):
        mine = {label: (r["unit"], values) for (label, t), (r, values) in found.items() if t == trait}
        again = {label: (unit, np.array(values)) for label, (unit, values) in mine.items() if len(values) > 1}
        if not again:
            continue
        told = {
            label: f"{label} ({', '.join(f'{v:.6g}' for v in values[:NAMED])} {unit})"
            for label, (unit, values) in again.items()
        }
        if len(again) <= NAMED:
            yield f"{trait} was measured more than once, and the mean is used: {', '.join(told.values())}"
            continue
        squares = sum(float(np.sum((values - values.mean()) ** 2)) for _, values in again.values())
        spread = np.sqrt(squares / sum(len(values) - 1 for _, values in again.values()))
        apart = max(again, key=lambda label: np.ptp(again[label][1]))
        yield (
            f"{trait} was measured more than once in {len(again)} of {len(mine)}, and the mean is used; standard "
            f"deviation of one measure {spread:.2g} {again[apart][0]}, farthest apart in {told[apart]}"
        )


def _by_name(wanted: Sequence[str], there: Sequence[str]) -> dict[str, str]:
    """The cloud of the results that each measured one means: by the first way of comparing by which they are alike,
    and no others are."""
    found: dict[str, str] = {}
    for key in (_exact, _as_path, _as_file, _as_words, _as_numbers):
        loose = key in (_as_words, _as_numbers)  # by which two plants may be alike: 1-2 and 1_2, 3 and 03
        mine, theirs = (Counter(map(key, names)) for names in (wanted, there))
        by_key = {key(name): name for name in there if not (loose and name in found.values())}
        for name in wanted:
            k = key(name)
            if name not in found and k in by_key and theirs[k] == 1 and (mine[k] == 1 or not loose):
                found[name] = by_key[k]
    return found


def _exact(name: str) -> str:
    """A name as tables have it, its letters composed as one character each."""
    return unicodedata.normalize("NFC", for_table(name))


def _as_path(name: str) -> str:
    text = unicodedata.normalize("NFKC", _exact(name).removeprefix("'").casefold()).replace("\\", "/")
    text = re.sub(r"^(\d+)\.0+$", r"\1", text)  # a number that a program took for a measure
    return next((text.removesuffix(suffix) for suffix in READERS if text.endswith(suffix)), text).replace("/", "_")


def _as_file(name: str) -> str:
    """As a result's folder is called."""
    return _as_path(for_file_name(_exact(name).removeprefix("'").replace("\\", "/").rpartition("/")[2]))


def _as_words(name: str) -> str:
    return re.sub(r"[\s_.-]+", "_", _as_file(name))


def _as_numbers(name: str) -> str:
    return re.sub(r"\d+", lambda digits: digits[0].lstrip("0") or "0", _as_words(name))
