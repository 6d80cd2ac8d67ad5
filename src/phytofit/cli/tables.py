"""What several commands print of results."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from phytofit.cli.console import remark

__all__ = ["print_remarks", "print_skipped"]

NAMED = 3  # so many of the files that were skipped are named
OF_LEAF = re.compile(r"leaf (\d+): (.*)", re.DOTALL)


def print_remarks(notes: Iterable[str], flags: Iterable[str]) -> None:
    """Each remark once, with all the leaves that it is about."""
    for kind, texts in (("note", notes), ("flag", flags)):
        leaves: dict[str, list[str]] = {}
        for text in texts:
            found = OF_LEAF.fullmatch(text)
            leaves.setdefault(found[2] if found else text, []).extend([found[1]] if found else [])
        for text, ranks in leaves.items():
            of = f"{'leaf' if len(ranks) == 1 else 'leaves'} {', '.join(ranks)}: " if ranks else ""
            remark(kind, f"{of}{text}")


def print_skipped(files: Sequence[Path]) -> None:
    """What of a folder is no cloud."""
    if files:
        names = [file.name for file in files[:NAMED]] + (["..."] if len(files) > NAMED else [])
        n = f"{len(files)} {'file' if len(files) == 1 else 'files'}"
        remark("note", f"skipped {n} that hold no point cloud: {', '.join(names)}")
