"""Numbers as text: the spellings that occur in files of points, and no others."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phytofit.cloud.table import FileError, quoted

__all__ = ["MISSING", "NUMBER", "is_number", "numbers", "plain_numbers"]

NUMBER = re.compile(r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?", re.ASCII)
MISSING = frozenset(
    (
        *("", "-", "--", "---", ".", "na", "n/a", "<na>", "none", "null", "(null)", "nil", "undefined"),
        *("#n/a", "#nv", "#num!", "#div/0!", "#value!"),
    )
)
"""Words that stand for no number, in lower case."""
NOT_FINITE = re.compile(r"[-+]?(?:[qs]?nan(?:\(\w*\))?|inf(?:inity)?|∞|1[.,]#[a-z]+\d*)|\*+", re.IGNORECASE)
DOUBLE = re.compile(r"(?<=[\d.])D(?=[-+]\d)")  # 1.5D+00
# 1.#QNAN and nan(ind) of compilers, and the stars of a number that was too wide for its place
NAN_OF_OTHERS = re.compile(r"[-+]?(?:\bnan\(\w*\)|\b[qs]?nan\b|∞|\b1[.,]#[a-z]+\d*)|\*{2,}", re.IGNORECASE)


def is_number(word: str) -> bool:
    """Whether a word is a number, or a spelling of one that is not finite."""
    return bool(NUMBER.fullmatch(word) or NOT_FINITE.fullmatch(word))


def plain_numbers(text: str) -> str:
    """The text with ``nan`` for the spellings of it that not every reader knows, and with E for Fortran's D."""
    if "D" in text:
        text = DOUBLE.sub("E", text)
    return NAN_OF_OTHERS.sub("nan", text) if any(sign in text for sign in "nN#*∞") else text  # most have none


def numbers(words: Sequence[bytes]) -> NDArray[np.float64]:
    """The words as numbers, NaN for what is missing or not finite; FileError for any other word."""
    try:
        if not any(b"_" in word for word in words):  # which Python takes for a separator of thousands
            return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError:
        pass
    return np.array([_number(word.decode("utf-8", "replace")) for word in words])


def _number(word: str) -> float:
    if NUMBER.fullmatch(word):
        return float(word.replace(",", "."))
    if NOT_FINITE.fullmatch(word) or word.lower() in MISSING:
        return np.nan
    raise FileError(f"found {quoted(word)}, expected a number; edited, or damaged?")
