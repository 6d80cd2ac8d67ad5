"""What a fit says: traits with their intervals, and remarks on what they rest on."""

from phytofit.results.fit import Fit, beside_its_rival, remarked

__all__ = ["Fit", "beside_its_rival", "remarked"]
