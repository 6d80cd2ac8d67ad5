"""Small files that people write: TOML and JSON, read whole, and whatever is wrong with one said in one line."""

import json
import tomllib
from pathlib import Path
from typing import Any

from phytofit.errors import InputError
from phytofit.text import one_line

__all__ = ["read_json", "read_toml", "shortened"]

MOST_BYTES = 4_000_000  # poses of ten thousand views; what is larger is another kind of file
MOST_SAID = 120  # characters of what a file holds that a message shows


def read_toml(path: Path, expected: str) -> dict[str, Any]:
    """What a TOML file holds; InputError, with what was `expected`, if it can't be read as one."""
    text = _text(path, expected)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers of more digits than Python takes
        raise InputError(f"{path}: not a TOML file ({_reason(error)}); expected {expected}") from None


def read_json(path: Path, expected: str) -> Any:
    """What a JSON file holds; InputError, with what was `expected`, if it can't be read as one."""
    text = _text(path, expected)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file ({_reason(error)}); expected {expected}") from None


def shortened(text: object) -> str:
    """What a message shows of a file: one line, and no more than a line."""
    line = one_line(text)
    return line if len(line) <= MOST_SAID else f"{line[:MOST_SAID]}..."


def _text(path: Path, expected: str) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero in it
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: can't be read ({reason}); expected {expected}") from None
    if len(data) > MOST_BYTES:
        raise InputError(f"{path}: more than {MOST_BYTES / 1e6:g} MB; expected {expected}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8 text; expected {expected}") from None


def _reason(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return "brackets within brackets, too deep"
    if "integer string conversion" in str(error):
        return "a number of more than 4300 digits"
    return shortened(error)
