"""The leaf's width by those of its pieces that were seen whole: what is left beside a hole says little of it."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from phytofit.engine.layout import State
from phytofit.engine.posterior import Posterior
from phytofit.engine.visibility import N_STRIPS, Hidden

__all__ = ["WIDTHS", "of_whole_pieces"]

FloatArray = NDArray[np.float64]
WIDTHS = ("leaf_width", "leaf_base_width", "leaf_widest_at", "leaf_taper")  # what is told anew
LEAST_WHOLE = 0.1  # of the leaf's pieces


def of_whole_pieces(posterior: Posterior, state: State) -> Posterior | None:
    """The posterior of the points on those pieces of the leaf that have no hole, and whose neighbours have none.

    It may change the leaf's width along the midrib (but for its shoulder, which hardly shows on a part), the noise on
    the leaf and the shares; all else is held where `state` has it.  None where no holes are known, or hardly a piece is
    whole: then nothing better is known.

    Which points were left out was decided by where they lie along the leaf alone.  So the density of those that are
    left is that of the whole leaf, divided by what it has on these pieces, and where the holes end across the blade,
    which is not known well, has no part in it.
    """
    hidden = posterior.hidden
    if hidden is None or not hidden.share.any():
        return None
    left_out = binary_dilation(np.any(hidden.share > 0.0, axis=1), np.ones(3))
    if np.mean(~left_out & (np.arange(len(left_out)) < state.seen * len(left_out))) < LEAST_WHOLE:
        return None
    kept = ~left_out[hidden.leaf.nearest(posterior.points)[0]]
    others = Hidden(hidden.leaf, np.repeat(left_out[:, np.newaxis].astype(float), N_STRIPS, axis=1), hidden.void)
    free = state.layout.mask(*WIDTHS, "leaf_noise", "stem_share", "outlier_share")
    part = posterior.of_part(kept, others)
    return part.under(part.prior.fixing(state.theta, ~free))
