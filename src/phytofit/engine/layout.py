"""Names for the entries of theta: what of a phytomer in a cloud is estimated."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["IN_CLOUD", "Layout", "State"]

FloatArray = NDArray[np.float64]
IN_CLOUD: Mapping[str, int] = {  # entries after the model's parameters, and how many numbers each has
    "midrib_seen": 1,
    "turn": 3,
    "shift": 3,
    "stem_facing": 2,
    "stem_noise": 1,
    "leaf_noise": 1,
    "leaf_thickness": 1,
    "stem_share": 1,
    "outlier_share": 1,
}


@dataclass(frozen=True)
class Layout:
    """Which numbers of theta (m,) bear which name: the model's `parameters` (k of them), then those of `IN_CLOUD`.

    ================ = ============================================================================
    midrib_seen      1 share of the midrib that was seen, from its start: 1 unless the tip is missing
    turn             3 rotation vector of the pose, radians
    shift            3 of the pose, cm
    stem_facing      2 von Mises concentration of the stem's points, in the frame across it
    stem_noise       1 logarithm of the standard deviation of its points, cm
    leaf_noise       1 the same of the leaf's
    leaf_thickness   1 logarithm of what its thickness adds to that across the blade, cm
    stem_share       1 logit of the share of the points, relative to the leaf's
    outlier_share    1 the same of the points of no organ
    ================ = ============================================================================
    """

    parameters: tuple[str, ...]

    @cached_property
    def _slices(self) -> Mapping[str, slice]:
        sizes = {**dict.fromkeys(self.parameters, 1), **IN_CLOUD}
        ends = np.cumsum(list(sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}

    def __len__(self) -> int:
        return len(self.parameters) + sum(IN_CLOUD.values())

    def __contains__(self, name: str) -> bool:
        return name in self._slices

    def __getitem__(self, name: str) -> slice:
        """Where the numbers of this name stand."""
        return self._slices[name]

    @property
    def model(self) -> slice:
        """Where the model's parameters stand."""
        return slice(0, len(self.parameters))

    def place(self, name: str) -> int:
        """Where the one number of this name stands."""
        start: int = self._slices[name].start
        return start

    def mask(self, *names: str) -> NDArray[np.bool_]:
        """Which numbers (m,) bear one of these names; names that there are none of do no harm."""
        found = np.zeros(len(self), bool)
        for name in names:
            if name in self._slices:
                found[self._slices[name]] = True
        return found

    def filled(self, values: Mapping[str, ArrayLike]) -> FloatArray:
        """Numbers (m,) by their names; all names must be there."""
        theta = np.empty(len(self))
        for name, where in self._slices.items():
            theta[where] = values[name]
        return theta


@dataclass(frozen=True)
class State:
    """A phytomer in a cloud: ``theta`` (m,) as the ``layout`` names it; ``pose`` (4, 4) is the pose before it is turned
    about ``center`` (3,) and shifted."""

    theta: FloatArray
    layout: Layout
    pose: FloatArray
    center: FloatArray

    def __getitem__(self, name: str) -> float:
        """The one number of this name."""
        return float(self.theta[self.layout.place(name)])

    def at(self, theta: FloatArray) -> "State":
        """The state with another theta (m,)."""
        return replace(self, theta=theta)

    def changed(self, **values: ArrayLike) -> "State":
        """The state with other numbers of these names."""
        theta = self.theta.copy()
        for name, value in values.items():
            theta[self.layout[name]] = value
        return self.at(theta)

    def with_parameters(self, x: FloatArray) -> "State":
        """The state with other parameters x (k,) of the model."""
        theta = self.theta.copy()
        theta[self.layout.model] = x
        return self.at(theta)

    @property
    def x(self) -> FloatArray:
        """Parameters (k,) of the model."""
        return self.theta[self.layout.model]

    @property
    def seen(self) -> float:
        """Share of the midrib that was seen."""
        return self["midrib_seen"]

    @property
    def turn(self) -> FloatArray:
        """Rotation vector (3,), radians."""
        return self.theta[self.layout["turn"]]

    @property
    def shift(self) -> FloatArray:
        """(3,) cm."""
        return self.theta[self.layout["shift"]]

    @property
    def facing(self) -> FloatArray:
        """(2,) concentration of the stem's points around it."""
        return self.theta[self.layout["stem_facing"]]

    @property
    def noise(self) -> FloatArray:
        """(3,) cm: on the stem, on the leaf, and what its thickness adds to that across the blade."""
        return np.exp([self["stem_noise"], self["leaf_noise"], self["leaf_thickness"]])

    @property
    def share(self) -> FloatArray:
        """(3,) of the points: stem, leaf, outliers."""
        share = np.exp([self["stem_share"], 0.0, self["outlier_share"]])
        normed: FloatArray = share / share.sum()
        return normed
