"""How far to trust each trait: by the remarks that touch it, and by the width of its interval."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from phytofit.results.remarks import CHECK, GOOD, OF_INTERVALS, POOR, Remark, in_short, remark, worst
from phytofit.traits import Trait

__all__ = ["LIMITS", "graded", "half_width", "of_intervals"]

# Half of an interval, from which on a trait is to be checked, and from which on it is poor: of lengths and areas shares
# of the value, of angles degrees, of curvature degrees per cm.  Chosen by what the numbers are used for:
ALONG = (0.08, 0.30)  # a tape along the midrib repeats within 2 to 5 %; a third off, a short leaf is a long one
ACROSS = (0.20, 0.40)  # widths of a blade differ by a fifth from fold to fold and from hand to hand
AREA = (0.20, 0.50)  # length and width together
ANGLE = (15.0, 35.0)  # deg; cultivars differ by 10 to 20, erect leaves from level ones by 60
TURNING = (0.6, 1.5)  # deg/cm; of a leaf of 50 cm, 30 and 75 degrees from base to tip
LIMITS = {
    "leaf_length": ALONG,
    "stem_length": ALONG,
    "leaf_width": ACROSS,
    "stem_diameter": ACROSS,
    "leaf_area": AREA,
    "leaf_angle": ANGLE,
    "leaf_insertion_angle": ANGLE,
    "leaf_curvature": TURNING,
}
RELATIVE = ("cm", "cm²", "rel", "rel²")


def half_width(trait: Trait) -> float | None:
    """Half of a trait's interval, from the value to its closed end where it is open, in shares of the value for lengths
    and areas; None without an interval."""
    ends = [abs(end - trait.value) for end in (trait.low, trait.high) if end is not None]
    if not ends:
        return None
    half = sum(ends) / len(ends)
    return half / max(abs(trait.value), 1e-12) if trait.unit in RELATIVE else half


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
    if half is None or trait.name not in LIMITS:
        return ""
    check, poor = LIMITS[trait.name]
    return POOR if half > poor else CHECK if half > check else GOOD
