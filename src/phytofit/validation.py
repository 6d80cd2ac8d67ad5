"""Results against hand measures: pairs of the same trait of the same cloud, and how well they agree."""

import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from phytofit.errors import InputError

__all__ = ["Agreement", "Comparison", "agreement", "compare", "concordance", "read_measures", "read_results"]

FloatArray = NDArray[np.float64]
CLOUD_NAMES = ("cloud", "name", "id", "plant", "sample", "scan", "file", "leaf", "phytomer")
TRAIT_WORDS = {  # the words of a column's name, in any order, that mean a trait; the first that fits counts
    "leaf_insertion_angle": ({"insertion", "angle"},),
    "leaf_angle": ({"leaf", "angle"}, {"angle"}, {"inclination"}),
    "leaf_length": ({"leaf", "length"}, {"blade", "length"}, {"length"}),
    "leaf_width": ({"leaf", "width"}, {"blade", "width"}, {"width"}),
    "leaf_area": ({"leaf", "area"}, {"area"}),
    "leaf_curvature": ({"curvature"},),
    "stem_length": ({"stem", "length"}, {"internode", "length"}),
    "stem_diameter": ({"stem", "diameter"}, {"diameter"}, {"stem", "diam"}, {"diam"}, {"stem", "width"}),
}
UNITS = {  # written, and as results have it: factor and unit
    "mm": (0.1, "cm"), "cm": (1.0, "cm"), "m": (100.0, "cm"), "in": (2.54, "cm"),
    "mm2": (0.01, "cm²"), "mm²": (0.01, "cm²"), "cm2": (1.0, "cm²"), "cm²": (1.0, "cm²"), "m²": (1e4, "cm²"),
    "deg": (1.0, "deg"), "degree": (1.0, "deg"), "degrees": (1.0, "deg"), "°": (1.0, "deg"),
    "rad": (180.0 / np.pi, "deg"), "deg/cm": (1.0, "deg/cm"), "rel": (1.0, "rel"),
}  # fmt: skip
PAIR_COLUMNS = ["cloud", "trait", "unit", "measured", "value", "low", "high", "flags"]
LIMITS = 1.96  # standard deviations of the differences to either side of their mean (Bland and Altman, 1986)
FAR_OFF, LEAST_FOR_OUTLIERS = 3.5, 5  # of the modified z-score (Iglewicz and Hoaglin, 1993); pairs


@dataclass(frozen=True)
class Comparison:
    """``pairs``: one row a cloud and trait that both have (cloud, trait, unit, measured, value, low, high, flags);
    ``unmatched``: what has no partner, in words."""

    pairs: pd.DataFrame
    unmatched: tuple[str, ...]


class Agreement(NamedTuple):
    """How well the results of a trait agree with the hand: differences are result minus measure, in ``unit``.

    ``bias`` their mean, ``rmse``, ``mae``; ``r`` Pearson's correlation and ``ccc`` Lin's concordance (NaN with fewer
    than three pairs); ``lower``, ``upper``: Bland and Altman's 95 % limits of agreement; ``coverage``: share of the
    measures within the results' intervals, of the ``n_intervals`` that there are; ``flagged`` results; ``outliers``:
    clouds whose difference is far from all the others'.
    """

    trait: str
    unit: str
    n: int
    bias: float
    rmse: float
    mae: float
    r: float
    ccc: float
    lower: float
    upper: float
    coverage: float
    n_intervals: int
    flagged: int
    outliers: tuple[str, ...]


def read_measures(path: str | Path) -> pd.DataFrame:
    """Hand measures as a table (cloud, rank, trait, value, unit), from a CSV file.

    Either one row a cloud, with a column a trait whose name says the unit (``leaf_length_cm``, ``Leaf length (mm)``,
    ``angle [deg]``; angles may do without); or one row a cloud and trait, with columns cloud, trait, value and unit, as
    ``phytofit simulate`` writes its truth.  Of whole plants a column ``rank`` says which leaf, from the base.  Empty
    cells are no measures.  InputError where that can't be read.
    """
    path = Path(path)
    table = _read_csv(path)
    words = {column: _words(column) for column in table.columns}
    cloud = next((c for name in CLOUD_NAMES for c, w in words.items() if w == [name]), None)
    if cloud is None:
        raise InputError(
            f"{path}: expected a column that names the cloud ({', '.join(CLOUD_NAMES[:4])}), "
            f"got {', '.join(table.columns)}"
        )
    lower = {column.strip().lower(): column for column in table.columns}
    ranks = table[lower["rank"]] if "rank" in lower else [""] * len(table)
    if {"trait", "value"} <= set(lower):
        unit = lower.get("unit")
        rows = [
            (name, rank, trait, number, "" if unit is None else u)
            for name, rank, trait, number, u in zip(
                table[cloud], ranks, table[lower["trait"]], table[lower["value"]], table[unit or cloud], strict=True
            )
        ]
    else:
        found = {
            column: _trait_of(column, path) for column in table.columns if column not in (cloud, lower.get("rank"))
        }
        traits = {column: it for column, it in found.items() if it is not None}
        if not traits:
            raise InputError(
                f"{path}: expected columns such as leaf_length_cm or 'Leaf angle (deg)', got {', '.join(table.columns)}"
            )
        rows = [
            (name, rank, trait, number, unit)
            for column, (trait, unit) in traits.items()
            for name, rank, number in zip(table[cloud], ranks, table[column], strict=True)
        ]
    return _in_units(rows, path)


def read_results(path: str | Path) -> pd.DataFrame:
    """The table of a folder of results, ``traits.csv`` in it, or of that file; InputError if it is none."""
    path = Path(path)
    file = path / "traits.csv" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{path}: expected a folder of results, with traits.csv in it, or that file")
    table = _read_csv(file)
    missing = [name for name in ("cloud", "trait", "value", "unit", "low", "high", "flags") if name not in table]
    if missing:
        raise InputError(f"{file}: expected the columns of a result, and {', '.join(missing)} are missing")
    numbers = {name: pd.to_numeric(table[name], errors="coerce") for name in ("value", "low", "high")}
    return table.assign(**numbers)


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


def agreement(pairs: pd.DataFrame) -> list[Agreement]:
    """The statistics of each trait of a comparison's pairs, in the order in which the traits come."""
    return [_agreement(trait, group) for trait, group in pairs.groupby("trait", sort=False)]


def _agreement(trait: object, group: pd.DataFrame) -> Agreement:
    measured, value = group["measured"].to_numpy(float), group["value"].to_numpy(float)
    low, high = group["low"].to_numpy(float), group["high"].to_numpy(float)
    given = np.isfinite(low) | np.isfinite(high)
    held = (np.nan_to_num(low, nan=-np.inf) <= measured) & (measured <= np.nan_to_num(high, nan=np.inf))
    difference = value - measured
    n, bias = len(difference), float(difference.mean())
    spread = float(difference.std(ddof=1)) if n > 1 else np.nan
    return Agreement(
        trait=str(trait),
        unit=str(group["unit"].iloc[0]),
        n=n,
        bias=bias,
        rmse=float(np.sqrt(np.mean(difference**2))),
        mae=float(np.mean(np.abs(difference))),
        r=_correlation(measured, value),
        ccc=concordance(measured, value),
        lower=bias - LIMITS * spread,
        upper=bias + LIMITS * spread,
        coverage=float(held[given].mean()) if given.any() else np.nan,
        n_intervals=int(given.sum()),
        flagged=int(group["flags"].fillna("").astype(bool).sum()),
        outliers=tuple(group["cloud"].to_numpy()[_far_off(difference)]),
    )


def concordance(x: FloatArray, y: FloatArray) -> float:
    """Lin's concordance correlation coefficient (Biometrics 45, 1989) of x (n,) and y (n,); NaN of fewer than three."""
    if len(x) < 3:
        return np.nan
    both = float(np.mean((x - x.mean()) * (y - y.mean())))
    apart = float(np.var(x) + np.var(y) + (x.mean() - y.mean()) ** 2)
    return 2.0 * both / apart if apart > 0.0 else np.nan


def _correlation(x: FloatArray, y: FloatArray) -> float:
    if len(x) < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return np.nan
    return float(np.corrcoef(x, y)[0, 1])


def _far_off(difference: FloatArray) -> NDArray[np.bool_]:
    """Which (n,) differ from the median by much more than the others do, by the modified z-score."""
    off = np.abs(difference - np.median(difference))
    typical = float(np.median(off))
    if len(off) < LEAST_FOR_OUTLIERS or typical == 0.0:
        return np.zeros(len(off), bool)
    far: NDArray[np.bool_] = 0.6745 * off / typical > FAR_OFF
    return far


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = file.readline()
        separator = max(",;\t", key=header.count)
        table = pd.read_csv(path, dtype=str, keep_default_na=False, sep=separator, encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # also what pandas can't parse
        raise InputError(f"{path}: expected a CSV table, and can't read it as one ({error})") from None
    if table.empty:
        raise InputError(f"{path}: expected a CSV table with a row a cloud, got no rows")
    return table


def _words(column: str) -> list[str]:
    """Lower-case words of a column's name, units included."""
    return [word for word in re.split(r"[^0-9a-z°²/]+", column.lower()) if word]


def _trait_of(column: str, path: Path) -> tuple[str, str] | None:
    """Trait and written unit of a column; None if it is none."""
    words = set(_words(column))
    unit = next((word for word in words if word in UNITS), "")
    rest = words - {unit}
    for trait, ways in TRAIT_WORDS.items():
        if any(way <= rest for way in ways):
            if not unit and "angle" not in trait:
                raise InputError(
                    f"{path}: column {column!r} has no unit; write it behind, as in {trait}_cm or {trait}_mm"
                )
            return trait, unit or "deg"
    return None


def _in_units(rows: list[tuple[str, str, str, str, str]], path: Path) -> pd.DataFrame:
    made = []
    for cloud, rank, trait, text, unit in rows:
        if not str(text).strip():
            continue
        try:
            value = float(str(text).replace(",", "."))
        except ValueError:
            raise InputError(f"{path}: {cloud}, {trait}: expected a number, got {text!r}") from None
        written = unit.strip().lower() or ("deg" if "angle" in trait else "")
        if written not in UNITS:
            raise InputError(f"{path}: {cloud}, {trait}: expected a unit ({', '.join(UNITS)}), got {unit!r}")
        factor, named = UNITS[written]
        made.append((cloud.strip(), str(rank).strip(), trait.strip(), factor * value, named))
    return pd.DataFrame(made, columns=["cloud", "rank", "trait", "value", "unit"])


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
