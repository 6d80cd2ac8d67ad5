"""What is remarkable about a fit by the default method; and what is no phytomer, and refused."""

from collections.abc import Iterator
from dataclasses import replace

from phytofit.engine.sighting import OFFSET, Sighting
from phytofit.errors import ONE_LEAF_ONLY, NoPhytomerError
from phytofit.results.fit import Fit
from phytofit.results.remarks import LEAF, STEM, Remark, remark

__all__ = ["IMPLAUSIBLE", "MUCH_ELSEWHERE", "beside_its_rival", "reviewed"]

LEAST_ON_STEM = 10.0  # points; with fewer it is no stem
THIN = 2.0  # spreads of the prior, by which a stem is thinner than expected
MUCH_ELSEWHERE = 0.08  # share of the points; phytomers have up to 0.06, those fitted wrongly and others 0.1 and more
SPARSE = 0.4  # of the leaf's density of points; a stem seen from one side has half
FEW_FOR_SHAPE = 200.0  # points, fewer than which tell little of a leaf with a shape of its own
ROUND = 0.7  # share of the stem's circumference that must be seen
MANY_GAPS = 0.1  # share of the blade
FEW_ON_STEM = 60  # points
LITTLE_EXPLAINED = 0.1  # share of outliers that is worth a remark
MUCH_NOISE_CM = 1.0
BLURRED = 2.0  # stem noises in a stem's radius; a thinner tube looks like a filled stem
EDGE_ON = 1.5  # leaf noises in a leaf's half width, below which the width is not resolved
IMPLAUSIBLE = 4.0  # spreads of the prior
NEAR_BOUND = 1e-6
NO_STEM = (
    "no stem in this cloud: the {:.0f} points that look most like one may belong to the leaf; keep some stem below the "
    "leaf"
)
THICK_STEM = (
    "no stem in this cloud: what looks most like one is {:.3g} cm thick, far thicker than a stem of {}; check the unit"
)
NO_LEAF = "no leaf in this cloud: what looks most like one is as short as a leaf of {} can be, {:g} cm; check the unit"
SEVERAL_LEAVES = f"this looks like a whole plant, or more than one leaf: {{}}; {ONE_LEAF_ONLY}"
FOLLOWS = {  # the traits that follow from a parameter
    "stem_diameter": ("stem_diameter",),
    "stem_diameter_above": ("stem_diameter",),
    "leaf_angle": ("leaf_angle", "leaf_insertion_angle"),
    "leaf_length": ("leaf_length", "leaf_area"),
    "leaf_width": ("leaf_width", "leaf_area"),
}


def reviewed(result: Fit, *, labelled: bool = False) -> Fit:
    """The result with remarks on what it rests on; NoPhytomerError where the cloud holds no stem, no leaf, or more than
    one leaf on its piece of stem.

    Of clouds that are `labelled` it is known what is stem and what is leaf.  Where a seed point said which leaf is the
    target, what else there is, is a remark.
    """
    seen = result.estimate.sighting
    length = next(t.value for t in result._measured(result.x) if t.name == "leaf_length")
    if seen.stem_points < LEAST_ON_STEM or length <= 0.0:
        raise NoPhytomerError(
            f"no stem with a leaf was found: the best fit has {seen.stem_points:.0f} points on its stem and a "
            f"leaf of {length:.3g} cm"
        )
    found: list[Remark] = []
    if not labelled:
        if _lacks_stem(result):
            raise NoPhytomerError(NO_STEM.format(seen.stem_points))
        if not result.relative:
            _check_sizes(result)
    if seen.elsewhere > MUCH_ELSEWHERE:
        others = remark("other_surfaces", share=_percent(seen.elsewhere))
        if not labelled and result.settings.get("seed_point") is None:
            raise NoPhytomerError(SEVERAL_LEAVES.format(others.text))
        found.append(others)
    found += [*_of_the_tip(result), *_of_what_was_seen(result, seen), *_of_noise(result), *_of_the_prior(result)]
    return replace(result, observed=(*result.observed, *found))


def _of_the_tip(result: Fit) -> Iterator[Remark]:
    made, seen = result.estimate, result.estimate.sighting
    if made.seen < 1.0:
        yield remark("tip_unseen")
    elif made.blunt:
        yield remark("tip_blunt")
    if made.too_long and made.ends_at < 1.0:
        yield remark("tip_cut_back", share=_percent(1.0 - made.ends_at), n=f"{seen.short:.0f}")
    if seen.beyond:
        yield remark("tip_exceeded", n=f"{seen.beyond:.0f}")
    elif made.seen == 1.0 and not (made.blunt or made.too_long or made.tip_seen):
        yield remark("tip_doubtful")


def _of_what_was_seen(result: Fit, seen: Sighting) -> Iterator[Remark]:
    if not seen.shows_base:
        yield remark("base_hidden")
    if seen.leaf < 0.5:
        yield remark("leaf_mostly_unseen", share=_percent(seen.leaf))
    elif seen.gaps >= MANY_GAPS:
        yield remark("width_holes", share=_percent(seen.gaps))
    if seen.leaf_points < FEW_FOR_SHAPE and OFFSET in result.species.space.names:
        yield remark("leaf_few_points", n=f"{seen.leaf_points:.0f}")
    if seen.stem_points < FEW_ON_STEM:
        yield remark("stem_few_points", n=f"{seen.stem_points:.0f}")
    elif seen.sectors < ROUND:
        yield remark("stem_one_sided", angle=f"{360 * seen.sectors:.0f}°")
    if seen.along_stem:
        yield remark("hugs_stem", length=f"{seen.along_stem * result.scale:.2g} {_length_unit(result)}")


def _of_noise(result: Fit) -> Iterator[Remark]:
    """What does not lie on the model, or not near it."""
    outliers, noise = float(result.estimate.share[2]), result.estimate.noise
    if outliers >= LITTLE_EXPLAINED:
        yield remark("points_unexplained", share=_percent(outliers))
    for organ, traits, std in zip(("stem", "leaf"), (STEM, LEAF), noise.tolist(), strict=False):
        if std > MUCH_NOISE_CM:
            scatter = f"{std * result.scale:.3g} {_length_unit(result)}"
            yield remark("much_noise", traits=traits, scatter=scatter, organ=organ)
    value = dict(zip(result.species.space.names, result.x.tolist(), strict=True))
    if 0.5 * value["stem_diameter"] < BLURRED * noise[0]:
        yield remark("stem_filled")
    if 0.5 * value["leaf_width"] < EDGE_ON * noise[1]:
        yield remark("leaf_edge_on")


def _of_the_prior(result: Fit) -> Iterator[Remark]:
    names = result.species.space.names
    for p, x in zip(result.species.space.parameters, result.x.tolist(), strict=True):
        value = f"{x * result.scale:.3g} {_length_unit(result)}" if p.unit == "cm" else f"{x:.3g} {p.unit}"
        traits = FOLLOWS.get(p.name)
        along_stem = p.name == "leaf_angle" and x == p.lower and "leaf_base_bend" in names  # as leaves may be
        at_bound = min(x - p.lower, p.upper - x) < NEAR_BOUND and not along_stem
        if at_bound and (p.name in FOLLOWS or p.unit == "deg"):  # a share may be 0 or 1; no angle is the greatest
            code = "shape_at_limit" if traits is None else "at_limit"
            yield remark(code, traits=traits, parameter=p.name, value=value)
        elif traits is not None and abs(x - p.mean) > IMPLAUSIBLE * p.std:
            yield remark("unusual", traits=traits, parameter=p.name, value=value)


def _check_sizes(result: Fit) -> None:
    """NoPhytomerError where the stem is far thicker than any, or the leaf as short as one can be: it is none."""
    space, name = result.species.space, result.species.name
    expected = space.parameters[space.index("stem_diameter")]
    if result.parameters["stem_diameter"] > expected.mean + IMPLAUSIBLE * expected.std:
        raise NoPhytomerError(THICK_STEM.format(result.parameters["stem_diameter"], name))
    shortest = space.parameters[space.index("leaf_length")].lower
    if result.parameters["leaf_length"] <= shortest + NEAR_BOUND:
        raise NoPhytomerError(NO_LEAF.format(name, shortest))


def _lacks_stem(result: Fit) -> bool:
    """Whether what was fitted as a stem is none: so thin that neither its points nor the species speak for it, thinner
    than they scatter and than nearly all stems are; or with few points, and these far apart beside the leaf's, some of
    which a stem takes over that stands where there is only leaf."""
    place = result.species.space.index("stem_diameter")
    expected, diameter = result.species.space.parameters[place], float(result.x[place])
    thin = 0.5 * diameter < result.estimate.noise[0] and diameter < expected.mean - THIN * expected.std
    stem, leaf = (float(organ.area) for organ in result._organs_of(result.x))
    seen = result.estimate.sighting
    sparse = seen.stem_points * leaf < SPARSE * seen.leaf_points * stem
    return thin or (sparse and seen.stem_points < FEW_ON_STEM)


def beside_its_rival(result: Fit) -> Fit:
    """The result, with a remark if another estimate is about as probable and its traits lie beyond the intervals."""
    other = result.beside_alternatives
    if not other:
        return result
    units = {t.name: t.unit for t in result.traits}
    others = ", ".join(f"{name} may be {value:.3g} {units[name]}" for name, value in other.items())
    found = remark("two_fits", traits=list(other), others=others)
    return replace(result, observed=(*result.observed, found))


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _length_unit(result: Fit) -> str:
    return "(relative length)" if result.relative else "cm"
