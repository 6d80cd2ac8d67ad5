"""The species whose leaves are the model's own: what intervals hold without any discrepancy of real ones."""

from dataclasses import replace

import phytofit
from phytofit.parameters import ParameterSpace

__all__ = ["OWN_LEAVES"]

SORGHUM = phytofit.load_species()
OWN_LEAVES = replace(SORGHUM, space=ParameterSpace([replace(p, discrepancy=0.0) for p in SORGHUM.space.parameters]))
