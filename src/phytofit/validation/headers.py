"""What the columns of hand measures mean, by their names: the trait, its unit, the cloud, the leaf."""

import math
import re
import unicodedata
from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["CLOUD_NAMES", "ColumnError", "Measured", "cloud_column", "is_rank", "measured", "trait_name", "unit_named"]

CLOUD_NAMES = (
    *("cloud", "name", "id", "plant", "sample", "scan", "file", "specimen", "individual", "pot", "plot"),
    *("leaf", "phytomer"),
)
OF_A_NAME = ("id", "name", "no", "nr", "number", "code", "label")  # words that may stand beside these
OF_A_RANK = (*OF_A_NAME[2:5], "rank", "position", "index")

# Words that mean the same, and what they are called here.
SAME = {
    **dict.fromkeys(("blade", "lamina", "leaves"), "leaf"),
    **dict.fromkeys(("stalk", "culm", "internode"), "stem"),
    **{"len": "length", "breadth": "width", "diam": "diameter", "dia": "diameter", "inclination": "angle"},
}
LENGTHS = {  # cm in one, and what else it is called
    "um": (1e-4, "µm micrometre micrometer"),
    "mm": (0.1, "millimetre millimeter"),
    "cm": (1.0, "centimetre centimeter"),
    "dm": (10.0, "decimetre decimeter"),
    "m": (100.0, "metre meter"),
    "in": (2.54, "inch inches"),
    "ft": (30.48, "foot feet"),
}
SHORT = {word: unit for unit, (_, others) in LENGTHS.items() for word in (unit, *others.split())}
FACTORS = {  # of units as they are written: factor, and the unit that results have
    **{word: (LENGTHS[unit][0], "cm") for word, unit in SHORT.items()},
    **{f"{unit}2": (factor**2, "cm²") for unit, (factor, _) in LENGTHS.items()},
    **dict.fromkeys(("deg", "degree", "°"), (1.0, "deg")),
    **dict.fromkeys(("rad", "radian"), (180.0 / math.pi, "deg")),
    **dict.fromkeys(("gon", "gradian"), (0.9, "deg")),
    **dict.fromkeys(("deg/cm", "°/cm"), (1.0, "deg/cm")),
    **{"rel": (1.0, "rel"), "rel2": (1.0, "rel²"), "deg/rel": (1.0, "deg/rel")},
}
PLURALS = {f"{word}s": word for word in FACTORS if len(word) > 2 and word.isalpha()}
WORD = re.compile(r"(?:deg|°)/(?:cm|rel)\b|°|\b(?:" + "|".join((*LENGTHS, "rel")) + r")2(?!\d)|[^\W\d_]+|\d+")
BRACKETS = re.compile(r"[(\[{<]([^()\[\]{}<>]*)[)\]}>]")
AMBIGUOUS = ("in", "m")  # a preposition, an initial: units only where nothing else is one
UNITLESS = ("deg", "1")  # what may go without a unit


class _Way(NamedTuple):
    """Words that mean a trait if all are there; ``alone`` if no words may be there that are not known."""

    trait: str
    kind: str
    words: frozenset[str]
    alone: bool


def _set(*lines: str) -> frozenset[str]:
    return frozenset(word for line in lines for word in line.split())


def _way(trait: str, kind: str, words: str, *, alone: bool = False) -> _Way:
    return _Way(trait, kind, _set(words), alone)


WAYS = (  # the first of the longest that fits counts
    _way("leaf_insertion_angle", "deg", "insertion angle"),
    _way("divergence_angle", "deg", "divergence angle"),
    _way("leaf_azimuth", "deg", "leaf azimuth"),
    _way("collar_height", "cm", "collar height"),
    _way("collar_distance", "cm", "collar distance"),
    _way("plant_height", "cm", "plant height"),
    _way("leaf_count", "1", "leaf count"),
    _way("leaf_angle", "deg", "leaf angle"),
    _way("leaf_length", "cm", "leaf length"),
    _way("leaf_width", "cm", "leaf width"),
    _way("leaf_area", "cm²", "leaf area"),
    _way("leaf_curvature", "deg/cm", "leaf curvature"),
    _way("stem_length", "cm", "stem length"),
    _way("stem_diameter", "cm", "stem diameter"),
    _way("stem_diameter", "cm", "stem width"),
    _way("leaf_angle", "deg", "angle", alone=True),
    _way("leaf_length", "cm", "length", alone=True),
    _way("leaf_width", "cm", "width", alone=True),
    _way("leaf_area", "cm²", "area", alone=True),
    _way("leaf_curvature", "deg/cm", "curvature", alone=True),
    _way("stem_diameter", "cm", "diameter", alone=True),
    _way("plant_height", "cm", "height", alone=True),
)
KIND_OF = {way.trait: way.kind for way in WAYS}
QUANTITIES = _set("length width angle area diameter curvature height distance azimuth count")
SAYS_HOW = _set(  # a trait was measured; which it is does not change
    "mean average avg max maximum total measured measure measurement measurements manual manually hand ruler tape",
    "caliper calliper protractor by with observer obs operator person rep replicate repeat repetition in of the an at",
    "true truth ground reference ref final value",
)
OTHER_NUMBERS = _set(  # about a trait, not its value
    "sd std stdev se sem error err var variance cv ci min minimum n range ratio index percent rate relative increase",
    "change growth difference diff predicted prediction estimated estimate fitted fit model phytofit software upper",
    "lower low high confidence log sqrt quality flag flags note notes comment remark remarks date time",
)
OTHER_PARTS = _set(
    "sheath petiole ligule auricle root roots panicle tassel ear cob spike awn tiller canopy pod seed shoot branch",
    "leaflet flower fruit node hypocotyl cotyledon coleoptile",
)
OTHER_FRAMES = _set("horizontal horizontally horizon elevation")  # from which an angle is counted; ours from the stem
OTHER_PLACES = _set("tip base apex neck")  # of a leaf, whose traits are of all of it


class ColumnError(ValueError):
    """A column's name can be read in several ways, or in none; the text says which, without the file's name."""


class Measured(NamedTuple):
    """What a column holds: a trait, in ``factor`` times the unit of results; no factor where no unit is named."""

    trait: str
    unit: str
    factor: float | None
    ignored: str = ""  # why the column is not read


def cloud_column(names: Sequence[str]) -> list[int]:
    """The columns that may name the cloud, the likeliest first."""
    ranked = []
    for i, name in enumerate(names):
        words = _words(name)
        kept = [w for w in words if w not in OF_A_NAME] or words[:1]
        kept = kept[1:] if kept[:1] == ["point"] else kept
        if len(kept) == 1 and kept[0] in CLOUD_NAMES:
            ranked.append((CLOUD_NAMES.index(kept[0]), len(words), i))
    return [i for *_, i in sorted(ranked)]


def is_rank(name: str) -> bool:
    """Whether a column says which leaf, counted from the base."""
    words = _words(name)
    return words == ["rank"] or (words[:1] == ["leaf"] and all(w in OF_A_RANK for w in words[1:]))


def measured(name: str) -> Measured | None:
    """What a column of this name holds; None if no trait.

    Raises ColumnError if the name means several traits, or has several units.
    """
    outside, *inside = _phrases(name)
    words = {SAME.get(w, w) for phrase in (outside, *inside) for w in phrase if w not in FACTORS}
    if {"number", "of", "leaf"} <= words:
        words |= {"count"}
    quantities = sorted(words.intersection(SAME.get(w, w) for w in outside) & QUANTITIES) or sorted(words & QUANTITIES)
    if not quantities:
        is_length = any(len(phrase) == 1 and phrase[0] in FACTORS for phrase in inside)
        return Measured("", "", None, "its name says no trait that is measured") if is_length else None
    way = next((way for way in WAYS if way.words <= words), None)
    strange = _strange(words, outside, way)
    if strange or way is None:
        return Measured("", "", None, strange or "no such trait is measured")
    if len(quantities) > 1:
        raise ColumnError(f"column {name!r} names {' and '.join(quantities)}; expected one trait in each column")
    written = _unit_of(name, way)
    factor, unit = FACTORS[written] if written else (None, way.kind)
    return Measured(way.trait, unit, factor)


def trait_name(text: str) -> str:
    """The name that results have for a trait, where it is one of these; else its words."""
    words = _words(text)
    if (plain := "_".join(words)) in KIND_OF:
        return plain
    found = {SAME.get(w, w) for w in words}
    return next((way.trait for way in WAYS if way.words == found), plain)


def unit_named(text: str) -> tuple[float, str] | None:
    """Factor and unit, as results have it, of a unit that stands alone; None if it is none."""
    words = _words(text)
    if words == ["1"]:
        return 1.0, "1"
    return FACTORS.get(words[0]) if len(words) == 1 else None


def _strange(words: set[str], outside: Sequence[str], way: _Way | None) -> str:
    """Why a column is not read, where its words may mean something else than a trait; else empty."""
    other = words & (OTHER_NUMBERS | OTHER_PARTS)
    if way is not None and way.trait.startswith("leaf"):
        other |= words & OTHER_FRAMES if way.kind == "deg" else set()
        other |= (OTHER_PLACES & set(outside) if "to" not in outside else set()) | (words & {"plant"})
    if way is not None and way.alone:  # what else there is says of what organ it is
        other |= {w for w in words - way.words - SAYS_HOW if len(w) > 1 and not w.isdigit()}
    return f"{' and '.join(repr(w) for w in sorted(other))} may say that it is no {_called(way)}" if other else ""


def _called(way: _Way | None) -> str:
    return "trait" if way is None else way.trait.replace("_", " ")


def _unit_of(name: str, way: _Way) -> str:
    """The unit as it was written, empty where there is none.

    In brackets, or wherever a word is one.  Where words compete, those lose that may be something else: ``in``, ``m``,
    and what a number stands before, as in 'at 8 cm'.
    """
    strong: list[str] = []
    weak: list[str] = []
    for phrase in _phrases(name):
        for before, word, after in zip(["", *phrase], phrase, [*phrase[1:], ""], strict=False):
            if word not in FACTORS or (word == "in" and after):
                continue
            doubtful = before.isdigit() or (word in AMBIGUOUS and len(phrase) > 1)
            (weak if doubtful else strong).append(word)
    found = strong or weak
    for phrase in [] if strong else _phrases(name)[1:]:
        if len(phrase) > 1 and phrase[-1] in FACTORS and phrase[-2].isdigit():
            raise ColumnError(f"column {name!r} has a number before its unit; write it as in {_example(way)!r}")
    fitting = [word for word in dict.fromkeys(found) if FACTORS[word][1] in (way.kind, way.kind.replace("cm", "rel"))]
    if found and not fitting:
        raise ColumnError(f"column {name!r}: {found[0]!r} is no unit of {way.trait}; write it as in {_example(way)!r}")
    if len({FACTORS[word] for word in fitting}) > 1:
        raise ColumnError(
            f"column {name!r} names several units, {' and '.join(fitting)}; keep one, as in {_example(way)!r}"
        )
    if not found:
        for phrase in _phrases(name)[1:]:
            if len(phrase) == 1 and len(phrase[0]) > 1 and not phrase[0].isdigit() and phrase[0] not in SAYS_HOW:
                raise ColumnError(f"column {name!r}: {phrase[0]!r} is no unit known; write it as in {_example(way)!r}")
    return fitting[0] if fitting else ""


def _example(way: _Way) -> str:
    return f"{way.trait}_{way.kind}".replace("²", "2").replace("/", " per ")


def _phrases(name: str) -> list[list[str]]:
    """Lower-case words of a name, units among them as `FACTORS` has them: first those outside brackets, then those of
    each bracket."""
    text = unicodedata.normalize("NFKC", re.sub("[º˚]", "°", name))  # ordinals and rings that look like degrees
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text).casefold()
    text = text.replace("μ", "µ").replace("_", " ").replace("%", " percent ")
    text = re.sub(r"(?:\^|\*\*)\s*2\b", "2", text)
    text = re.sub(r"\b(?:square|sq)[ .]*([a-zµ]+)", lambda found: _squared(found[1]), text)
    inside = re.findall(BRACKETS, text)
    return [[PLURALS.get(w, w) for w in re.findall(WORD, part)] for part in (re.sub(BRACKETS, " ", text), *inside)]


def _squared(word: str) -> str:
    word = PLURALS.get(word, word)
    return f"{SHORT[word]}2" if word in SHORT else word


def _words(name: str) -> list[str]:
    return [word for phrase in _phrases(name) for word in phrase]
