"""Which result a hand measure is compared with: pairs of the same trait of the same leaf."""

import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from phytofit.errors import InputError

__all__ = ["PAIR_COLUMNS", "Comparison", "compare"]

PAIR_COLUMNS = ["cloud", "trait", "unit", "measured", "value", "low", "high", "flags"]


@dataclass(frozen=True)
class Comparison:
    """``pairs``: one row a cloud and trait that both have (cloud, trait, unit, measured, value, low, high, flags);
    ``unmatched``: what has no partner, in words."""

    pairs: pd.DataFrame
    unmatched: tuple[str, ...]


def compare(measures: pd.DataFrame, results: pd.DataFrame) -> Comparison:
    """Pairs of hand measures (as `read_measures` gives them) and results (a table with the columns of ``traits.csv``).

    A cloud is found by its name, else by its name without case and file ending, else by its number without leading
    zeros, where only one is like that.  Where measures have a ``rank``, of the leaf, it has to be the result's.

    Raises InputError where a result has a trait of several leaves and the measures do not say of which.
    """
    named = _by_name(measures["cloud"].unique(), results["cloud"].unique())
    pairs, lone = [], []
    given: dict[tuple[str, str], list[dict[Hashable, Any]]] = {}
    for result in results.to_dict("records"):
        given.setdefault((result["cloud"], result["trait"]), []).append(result)
    for row in measures.to_dict("records"):
        cloud, rank = named.get(row["cloud"]), row.get("rank", "")
        found = [r for r in given.get((str(cloud), row["trait"]), []) if not rank or str(r.get("rank", "")) == rank]
        if len(found) > 1:
            raise InputError(
                f"{row['cloud']}: the results have {row['trait']} of {len(found)} leaves; expected a column rank in "
                "the measures, that counts leaves from the base"
            )
        leaf = f" leaf {rank}" if rank else ""
        if not found:
            lone.append(f"measured, no result: {row['cloud']}{leaf}" + ("" if cloud is None else f", {row['trait']}"))
            continue
        result = found[0]
        if result["unit"] != row["unit"]:
            raise InputError(
                f"{row['cloud']}, {row['trait']}: measured in {row['unit']}, but the result is in {result['unit']}"
            )
        shown = [result[key] for key in ("value", "low", "high", "flags")]
        pairs.append((f"{cloud}{leaf}", row["trait"], row["unit"], row["value"], *shown))
    lone += [f"result, not measured: {cloud}" for cloud in results["cloud"].unique() if cloud not in named.values()]
    table = pd.DataFrame(pairs, columns=PAIR_COLUMNS)
    return Comparison(table.astype(dict.fromkeys(PAIR_COLUMNS[3:7], float)), tuple(dict.fromkeys(lone)))


def _by_name(wanted: NDArray[np.object_], there: NDArray[np.object_]) -> Mapping[str, str]:
    """The cloud of the results that each measured one means."""

    def plain(name: str) -> str:
        return re.sub(r"\.[a-z]{2,4}$", "", name.strip().lower())

    found = {name: name for name in wanted if name in set(there)}
    for alike in (plain, lambda name: plain(name).lstrip("0")):
        for name in wanted:
            same = [it for it in there if alike(str(it)) == alike(str(name)) and it not in found.values()]
            if name not in found and len(same) == 1:
                found[name] = same[0]
    return found
