"""Where a leaf ends: by the model of the whole leaf, and by its own last points."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior
from phytofit.engine.sighting import across_leaf
from phytofit.models import move
from phytofit.models.surface import places_on_strip

__all__ = ["MISFIT", "Ending", "PointsEnd", "combined", "ending", "points_end"]

FloatArray = NDArray[np.float64]
N_DECIDE, LEAST_DECIDE = 120, 40  # points before the end that tell where it is; fewer than the latter don't
NEAREST, OUTERMOST = 0.10, 0.35  # of the midrib, before the last point: they are taken from more, and from less
POWERS = np.exp(np.linspace(np.log(0.15), np.log(4.0), 7))  # of the way left to the end, as which the width falls
POWER_SPREAD = 0.7  # of their logarithms, before the points are seen
WIDTHS = np.exp(np.linspace(-0.2, 0.2, 3))  # times the width that the points' variance across the blade has
SHARPER = (0.4, 0.65, 1.0)  # times the noise of the whole leaf, which has its misfit too; as probable as their squares
N_ENDS = 17  # that are weighed, twice: all that may be, and those that turn out to be probable
NODES, SHARES = np.sqrt(3.0) * np.array([0.0, 1.0, -1.0]), np.array([4.0, 1.0, 1.0]) / 6.0  # Gauss-Hermite
NEAREST_END, FARTHEST = 0.3, 1.5  # of the way from the first to the last of these points
BEYOND, NEAR = 1.1, 2.0  # of the length, to which it is continued; noise levels within which points are its
N_STEPS, ACROSS, LEAST_SEEN = 60, (-0.6, 0.0, 0.6), 0.02  # along the strip; places across; share seen, at least
STEP = 1e-4  # for derivatives of the tip
CLEARLY = 2.0  # standard errors
MISFIT = 0.018  # of the length, by which the model's end is off, of real leaves: benchmarks/leaf_ends.py
N_BANDS = 8  # with equal numbers of expected points, in which the evenness of the points is tested
NOTHING = 1e-12  # of a strip that ends before all its points
STRAY = 1e-9  # density of points that the strip does not explain, in units of the noise


class PointsEnd(NamedTuple):
    """Where along the midrib, cm from its start, a leaf's own last points say that it ends, and the standard error."""

    at: float
    error: float


class Ending(NamedTuple):
    """``share`` of the fitted midrib at which the leaf ends, and by how much (k + 14, k + 14) to know that has
    ``changed`` the covariance of what was fitted; whether it is ``clearly_shorter`` than the fitted leaf."""

    share: float
    changed: FloatArray
    clearly_shorter: bool = False


class _Steps(NamedTuple):
    """Steps along the strip: their middles (s,), length, and share (s,) that was seen there."""

    at: FloatArray
    long: float
    seen: FloatArray

    def expected(self, end: float, power: float) -> FloatArray:
        """Points (s,) in each step, relative to those where the strip is widest."""
        tapered: FloatArray = np.clip(1.0 - self.at / end, 0.0, 1.0) ** power * self.seen * self.long
        return tapered


def points_end(posterior: Posterior, state: State, at: Evaluation) -> PointsEnd | None:
    """Where the leaf's last points say that it ends, whatever the rest of it is like; None where they are too few.

    Their places along and across the midrib are uniform, with normal noise, on a strip whose width falls as a power of
    the way that is left to its end: below 1 it is blunt, 1 a point, above 1 hollow.  End, power and width are weighed
    on a grid; the answer is the median of the end's posterior, with its standard deviation.  Where points lie less
    evenly than that, in bands along the strip, they count for fewer (a quasi-likelihood: McCullagh and Nelder,
    Generalized Linear Models, 1989, ch. 9).

    Parameters
    ----------
    at : the state evaluated
    """
    noise = float(state.noise[1])
    length, place, across = _near_leaf(posterior, state, at)
    if len(place) < LEAST_DECIDE:
        return None
    last = float(place.max())
    start = float(np.sort(place)[max(0, len(place) - 1 - N_DECIDE)])
    start = min(max(start, last - OUTERMOST * length), last - NEAREST * length)
    there = place > start
    if np.count_nonzero(there) < LEAST_DECIDE:
        return None
    along, lateral = (place[there] - start) / noise, across[there] / noise  # in units of the noise
    lateral -= np.median(lateral)
    far = float(along.max())
    step = FARTHEST * far / N_STEPS
    middles = step * (np.arange(N_STEPS, dtype=float) + 0.5)
    steps = _Steps(middles, step, _seen_along(posterior, state, start + middles * noise))
    ends = np.linspace(max(0.95 * far - 2.5, NEAREST_END * far), FARTHEST * far, N_ENDS)
    fits = _of_strips(ends, along, lateral, steps)
    i, _, j, _ = np.unravel_index(int(np.argmax(fits)), fits.shape)
    uneven = _unevenness(along, steps.expected(float(ends[i]), float(POWERS[j])), steps)
    middle, spread = _median_and_spread(ends, fits / uneven)
    ends = middle + max(spread, 0.5 * float(ends[1] - ends[0])) * np.linspace(-4.0, 4.0, N_ENDS)
    ends = ends[ends > NEAREST_END * far]
    if len(ends) < 2:  # nearer than the strip begins
        return None
    middle, spread = _median_and_spread(ends, _of_strips(ends, along, lateral, steps) / uneven)
    return PointsEnd(start + middle * noise, spread * noise)


def _near_leaf(posterior: Posterior, state: State, at: Evaluation) -> tuple[float, FloatArray, FloatArray]:
    """Length of the fitted midrib, and places (n,) along it and sideways, cm, of the leaf's points, and of those near
    to its straight continuation, where the fitted leaf has none."""
    length = float(posterior.model.organs(state.x)[1].row(0).segment_lengths.sum())
    place, across = across_leaf(posterior, state, until=BEYOND)
    near = NEAR * np.array([state.noise[1], np.hypot(state.noise[1], state.noise[2])])
    beyond = (place > 1.0) & (place < BEYOND) & (np.abs(across) < near).all(axis=1) & (posterior.organ != 0)
    theirs = (at.responsibilities[:, 1] > 0.5) | beyond
    return length, length * place[theirs], across[theirs, 0]


def _of_strips(ends: FloatArray, along: FloatArray, lateral: FloatArray, steps: _Steps) -> FloatArray:
    """Log probability (e, s, p, w) of the points on strips of `ends` (e,), noise, powers and widths; places (n,) in
    units of the noise."""
    fits = np.empty((len(ends), len(SHARPER), len(POWERS), len(WIDTHS)))
    for k, noise in enumerate(SHARPER):
        places, sideways = along[:, np.newaxis] + noise * NODES, lateral[:, np.newaxis]  # where points may come from
        for i, end in enumerate(ends):
            left = np.clip(1.0 - places / end, 0.0, 1.0)
            for j, power in enumerate(POWERS):
                profile = left**power
                variance = np.sum(lateral**2 - noise**2) / max(np.sum(profile[:, 0] ** 2), NOTHING)
                half = np.sqrt(3.0 * max(variance, 0.01)) * WIDTHS[:, np.newaxis, np.newaxis]
                edge = half * profile
                inside = (ndtr((edge + sideways) / noise) - ndtr((sideways - edge) / noise)) @ SHARES
                density = inside / (2.0 * half[:, :, 0] * steps.expected(end, power).sum())
                fits[i, k, j] = np.log(density + STRAY).sum(axis=1)
    return fits


def _unevenness(along: FloatArray, expected: FloatArray, steps: _Steps) -> float:
    """Pearson's statistic of points (n,) in bands of about as many expected ones, for each degree of freedom; 1 or
    more.  `expected` (s,) of the steps, in any measure."""
    before = np.cumsum(expected) / expected.sum()
    edges = np.searchsorted(before, np.arange(1, N_BANDS) / N_BANDS)
    wanted = len(along) * np.diff(np.concatenate([[0.0], before[edges], [1.0]]))
    found = np.histogram(along, np.concatenate([[-np.inf], steps.at[edges] + 0.5 * steps.long, [np.inf]]))[0]
    bands = wanted > 0.0  # none where the expected all lie in one step, of a leaf hardly seen there
    return max(1.0, float(np.sum((found - wanted)[bands] ** 2 / wanted[bands])) / (N_BANDS - 3))


def _seen_along(posterior: Posterior, state: State, at: FloatArray) -> FloatArray:
    """Share (s,) of the leaf that was seen at places `at` (s,) along its midrib, cm."""
    if posterior.hidden is None:
        return np.ones(len(at))
    leaf = move([posterior.model.organs(state.x)[1].row(0)], posterior.pose_of(state))[0]
    nodes = np.append(0.0, np.cumsum(leaf.segment_lengths))
    piece = np.clip(np.searchsorted(nodes, at) - 1, 0, len(leaf.frame) - 1)
    half = np.interp(at, nodes, leaf.half_width)
    across = [places_on_strip(leaf, piece, at - nodes[piece], share * half) for share in ACROSS]
    hidden = np.mean([posterior.hidden.around(places) for places in across], axis=0)
    seen: FloatArray = np.maximum(1.0 - hidden, LEAST_SEEN)
    return seen


def _median_and_spread(ends: FloatArray, fits: FloatArray) -> tuple[float, float]:
    """Median and standard deviation of the end, of log probabilities (e, s, p, w) of the points on an even grid."""
    posterior = fits - 0.5 * (np.log(POWERS)[:, np.newaxis] / POWER_SPREAD) ** 2
    posterior += 2.0 * np.log(SHARPER)[:, np.newaxis, np.newaxis]
    weight = np.exp(posterior - posterior.max()).sum(axis=(1, 2, 3))
    weight /= weight.sum()
    spread = np.sqrt(max(0.0, float(weight @ ends**2 - (weight @ ends) ** 2)))
    return float(np.interp(0.5, np.cumsum(weight) - 0.5 * weight, ends)), float(spread)


def combined(end: float, error: float, told: PointsEnd) -> tuple[float, float]:
    """An end that follows from the whole leaf, with a standard error, and what its points tell of it: both, by their
    precisions, and the standard error of that, as both rest on the same points: their errors may be the same.

    Where they differ by more than their errors, the whole leaf's has one more: a leaf need not taper as the model does
    (a random effect of the model; DerSimonian and Laird, Controlled Clinical Trials 7, 1986).
    """
    variance = max(error**2, (end - told.at) ** 2 - told.error**2)
    weight = variance / (variance + told.error**2)
    return end - weight * (end - told.at), float(weight * told.error + (1.0 - weight) * np.sqrt(variance))


def ending(
    posterior: Posterior, state: State, at: Evaluation, covariance: FloatArray, shared_cm: float = 0.0
) -> Ending:
    """Where the leaf ends, by its model and, where they are enough to tell, by its last points.

    Parameters
    ----------
    at : the state evaluated
    covariance : (k + 14, k + 14) of the error of what was fitted
    shared_cm : error that the last points have in common
    """
    told = points_end(posterior, state, at)
    moved = _tip_moved(posterior, state)
    of_tip = covariance @ moved
    error = float(np.sqrt(max(float(moved @ of_tip), 1e-12)))
    length = float(posterior.model.organs(state.x)[1].row(0).segment_lengths.sum())
    end, left = length, float(np.hypot(error, MISFIT * length))
    if told is not None:
        end, left = combined(end, left, told._replace(error=float(np.hypot(told.error, shared_cm))))
    changed = (left**2 - error**2) / error**4 * np.outer(of_tip, of_tip)
    return Ending(end / length, changed, bool(length - end > CLEARLY * left))


def _tip_moved(posterior: Posterior, state: State) -> FloatArray:
    """How far (k + 14,) the fitted leaf's tip moves on, along its midrib, with each entry of theta."""

    def tip(theta: FloatArray) -> FloatArray:
        there = state.at(theta)
        pose, axis = posterior.pose_of(there), posterior.organs(there)[1].axis
        place: FloatArray = axis[-2:] @ pose[:3, :3].T + pose[:3, 3]
        return place

    ahead = np.diff(tip(state.theta), axis=0)[0]
    ahead /= np.linalg.norm(ahead)
    steps = STEP * np.eye(len(state.theta))
    moves = np.stack([tip(state.theta + step)[1] - tip(state.theta - step)[1] for step in steps])
    moved: FloatArray = moves @ ahead / (2.0 * STEP)
    return moved
