"""Fit: a phytomer model fitted to a cloud, its traits with their intervals, and remarks on them."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from phytofit.display import Shown, Summary
from phytofit.engine.intervals import Ends, propagated
from phytofit.engine.outcome import Estimate
from phytofit.errors import ONE_LEAF_ONLY, NoPhytomerError, Status
from phytofit.models import STEM, Organ, move
from phytofit.paper.cross_entropy import Generation
from phytofit.paper.objective import Registration
from phytofit.results.remarks import FEW_ON_STEM, IMPLAUSIBLE, NEAR_BOUND, UNUSABLE, flags_of
from phytofit.species import Species
from phytofit.traits import CHORD_CM, Trait, measure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["Fit", "beside_its_rival", "remarked"]

FloatArray = NDArray[np.float64]
LEAST_ON_STEM = 10.0  # points; with fewer it is no stem
THIN = 2.0  # spreads of the prior, by which a stem is thinner than expected
MUCH_ELSEWHERE = 0.08  # share of the points; phytomers have up to 0.06, those fitted wrongly and others 0.1 and more
SPARSE = 0.4  # of the leaf's density of points; a stem seen from one side has half
NO_STEM = (
    "no stem in this cloud: the {:.0f} points that look most like one may belong to the leaf; keep some stem below the "
    "leaf"
)
THICK_STEM = (
    "no stem in this cloud: what looks most like one is {:.3g} cm thick, far thicker than a stem of {}; check the unit"
)
NO_LEAF = "no leaf in this cloud: what looks most like one is as short as a leaf of {} can be, {:g} cm; check the unit"
MORE_THAN_ONE_LEAF = "{:.0f} % of the points lie on surfaces that are neither the fitted stem nor the fitted leaf"
INTERVAL_METHOD = "sandwich interval"
OPEN_WITHOUT_TIP = ("leaf_length", "leaf_area")  # no upper end where the tip was not seen
TOLD_OF_RIVALS = ("stem_diameter", "leaf_length", "leaf_angle", "leaf_width")


@dataclass(frozen=True, repr=False)
class Fit(Shown):
    """A phytomer model fitted to a cloud.

    ``x`` (k,) are the parameters, in the order of ``species.space``; ``pose`` (4, 4) maps the model's frame to the
    cloud's, cm.  By method "likelihood", ``covariance`` (k, k) is that of x's error, ``trait_covariance`` the same with
    what the leaf's last points tell of its end, ``error`` minus the log posterior (nats); ``estimate`` has the rest, in
    the start pose's frame.  By method "paper", ``covariance`` is the spread of the last elite: how far the search has
    contracted, not how far it is from the truth; ``error`` is the distance, cm, ``registration`` how ICP ended.

    ``reference`` (m, 3) are the points that were fitted, in the cloud's frame, cm.  ``flags`` are remarks on the
    result in plain words, ``notes`` on what was done to the cloud.  ``relative`` says that the cloud had no unit:
    lengths are then relative to each other only, and ``scale`` of them make a cm of the prior (1 otherwise); `x`,
    `history`, `registration` and `estimate` are in the prior's cm.  ``settings`` repeat the run; ``name`` is the
    cloud's.
    """

    species: Species
    x: FloatArray
    covariance: FloatArray
    pose: FloatArray
    error: float
    history: tuple[Generation, ...]
    status: Status
    seed: int
    reference: FloatArray
    method: str
    registration: Registration | None = None
    estimate: Estimate | None = None
    trait_covariance: FloatArray | None = None
    flags: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    relative: bool = False
    scale: float = 1.0
    settings: dict[str, object] = field(default_factory=dict)
    name: str = "cloud"

    def summary(self) -> Summary:
        """The traits with their intervals, and the flags."""
        rows = [(t.organ, t.name, f"{t.value:.2f}", t.interval, t.unit) for t in self.traits]
        title = f"Fit of {self.name}: {self.species.name} phytomer, method {self.method}"
        columns = ("organ", "trait", "value", "95 % interval", "unit")
        return Summary(title, columns, rows, [f"flag: {flag}" for flag in self.flags])

    def to_frame(self) -> "pd.DataFrame":
        """The traits as a table, with the columns of ``traits.csv``."""
        from phytofit.io import trait_table

        return trait_table(self.name, self.traits)

    def plot(self) -> "Figure":
        """The model on the points, and the table of traits: ``fit.png``."""
        from phytofit.plots import plot_fit

        return plot_fit(self, title=self.name)

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters by name; lengths in cm (or relative), angles in degrees."""
        return dict(zip(self.species.space.names, self._in_units(self.x).tolist(), strict=True))

    @property
    def parameter_intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter, within its bounds; empty where the method gives none."""
        if self.estimate is None:
            return {}
        space = self.species.space
        half = self.estimate.quantile * np.sqrt(np.diag(self.covariance))
        low = self._in_units(np.minimum(np.maximum(self.x - half, space.lower), self.x)).tolist()
        high = self._in_units(np.maximum(np.minimum(self.x + half, space.upper), self.x)).tolist()
        return dict(zip(space.names, zip(low, high, strict=True), strict=True))

    def _in_units(self, x: FloatArray) -> FloatArray:
        return np.where(np.array(self.species.space.units) == "cm", x * self.scale, x)

    @property
    def organs(self) -> tuple[Organ, ...]:
        """Stem and leaf in the cloud's frame, cm."""
        return move(self._organs_of(self.x), self.pose)

    def _organs_of(self, x: FloatArray, *, whole: bool = False) -> tuple[Organ, ...]:
        own = (o.row(0) for o in self.species.model.organs(x))
        stem, leaf = (replace(o, axis=o.axis * self.scale, half_width=o.half_width * self.scale) for o in own)
        return stem, leaf if whole or self.estimate is None else leaf.until(self.estimate.ends_at)

    @cached_property
    def traits(self) -> list[Trait]:
        """The traits, measured on the fitted organs, with 95 % intervals where the method gives them.

        Lengths are in "rel" in place of "cm" where the cloud had no unit.
        """
        traits = self._measured(self.x)
        if self.estimate is not None:
            ends = self._ends()
            open_above = () if self.estimate.tip_seen else OPEN_WITHOUT_TIP
            traits = [
                replace(
                    trait,
                    low=max(0.0, trait.value - self._not_seen(trait.name) - below),
                    high=None if trait.name in open_above else trait.value + above,
                )
                if np.isfinite(below + above)
                else trait
                for trait, below, above in zip(traits, ends.below.tolist(), ends.above.tolist(), strict=True)
            ]
        if not self.relative:
            return traits
        return [replace(trait, unit=trait.unit.replace("cm", "rel")) for trait in traits]

    def _measured(self, x: FloatArray) -> list[Trait]:
        method = self.method if self.estimate is None else f"{self.method}, 95 % {INTERVAL_METHOD}"
        return measure(self._organs_of(x), chord_cm=self._chord_cm, method=method, flags=self.flags)

    @property
    def _chord_cm(self) -> float:
        return np.inf if self.relative else CHORD_CM

    def _not_seen(self, name: str) -> float:
        """What of a trait is of an unseen tip, or beyond a blunt leaf's last point: its low end is without that."""
        assert self.estimate is not None
        made = self.estimate
        seen = min(1.0, made.sighting.end / made.ends_at) if made.blunt else made.seen
        if name not in OPEN_WITHOUT_TIP or seen == 1.0:
            return 0.0
        whole = self._organs_of(self.x)[1]
        part = whole.until(seen)
        if name == "leaf_area":
            return float(whole.area - part.area)
        return float(whole.segment_lengths.sum() - part.segment_lengths.sum())

    def _ends(self) -> Ends:
        """How far the traits' intervals reach: by the errors of the parameters, by how far the blade's surface lies
        off the model's where it leaves the stem, by how far its width does, and by what the stem hides of it."""
        assert self.estimate is not None
        assert self.trait_covariance is not None
        space, made = self.species.space, self.estimate
        angle = np.array(space.units) == "deg"
        lower, upper = np.where(angle, -np.inf, space.lower), np.where(angle, np.inf, space.upper)
        ends = propagated(self._values, self.x, self.trait_covariance, made.quantile, lower, upper)
        off = made.quantile * made.misfit_cm * self.scale
        values, measured = self._values(self.x), self._measured(self.x)
        changes = np.array([self._values(self.x, thicker=by) for by in (off, -off)]) - values
        changes[:, [trait.organ == STEM for trait in measured]] = 0.0
        ends = ends.with_error(np.minimum(changes, 0.0).min(axis=0), np.maximum(changes, 0.0).max(axis=0))
        names = np.array([trait.name for trait in measured])
        by_width = (names == "leaf_width") * made.quantile * made.width_misfit * values
        inside, leaf = made.sighting.along_stem * self.scale, self._organs_of(self.x)[1]
        strip = float(leaf.until(inside / leaf.segment_lengths.sum()).area) if inside else 0.0
        below = self._further_down(off, float(values[names == "leaf_angle"][0]))
        below = max(0.0, below - float(changes[1, names == "leaf_length"][0]))
        strip += 2.0 * float(leaf.half_width[0]) * below
        by_stem = (names == "leaf_length") * (inside + below) + (names == "leaf_area") * strip
        return ends.with_error(by_width, by_width + by_stem)

    def _further_down(self, off: float, angle: float) -> float:
        """How much further down its stem, cm, a leaf at this angle, deg, may start that lies `off` cm off where it was
        fitted: it nears the stem as its chord does, below its midrib's start as well."""
        least = np.arctan2(off, self.parameters["stem_length"])  # at which that is all of the stem below it
        return float(off / np.tan(max(np.deg2rad(angle), least))) if off > 0.0 and angle < 90.0 else 0.0

    def _values(self, x: FloatArray, *, thicker: float = 0.0, whole: bool = False) -> FloatArray:
        """Values (t,) of the traits, of a stem with a radius so much larger, of the leaf as it ends, or `whole`."""
        stem, leaf = self._organs_of(x, whole=whole)
        stem = replace(stem, half_width=np.maximum(stem.half_width + thicker, 0.0))
        return np.array([trait.value for trait in measure((stem, leaf), chord_cm=self._chord_cm)])

    @property
    def elite_std(self) -> dict[str, float]:
        """Spread of each parameter in the last elite of the search; not an error of the estimate."""
        last = np.sqrt(np.diag(self.history[-1].cov))
        units = self.species.space.units[: len(last)]
        scaled = [s * self.scale if unit == "cm" else s for s, unit in zip(last.tolist(), units, strict=True)]
        return dict(zip(self.species.space.names, scaled, strict=False))


def remarked(result: Fit, *, labelled: bool = False) -> Fit:
    """The result with the flags of what it rests on; NoPhytomerError where the cloud holds no stem, no leaf, or more
    than one leaf on its piece of stem.

    Of clouds that are `labelled` it is known what is stem and what is leaf.  Where a seed point said which leaf is
    meant, what else there is, is a flag.
    """
    made = result.estimate
    if made is None:
        return result
    length = next(t.value for t in result._measured(result.x) if t.name == "leaf_length")
    if made.sighting.stem_points < LEAST_ON_STEM or length <= 0.0:
        raise NoPhytomerError(
            f"no stem with a leaf was found: the best fit has {made.sighting.stem_points:.0f} points on its stem and a "
            f"leaf of {length:.3g} cm"
        )
    flags: list[str] = []
    if not labelled:
        if _lacks_stem(result, made):
            raise NoPhytomerError(NO_STEM.format(made.sighting.stem_points))
        if not result.relative:
            _check_sizes(result)
        if made.sighting.elsewhere > MUCH_ELSEWHERE:
            text = MORE_THAN_ONE_LEAF.format(100.0 * made.sighting.elsewhere)
            if result.settings.get("seed_point") is None:
                raise NoPhytomerError(f"this looks like a whole plant, or more than one leaf: {text}; {ONE_LEAF_ONLY}")
            flags.append(f"{UNUSABLE}{text}. Cut the other leaves away")
    flags += flags_of(
        result.species.space,
        result.x,
        made.sighting,
        noise=made.noise,
        outlier_share=float(made.share[2]),
        midrib_seen=made.seen,
        tip_seen=made.tip_seen,
        blunt=made.blunt,
        ends_at=made.ends_at if made.too_long else 1.0,
        scale=result.scale,
    )
    return replace(result, flags=(*result.flags, *flags))


def _check_sizes(result: Fit) -> None:
    """NoPhytomerError where the stem is far thicker than any, or the leaf as short as one can be: it is none."""
    space, name = result.species.space, result.species.name
    expected = space.parameters[space.index("stem_diameter")]
    if result.parameters["stem_diameter"] > expected.mean + IMPLAUSIBLE * expected.std:
        raise NoPhytomerError(THICK_STEM.format(result.parameters["stem_diameter"], name))
    shortest = space.parameters[space.index("leaf_length")].lower
    if result.parameters["leaf_length"] <= shortest + NEAR_BOUND:
        raise NoPhytomerError(NO_LEAF.format(name, shortest))


def _lacks_stem(result: Fit, made: Estimate) -> bool:
    """Whether what was fitted as a stem is none: so thin that neither its points nor the species speak for it, thinner
    than they scatter and than nearly all stems are; or with few points, and these far apart beside the leaf's, some of
    which a stem takes over that stands where there is only leaf."""
    place = result.species.space.index("stem_diameter")
    expected, diameter = result.species.space.parameters[place], float(result.x[place])
    thin = 0.5 * diameter < made.noise[0] and diameter < expected.mean - THIN * expected.std
    stem, leaf = (float(organ.area) for organ in result._organs_of(result.x))
    seen = made.sighting
    sparse = seen.stem_points * leaf < SPARSE * seen.leaf_points * stem
    return thin or (sparse and seen.stem_points < FEW_ON_STEM)


def beside_its_rival(result: Fit) -> Fit:
    """The result, with a flag if another model is about as probable and its traits lie beyond the intervals."""
    if result.estimate is None or result.estimate.rival is None:
        return result
    other = dict(zip([t.name for t in result.traits], result._values(result.estimate.rival, whole=True), strict=True))
    differ = [
        f"{t.name} may be {other[t.name]:.3g} {t.unit}"
        for t in result.traits
        if t.name in TOLD_OF_RIVALS and not (t.low or 0.0) <= other[t.name] <= (np.inf if t.high is None else t.high)
    ]
    if not differ:
        return result
    return replace(
        result, flags=(*result.flags, f"two fits are about equally probable: {', '.join(differ)}. Look at fit.png")
    )
