"""Parametric plant models: x -> organs, and what all organs share."""

from phytofit.models.organs import LEAF, STEM, Organ, SurfaceSampler, mesh, move
from phytofit.models.phytomer import Phytomer

__all__ = ["LEAF", "STEM", "Organ", "Phytomer", "SurfaceSampler", "mesh", "move"]
