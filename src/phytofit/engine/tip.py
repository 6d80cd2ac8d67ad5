"""Whether a leaf's points end bluntly, as they do where its tip was not seen."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtr

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior
from phytofit.engine.sighting import across_leaf

__all__ = ["gain_of_blunt_end"]

FloatArray = NDArray[np.float64]
WINDOW = 0.25  # of the midrib, before its end, that is looked at
LEAST_THERE = 50  # points in it: a twentieth of a leaf that is missing makes some four nats a hundred
BLUNT = (0.1, 0.4, 0.8)  # of the width at the window's start, from which the width at the end is begun
FARTHEST = 10.0  # logarithms of lengths, in units of the noise, that the search may come to
POINTED, STRAY = 1e-3, 1e-9  # of the noise: a width that is none; density of points that the strip does not explain


def gain_of_blunt_end(posterior: Posterior, state: State, at: Evaluation) -> float:
    """Log probability, nats, that the points at the end of a whole leaf gain if it may end bluntly; infinite where they
    are too few to tell.

    A strip that narrows evenly is fitted to the places of the points along and across the last quarter of the midrib,
    by maximum likelihood: uniform, with normal noise, once to a point and once to any width.  What the rest of the leaf
    is like has no part in it.

    Parameters
    ----------
    state : of a leaf that is taken as whole
    at : the state evaluated
    """
    on_leaf = at.responsibilities[:, 1]
    place, across = across_leaf(posterior, state)
    leaf = posterior.model.organs(state.x)[1].row(0)
    length = float(leaf.segment_lengths.sum())
    there = (on_leaf > 0.5) & (place > 1.0 - WINDOW)
    if np.count_nonzero(there) < LEAST_THERE:
        return np.inf
    noise = state.noise[1]
    along, lateral = (place[there] - 1.0 + WINDOW) * length / noise, across[there, 0] / noise  # in units of the noise
    start = float(np.interp(1.0 - WINDOW, np.linspace(0.0, 1.0, len(leaf.half_width)), leaf.half_width)) / noise

    def error(logs: FloatArray) -> float:
        end, first, *rest = np.exp(np.clip(logs, -FARTHEST, FARTHEST))
        last = rest[0] if rest else POINTED
        half = np.maximum(first + (last - first) * np.clip(along / end, 0.0, 1.0), POINTED)
        inside = (ndtr(half + lateral) + ndtr(half - lateral) - 1.0) * ndtr(end - along)
        return -float(np.log(np.maximum(inside, 0.0) / (end * (first + last)) + STRAY).sum())

    ends = WINDOW * length / noise, float(along.max())
    best = []
    for widths in ((), BLUNT):
        begun = [[np.log(end), np.log(start), *np.log([width * start])] for end in ends for width in widths]
        begun = begun or [[np.log(end), np.log(start)] for end in ends]
        best.append(min(minimize(error, x, method="Nelder-Mead", options={"maxiter": 400}).fun for x in begun))
    pointed, blunt = best
    return float(pointed - blunt)
