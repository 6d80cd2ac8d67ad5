"""What the commands that take many clouds share: one after the other, and how that ends."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeVar

import typer

from phytofit.cli.console import complain, say
from phytofit.cli.progress import Items, Told
from phytofit.errors import PhytofitError

if TYPE_CHECKING:
    from phytofit.io import FolderTable

__all__ = ["measure_each"]

T = TypeVar("T")


def measure_each(
    clouds: Sequence[Path],
    folder: Path,
    measured: Callable[[Path, str, Told], T],
    table: "Callable[[Path], FolderTable]",
    show: Callable[[T, str, Path], None],
    done: str,
    *,
    workbook: bool = False,
) -> NoReturn:
    """Measure each cloud and show what came out, or one line that says why nothing did; exit with 0 if all were
    measured, 1 if some were, 2 if none was."""
    from phytofit.batch import each_cloud

    items, counter = Items(len(clouds), "cloud"), itertools.count()

    def in_view(path: Path, name: str) -> T:
        with items.item(next(counter), name) as told:
            return measured(path, name, told)

    n_done = 0
    whole = True
    try:
        for made in each_cloud(clouds, folder, in_view, table, workbook=workbook):
            if made.result is None:
                complain(made.failure)
            else:
                n_done += 1
                show(made.result, made.name, folder / made.name)
    except PhytofitError as error:
        complain(error)
        whole = False
    if n_done and whole:
        say(f"{n_done} of {len(clouds)} {done}")
    raise typer.Exit(0 if whole and n_done == len(clouds) else 1 if n_done else 2)
