"""Parameter spaces: what each entry of a parameter vector x means, and what is believed of it beforehand."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import SettingError

__all__ = ["Parameter", "ParameterSpace"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """One model parameter: its name and unit, the prior's mean and spread, and hard bounds where nature has them.

    ``discrepancy`` is the standard deviation by which a fit without any noise is off on real organs, whose shape the
    model does not quite have: a share of the value for lengths (unit cm), else in the parameter's unit.
    """

    name: str
    unit: str
    mean: float
    std: float
    lower: float = -np.inf
    upper: float = np.inf
    discrepancy: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mean) and np.isfinite(self.std) and self.std > 0):
            raise SettingError(
                f"parameter {self.name}: expected a finite mean and a positive std, "
                f"got mean {self.mean:g} and std {self.std:g}"
            )
        if not 0.0 <= self.discrepancy < np.inf:
            raise SettingError(f"parameter {self.name}: expected a discrepancy of 0 or more, got {self.discrepancy:g}")
        if not self.lower <= self.mean <= self.upper or self.lower == self.upper:
            raise SettingError(
                f"parameter {self.name}: expected lower <= mean <= upper and lower < upper, "
                f"got {self.lower:g} <= {self.mean:g} <= {self.upper:g}"
            )


@dataclass(frozen=True)
class ParameterSpace:
    """The parameters of a model, in the order of the vector x (k,)."""

    parameters: tuple[Parameter, ...]

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        object.__setattr__(self, "parameters", tuple(parameters))
        if len(set(self.names)) != len(self.parameters) or not self.parameters:
            raise SettingError(f"expected one or more parameters of different names, got {list(self.names)}")

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(p.unit for p in self.parameters)

    @property
    def mean(self) -> FloatArray:
        return np.array([p.mean for p in self.parameters])

    @property
    def std(self) -> FloatArray:
        return np.array([p.std for p in self.parameters])

    @property
    def lower(self) -> FloatArray:
        return np.array([p.lower for p in self.parameters])

    @property
    def upper(self) -> FloatArray:
        return np.array([p.upper for p in self.parameters])

    def discrepancy_at(self, x: FloatArray) -> FloatArray:
        """Standard deviations (k,) by which the parameters x (k,) of real organs are off, in their units."""
        share = np.array([p.discrepancy for p in self.parameters])
        return np.where(np.array(self.units) == "cm", share * np.abs(x), share)

    def index(self, name: str) -> int:
        """Position of the parameter called `name` in x; SettingError names the known ones."""
        try:
            return self.names.index(name)
        except ValueError:
            raise SettingError(f"no parameter is called {name!r}; there are {', '.join(self.names)}") from None
