"""Whether a number comes back when the same leaf is measured again; by the default method, on real clouds.

    python benchmarks/repeatability.py [greenhouse] [field] [turntable] [maize] [--permutations 10] [--subsets 10]
                                       [--perturbations 3]

greenhouse, field  the paper's clouds in ../shared/data/sodhi2018
turntable          the leaves of the plant in ../shared/data/mccormick2016_turntable, as `phytofit run` cuts them
maize              a leaf of a plant in ../shared/data/corn_leaf_area, and one in ../shared/data/label3dmaize

Of each cloud there are copies: with its points in another order; with a tenth of them left out; with each point moved
by some 1e-9 cm, as another machine's rounding may move it.  Of each kind, the spread of a trait is what 95 % of the
copies lie within, on either side of the whole cloud's value.  A trait comes back if no spread is wider than half its
interval; an interval that is open on one side counts as far as its closed side reaches.  Some 25 fits of a few seconds
for each of 17 clouds: about 20 minutes of one core, divided by the number of cores.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from common import DATA, clouds, progress, read, run_parts
from cut_leaves import rows_of as labelled_points

import phytofit

LEFT_OUT = 0.1  # of the points, in a subset
MOVED_CM = 1e-9  # as sums in another order differ, of coordinates of 10 to 100 cm
COVERED = 0.95  # of the copies


class Copy(NamedTuple):
    """Which copy of a cloud: permuted, subset, moved, or the whole; and its number."""

    kind: str
    number: int = 0


WHOLE = Copy("whole")


class Measured(NamedTuple):
    """Of one fit: values, ends of the intervals and quality of each trait; None where it was refused."""

    values: dict[str, float]
    ends: dict[str, tuple[float | None, float | None]]
    quality: dict[str, str]


class Row(NamedTuple):
    """A trait of a cloud: its value, half its interval, the spread of each kind of copy, copies beyond the interval."""

    cloud: str
    trait: str
    value: float
    half: float
    spread: dict[str, float]
    beyond: int
    quality: str

    @property
    def comes_back(self) -> bool:
        return max(self.spread.values()) <= self.half


def copy_of(cloud: phytofit.PointCloud, copy: Copy) -> phytofit.PointCloud:
    random = np.random.default_rng(copy.number)
    if copy.kind == "permuted":
        return cloud.take(random.permutation(len(cloud)))
    if copy.kind == "subset":
        n = round((1.0 - LEFT_OUT) * len(cloud))
        return cloud.take(np.sort(random.permutation(len(cloud))[:n]))
    if copy.kind == "moved":
        return dataclasses.replace(cloud, points=cloud.points + random.normal(0.0, MOVED_CM, cloud.points.shape))
    return cloud


def measured(job: tuple[phytofit.PointCloud, np.ndarray | None, Copy]) -> Measured | None:
    cloud, up, copy = job
    try:
        traits = phytofit.fit(copy_of(cloud, copy), up=up, threads=1).traits
    except phytofit.NoPhytomerError:
        return None
    return Measured(
        {t.name: t.value for t in traits},
        {t.name: (t.low, t.high) for t in traits},
        {t.name: t.quality for t in traits},
    )


def half_interval(value: float, low: float | None, high: float | None) -> float:
    """Half of the interval, or from the value to its closed end; infinite without one."""
    if low is not None and high is not None:
        return 0.5 * (high - low)
    ends = [abs(value - end) for end in (low, high) if end is not None]
    return min(ends, default=np.inf)


def rows_of(name: str, whole: Measured, copies: dict[Copy, Measured | None]) -> Iterator[Row]:
    """A copy that was refused is as far off as can be."""
    for trait, value in whole.values.items():
        low, high = whole.ends[trait]
        off: dict[str, list[float]] = {}
        beyond = 0
        for copy, other in copies.items():
            there = np.inf if other is None else other.values[trait]
            off.setdefault(copy.kind, []).append(abs(there - value))
            beyond += not (-np.inf if low is None else low) <= there <= (np.inf if high is None else high)
        spread = {kind: float(np.quantile(each, COVERED, method="higher")) for kind, each in off.items()}
        yield Row(name, trait, value, half_interval(value, low, high), spread, beyond, whole.quality[trait])


def report(title: str, found: dict[str, tuple[phytofit.PointCloud, np.ndarray | None]], copies: list[Copy],
           pool: ProcessPoolExecutor) -> list[Row]:  # fmt: skip
    jobs = [(cloud, up, copy) for cloud, up in found.values() for copy in (WHOLE, *copies)]
    done = list(progress(pool.map(measured, jobs, chunksize=1), len(jobs)))
    each = 1 + len(copies)
    kinds = list(dict.fromkeys(copy.kind for copy in copies))
    print(
        f"\n{title}: value, half its interval, spread of copies "
        + ", ".join(kinds)
        + "; * wider than half; (quality, unless good)"
    )
    rows: list[Row] = []
    for i, name in enumerate(found):
        whole, *others = done[i * each : (i + 1) * each]
        if whole is None:
            print(f"{name:18} no phytomer was found")
            continue
        refused = sum(other is None for other in others)
        mine = list(rows_of(name, whole, dict(zip(copies, others, strict=True))))
        for row in mine:
            spreads = "".join(f"{row.spread[kind]:10.3g}" for kind in kinds)
            beyond = f"  {row.beyond} of {len(copies)} beyond the interval" if row.beyond else ""
            wide, quality = "" if row.comes_back else " *", "" if row.quality == "good" else f" ({row.quality})"
            print(f"{name:18} {row.trait:22}{row.value:9.2f} ±{row.half:7.3g}{spreads}{wide}{quality}{beyond}")
        if refused:
            print(f"{name:18} {refused} of {len(copies)} copies were refused")
        rows += mine
    print_share(title, rows, kinds)
    return rows


def print_share(title: str, rows: list[Row], kinds: list[str]) -> None:
    for what, those in (
        ("good", [row for row in rows if row.quality == "good"]),
        ("good and check", [row for row in rows if row.quality != "poor"]),
        ("of all", rows),
    ):
        if those:
            by_kind = ", ".join(
                f"{kind} {np.mean([row.spread[kind] <= row.half for row in those]):.0%}" for kind in kinds
            )
            met = np.mean([row.comes_back for row in those])
            print(f"{title}: {met:.0%} of {len(those)} {what} traits come back within half their interval ({by_kind})")


Found = dict[str, tuple[phytofit.PointCloud, np.ndarray | None]]


def of_paper(folder: str) -> Found:
    return {path.stem[:12]: (read(path), None) for path in clouds(folder)}


def turntable() -> Found:
    scan = DATA.parent / "mccormick2016_turntable"
    made = phytofit.reconstruct(scan, camera="kinect-v2", pattern="DepthImage_*.png")
    found = phytofit.segment(made.cloud)
    return {f"leaf {i}": (cloud, found.up) for i, cloud in enumerate(found.phytomers(), start=1)}


def maize() -> Found:
    """The leaf in the middle of each of two plants, cut out by their labels."""
    points, labels = labelled_points(DATA.parent / "label3dmaize" / "v-6-1-l-r.txt")
    chosen = {
        "corn": phytofit.read_cloud(DATA.parent / "corn_leaf_area" / "01.ply", "m"),
        "label3dmaize": phytofit.from_points(points, "mm", labels=labels),
    }
    leaves = {}
    for name, cloud in chosen.items():
        plant = phytofit.segment(cloud, labelled=True)
        phytomers = plant.phytomers()
        leaves[f"{name} leaf {len(phytomers) // 2 + 1}"] = (phytomers[len(phytomers) // 2], plant.up)
    return leaves


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="some of the sets above; all by default")
    parser.add_argument("--permutations", type=int, default=10)
    parser.add_argument("--subsets", type=int, default=10)
    parser.add_argument("--perturbations", type=int, default=3)
    given = parser.parse_args()
    numbers = {"permuted": given.permutations, "subset": given.subsets, "moved": given.perturbations}
    copies = [Copy(kind, number) for kind, n in numbers.items() for number in range(n)]
    sets = {"greenhouse": partial(of_paper, "greenhouse"), "field": partial(of_paper, "field")}
    sets |= {"turntable": turntable, "maize": maize}
    rows: list[Row] = []

    def part(name: str, pool: ProcessPoolExecutor) -> None:
        rows.extend(report(name, sets[name](), copies, pool))

    run_parts({name: partial(part, name) for name in sets}, given.parts)
    print()
    print_share("in all", rows, [kind for kind, n in numbers.items() if n])


if __name__ == "__main__":
    main()
