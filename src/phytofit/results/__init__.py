"""What a fit says: traits with their intervals and quality, and remarks on what they rest on."""

from phytofit.results.fit import Fit
from phytofit.results.fitted import FittedPhytomer
from phytofit.results.paper import PaperFit
from phytofit.results.quality import graded
from phytofit.results.remarks import Placed, Remark, grouped, of_codes, remark
from phytofit.results.review import beside_its_rival, reviewed

__all__ = [
    "Fit",
    "FittedPhytomer",
    "PaperFit",
    "Placed",
    "Remark",
    "beside_its_rival",
    "graded",
    "grouped",
    "of_codes",
    "remark",
    "reviewed",
]
