"""Fit: the most probable phytomer of a cloud, and its traits with their intervals."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from phytofit.engine.intervals import Ends, propagated
from phytofit.engine.outcome import Alternative, Estimate
from phytofit.models import STEM, Organ
from phytofit.parameters import ParameterSpace
from phytofit.results.fitted import FittedPhytomer
from phytofit.traits import Trait, measure

__all__ = ["Fit"]

FloatArray = NDArray[np.float64]
INTERVAL_METHOD = "sandwich interval"
ABOUT_AS_PROBABLE = 0.08  # from which what another estimate has is worth a remark
COMPARED = ("stem_diameter", "leaf_length", "leaf_angle", "leaf_insertion_angle", "leaf_width")
OPEN_WITHOUT_TIP = ("leaf_length", "leaf_area")  # no upper end where the tip was not seen


@dataclass(frozen=True, kw_only=True, repr=False)
class Fit(FittedPhytomer):
    """The most probable phytomer of a cloud.

    ``error`` is minus the log posterior (nats); ``covariance`` (k, k) is that of x's error, ``trait_covariance`` the
    same with what the leaf's last points tell of its end; ``estimate`` has the rest, in the start pose's frame and the
    prior's cm.
    """

    method: ClassVar[str] = "likelihood"

    covariance: FloatArray
    trait_covariance: FloatArray
    estimate: Estimate

    @property
    def parameter_intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter, within its bounds."""
        space, quantile = self.species.space, self.estimate.quantile
        half = quantile * np.sqrt(np.diag(self.covariance))
        others = [
            (p, other.x - self.x, Ends(*[quantile * np.sqrt(np.diag(other.covariance))] * 2))
            for p, other in self._alternatives
            if other.species.space.names == space.names
        ]
        ends = Ends(half, half).mixed(others, quantile)
        low = self._in_units(np.minimum(np.maximum(self.x - ends.below, space.lower), self.x)).tolist()
        high = self._in_units(np.maximum(np.minimum(self.x + ends.above, space.upper), self.x)).tolist()
        return dict(zip(space.names, zip(low, high, strict=True), strict=True))

    @property
    def midrib_seen(self) -> float:
        """Share of the midrib that was seen; 1 unless the tip is missing."""
        return min(1.0, self.estimate.seen)

    @property
    def closeness(self) -> str:
        """The noise on the organs, and the share of outliers."""
        unit = "relative" if self.relative else "cm"
        stem, leaf, thickness = self.estimate.noise * self.scale
        return (
            f"noise {stem:.2f} {unit} on the stem, {leaf:.2f} on the leaf, {thickness:.2f} more across it; "
            f"{100 * self.estimate.share[2]:.0f} % outliers"
        )

    @property
    def details(self) -> dict[str, Any]:
        """Noise, shares, evidence, and the covariances."""
        made = self.estimate
        noise = made.noise * self.scale
        return {
            "noise": dict(zip(("stem", "leaf", "leaf_thickness"), noise.tolist(), strict=True)),
            "share": dict(zip(("stem", "leaf", "outliers"), made.share.tolist(), strict=True)),
            "midrib_seen": made.seen,
            "tip_seen": made.tip_seen,
            "leaf_ends_at": made.ends_at,
            "correlated_cm": made.correlated_cm,
            "evidence": made.evidence,
            "variance_inflation": made.inflation,
            "covariance": self.covariance.tolist(),
            "trait_covariance": self.trait_covariance.tolist(),
        }

    def upside_down(self) -> "Fit | None":
        """The result with the same organs the other way up; None where the model has no such phytomer."""
        turned = self._turn_over()
        if turned is None:
            return None
        turn, others = turned
        covariance, of_traits = (turn @ each @ turn.T for each in (self.covariance, self.trait_covariance))
        made = replace(self.estimate, alternatives=tuple(self._turned_alternatives()))
        return replace(self, **others, covariance=covariance, trait_covariance=of_traits, estimate=made)

    def _turned_alternatives(self) -> Iterator[Alternative]:
        for it in self.estimate.alternatives:
            made = it.estimate
            found = self.species.model.upside_down(made.x)
            if found is not None:
                turn, offset, _ = found
                covariance, of_traits = (turn @ each @ turn.T for each in (made.covariance, made.trait_covariance))
                x = turn @ made.x + offset
                yield it._replace(estimate=replace(made, x=x, covariance=covariance, trait_covariance=of_traits))

    def _organs_of(self, x: FloatArray) -> tuple[Organ, ...]:
        stem, leaf = self._scaled_organs(x)
        return stem, leaf.until(self.estimate.ends_at)

    def _with_intervals(self) -> list[Trait]:
        traits, ends = self._measured(self.x), self._ends()
        open_above = () if self.estimate.tip_seen else OPEN_WITHOUT_TIP
        return [
            replace(
                trait,
                low=max(0.0, trait.value - self._not_seen(trait.name) - below),
                high=None if trait.name in open_above else trait.value + above,
            )
            if np.isfinite(below + above)
            else trait
            for trait, below, above in zip(traits, ends.below.tolist(), ends.above.tolist(), strict=True)
        ]

    def _measured(self, x: FloatArray) -> list[Trait]:
        method = f"{self.method}, 95 % {INTERVAL_METHOD}"
        return measure(self._organs_of(x), chord_cm=self._chord_cm, method=method)

    def _not_seen(self, name: str) -> float:
        """What of a trait is of an unseen tip, or beyond a blunt leaf's last point: its low end is without that."""
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
        """How far the traits' intervals reach, as it may be this estimate that is right or another."""
        return self._own_ends.mixed(self._apart, self.estimate.quantile)

    @cached_property
    def _own_ends(self) -> Ends:
        """How far the intervals reach if this estimate is right: by the errors of the parameters, by how far the
        blade's surface lies off the model's where it leaves the stem, by how far its width does, and by what the stem
        hides of it."""
        space, made = self.species.space, self.estimate
        ends = propagated(self._values, self.x, self.trait_covariance, made.quantile, *_within(space))
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

    @cached_property
    def _alternatives(self) -> list[tuple[float, "Fit"]]:
        """What this fit would say were another estimate the right one, and how probable that is."""
        return [
            (
                it.probability,
                replace(
                    self,
                    species=replace(self.species, space=it.space),
                    x=it.estimate.x,
                    covariance=it.estimate.covariance,
                    trait_covariance=it.estimate.trait_covariance,
                    estimate=it.estimate,
                ),
            )
            for it in self.estimate.alternatives
        ]

    @cached_property
    def _apart(self) -> list[tuple[float, FloatArray, Ends]]:
        """How probable other estimates are, how far (t,) from this one their traits lie, and how far these reach."""
        values = self._values(self.x)
        return [(p, other._values(other.x) - values, other._own_ends) for p, other in self._alternatives]

    @property
    def beside_alternatives(self) -> dict[str, float]:
        """Values of those traits that another estimate, about as probable, has beyond the interval of this one, in
        cm and degrees."""
        found: dict[str, float] = {}
        if not self.estimate.alternatives:
            return found
        own, names = self._own_ends, [trait.name for trait in self._measured(self.x)]
        for p, apart, _ in self._apart:
            if p < ABOUT_AS_PROBABLE:
                continue
            beyond = np.isfinite(apart) & ((apart > own.above) | (apart < -own.below))
            values = self._values(self.x) + apart
            found |= {names[i]: float(values[i]) for i in np.flatnonzero(beyond) if names[i] in COMPARED}
        return found

    def _further_down(self, off: float, angle: float) -> float:
        """How much further down its stem, cm, a leaf at this angle, deg, may start that lies `off` cm off where it was
        fitted: it nears the stem as its chord does, below its midrib's start as well."""
        least = np.arctan2(off, self.parameters["stem_length"])  # at which that is all of the stem below it
        return float(off / np.tan(max(np.deg2rad(angle), least))) if off > 0.0 and angle < 90.0 else 0.0

    def _values(self, x: FloatArray, *, thicker: float = 0.0) -> FloatArray:
        """Values (t,) of the traits, of a stem with a radius so much larger."""
        stem, leaf = self._organs_of(x)
        stem = replace(stem, half_width=np.maximum(stem.half_width + thicker, 0.0))
        return np.array([trait.value for trait in measure((stem, leaf), chord_cm=self._chord_cm)])


def _within(space: ParameterSpace) -> tuple[FloatArray, FloatArray]:
    """Bounds (k,) of the parameters, but of angles, for which 0 is no end."""
    angle = np.array(space.units) == "deg"
    return np.where(angle, -np.inf, space.lower), np.where(angle, np.inf, space.upper)
