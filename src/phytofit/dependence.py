"""How far errors of neighbouring points depend on each other, and what that does to an estimate's variance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from phytofit.flags import across_leaf
from phytofit.kernels.neighbors import sum_by_distance
from phytofit.likelihood import CloudLikelihood, State
from phytofit.models import Organ, move

__all__ = ["Dependence", "score_dependence", "width_misfit"]

FloatArray = NDArray[np.float64]
SHIFT = 0.3  # of the noise: by so much points are moved to see how their scores change
SURE = 0.9  # probability of its organ, of a point whose error is looked at
N_PROBED = 250  # points whose neighbours' errors are compared with theirs
LAG_CM = 0.25  # width of the distance classes for that
LONGEST_CM = 10.0
REACHES_CM = np.geomspace(0.2, 6.0, 30)
CLEAR = 4.0  # standard errors by which a correlation must differ from none
CELL = 0.5  # of the reach: points within such a cell count as one place
N_PIECES, LEAST_ON_PIECE = 15, 40  # of the leaf, whose width is compared with the model's; points
CUT = 2.5  # reaches at which the correlation counts as none


@dataclass(frozen=True)
class Dependence:
    """``variability`` (k, k): covariance of the sum of the scores; ``inflation``: how many times that of independent
    points it is, on average; ``n_independent``: number of independent points whose mean error varies as much;
    ``reach_cm``: standard deviation of the correlation's bell, 0 if there is none; ``correlation`` at no distance."""

    variability: FloatArray
    inflation: float
    n_independent: float
    reach_cm: float
    correlation: float


def score_dependence(likelihood: CloudLikelihood, state: State, known: Dependence | None = None) -> Dependence:
    """Covariance of the sum of scores of points whose errors are correlated with their neighbours'.

    How far they are correlated is taken from what is `known` of another model of the same cloud, if it is given.

    A spatial sandwich (Conley, J. Econometrics 92, 1999), but with a correlation that is first fitted to the points'
    distances from the surface: a bell over distance, a exp(-d² / (2 reach²)).  A score depends on a point's place on
    the surface, which is random too, so that products of neighbours' scores would not do; only the part that follows
    the errors counts, the scores' change when a point is moved.  Misfit of the model is correlated as well, and counts.
    """
    scores = likelihood.evaluate(state).scores
    independent = scores.T @ scores
    on_stem = scores[:, -2] + state.share[0]
    outlier = scores[:, -1] + state.share[2]
    noise = state.noise
    organs = move([o.row(0) for o in likelihood.model.organs(state.x)], likelihood.pose_of(state))
    frame, distance = _local(organs, likelihood.points, on_stem > 0.5)
    across = float(np.hypot(noise[1], noise[2]))
    std = np.where((on_stem > 0.5)[:, np.newaxis], noise[0], [noise[1], noise[1], across])  # tangent, lateral, normal
    errors = distance / std[:, 2]
    sure = np.maximum(on_stem, 1.0 - on_stem - outlier) > SURE
    for organ in (sure & (on_stem > 0.5), sure & (on_stem <= 0.5)):
        errors[organ] -= errors[organ].mean() if organ.any() else 0.0  # noise moves points off a tube on average
    # places on the surface: points that are near each other in space have been moved alike, by selection
    place = likelihood.points - distance[:, np.newaxis] * frame[:, :, 2]
    correlation, reach = (
        _correlation(place[sure], errors[sure]) if known is None else (known.correlation, known.reach_cm)
    )
    if correlation == 0.0:
        return Dependence(independent, 1.0, float(len(scores)), 0.0, 0.0)

    cell = np.floor(place / (CELL * reach)).astype(np.int64)
    number = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(number)
    center = np.stack([np.bincount(number, column) for column in place.T], axis=1) / count[:, np.newaxis]
    pairs = cKDTree(center).query_pairs(CUT * reach, output_type="ndarray")
    gap = np.linalg.norm(center[pairs[:, 0]] - center[pairs[:, 1]], axis=1)
    weight = coo_array((np.exp(-0.5 * (gap / reach) ** 2), pairs.T), shape=(len(count), len(count))).tocsr()
    extra = np.zeros_like(independent)
    for a in range(3):
        change = _change_of_scores(likelihood, state, frame[:, :, a], std[:, a])
        sums = np.stack([np.bincount(number, column) for column in change.T], axis=1)
        cross = sums.T @ (weight @ sums)
        extra += sums.T @ sums - change.T @ change + cross + cross.T
    values, vectors = np.linalg.eigh(extra)  # a bell that is cut off is not quite positive
    variability = independent + correlation * (vectors * np.maximum(values, 0.0)) @ vectors.T
    factor = cho_factor(independent + np.diag(likelihood.precision + 1e-9))
    inflation = float(np.trace(cho_solve(factor, variability + np.diag(likelihood.precision)))) / len(independent)
    alike = correlation * float(count @ (weight @ count) * 2.0 + count @ count) + (1.0 - correlation) * len(scores)
    return Dependence(variability, max(1.0, inflation), len(scores) ** 2 / alike, reach, correlation)


def _change_of_scores(likelihood: CloudLikelihood, state: State, direction: FloatArray, std: FloatArray) -> FloatArray:
    """Change (n, k) of each point's scores by one standard deviation `std` (n,) along its `direction` (n, 3)."""
    shift = (SHIFT * std)[:, np.newaxis] * direction
    there, back = (likelihood.at(likelihood.points + sign * shift).evaluate(state).scores for sign in (1.0, -1.0))
    return (there - back) / (2.0 * SHIFT)


def width_misfit(likelihood: CloudLikelihood, state: State, scores: FloatArray) -> float:
    """Standard deviation of the leaf's width about the model's, place by place, as a share of it, beyond chance.

    Points that are uniform across a strip vary by a third of its half width squared, and by the noise.
    """
    on_leaf = 1.0 - scores[:, -2] - state.share[0] - scores[:, -1] - state.share[2] > 0.5
    leaf = likelihood.model.organs(state.x)[1].row(0)
    lengths = leaf.segment_lengths
    place, across = across_leaf(likelihood, state)
    place, lateral = place[on_leaf], across[on_leaf, 0]
    half = np.interp(place * lengths.sum(), np.concatenate([[0.0], np.cumsum(lengths)]), leaf.half_width)
    ratio, chance = [], []
    for i in range(1, N_PIECES - 2):  # not where stem and tip are
        those = (place * N_PIECES).astype(int) == i
        n = np.count_nonzero(those)
        if n < LEAST_ON_PIECE:
            continue
        wide = np.mean(half[those] ** 2) / 3.0
        ratio.append(np.sqrt(max(0.0, np.mean(lateral[those] ** 2) - state.noise[1] ** 2) / wide))
        chance.append(0.2 / n * (1.0 + state.noise[1] ** 2 / wide) ** 2)
    if len(ratio) < 3:
        return 0.0
    return float(np.sqrt(max(0.0, np.var(ratio, ddof=1) - np.mean(chance))))


def _local(organs: tuple[Organ, ...], points: FloatArray, on_stem: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Frames (n, 3, 3), columns along, across, normal, of the surface near each point, and distances (n,) from it."""
    stem, leaf = organs
    piece, _ = leaf.nearest(points)
    frame = leaf.frame[piece]
    distance = np.einsum("ni,ni->n", points - leaf.axis[piece], frame[:, :, 2])
    axis = stem.frame[0, :, 0]
    radial = points[on_stem] - stem.axis[0]
    height, nodes = radial @ axis, np.concatenate([[0.0], np.cumsum(stem.segment_lengths)])
    radial -= (radial @ axis)[:, np.newaxis] * axis
    rho = np.linalg.norm(radial, axis=1)
    outward = radial / np.maximum(rho, 1e-9)[:, np.newaxis]
    axes = np.broadcast_to(axis, outward.shape)
    frame[on_stem] = np.stack([axes, np.cross(outward, axes), outward], axis=-1)
    distance[on_stem] = rho - np.interp(height, nodes, stem.half_width)
    return frame, distance


def _correlation(points: FloatArray, errors: FloatArray) -> tuple[float, float]:
    """Correlation at no distance and reach, cm, of a bell fitted to the products of errors (n,) of neighbours."""
    if len(points) < 2:
        return 0.0, 0.0
    probed = np.unique(np.linspace(0, len(points) - 1, N_PROBED).astype(int))
    n = int(LONGEST_CM / LAG_CM)
    count, total = np.empty(n), np.empty(n)
    sum_by_distance(points, errors, probed, LAG_CM, count, total)
    mean = total / np.maximum(count, 1.0) / np.mean(errors**2)
    middle = (np.arange(n) + 0.5) * LAG_CM
    twice = 2.0 if len(probed) == len(points) else 1.0  # each pair was met twice
    best, found = np.inf, (0.0, 0.0)
    for reach in REACHES_CM:
        bell = np.exp(-0.5 * (middle / reach) ** 2)
        height, below, square = _line(bell, mean, count)
        if below > 0.0:
            height, below, square = float(count @ (bell * mean)) / float(count @ bell**2), 0.0, float(count @ bell**2)
        misfit = float(count @ (mean - below - height * bell) ** 2)
        if height * np.sqrt(square / twice) > CLEAR and misfit < best:
            best, found = misfit, (min(height, 1.0), float(reach))
    return found


def _line(x: FloatArray, y: FloatArray, count: FloatArray) -> tuple[float, float, float]:
    """Slope and intercept of a line through weighted points, and the sum of squares that the slope rests on.

    A fit takes a part of the errors up, which leaves a little less than the bell at all distances: the intercept.
    """
    share = count / count.sum()
    x_mean, y_mean = float(share @ x), float(share @ y)
    square = max(float(count @ (x - x_mean) ** 2), 1e-12)
    slope = float(count @ ((x - x_mean) * y)) / square
    return slope, y_mean - slope * x_mean, square
