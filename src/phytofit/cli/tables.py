"""What several commands print of results."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from phytofit.cli.console import remark

if TYPE_CHECKING:
    from phytofit.results import Placed

__all__ = ["MARKS", "graded", "print_remarks", "print_skipped"]

NAMED = 3  # so many of the files that were skipped are named
STYLES = {"good": "green", "check": "yellow", "poor": "bold red"}  # of a quality
MARKS = {"check": "?", "poor": "!"}  # behind a value; those without are good, or nothing is known of them


def graded(quality: str) -> Text:
    """The quality of a trait, in its colour."""
    return Text(quality, STYLES.get(quality, ""))


def print_remarks(notes: Iterable[str], remarks: "Iterable[Placed]") -> None:
    """Each note and each remark once, with all the leaves that it is on; the worst first."""
    from phytofit.results import grouped

    for text in dict.fromkeys(notes):
        remark("note", text)
    for grade, line in grouped(remarks):
        remark(grade, line)


def print_skipped(files: Sequence[Path]) -> None:
    """What of a folder is no cloud."""
    if files:
        names = [file.name for file in files[:NAMED]] + (["..."] if len(files) > NAMED else [])
        n = f"{len(files)} {'file' if len(files) == 1 else 'files'}"
        remark("note", f"skipped {n} that hold no point cloud: {', '.join(names)}")
