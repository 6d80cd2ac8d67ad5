"""Results against a ruler, and against simulations (in `phytofit.validation.trials`, which fits)."""

from phytofit.validation.agreement import Agreement, agreement, concordance
from phytofit.validation.matching import PAIR_COLUMNS, Comparison, compare
from phytofit.validation.measures import read_measures, read_results
from phytofit.validation.tables import listed

__all__ = [
    "PAIR_COLUMNS",
    "Agreement",
    "Comparison",
    "agreement",
    "compare",
    "concordance",
    "listed",
    "read_measures",
    "read_results",
]
