"""What the benchmarks share: the real clouds, a pool of processes, how far they are."""

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import phytofit

T = TypeVar("T")
DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "sodhi2018"
MM = {"0015_occl1"}  # of the paper's clouds; the others are in cm


def clouds(*folders: str) -> list[Path]:
    """The paper's clouds in these folders; in all of them by default."""
    if not DATA.is_dir():
        sys.exit(f"{DATA} is absent: the paper's clouds can't be measured")
    folders = folders or ("greenhouse", "field", "simulated")
    return [path for folder in folders for path in sorted((DATA / folder).rglob("*.ply"))]


def read(path: Path) -> phytofit.PointCloud:
    """One of the paper's clouds, in its unit."""
    return phytofit.read_cloud(path, "mm" if path.stem in MM else "cm")


def run_parts(parts: Mapping[str, Callable[[ProcessPoolExecutor], None]], chosen: Sequence[str]) -> None:
    """Run the chosen parts, or all, each with a process for each core."""
    unknown = set(chosen) - set(parts)
    if unknown:
        sys.exit(f"no part is called {', '.join(unknown)}; there are {', '.join(parts)}")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        for name in chosen or parts:
            parts[name](pool)


def progress(results: Iterable[T], total: int) -> Iterator[T]:
    """The results, one by one, with a line that counts them."""
    for done, result in enumerate(results, start=1):
        if sys.stderr.isatty() or done % 50 == 0:
            print(f"\r{done}/{total}", end="" if sys.stderr.isatty() else "\n", file=sys.stderr, flush=True)
        yield result
