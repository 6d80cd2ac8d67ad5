"""How far a command has come: a bar on a terminal, with the time that is left; elsewhere one line for each item, or
each stage of what takes long.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from phytofit.cli.console import err, out, progress_line
from phytofit.text import one_line

__all__ = ["Items", "Told"]

Told = Callable[[str, float], None]
QUICK_S = 2.0  # what takes no longer shows no stages
SURE = 0.05  # share of the work after which the time left is shown


class Items:
    """Of `n` items (clouds, plants), which are worked on one after the other, how many are done."""

    def __init__(self, n: int, thing: str, *, in_stages: bool = False) -> None:
        self.n, self.thing, self.in_stages = n, thing, in_stages
        self.started = time.monotonic()

    @contextmanager
    def item(self, i: int, name: str) -> Iterator[Told]:
        """Meanwhile item `i`, from 0, is worked on: call what this gives with a stage and the share that is done."""
        head = f"{self.thing} {i + 1} of {self.n}: {one_line(name)}" if self.n > 1 else one_line(name)
        if self.n > 1:
            progress_line(f"{head}{self._left(i)}")
        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(20), TimeElapsedColumn())
        shown = err.is_terminal and not out.quiet
        with Progress(*columns, console=err, transient=True, disable=not shown) as bar:
            task = bar.add_task(head, total=1.0)
            stages = [""]

            def told(stage: str, share: float) -> None:
                now = f"{head}: {one_line(stage)}"
                bar.update(task, completed=share, description=f"{now}{self._left(i + share)}")
                kind = "".join(c for c in stage if not c.isdigit())
                if self.in_stages and time.monotonic() - self.started > QUICK_S and kind != stages[-1]:
                    stages.append(kind)
                    progress_line(now)

            yield told

    def _left(self, done: float) -> str:
        if done < SURE * self.n:
            return ""
        seconds = (time.monotonic() - self.started) * (self.n - done) / done
        return f", {_duration(seconds)} left"


def _duration(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 90
        else f"{seconds / 60:.0f} min"
        if seconds < 5400
        else f"{seconds / 3600:.1f} h"
    )
