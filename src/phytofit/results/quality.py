"""How far to trust each trait: by the remarks that touch it, and by the width of its interval."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from phytofit.results.remarks import CHECK, GOOD, OF_INTERVALS, POOR, Remark, in_short, remark, worst
from phytofit.traits import Trait

__all__ = ["LIMITS", "graded", "half_width", "of_intervals"]

# Half of an interval, from which on a trait is to be checked, and from which on it is poor: of lengths and areas
# shares of the value, of angles degrees, of curvature degrees per cm.  Chosen by what the numbers are used for:
LIMITS = {
    "cm": (0.10, 0.35),  # hand measures repeat within 2 to 5 %; a third off, a short leaf is a long one
    "cm²": (0.15, 0.50),  # length and width together
    "deg": (8.0, 25.0),  # cultivars differ by some 10 degrees, erect leaves from level ones by 60
    "deg/cm": (0.4, 1.2),  # of a leaf of 50 cm, 20 and 60 degrees from base to tip
}
RELATIVE = ("cm", "cm²")


def half_width(trait: Trait) -> float | None:
    """Half of a trait's interval, from the value to its closed end where it is open, in shares of the value for lengths
    and areas; None without an interval."""
    ends = [abs(end - trait.value) for end in (trait.low, trait.high) if end is not None]
    if not ends:
        return None
    half = sum(ends) / len(ends)
    return half / max(abs(trait.value), 1e-12) if _kind(trait) in RELATIVE else half


def of_intervals(traits: Sequence[Trait]) -> Iterator[Remark]:
    """Remarks on the traits whose intervals are wide, or too wide to be of use."""
    for code, grade in zip(OF_INTERVALS, (CHECK, POOR), strict=True):
        names = [trait.name for trait in traits if _by_width(trait) == grade]
        if names:
            yield remark(code, traits=names, named=", ".join(map(in_short, names)))


def graded(traits: Iterable[Trait], remarks: Sequence[Remark]) -> list[Trait]:
    """The traits, each with its quality and the codes of the remarks that touch it.

    Without an interval nothing speaks for a trait: its quality is empty where no remark touches it.
    """
    marked = []
    for trait in traits:
        mine = [one for one in remarks if trait.name in one.traits]
        at_best = [GOOD] if half_width(trait) is not None else []
        codes = tuple(dict.fromkeys(one.code for one in mine))
        marked.append(replace(trait, quality=worst([*at_best, *(one.grade for one in mine)]), flags=codes))
    return marked


def _by_width(trait: Trait) -> str:
    half = half_width(trait)
    if half is None or _kind(trait) not in LIMITS:
        return ""
    check, poor = LIMITS[_kind(trait)]
    return POOR if half > poor else CHECK if half > check else GOOD


def _kind(trait: Trait) -> str:
    return trait.unit.replace("rel", "cm")
