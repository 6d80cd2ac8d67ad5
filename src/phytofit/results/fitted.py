"""What the results of both methods share: a phytomer in a cloud, its traits, and remarks on them."""

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from phytofit.display import Shown, Summary
from phytofit.errors import Status
from phytofit.models import Organ, move
from phytofit.paper.cross_entropy import Generation
from phytofit.results.quality import graded, of_intervals
from phytofit.results.remarks import Placed, Remark, grouped
from phytofit.species import Species
from phytofit.traits import CHORD_CM, Trait

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["FittedPhytomer"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, repr=False)
class FittedPhytomer(Shown):
    """A phytomer model fitted to a cloud, by either method.

    ``x`` (k,) are the parameters, in the order of ``species.space``; ``pose`` (4, 4) maps the model's frame to the
    cloud's, cm; ``error`` is what was minimised; ``reference`` (m, 3) are the points that were fitted, in the cloud's
    frame, cm.  ``observed`` are the remarks on the cloud and the fit, to which `remarks` adds those on the intervals;
    ``notes`` tell what was done to the cloud.  ``relative`` says that the cloud had no unit: lengths are then relative
    to each other only, and ``scale`` of them make a cm of the prior (1 otherwise); `x` and `history` are in the prior's
    cm.  ``settings`` repeat the run; ``name`` is the cloud's.
    """

    method: ClassVar[str]  # "likelihood" or "paper"

    species: Species
    x: FloatArray
    pose: FloatArray
    error: float
    history: tuple[Generation, ...]
    status: Status
    seed: int
    reference: FloatArray
    observed: tuple[Remark, ...] = ()
    notes: tuple[str, ...] = ()
    relative: bool = False
    scale: float = 1.0
    settings: dict[str, object] = field(default_factory=dict)
    name: str = "cloud"

    @property
    @abstractmethod
    def parameter_intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter, within its bounds; empty where the method gives none."""

    @property
    @abstractmethod
    def midrib_seen(self) -> float:
        """Share of the midrib that was seen; 1 unless the tip is missing."""

    @property
    @abstractmethod
    def closeness(self) -> str:
        """How closely the points lie on the model, in a line."""

    @property
    @abstractmethod
    def details(self) -> dict[str, Any]:
        """What only this method tells, as ``fit.json`` has it."""

    @abstractmethod
    def upside_down(self) -> "FittedPhytomer | None":
        """The result with the same organs the other way up; None where the model has no such phytomer."""

    @abstractmethod
    def _organs_of(self, x: FloatArray) -> tuple[Organ, ...]:
        """Stem and leaf as they are measured, in the model's frame."""

    @abstractmethod
    def _with_intervals(self) -> list[Trait]:
        """The traits, measured on the fitted organs, with the intervals that the method gives; lengths in cm."""

    @cached_property
    def traits(self) -> list[Trait]:
        """The traits, measured on the fitted organs, with 95 % intervals where the method gives them, their quality,
        and the codes of the remarks that touch them.

        Lengths are in "rel" in place of "cm" where the cloud had no unit.
        """
        return graded(self._in_their_units, self.remarks)

    @cached_property
    def remarks(self) -> tuple[Remark, ...]:
        """What was noticed of the cloud, the fit, and the intervals."""
        return (*self.observed, *of_intervals(self._in_their_units))

    @cached_property
    def _in_their_units(self) -> list[Trait]:
        traits = self._with_intervals()
        return [replace(t, unit=t.unit.replace("cm", "rel")) for t in traits] if self.relative else traits

    @property
    def flags(self) -> tuple[str, ...]:
        """The codes of the remarks."""
        return tuple(dict.fromkeys(one.code for one in self.remarks))

    def summary(self) -> Summary:
        """The traits with their intervals, and the remarks."""
        rows = [(t.organ, t.name, f"{t.value:.2f}", t.interval, t.unit, t.quality) for t in self.traits]
        title = f"Fit of {self.name}: {self.species.name} phytomer, method {self.method}"
        columns = ("organ", "trait", "value", "95 % interval", "unit", "quality")
        said = [f"{grade}: {line}" for grade, line in grouped(map(Placed, self.remarks))]
        return Summary(title, columns, rows, said)

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
    def organs(self) -> tuple[Organ, ...]:
        """Stem and leaf in the cloud's frame, cm."""
        return move(self._organs_of(self.x), self.pose)

    @property
    def length_unit(self) -> str:
        """The unit of lengths: "cm", or "rel"."""
        return "rel" if self.relative else "cm"

    def _in_units(self, x: FloatArray) -> FloatArray:
        return np.where(np.array(self.species.space.units) == "cm", x * self.scale, x)

    def _scaled_organs(self, x: FloatArray) -> tuple[Organ, Organ]:
        """Stem and leaf as the model has them, in the model's frame."""
        own = (o.row(0) for o in self.species.model.organs(x))
        stem, leaf = (replace(o, axis=o.axis * self.scale, half_width=o.half_width * self.scale) for o in own)
        return stem, leaf

    @property
    def _chord_cm(self) -> float:
        return np.inf if self.relative else CHORD_CM

    def _turn_over(self) -> tuple[FloatArray, dict[str, Any]] | None:
        """The matrix (k, k) that turns the errors of the parameters, and what of the result is another upside down."""
        found = self.species.model.upside_down(self.x)
        searched = self.species.model.upside_down(self.x[: len(self.history[0].mean)])
        if found is None or searched is None:
            return None
        turn, offset, pose = found
        pose[:3, 3] *= self.scale
        part, shift, _ = searched
        history = tuple(
            replace(g, mean=part @ g.mean + shift, cov=part @ g.cov @ part.T, best_x=part @ g.best_x + shift)
            for g in self.history
        )
        return turn, {"x": turn @ self.x + offset, "pose": self.pose @ pose, "history": history}
