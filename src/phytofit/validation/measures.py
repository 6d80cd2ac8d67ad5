"""Hand measures and results, read from tables as people write them."""

import re
from pathlib import Path

import numpy as np
import pandas as pd

from phytofit.errors import InputError

__all__ = ["read_measures", "read_results"]

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
