"""What several commands print of results."""

from typing import TYPE_CHECKING

from phytofit.cli.console import flag, note

if TYPE_CHECKING:
    from phytofit.fitted import Fit
    from phytofit.traits import Trait

__all__ = ["interval", "print_remarks"]


def interval(trait: "Trait") -> str:
    low, high = ("" if end is None else f"{end:.2f}" for end in (trait.low, trait.high))
    return f"{low} – {high}" if low or high else ""


def print_remarks(result: "Fit") -> None:
    for text in result.notes:
        note(text)
    for text in result.flags:
        flag(text)
