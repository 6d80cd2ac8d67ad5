"""PaperFit: a phytomer fitted by the paper's method, which gives no intervals."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from phytofit.models import Organ
from phytofit.paper.objective import Registration
from phytofit.results.fitted import FittedPhytomer
from phytofit.traits import Trait, measure

__all__ = ["PaperFit"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, repr=False)
class PaperFit(FittedPhytomer):
    """A phytomer fitted by the paper's method: the mean of the last elite of a cross-entropy search.

    ``error`` is the distance between model and cloud, cm (or relative); ``registration`` says how ICP ended, in the
    prior's cm.
    """

    method: ClassVar[str] = "paper"

    registration: Registration

    @property
    def parameter_intervals(self) -> dict[str, tuple[float, float]]:
        """Empty: the method gives none."""
        return {}

    @property
    def elite_std(self) -> dict[str, float]:
        """Spread of each parameter in the last elite: how far the search has contracted, not how far it is from the
        truth."""
        spread = self._in_units(np.sqrt(np.diag(self.history[-1].cov)))
        return dict(zip(self.species.space.names, spread.tolist(), strict=True))

    @property
    def midrib_seen(self) -> float:
        """1: the method takes every leaf as whole."""
        return 1.0

    @property
    def closeness(self) -> str:
        """The distance that was minimised."""
        unit = "relative" if self.relative else "cm"
        return f"{self.settings['distance']} distance {self.error:.2f} {unit}"

    @property
    def details(self) -> dict[str, Any]:
        """How the registration ended, and the spread of the last elite."""
        ended = self.registration
        return {
            "registration": {"rmse": ended.rmse, "iterations": ended.iterations, "converged": ended.converged},
            "elite_std": self.elite_std,
        }

    def upside_down(self) -> "PaperFit | None":
        """The result with the same organs the other way up; None where the model has no such phytomer."""
        turned = self._turn_over()
        return None if turned is None else replace(self, **turned[1])

    def _organs_of(self, x: FloatArray) -> tuple[Organ, ...]:
        return self._scaled_organs(x)

    def _with_intervals(self) -> list[Trait]:
        return measure(self._organs_of(self.x), chord_cm=self._chord_cm, method=self.method)
