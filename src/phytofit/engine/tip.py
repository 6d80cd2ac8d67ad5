"""Whether a leaf's points end before it has tapered off, as they do where its tip was not seen."""

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
CUT = (0.5, 0.8, 0.95)  # of the window that is left, from which a cut is begun
FARTHEST = 10.0  # logarithms of lengths, in units of the noise, that the search may come to
THIN, STRAY = 1e-3, 1e-9  # of the noise: a width that is none; density of points that the strip does not explain
N_PROFILE = 50  # places at which the leaf's own width is taken


def gain_of_blunt_end(posterior: Posterior, state: State, at: Evaluation) -> float:
    """Log probability, nats, that the points at the end of a whole leaf gain if it may be cut off; infinite where they
    are too few to tell.

    A strip that narrows as the fitted leaf does is fitted to the places of the points along and across the last quarter
    of the midrib, by maximum likelihood: uniform, with normal noise, once whole and once cut off anywhere, as long and
    as wide as need be.  What the rest of the leaf is like has no part in it.

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
    share = np.linspace(0.0, 1.0, N_PROFILE)
    nodes = (np.linspace(0.0, 1.0, len(leaf.half_width)) - 1.0 + WINDOW) / WINDOW
    half_width = np.interp(share, nodes, leaf.half_width)
    start, narrows = float(half_width[0]) / noise, half_width / max(float(half_width[0]), 1e-9)
    before = np.append(0.0, np.cumsum(0.5 * (narrows[1:] + narrows[:-1]))) / (N_PROFILE - 1)

    def error(logs: FloatArray) -> float:
        end, first, *rest = np.exp(np.clip(logs, -FARTHEST, FARTHEST))
        left = min(rest[0], 1.0) if rest else 1.0
        half = np.maximum(first * np.interp(left * np.clip(along / end, 0.0, 1.0), share, narrows), THIN)
        inside = (ndtr(half + lateral) + ndtr(half - lateral) - 1.0) * ndtr(end - along)
        area = 2.0 * end * first * float(np.interp(left, share, before)) / left
        return -float(np.log(np.maximum(inside, 0.0) / area + STRAY).sum())

    best = []
    for cuts in ((), CUT):
        begun = [[np.log(float(along.max())), np.log(start), np.log(cut)] for cut in cuts]
        begun = begun or [[np.log(end), np.log(start)] for end in (WINDOW * length / noise, float(along.max()))]
        best.append(min(minimize(error, x, method="Nelder-Mead", options={"maxiter": 400}).fun for x in begun))
    whole, cut_off = best
    return float(whole - cut_off)
