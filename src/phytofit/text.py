"""Text from outside (file names, metadata, headers) on its way to a terminal, a picture, a table or a file name.

Each of these gives some characters a meaning: a terminal obeys control sequences and rich its markup, matplotlib sets
what stands between dollar signs as mathematics, a spreadsheet runs a cell that begins with ``=``.  What comes from
outside passes the one function for where it goes.
"""

import html
import re

from rich.markup import escape

__all__ = ["for_file_name", "for_page", "for_picture", "for_table", "for_terminal", "from_table", "one_line"]

FORMULA_STARTS = ("=", "+", "-", "@")  # with which a spreadsheet takes a cell for a formula (OWASP, CSV injection)
MOST_NAME_BYTES = 200  # of a file name: most file systems take 255, and parts of files add to it


def one_line(text: object) -> str:
    """The text in one line of visible characters: blanks folded, control characters and bytes that are no text as
    escapes such as ``\\x1b``."""
    folded = " ".join(str(text).split())
    return "".join(c if c.isprintable() else _visible(c) for c in folded)


def for_terminal(text: object) -> str:
    """The text in one line, without markup that rich would act on; a backslash before a bracket or at the end may show
    twice, or not at all."""
    return escape(one_line(text))


def for_picture(text: object) -> str:
    """The text in one line, without mathematics that matplotlib would set."""
    return one_line(text).replace("$", r"\$")


def for_page(text: object) -> str:
    """The text in one line, without markup of a web page."""
    return html.escape(one_line(text))


def for_table(text: object) -> str:
    """The text in one line; an apostrophe in front of what a spreadsheet would run as a formula."""
    line = one_line(text)
    return f"'{line}" if line.startswith(FORMULA_STARTS) else line


def from_table(cell: object) -> str:
    """What :func:`for_table` put into a cell, without its apostrophe."""
    text = str(cell)
    return text[1:] if text.startswith("'") and text[1:].startswith(FORMULA_STARTS) else text


def for_file_name(text: object) -> str:
    """A name that a file or folder can bear on any system: one part, not hidden, no option, at most `MOST_NAME_BYTES`;
    ``_`` where it can't keep a character, ``cloud`` where nothing is left."""
    line = re.sub(r'[\\/:*?"<>|]', "_", one_line(text)).strip(" .").lstrip("-")
    line = line.encode()[:MOST_NAME_BYTES].decode(errors="ignore")
    return line.strip(" .") or "cloud"


def _visible(character: str) -> str:
    return character.encode("ascii", "backslashreplace").decode() if ord(character) > 127 else repr(character)[1:-1]
