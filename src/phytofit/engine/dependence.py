"""How far errors of neighbouring points depend on each other, and what that does to an estimate's variance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior
from phytofit.engine.sighting import across_leaf
from phytofit.kernels.neighbors import sum_by_distance
from phytofit.models import Organ, move
from phytofit.models.surface import on_strip

__all__ = ["Dependence", "score_dependence", "width_misfit"]

FloatArray = NDArray[np.float64]
SHIFT = 0.3  # of the noise: by so much points are moved to see how their scores change
SURE = 0.9  # probability of its organ, of a point whose error is looked at
N_PROBED = 250  # points whose neighbours' errors are compared with theirs
LAG_CM = 0.25  # width of the distance classes for that
LONGEST_CM = 10.0
MIDDLES_CM: FloatArray = LAG_CM * (np.arange(round(LONGEST_CM / LAG_CM), dtype=np.float64) + 0.5)
REACHES_CM = np.geomspace(0.2, 6.0, 30)
CLEAR, CLEAR_OF_ORGAN = 4.0, 3.0  # standard errors by which a correlation must differ from none: of all, of an organ
N_EXPECTED = 300  # points for which it is computed what a fit leaves of their errors
FARTHER = 1.5  # times: a misfit of the model, which no fit took up, would else be taken for errors without end
HEIGHTS = np.linspace(0.05, 1.0, 20)
CELL = 0.5  # of the reach: points within such a cell count as one place
N_PIECES, LEAST_ON_PIECE = 15, 40  # of the leaf, whose width is compared with the model's; points
CUT = 2.5  # reaches at which the correlation counts as none


class GaussianCorrelation(NamedTuple):
    """Correlation of errors over distance: at none, and the standard deviation of its bell, cm; 0 if there is none."""

    correlation: float
    reach_cm: float


NONE = GaussianCorrelation(0.0, 0.0)


@dataclass(frozen=True)
class Dependence:
    """``variability`` (k, k): covariance of the sum of the scores; ``inflation``: how many times that of independent
    points it is, on average; ``n_independent``: number of independent points whose mean error varies as much;
    ``stem``, ``leaf``: how errors of neighbours on each are correlated."""

    variability: FloatArray
    inflation: float
    n_independent: float
    stem: GaussianCorrelation
    leaf: GaussianCorrelation


def score_dependence(posterior: Posterior, state: State, known: Dependence | None = None) -> Dependence:
    """Covariance of the sum of scores of points whose errors are correlated with their neighbours'.

    How far they are correlated is taken from what is `known` of another model of the same cloud, if it is given.

    A spatial sandwich (Conley, J. Econometrics 92, 1999), but with a correlation that is first fitted to the points'
    distances from the surface: a bell over distance, a exp(-d² / (2 reach²)).  A score depends on a point's place on
    the surface, which is random too, so that products of neighbours' scores would not do; only the part that follows
    the errors counts, the scores' change when a point is moved.  Misfit of the model is correlated as well, and counts;
    where it is far less on one of stem and leaf, the bell is lower there.
    """
    at = posterior.evaluate(state)
    scores = at.scores
    independent = scores.T @ scores
    on_stem, _, outlier = at.responsibilities.T
    noise = state.noise
    organs = move([o.row(0) for o in posterior.model.organs(state.x)], posterior.pose_of(state))
    frame, distance = _local(organs, posterior.points, on_stem > 0.5)
    across = float(np.hypot(noise[1], noise[2]))
    std = np.where((on_stem > 0.5)[:, np.newaxis], noise[0], [noise[1], noise[1], across])  # tangent, lateral, normal
    errors = distance / std[:, 2]
    sure = np.maximum(on_stem, 1.0 - on_stem - outlier) > SURE
    organs_of = (on_stem > 0.5, on_stem <= 0.5)
    for organ in organs_of:
        one = sure & organ
        errors[one] -= errors[one].mean() if one.any() else 0.0  # noise moves points off a tube on average
    # places on the surface: points that are near each other in space have been moved alike, by selection
    place = posterior.points - distance[:, np.newaxis] * frame[:, :, 2]
    bells, both = [NONE, NONE], NONE
    if known is not None:
        bells = [known.stem, known.leaf]
    elif (both := _correlation(place[sure], errors[sure])) != NONE:
        bells = [_of_organ(place[sure & o], errors[sure & o], both) for o in organs_of]
    if bells == [NONE, NONE]:
        return Dependence(independent, 1.0, float(len(scores)), NONE, NONE)

    changes = [_change_of_scores(posterior, state, frame[:, :, a], std[:, a]) for a in range(3)]
    if known is None:
        information = independent + np.diag(posterior.prior.precision + 1e-9)
        whole = _before_the_fit(
            place[sure], errors[sure], [change[sure] for change in changes], information, both.reach_cm
        )
        bells = [
            GaussianCorrelation(whole.correlation * bell.correlation / both.correlation, whole.reach_cm)
            for bell in bells
        ]
    variability, alike = independent.copy(), 0.0
    for organ, bell in zip(organs_of, bells, strict=True):
        if bell == NONE:
            alike += np.count_nonzero(organ)
            continue
        extra, pairs = _alike(place[organ], [change[organ] for change in changes], bell.reach_cm)
        variability += bell.correlation * extra
        alike += bell.correlation * pairs + (1.0 - bell.correlation) * np.count_nonzero(organ)
    factor = cho_factor(independent + np.diag(posterior.prior.precision + 1e-9))
    inflation = float(np.trace(cho_solve(factor, variability + np.diag(posterior.prior.precision)))) / len(independent)
    return Dependence(variability, max(1.0, inflation), len(scores) ** 2 / alike, *bells)


def _alike(places: FloatArray, changes: Sequence[FloatArray], reach_cm: float) -> tuple[FloatArray, float]:
    """Sum (k, k) over pairs of points at their `places` (n, 3), weighted by the bell of their distance, of products of
    their scores' `changes` (n, k), but of points with themselves; and the sum of the weights of all pairs."""
    cell = np.floor(places / (CELL * reach_cm)).astype(np.int64)
    number = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(number)
    center = np.stack([np.bincount(number, column) for column in places.T], axis=1) / count[:, np.newaxis]
    pairs = cKDTree(center).query_pairs(CUT * reach_cm, output_type="ndarray")
    gap = np.linalg.norm(center[pairs[:, 0]] - center[pairs[:, 1]], axis=1)
    weight = coo_array((np.exp(-0.5 * (gap / reach_cm) ** 2), pairs.T), shape=(len(count), len(count))).tocsr()
    extra = np.zeros((changes[0].shape[1],) * 2)
    for change in changes:
        sums = np.stack([np.bincount(number, column) for column in change.T], axis=1)
        cross = sums.T @ (weight @ sums)
        extra += sums.T @ sums - change.T @ change + cross + cross.T
    values, vectors = np.linalg.eigh(extra)  # a bell that is cut off is not quite positive
    positive: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive, float(count @ (weight @ count) * 2.0 + count @ count)


def _change_of_scores(posterior: Posterior, state: State, direction: FloatArray, std: FloatArray) -> FloatArray:
    """Change (n, k) of each point's scores by one standard deviation `std` (n,) along its `direction` (n, 3)."""
    shift = (SHIFT * std)[:, np.newaxis] * direction
    there, back = (posterior.at(posterior.points + sign * shift).evaluate(state).scores for sign in (1.0, -1.0))
    return (there - back) / (2.0 * SHIFT)


def width_misfit(posterior: Posterior, state: State, at: Evaluation, bell: GaussianCorrelation) -> float:
    """Standard deviation of the leaf's width about the model's, place by place, as a share of it, beyond chance.

    Points that are uniform across a strip vary by a third of its half width squared, and by the noise, which neighbours
    share as the `bell` says.
    """
    on_leaf = at.responsibilities[:, 1] > 0.5
    leaf = posterior.model.organs(state.x)[1].row(0)
    lengths = leaf.segment_lengths
    place, across = across_leaf(posterior, state)
    place, lateral = place[on_leaf], across[on_leaf, 0]
    half = np.interp(place * lengths.sum(), np.concatenate([[0.0], np.cumsum(lengths)]), leaf.half_width)
    ratio, chance = [], []
    hidden = posterior.hidden
    whole = np.ones(posterior.model.n_pieces, bool) if hidden is None else ~hidden.pieces
    for i in range(1, N_PIECES - 2):  # not where stem and tip are
        low, high = (int(np.floor(end * len(whole) / N_PIECES)) for end in (i, i + 1))
        those = (place * N_PIECES).astype(int) == i
        n = np.count_nonzero(those)
        if n < LEAST_ON_PIECE or not whole[low:high].all():
            continue
        wide = np.mean(half[those] ** 2) / 3.0
        ratio.append(np.sqrt(max(0.0, np.mean(lateral[those] ** 2) - state.noise[1] ** 2) / wide))
        noise = state.noise[1] ** 2 / wide
        area = 2.0 * np.mean(half[those]) * lengths.sum() / N_PIECES
        patches = np.clip(area / max(2.0 * np.pi * bell.reach_cm**2, 1e-9), 1.0, n)  # whose noise is its own
        chance.append(0.2 / n * (1.0 + noise) ** 2 + bell.correlation * noise * (1.0 + 0.25 * noise) / patches)
    if len(ratio) < 3:
        return 0.0
    spread = 1.4826 * np.median(np.abs(ratio - np.median(ratio)))  # a hole that is not known of is no misfit
    return float(np.sqrt(max(0.0, spread**2 - np.mean(chance))))


def _local(organs: tuple[Organ, ...], points: FloatArray, on_stem: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Frames (n, 3, 3), columns along, across, normal, of the surface near each point, and distances (n,) from it."""
    stem, leaf = organs
    by = on_strip(leaf, points)
    frame, distance = by.frame, by.off
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


class _Products(NamedTuple):
    """Number of pairs of points and mean product of their errors, in units of their square's mean, by the distance
    between them (`MIDDLES_CM`); and how often each pair was met."""

    pairs: FloatArray
    mean: FloatArray
    met: float

    @classmethod
    def of(cls, points: FloatArray, errors: FloatArray) -> "_Products":
        probed = np.unique(np.linspace(0, len(points) - 1, N_PROBED).astype(int))
        count, total = np.empty_like(MIDDLES_CM), np.empty_like(MIDDLES_CM)
        sum_by_distance(points, errors, probed, LAG_CM, count, total)
        mean = total / np.maximum(count, 1.0) / np.mean(errors**2)
        return cls(count, mean, 2.0 if len(probed) == len(points) else 1.0)

    def height(self, reach_cm: float) -> tuple[float, float, float]:
        """Of the bell of this reach that fits best; its standard error; and what the fit leaves."""
        bell = np.exp(-0.5 * (MIDDLES_CM / reach_cm) ** 2)
        height, below, square = _line(bell, self.mean, self.pairs)
        if below > 0.0:
            square = float(self.pairs @ bell**2)
            height, below = float(self.pairs @ (bell * self.mean)) / square, 0.0
        misfit = float(self.pairs @ (self.mean - below - height * bell) ** 2)
        return height, np.sqrt(self.met / square), misfit


def _correlation(points: FloatArray, errors: FloatArray) -> GaussianCorrelation:
    """The bell that fits the products of errors (n,) of neighbours best, of those that are clear."""
    if len(points) < 2:
        return NONE
    products = _Products.of(points, errors)
    best, found = np.inf, NONE
    for reach in REACHES_CM.tolist():
        height, error, misfit = products.height(reach)
        if height > CLEAR * error and misfit < best:
            best, found = misfit, GaussianCorrelation(min(height, 1.0), reach)
    return found


def _before_the_fit(
    points: FloatArray, errors: FloatArray, changes: Sequence[FloatArray], information: FloatArray, left_cm: float
) -> GaussianCorrelation:
    """The bell of the errors (n,) as they were before a fit took a part of them up, the more of those that reach far.

    What is left of errors with covariance C after a fit is (I - H) C (I - H)'.  H, which says how the fit follows the
    errors, is known from the scores' `changes` (n, k) by errors in three directions, the last across the surface, and
    the `information` (k, k).  So for each bell it can be told what products of neighbours' errors would be left, and
    the bell is taken for which these are nearest to those that are found.
    """
    products = _Products.of(points, errors)
    some = np.unique(np.linspace(0, len(points) - 1, N_EXPECTED).astype(int))
    each = len(points) / len(some)  # of which each stands for so many
    moved = [change[some] for change in changes]
    follow = np.linalg.solve(information, moved[2].T)  # (k, m): how the fit follows an error, and takes it up elsewhere
    gap = np.linalg.norm(points[some, np.newaxis] - points[some], axis=2)
    lag = (gap / LAG_CM).astype(int)
    pair = ~np.eye(len(some), dtype=bool) & (lag < len(MIDDLES_CM))
    count = np.bincount(lag[pair], minlength=len(MIDDLES_CM))
    taken = moved[2] @ follow

    def by_lag(left: FloatArray) -> FloatArray:
        return np.bincount(lag[pair], left[pair], minlength=len(MIDDLES_CM)) / np.maximum(count, 1)

    weight = np.where(count > 0, products.pairs, 0.0)
    white, white_at_none = -by_lag(taken), 1.0 - float(np.mean(np.diag(taken)))
    best, found = np.inf, NONE
    for reach in REACHES_CM[FARTHER * left_cm >= REACHES_CM].tolist():
        alike = np.exp(-0.5 * (gap / reach) ** 2)
        once = each * (moved[2] @ np.linalg.solve(information, moved[2].T @ alike))
        sums = each**2 * sum(change.T @ alike @ change for change in moved)
        left = alike - once - once.T + follow.T @ sums @ follow
        shared, shared_at_none = by_lag(left), float(np.mean(np.diag(left)))
        for correlation in HEIGHTS.tolist():
            at_none = correlation * shared_at_none + (1.0 - correlation) * white_at_none
            expected = (correlation * shared + (1.0 - correlation) * white) / at_none
            misfit = float(weight @ (products.mean - expected) ** 2)
            if misfit < best:
                best, found = misfit, GaussianCorrelation(correlation, reach)
    return found


def _of_organ(points: FloatArray, errors: FloatArray, both: GaussianCorrelation) -> GaussianCorrelation:
    """The bell of one organ: that of both, unless its own is clearly lower than half of it (a fit takes up more of the
    errors of the smaller organ)."""
    if len(points) < 2:
        return both
    height, error, _ = _Products.of(points, errors).height(both.reach_cm)
    if height + CLEAR_OF_ORGAN * error >= 0.5 * both.correlation:
        return both
    return both._replace(correlation=height) if height > CLEAR_OF_ORGAN * error else NONE


def _line(x: FloatArray, y: FloatArray, count: FloatArray) -> tuple[float, float, float]:
    """Slope and intercept of a line through weighted points, and the sum of squares that the slope rests on.

    A fit takes a part of the errors up, which leaves a little less than the bell at all distances: the intercept.
    """
    share = count / max(float(count.sum()), 1.0)  # none are near each other where hardly a point is the organ's
    x_mean, y_mean = float(share @ x), float(share @ y)
    square = max(float(count @ (x - x_mean) ** 2), 1e-12)
    slope = float(count @ ((x - x_mean) * y)) / square
    return slope, y_mean - slope * x_mean, square
