"""What is wrong, in one line, as a user of the command line needs it said: with the names of options.

The library names Python's arguments, or the thing itself; here, and only here, they become options.
"""

import re
import unicodedata
from difflib import get_close_matches
from typing import Any

import typer

from phytofit.text import one_line

__all__ = ["at_command_line", "in_ascii", "meant", "of_usage"]

ARGUMENTS = {  # with which a message of the library may begin, and the option that sets it
    "n_samples": "samples",
    "n_points": "points",
    "n_generations": "generations",
    "noise_cm": "noise",
    "noise_reach_cm": "noise-reach",
    "n_views": "views",
    "n_spheres": "spheres",
    "sphere_diameter_cm": "sphere-diameter",
    "outlier_share": "outliers",
    "step_deg": "step",
    "spacing_cm": "spacing",
    "unit": "depth-unit",
    **{
        name: name for name in ("camera", "distance", "generations", "labels", "method", "noise", "outliers", "pattern")
    },
    **{name: name for name in ("points", "poses", "samples", "seed", "spacing", "species", "spheres", "step")},
    **{name: name for name in ("threads", "units", "up", "views")},
    **{name: name.replace(" ", "-") for name in ("noise reach", "sphere diameter")},
    **{name: name.replace("_", "-") for name in ("seed_point", "stem_above", "random_start")},
}
ASCII = {"–": "-", "−": "-", "×": "x", "°": " deg"}
ADVICE = {  # of the library, and the option that follows it
    r"\bchoose another folder\b": "--out",
    r"\bneeds its camera\b": "--camera",
    r"\bname the right camera\b": "--camera",
    r"\bstate its unit\b": "--units",
    r"\bstate the unit of depths\b": "--depth-unit",
    r"\b[Ss]tate up\b": "--up",
    r"\bname the property\b": "--labels",
    r"\bgive a seed point\b": "--seed-point",
}


def at_command_line(said: object) -> str:
    """What the library says, with the names of options."""
    text = str(said)
    beginning = re.match(r"(\w+(?: \w+)?)(?=:| -?[\d.]+:)", text)
    if beginning and beginning[1] in ARGUMENTS:
        text = f"--{ARGUMENTS[beginning[1]]}{text[beginning.end() :]}"
    for advice, option in ADVICE.items():
        text = re.sub(advice, rf"\g<0> ({option})", text)
    text = re.sub(r"\bstem_above='(\w+)'", r"--stem-above \1", text)
    return text.replace("phytofit.run", "phytofit run")


def of_usage(error: typer.TyperException) -> str:
    """What is wrong with the arguments, what may have been meant, and where to read on."""
    text = error.format_message().rstrip(".")
    found: list[Any] = getattr(error.__cause__, "errors", list)()
    if found:  # by pydantic, of a value that is no number
        wanted = "a whole number" if found[0]["type"].startswith("int") else "a number"
        text = f"{text.partition(': ')[0]}: expected {wanted}, got {one_line(found[0]['input'])!r}"
    if possible := getattr(error, "possibilities", None):  # the nearest comes first
        text = f"{error.message}; did you mean {possible[0]}?"
    text = re.sub(r"\. Did you mean '(.*)'\?$", r"; did you mean \1?", text)
    text = f"{text[:1].lower()}{text[1:]}"
    context = getattr(error, "ctx", None)
    if context is None:
        return text
    command = " ".join(["phytofit", *context.command_path.split()[1:]])
    return f"{text}{'' if text.endswith('?') else ';'} see {command} --help"


def in_ascii(error: UnicodeError) -> tuple[str, int]:
    """What a terminal without such characters shows: an error handler for :func:`codecs.register_error`."""
    assert isinstance(error, UnicodeEncodeError)
    shown = []
    for character in error.object[error.start : error.end]:
        plain = ASCII.get(character) or unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
        shown.append(plain or character.encode("ascii", "backslashreplace").decode())
    return "".join(shown), error.end


def meant(given: str, names: list[str]) -> str:
    """``; did you mean NAME?``, or nothing where no name is near."""
    near = get_close_matches(given.lower(), names, n=1)
    return f"; did you mean {near[0]}?" if near else ""
