"""What all commands share: the program, its two streams, how a cloud is read and an error is told."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console

from phytofit.errors import PhytofitError
from phytofit.text import for_terminal

if TYPE_CHECKING:
    from phytofit.cloud import PointCloud

__all__ = ["app", "complain", "err", "flag", "note", "or_exit", "out", "read_quietly", "tell"]

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    help="Plant traits from 3D point clouds, by fitting parametric plant models.\n\n"
    "Start with `phytofit demo`; then `phytofit fit leaf.ply --units cm`.",
)
out = Console()
err = Console(stderr=True)


def tell(text: object) -> None:
    """Print a line, whatever names it holds."""
    out.print(for_terminal(text), highlight=False)


def note(text: object) -> None:
    out.print(f"note: {for_terminal(text)}", highlight=False)


def flag(text: object) -> None:
    out.print(f"[bold yellow]flag:[/] {for_terminal(text)}", highlight=False)


def complain(error: object) -> None:
    err.print(f"[bold red]error:[/] {for_terminal(error)}", highlight=False, soft_wrap=True)


def or_exit(call: Any) -> Any:
    """What the call returns; or one line and exit code 2."""
    try:
        return call()
    except PhytofitError as error:
        complain(error)
        raise typer.Exit(2) from None


def read_quietly(path: Path, units: str | None, labels: str | None, **how: Any) -> "PointCloud":
    """The cloud in a file, whose warnings stand in its notes, which are printed."""
    from phytofit.cloud import read_cloud

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read_cloud(path, units, label_property=labels, **how)
