"""Pictures of results.  Functions of a result that return a figure; nothing here needs a screen."""

from phytofit.plots.agreement import plot_agreement, plot_trials
from phytofit.plots.phytomer import plot_convergence, plot_fit
from phytofit.plots.plant import plot_plant, plot_reconstruction, plot_segmentation
from phytofit.plots.several import plot_plants

__all__ = [
    "plot_agreement",
    "plot_convergence",
    "plot_fit",
    "plot_plant",
    "plot_plants",
    "plot_reconstruction",
    "plot_segmentation",
    "plot_trials",
]
