"""The prior of a phytomer in a cloud: normal, within bounds, entry by entry of theta."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.engine.layout import Layout
from phytofit.parameters import ParameterSpace

__all__ = ["NO_THICKNESS_CM", "Prior"]

FloatArray = NDArray[np.float64]
NO_THICKNESS_CM = 1e-6
LEAST_NOISE_CM = 0.05  # a midrib of straight pieces lies up to 0.02 cm off a curved one
LEAST_THICKNESS_CM, MOST_NOISE_CM = 0.005, 5.0
LEAST_SEEN, SEEN_SPREAD = 0.3, 0.3  # of the midrib: bound, and the prior's spread below 1
NOISE_CM, NOISE_FACTOR = 0.3, 3.0  # of a surface's points: the prior's middle, and one spread of it
FACING_SPREAD, MOST_FACING = 1.0, 2.5  # of the concentrations around the stem: the prior's spread, and bound
SAME_NOISE = 1.3  # one spread of the leaf's noise about the stem's
SHARE_SPREAD = 2.5  # of the logits of the shares
STEM_SHARE, OUTLIER_SHARE = 0.3, 0.03  # before a cloud is seen; the rest is the leaf's
LEAST_LOGIT, MOST_LOGIT, MOST_OUTLIERS = -9.0, 5.0, np.log(4.0)  # of the shares


@dataclass(frozen=True)
class Prior:
    """``mean`` and ``std`` (m,) of theta, within ``lower`` and ``upper`` (m,); ``space`` are the model's parameters.

    ``weight`` (m,) says how often it counts: points that err alike count too often, and it as often beside them.
    """

    space: ParameterSpace
    mean: FloatArray
    std: FloatArray
    lower: FloatArray
    upper: FloatArray
    weight: FloatArray

    @classmethod
    def of(
        cls,
        space: ParameterSpace,
        *,
        thick: bool = False,
        cut: bool = False,
        leaf_noise_cm: float | None = None,
    ) -> "Prior":
        """That of the model's parameters in `space`, seen in a cloud.

        thick : whether the leaf may have a thickness; cut : whether its tip may be missing; leaf_noise_cm : about that
        of its points, which few of them can't tell from its shape
        """
        layout = Layout(space.names)
        inside = 1.0 - STEM_SHARE - OUTLIER_SHARE
        noise, factor, least, most = np.log([NOISE_CM, NOISE_FACTOR, LEAST_NOISE_CM, MOST_NOISE_CM])
        leaf_noise = (noise, factor) if leaf_noise_cm is None else np.log([leaf_noise_cm, SAME_NOISE])
        thickness = (noise, factor, np.log(LEAST_THICKNESS_CM), most)
        if not thick:
            thickness = (np.log(NO_THICKNESS_CM), factor, *[np.log(NO_THICKNESS_CM)] * 2)
        entries: dict[str, tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]] = {
            "midrib_seen": (1.0, SEEN_SPREAD, LEAST_SEEN if cut else 1.0, 1.0),
            "turn": (0.0, np.inf, -np.inf, np.inf),
            "shift": (0.0, np.inf, -np.inf, np.inf),
            "stem_facing": (0.0, FACING_SPREAD, 0.0, 0.0),
            "stem_noise": (noise, factor, least, most),
            "leaf_noise": (*leaf_noise, least, most),
            "leaf_thickness": thickness,
            "stem_share": (np.log(STEM_SHARE / inside), SHARE_SPREAD, LEAST_LOGIT, MOST_LOGIT),
            "outlier_share": (np.log(OUTLIER_SHARE / inside), SHARE_SPREAD, LEAST_LOGIT, MOST_OUTLIERS),
        }
        entries |= {p.name: (p.mean, p.std, p.lower, p.upper) for p in space.parameters}
        columns = [layout.filled({name: values[i] for name, values in entries.items()}) for i in range(4)]
        mean, std, lower, upper = columns
        return cls(space, mean, std, lower, upper, np.ones(len(layout)))

    @cached_property
    def layout(self) -> Layout:
        """Which entry is which."""
        return Layout(self.space.names)

    @property
    def precision(self) -> FloatArray:
        """(m,) of the normal distributions."""
        return self.std**-2.0

    @property
    def curvature(self) -> FloatArray:
        """Second derivatives (m,) of the error that the prior brings."""
        return self.precision * self.weight

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which entries (m,) are not fixed."""
        return self.lower < self.upper

    def error(self, theta: FloatArray) -> float:
        """Minus its logarithm, up to a constant."""
        return 0.5 * float(np.sum((theta - self.mean) ** 2 * self.curvature))

    def gradient(self, theta: FloatArray) -> FloatArray:
        """Derivatives (m,) of the error."""
        return (theta - self.mean) * self.curvature

    def fixing(self, theta: FloatArray, fixed: NDArray[np.bool_]) -> "Prior":
        """With some entries `fixed` (m,) where theta has them."""
        return replace(self, lower=np.where(fixed, theta, self.lower), upper=np.where(fixed, theta, self.upper))

    def bounded(self, name: str, *, lower: float | None = None, upper: float | None = None) -> "Prior":
        """With other bounds of the entry of this name."""
        here = self.layout.mask(name)
        low = self.lower if lower is None else np.where(here, lower, self.lower)
        high = self.upper if upper is None else np.where(here, upper, self.upper)
        return replace(self, lower=low, upper=high)

    def one_sided(self) -> "Prior":
        """Of a stem that may have been seen from one side."""
        return self.bounded("stem_facing", lower=-MOST_FACING, upper=MOST_FACING)

    def weighted(self, counted: NDArray[np.bool_], weight: float) -> "Prior":
        """With some entries `counted` (m,) so many times."""
        return replace(self, weight=np.where(counted, weight, 1.0))
