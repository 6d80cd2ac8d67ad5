"""Writes docs/remarks.md from the table of remarks: python docs/remarks.py"""

import re
from collections.abc import Iterator
from pathlib import Path

from phytofit.results.quality import LIMITS
from phytofit.results.remarks import KINDS, NOTE, Kind, in_short

PAGE = Path(__file__).with_name("remarks.md")
INTRODUCTION = """# Quality and remarks

Each trait has a *quality*, in the table's column `quality`, on the screen, on `fit.png` and on `plant.png`:

| quality | mark | what to do |
|---|---|---|
| `good` | ● | use it |
| `check` | ▲ | look at the picture; use it with its interval |
| `poor` | ✖ | do not use it |
| empty | | nothing is known: there is no interval, as with `--method paper`, or from the segmentation |

A trait's quality is the worst grade given by its interval or by any remark on it. The column `flags` has the codes
of these remarks, with `;` between them. In R or pandas, filter on `quality`.
The screen, `fit.json` and the pictures give each remark in full, with its remedy.

A good trait can still be wrong: look at the picture.
[How accurate, how robust, how fast](accuracy.md#quality) gives the errors at each quality.

## Intervals

A trait is `check` or `poor` if half the width of its interval exceeds these limits. If one end is open, the distance
to the other end counts.

| trait | `check` | `poor` |
|---|---|---|
"""
UNITS = {"leaf_angle": "deg", "leaf_insertion_angle": "deg", "leaf_curvature": "deg/cm"}  # of the others, the value


def page() -> str:
    """All of docs/remarks.md."""
    limits = "".join(
        f"| {in_short(name)} | {' | '.join(_limit(name, x) for x in ends)} |\n" for name, ends in LIMITS.items()
    )
    return INTRODUCTION + limits + "".join(line for code, kind in KINDS.items() for line in _section(code, kind))


def _limit(trait: str, value: float) -> str:
    return f"{value:g} {UNITS[trait]}" if trait in UNITS else f"{100.0 * value:g} % of the value"


def _section(code: str, kind: Kind) -> Iterator[str]:
    text = re.sub(r"\{[^}]*\}", "…", kind.text)
    yield f"\n## {code}\n\n*{text}.*\n\n{kind.when}\n\n"
    if kind.grade != NOTE:
        touched = ", ".join(map(in_short, kind.traits)) or "the traits that it names"
        yield f"- Makes `{kind.grade}`: {touched}\n"
    if kind.remedy:
        yield f"- What to do: {kind.remedy[:1].lower()}{kind.remedy[1:]}.\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
