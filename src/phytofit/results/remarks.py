"""Remarks on results: what was noticed, which traits it touches, how far to trust these, and what to do about it.

`KINDS` is the one table of them; docs/remarks.md is written from it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

__all__ = [
    "CHECK",
    "GOOD",
    "KINDS",
    "NOTE",
    "OF_INTERVALS",
    "POOR",
    "Kind",
    "Placed",
    "Remark",
    "grouped",
    "in_short",
    "of_codes",
    "remark",
    "worst",
]

GOOD, CHECK, POOR = "good", "check", "poor"  # how far to trust a trait
NOTE = "note"  # the grade of a remark that touches no trait
OF_INTERVALS = ("interval_wide", "interval_useless")
ORDER = (POOR, CHECK, GOOD, NOTE)  # the worst first

STEM = ("stem_diameter", "stem_length")
ANGLES = ("leaf_angle", "leaf_insertion_angle")
WIDTHS = ("leaf_width", "leaf_area")
LENGTHS = ("leaf_length", "leaf_area")
LEAF = ("leaf_length", *ANGLES, "leaf_width", "leaf_curvature", "leaf_area")


@dataclass(frozen=True)
class Remark:
    """Something that was noticed about a result.

    ``code`` is its name in tables, ``traits`` those that it touches, ``grade`` the best quality ("check" or "poor")
    that these can have, or "note" where it touches none; ``text`` says what was noticed, ``remedy`` what to do.
    """

    code: str
    traits: tuple[str, ...]
    grade: str
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.text}. {self.remedy}".removesuffix(". ")


class Placed(NamedTuple):
    """A remark on one leaf: the number of its plant and its rank, 0 where there is but one."""

    remark: Remark
    plant: int = 0
    rank: int = 0


@dataclass(frozen=True)
class Kind:
    """What all remarks of one code share: the traits that they touch, unless a remark names its own; the grade; the
    text, with {places} for what differs; what to do; when such a remark is made; and the text without what differs, by
    which several are said at once."""

    traits: tuple[str, ...]
    grade: str
    text: str
    remedy: str
    when: str
    general: str = ""


KINDS = {
    # the leaf's tip
    "tip_unseen": Kind(
        LENGTHS,
        CHECK,
        "the leaf's tip is missing: the leaf may be longer",
        "Scan the tip",
        "The leaf is still wide where its points end, and a longer leaf explains them clearly better. The "
        "intervals of length and area have no upper end.",
    ),
    "tip_doubtful": Kind(
        LENGTHS,
        CHECK,
        "the leaf's tip may be missing: the leaf may be longer",
        "Look at the tip in fit.png",
        "A leaf that goes on explains the points better, but not clearly. The intervals of length and area have no "
        "upper end.",
    ),
    "tip_blunt": Kind(
        LENGTHS,
        CHECK,
        "the leaf ends bluntly, as if its tip were cut off: length and area are those of the part that was seen",
        "Look at the tip in fit.png",
        "The leaf is still wide where its points end, but its shape says little about what is missing.",
    ),
    "tip_cut_back": Kind(
        LENGTHS,
        CHECK,
        "no points on the last {share} of the fitted leaf, where {n} are expected: the leaf ends where the points do",
        "Look at the tip in fit.png",
        "The model's leaf goes on where there is no point. The trait `leaf_length` is cut back, the parameter of that "
        "name in `fit.json` is not.",
        "no points on the last part of the fitted leaf: the leaf ends where the points do",
    ),
    "tip_exceeded": Kind(
        LENGTHS,
        CHECK,
        "{n} points lie beyond the fitted tip: the leaf may be longer",
        "Look at the tip in fit.png",
        "More points lie beyond the tip than stray points explain: it bends away sharply, or something touches it. The "
        "intervals of length and area have no upper end.",
        "points lie beyond the fitted tip: the leaf may be longer",
    ),
    # the leaf
    "leaf_mostly_unseen": Kind(
        LEAF,
        CHECK,
        "only {share} of the leaf was seen: the rest comes from the model",
        "Scan from more sides",
        "Less than half of the leaf's area has points.",
        "less than half of the leaf was seen: the rest comes from the model",
    ),
    "width_holes": Kind(
        WIDTHS,
        CHECK,
        "{share} of the blade has almost no points: leaf width and area come from the rest",
        "Scan from more sides",
        "A tenth of the blade or more has no points, where other parts have many.",
        "parts of the blade have almost no points: leaf width and area come from the rest",
    ),
    "leaf_edge_on": Kind(
        WIDTHS,
        CHECK,
        "the leaf is hardly wider than its points scatter, as if seen edge-on",
        "Scan across the blade",
        "Half the leaf's width is less than one and a half times the noise.",
    ),
    "leaf_few_points": Kind(
        LEAF,
        CHECK,
        "only {n} points on the leaf: its length tends to come out too short",
        "Scan more densely",
        "The leaf needs the richer model but has fewer than 200 points.",
        "few points on the leaf: its length tends to come out too short",
    ),
    "base_hidden": Kind(
        ANGLES,
        CHECK,
        "the leaf's base is hidden: its angles follow from the rest of the leaf",
        "Scan the base",
        "The leaf's first tenth has hardly any points, or neither stem nor leaf was seen where it starts.",
    ),
    "hugs_stem": Kind(
        ("leaf_length",),
        CHECK,
        "the leaf hugs its stem: its length counts from where it leaves the stem, and may be {length} more",
        "Look at the leaf's base in fit.png",
        "The midrib starts so near the stem's surface that it may be just inside or just outside.",
        "the leaf hugs its stem: its length counts from where it leaves the stem, and may be more",
    ),
    # the stem
    "stem_few_points": Kind(
        ("stem_diameter", "leaf_angle"),
        CHECK,
        "only {n} points on the stem",
        "Keep a longer piece of stem",
        "Fewer than 60 points are on the stem.",
        "few points on the stem",
    ),
    "stem_one_sided": Kind(
        ("stem_diameter",),
        CHECK,
        "the stem was seen from one side ({angle} of its circumference)",
        "Scan from more sides",
        "Less than seven tenths of the stem's circumference has points.",
        "the stem was seen from one side",
    ),
    "stem_filled": Kind(
        ("stem_diameter",),
        CHECK,
        "the stem's points scatter by half its radius or more: if its section is filled with points, it is thicker",
        "Look at the stem in fit.png",
        "With this much noise, a hollow and a filled stem look alike. A filled one comes out too thin.",
    ),
    "stem_ends_elsewhere": Kind(
        ("stem_length", *ANGLES),
        CHECK,
        "the stem goes on {above} above the leaf and {below} below it: stem_above={better!r} may fit better than "
        "{how!r}",
        "Fit again with it",
        "`--stem-above` states that the stem ends at the leaf, or is as long above it as below. In this cloud it is "
        "not so.",
    ),
    # the whole
    "two_fits": Kind(
        (),
        CHECK,
        "two fits are about equally probable: {others}",
        "Look at fit.png: the interval is that of both",
        "Two models explain the points about equally well, and the second one's values lie beyond the intervals that "
        "the first would have by itself. The intervals that are given are those of both. Touches the traits that it "
        "names.",
        "two fits are about equally probable",
    ),
    "not_converged": Kind(
        (*STEM, *LEAF),
        CHECK,
        "the fit did not converge",
        "Look at fit.png, or try another seed",
        "The refinement stopped before it converged.",
    ),
    "search_split": Kind(
        (*STEM, *LEAF),
        CHECK,
        "the search did not converge: its last best candidates differ",
        "Use more generations or samples, or another seed",
        "With `--method paper`: the best candidates lie in separate optima; their mean fits worse than they do.",
    ),
    "points_unexplained": Kind(
        (*STEM, *LEAF),
        CHECK,
        "the model does not explain {share} of the points: another leaf or clutter may be in the cloud",
        "Look at fit.png and cut the cloud more cleanly",
        "A tenth of the points or more are outliers.",
        "the model does not explain many of the points: another leaf or clutter may be in the cloud",
    ),
    "other_surfaces": Kind(
        (*STEM, *LEAF),
        POOR,
        "{share} of the points lie on surfaces that are neither the fitted stem nor the fitted leaf",
        "Cut the other leaves away",
        "With `--seed-point` or labels: other leaves remain, or the fitted one runs beside its own points.",
    ),
    "others_touch": Kind(
        ("leaf_angle", *WIDTHS, "stem_diameter"),
        CHECK,
        "other leaves touch this one or its stem",
        "Cut them away",
        "With `--seed-point`: what was left out comes within 2 cm of the leaf, or within 3 cm of the stem near where "
        "the leaf leaves it.",
    ),
    "much_noise": Kind(
        (),
        CHECK,
        "the points scatter by {scatter} around the {organ}, far more than expected",
        "Check the unit, and the fit in fit.png",
        "More than 1 cm of noise on the stem or the leaf. Touches the traits of that organ.",
        "the points scatter far more than expected",
    ),
    "at_limit": Kind(
        (),
        POOR,
        "{parameter} is at the limit of the species, {value}",
        "Check the unit, or widen the limit in a species file",
        "The species' bound stopped the search. Touches the traits that follow from the parameter.",
        "a parameter is at the limit of the species",
    ),
    "shape_at_limit": Kind(
        LEAF,
        CHECK,
        "{parameter} is at the limit of the species, {value}",
        "See in fit.png whether this is one leaf, or widen the limit in a species file",
        "The leaf twists, rolls or bends as far as the species allows: points of something else may be in the fit.",
        "the leaf's shape is at the limit of the species",
    ),
    "unusual": Kind(
        (),
        POOR,
        "{parameter} of {value} is unusual for the species",
        "Check the unit, and in fit.png whether this is one leaf on its stem",
        "A parameter lies more than four standard deviations from the species' mean. Touches the traits that follow "
        "from it.",
        "a parameter is unusual for the species",
    ),
    "up_unknown": Kind(
        ANGLES,
        CHECK,
        "this leaf does not show which way is up: its angles may be 180° minus these values",
        "State up if it is known",
        "The leaf's shape is plausible either way up.",
    ),
    "up_doubtful": Kind(
        ANGLES,
        CHECK,
        "with the stated up, the leaf points down or bends upwards",
        "Check which way is up",
        "With the `--up` that was given, the leaf is much less plausible than upside down. If it is right, the leaf is "
        "unusual.",
    ),
    # the intervals
    "interval_wide": Kind(
        (),
        CHECK,
        "wide intervals: {named}",
        "Use them with their intervals",
        "The cloud says little about these traits. Their intervals are wide, but not necessarily wrong.",
        "some intervals are wide: see the column quality of the tables",
    ),
    "interval_useless": Kind(
        (),
        POOR,
        "intervals too wide to be of use: {named}",
        "Scan more densely, or from more sides",
        "The cloud says next to nothing about these traits.",
        "some intervals are too wide to be of use: see the column quality of the tables",
    ),
    # of whole plants
    "not_fitted": Kind(
        ("leaf_length",),
        CHECK,
        "not fitted: {reason}",
        "Look at its points in segmentation.png",
        "The leaf could not be fitted. Its length is read along its points, without an interval.",
    ),
    "rank_uncertain": Kind(
        ("collar_height", "collar_distance", "divergence_angle"),
        CHECK,
        "the collar is next to another leaf's: their ranks may be swapped",
        "Look at plant.png",
        "Two leaves leave the stem at nearly the same height.",
    ),
    "leaf_doubtful": Kind(
        (*LEAF, "collar_height", "collar_distance", "divergence_angle", "leaf_azimuth"),
        CHECK,
        "few points: this may not be a leaf",
        "Look at plant.png",
        "It has fewer points than a leaf usually has.",
    ),
    "views": Kind(
        (),
        NOTE,
        "{said}",
        "",
        "The views of a reconstruction do not fit each other, or do not show all of the plant. The text says what to "
        "do.",
    ),
}


def remark(code: str, *, traits: Sequence[str] | None = None, **values: object) -> Remark:
    """A remark of a kind, with its `values` in the text; on these `traits` where not on those of its kind."""
    kind = KINDS[code]
    return Remark(code, kind.traits if traits is None else tuple(traits), kind.grade, kind.text.format(**values),
                  kind.remedy)  # fmt: skip


def of_codes(codes: Iterable[str]) -> tuple[Remark, ...]:
    """The remarks that some codes stand for; none for what another version called by another code."""
    return tuple(remark(code) for code in codes if code in KINDS)


def in_short(code: str) -> str:
    """A code as a few words."""
    return code.replace("_", " ")


def worst(grades: Iterable[str]) -> str:
    """The worst of some qualities; empty of none."""
    return min(grades, key=ORDER.index, default="")


def grouped(placed: Iterable[Placed]) -> list[tuple[str, str]]:
    """Grade and line of each remark, the worst first, said once for all the leaves to which it applies."""
    found: dict[tuple[str, str], dict[str, list[tuple[int, int]]]] = {}
    for one, *place in placed:
        found.setdefault((one.grade, one.code), {}).setdefault(str(one), []).append((place[0], place[1]))
    lines = []
    for (grade, code), said in sorted(found.items(), key=lambda item: ORDER.index(item[0][0])):
        kind = KINDS.get(code)
        if len(said) > 1 and kind is not None and kind.general:
            places = [place for each in said.values() for place in each]
            lines.append((grade, f"{_named(places)}{Remark(code, (), grade, kind.general, kind.remedy)} ({code})"))
        else:
            lines += [(grade, f"{_named(places)}{text} ({code})") for text, places in said.items()]
    return lines


def _named(places: Iterable[tuple[int, int]]) -> str:
    """Of which plants and leaves a line is, with a colon; nothing where there is but one."""
    ranks: dict[int, list[int]] = {}
    for plant, rank in dict.fromkeys(places):
        ranks.setdefault(plant, []).append(rank)
    named = []
    for plant, leaves in ranks.items():
        parts = [f"plant {plant}"] if plant else []
        numbers = [str(rank) for rank in sorted(leaves) if rank]
        parts += [f"{'leaf' if len(numbers) == 1 else 'leaves'} {', '.join(numbers)}"] if numbers else []
        named.append(" ".join(parts))
    whole = "; ".join(filter(None, named))
    return f"{whole}: " if whole else ""
