"""The default method: the most probable phytomer of a cloud, and how sure that is."""

from phytofit.engine.outcome import Estimate
from phytofit.engine.search import estimate

__all__ = ["Estimate", "estimate"]
