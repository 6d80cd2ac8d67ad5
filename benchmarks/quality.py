"""Whether a trait's quality says how far to trust it: how many traits are good, check or poor, and their errors.

    python benchmarks/quality.py [simulated] [foreign] [real] [--phytomers 200] [--leaves 60] [--keep ROWS.csv]
    python benchmarks/quality.py --from ROWS.csv

simulated  phytomers made worse as by robustness.py, at the steps at which the method is said to work
foreign    the leaves of foreign.py, thinned at random and on a grid, --leaves of each
real       the greenhouse and field clouds in ../shared/data/sodhi2018; greenhouse ones beside hand measures

Errors are medians, in % or degrees (curvature: degrees per cm); "holds" is the share of the 95 % intervals that hold
the truth.  Below, the same for each code of a remark, of the traits that it touches.  --keep writes a row for each
trait; --from grades such rows again, by the limits and grades as they are now, and fits nothing.
"""

import argparse
import csv
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import foreign
import numpy as np
import pandas as pd
from accuracy import HAND
from common import DATA, clouds, progress, read, run_parts
from robustness import SPECIES, SWEEPS

import phytofit
from phytofit.results.quality import graded, of_intervals
from phytofit.results.remarks import KINDS, OF_INTERVALS, Remark

FIRST_SEED = 2_000_000  # not those of other benchmarks
GRADES = ("good", "check", "poor")
CLEAN = ("0003", "0006", "0007")  # greenhouse clouds without holes


class Row(NamedTuple):
    """A trait of a cloud; `true` is not a number where it is not known."""

    part: str
    cloud: str
    trait: str
    unit: str
    value: float
    low: float
    high: float
    true: float
    quality: str
    flags: str


def rows_of(part: str, name: str, cloud: phytofit.PointCloud, true: dict[str, float]) -> list[Row]:
    """The traits of a cloud; none where it is refused."""
    try:
        traits = phytofit.fit(cloud, threads=1).traits
    except phytofit.PhytofitError:
        return []
    return [
        Row(part, name, t.name, t.unit, t.value, *ends(t), true.get(t.name, np.nan), t.quality, ";".join(t.flags))
        for t in traits
    ]


def ends(trait: phytofit.Trait) -> tuple[float, float]:
    return tuple(np.nan if end is None else end for end in (trait.low, trait.high))


def simulated(number: int) -> list[Row]:
    steps = [(name, step) for name, sweep in SWEEPS.items() for step in sweep.works]
    name, step = steps[number % len(steps)]
    sweep, seed = SWEEPS[name], FIRST_SEED + number
    made = phytofit.simulate(SPECIES, n_points=sweep.n_points, noise_cm=sweep.noise_cm, seed=seed)
    points = sweep.cloud(made, step, np.random.default_rng(seed))
    true = {t.name: t.value for t in phytofit.measure(made.organs)}
    return rows_of("simulated", f"{name} {step:g}, {number}", phytofit.from_points(points, "cm"), true)


def of_another(number: int, on_grid: bool) -> list[Row]:
    points, true = foreign.cloud(number, on_grid)
    known = {name: true[name] for name in foreign.TRAITS}
    how = "grid" if on_grid else "random"
    return rows_of("foreign", f"{how} {number}", phytofit.from_points(points, "cm"), known)


def real(path: Path) -> list[Row]:
    with (DATA / "greenhouse" / "ground_truth.csv").open() as file:
        hand = {row["cloud"]: row for row in csv.DictReader(file)}.get(path.stem, {})
    true = {name: float(hand[column]) for name, column in HAND.items() if column in hand}
    return rows_of(path.parent.name, path.stem, read(path), true)


def graded_again(rows: pd.DataFrame) -> Iterator[tuple[str, str]]:
    """Quality and codes of each trait by the limits and the grades as they are now."""
    for _, mine in rows.groupby(["part", "cloud"], sort=False):
        for row in mine.itertuples():
            low, high = (None if np.isnan(end) else end for end in (row.low, row.high))
            trait = phytofit.Trait("", 0, row.trait, row.value, row.unit, low, high)
            codes = [code for code in row.flags.split(";") if code and code not in OF_INTERVALS]
            touching = [Remark(code, (row.trait,), KINDS[code].grade, "") for code in codes]
            (again,) = graded([trait], [*touching, *of_intervals([trait])])
            yield again.quality, ";".join(again.flags)


def print_table(rows: pd.DataFrame) -> None:
    """One line for each trait, three columns for each grade; then one for each code."""
    relative = rows["unit"].isin(["cm", "cm²"])
    off = (rows["value"] - rows["true"]).abs()
    rows = rows.assign(error=off.where(~relative, 100.0 * off / rows["true"].abs()))
    low, high = rows["low"].fillna(-np.inf), rows["high"].fillna(np.inf)
    rows["holds"] = ((low <= rows["true"]) & (rows["true"] <= high)).where(rows["true"].notna())
    print(f"{'':22}" + "".join(f"{grade:>8}{'share':>8}{'error':>8}{'holds':>8}" for grade in GRADES))
    for name, mine in [*rows.groupby("trait", sort=False), ("all", rows)]:
        cells = (numbers(mine[mine["quality"] == grade], len(mine), name != "all") for grade in GRADES)
        print(f"{name:22}" + "".join(cells), flush=True)
    print(
        f"{'touched by':22}{'n':>8}{'share':>8}{'error':>8}{'holds':>8}   (error beside that of the good, its factor)"
    )
    usual = rows[rows["quality"] == "good"].groupby("trait")["error"].median()
    for code in dict.fromkeys(code for text in rows["flags"] for code in text.split(";") if code):
        mine = rows[[code in text.split(";") for text in rows["flags"]]]
        factor = (mine["error"] / mine["trait"].map(usual)).median()
        print(f"{code:22}{numbers(mine, len(rows), known=False)}{factor:8.1f}")


def numbers(mine: pd.DataFrame, of: int, known: bool) -> str:
    error = f"{mine['error'].median():8.2f}" if known and mine["error"].notna().any() else f"{'':8}"
    held = f"{100.0 * mine['holds'].mean():7.0f}%" if mine["holds"].notna().any() else f"{'':8}"
    return f"{len(mine):8}{100.0 * len(mine) / max(of, 1):7.0f}%{error}{held}"


def report(rows: pd.DataFrame) -> None:
    for part, mine in rows.groupby("part", sort=False):
        print(f"\n{part}: {mine['cloud'].nunique()} clouds measured")
        print_table(mine)
        clean = mine[mine["cloud"].isin(CLEAN)]
        if part == "greenhouse":
            print(
                f"of the clean ones ({', '.join(CLEAN)}) {np.mean(clean['quality'] == 'good'):.0%} of traits are good"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="some of the parts above; all by default")
    parser.add_argument("--phytomers", type=int, default=200, help="simulated ones")
    parser.add_argument("--leaves", type=int, default=60, help="foreign ones, each way")
    parser.add_argument("--keep", type=Path, help="write the rows there")
    parser.add_argument("--from", type=Path, dest="kept", help="grade these rows instead of fitting")
    given = parser.parse_args()
    if given.kept is not None:
        rows = pd.read_csv(given.kept, dtype={"cloud": str}).fillna({"flags": "", "quality": ""})
        quality, flags = zip(*graded_again(rows), strict=True)
        report(rows.assign(quality=quality, flags=flags))
        return
    found: list[Row] = []

    def part(measured: object, those: list[object], pool: ProcessPoolExecutor) -> None:
        found.extend(row for rows in progress(pool.map(measured, those), len(those)) for row in rows)

    leaves = list(range(given.leaves))
    parts = {"simulated": partial(part, simulated, list(range(given.phytomers)))}
    parts["foreign"] = lambda pool: [part(partial(of_another, on_grid=grid), leaves, pool) for grid in (False, True)]
    parts["real"] = lambda pool: part(real, clouds("greenhouse", "field"), pool)
    run_parts(parts, given.parts)
    rows = pd.DataFrame(found, columns=Row._fields)
    if given.keep is not None:
        rows.to_csv(given.keep, index=False)
    report(rows)


if __name__ == "__main__":
    main()
