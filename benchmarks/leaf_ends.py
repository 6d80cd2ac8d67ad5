"""How far a leaf's end by the model of the whole leaf differs from that by its last points, on real leaves.

    python benchmarks/leaf_ends.py [--leaves 4] [--points 3000]

No ruler has a part in it: of all labelled leaves in ../shared/data (and the paper's clouds, which are one leaf each),
cut out with their piece of stem, both ends are told, and how much they differ beyond their errors.  That is what
`phytofit.engine.leaf_end.MISFIT` rests on.
"""

import argparse
import multiprocessing
import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import numpy as np
from common import DATA, progress
from cut_leaves import SPECIES, Leaf, leaves
from scipy.optimize import minimize_scalar

from phytofit.engine import leaf_end
from phytofit.engine.search import estimate
from phytofit.fitting import N_SEARCHED, mean_at


def ends_of(leaf: Leaf) -> tuple[float, float] | None:
    """By how much of its length the model's end is beyond that of the points, and the standard error of that; None
    where the points don't tell, or the tip was not seen."""
    feet = [start.pose.copy() for start in leaf.starts]
    for foot, start in zip(feet, leaf.starts, strict=True):
        foot[:3, 3] += start.foot * start.pose[:3, 2]
    means = [mean_at(start, SPECIES.leading(N_SEARCHED)) for start in leaf.starts]
    with mock.patch.object(leaf_end, "combined", wraps=leaf_end.combined) as combined:
        estimate(SPECIES, leaf.points, list(zip(means, feet, strict=True)), organ=leaf.organ)
    if not combined.called:
        return None
    end, error, told = combined.call_args.args
    own = np.sqrt(max(0.0, error**2 - (leaf_end.MISFIT * end) ** 2))  # without the misfit that is to be told here
    return (end - told.at) / end, float(np.hypot(own, told.error)) / end


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--leaves", type=int, default=4, help="of a plant, at most; 4 by default")
    parser.add_argument("--points", type=int, default=3000, help="of a leaf and its stem; 3000 by default")
    arguments = parser.parse_args()
    if not DATA.is_dir():
        sys.exit(f"{DATA} is absent: there are no leaves to look at")
    cut = list(leaves(arguments.points, arguments.leaves))
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(progress(pool.map(ends_of, cut), len(cut)))
    told = [(leaf.data_set, *ends) for leaf, ends in zip(cut, found, strict=True) if ends is not None]
    by_set: dict[str, list[float]] = defaultdict(list)
    for data_set, apart, _ in told:
        by_set[data_set].append(100.0 * apart)
    print(f"\nEnd by the model beyond that by the last points, {len(told)} leaves of {len(cut)}, % of the length")
    for data_set, values in by_set.items():
        print(f"  {data_set:18} {len(values):3} leaves: mean {np.mean(values):+5.2f}, std {np.std(values):4.2f}")
    apart, error = 100.0 * np.array([row[1:] for row in told]).T

    def surprise(misfit: float) -> float:
        variance = error**2 + misfit**2
        return 0.5 * float(np.sum(np.log(variance) + apart**2 / variance))

    misfit = minimize_scalar(surprise, bounds=(0.0, 10.0), method="bounded").x
    print(
        f"  all: mean {apart.mean():+.2f}, median {np.median(apart):+.2f}; beyond the errors of both ends: {misfit:.2f}"
    )


if __name__ == "__main__":
    main()
