"""Jobs done once: what each returned is kept, so that an evaluation that was stopped goes on from there."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from joblib import Memory, Parallel, delayed
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import phytofit.version

KEPT = Path(__file__).parent / ".kept"  # what jobs returned, by state of the code
SOURCES = (Path(__file__).parent, Path(__file__).parents[1] / "benchmarks")  # beside the package
COLUMNS = (
    TextColumn("{task.description}"),
    BarColumn(),
    MofNCompleteColumn(),
    TimeElapsedColumn(),
    TimeRemainingColumn(),
)
console = Console()


def run_all(
    function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], title: str, *, one_by_one: bool = False
) -> list[Any]:
    """What the function returns for each job, in their order; on all cores unless one by one, as where time counts.

    A job that this state of the code has done before, even in another run, is not done again.
    """
    kept = Memory(KEPT / phytofit.version.state_of_the_code(SOURCES), verbose=0).cache(function)
    before = sum(kept.check_call_in_cache(*job) for job in jobs)
    work = Parallel(n_jobs=1 if one_by_one else -1, return_as="generator", batch_size=1)
    results = []
    with Progress(*COLUMNS, console=console, transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(title, total=len(jobs))
        for result in work(delayed(kept)(*job) for job in jobs):
            results.append(result)
            bar.advance(task)
    console.print(f"{title}: {len(jobs)} jobs" + (f", {before} of them done before" if before else ""), highlight=False)
    return results
