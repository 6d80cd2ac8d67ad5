"""The most probable phytomer of a cloud, and how well the cloud determines it."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh
from scipy.spatial import cKDTree
from scipy.special import expit, stdtrit

from phytofit.beginnings import along_points, lower_insertion, turned_blade
from phytofit.covariance import covariance_of, grown, misfit_of, mixed
from phytofit.dependence import Dependence, score_dependence, width_misfit
from phytofit.distances import Reference, chamfer
from phytofit.flags import OFFSET, Sighting, along_stem, sighting
from phytofit.hidden import Hidden
from phytofit.holes import find_holes
from phytofit.likelihood import NOISE, OUTLIERS, THICKNESS, CloudLikelihood, Evaluation, State
from phytofit.objectives import PaperObjective, minimise
from phytofit.optimize import CrossEntropy, Generation, Refined, refine
from phytofit.species import Species
from phytofit.tip import blunt_end
from phytofit.whole_pieces import of_whole_pieces

__all__ = ["DITHER_CM", "Estimate", "estimate"]

FloatArray = NDArray[np.float64]
COARSE_POINTS = 700  # that decide which start is the best
FEW_POINTS = 1250  # with which a refinement begins, and which decide from where a richer leaf is begun
SCOUT_ITERATIONS, COARSE_ITERATIONS = 5, 25  # of all starts; then of those that may be the best
LEFT_OUT = 0.1  # share of outliers, above which all starts are tried again with few of them
HELD_OUTLIERS, HELD_ITERATIONS = 0.1, 12  # at most, then, for each point of the leaf
HOPELESS = 0.3  # nats for each point, by which a start is behind after the first
COARSE_TOLERANCE = 1.0  # nats; it is refined with all points afterwards
START_NOISE = 0.036  # of the expected leaf's length: wide, so that a start some cm off is drawn in
CUT_SHARES = (0.85, 0.97)  # of the midrib, from which the search for a missing tip starts; the second of rich leaves
DITHER_CM = 0.1  # added to points without noise
N_PROBED = 300  # points around which it is seen whether there is any noise
SHAPE_PROMISE = 12.0  # nats for which a richer leaf is tried: its twelve parameters gain six by chance, and cost more
TIP_MISSING, TIP_DOUBTFUL = 5.0, 2.5  # nats by which a missing tip must fit better: by chance 1 in 1,300, 1 in 80
EXPECTED_BEYOND = 7.0  # points that should lie beyond the last: of a whole leaf 1 in 1,100 has as many
CLEARLY_BETTER = 5.0  # nats, by which another beginning of a richer leaf must fit better
ABOUT_AS_PROBABLE = 2.5  # nats by which another model may have less evidence: one to twelve
RARE = 4.6  # nats, a hundred to one: before a cloud is seen, that a leaf is like those of the paper's model
RICH_CUT = 3  # place of the richer leaf without its tip among those that are chosen from
HOLE_ROUNDS = 3  # in which a fit and the holes that it leaves in the leaf come to agree
SAME_SHARE = 0.05
LOWER_ROUNDS = 3


@dataclass(frozen=True)
class Estimate:
    """The maximum of the posterior; beside holes, with the leaf's width as its whole pieces have it.

    ``x`` (k,) with ``covariance`` (k, k) of its error; ``pose`` (4, 4) from the model's frame to the cloud's;
    ``noise`` (3,) cm: on the stem, on the leaf, and what the leaf's thickness adds across it; ``share`` (3,) of stem,
    leaf and outliers; ``seen``: share of the midrib that was seen, 1 unless the tip is missing; ``tip_seen``: whether
    it clearly is not; ``blunt``: whether a leaf that is taken as whole ends as one without its tip; ``ends_at``: share
    of the midrib at which the leaf ends, 1 unless its points clearly end before its tip; ``log_p`` (n,) of the points;
    ``evidence``: Laplace's approximation of the log probability of the cloud, up to a constant of the cloud;
    ``inflation``: how many times more the errors vary than those of independent points would; ``misfit_cm``: how far
    the blade's surface lies off the model's, as the errors that neighbours on it share say, and those on the stem do
    not; ``width_misfit``: by what share its width is off the model's, place by place; ``correlated_cm``: how far errors
    of neighbours on the leaf are correlated, 0 if they are not; ``rival`` (m,): parameters of the other model, if it is
    about as probable; ``quantile``: standard errors to either side of a 95 % interval, Student's; ``sighting``: what of
    the phytomer the cloud shows; ``dithered``: whether noise was added to the points, which had none.
    """

    x: FloatArray
    covariance: FloatArray
    pose: FloatArray
    noise: FloatArray
    share: FloatArray
    seen: float
    tip_seen: bool
    blunt: bool
    ends_at: float
    log_p: FloatArray
    error: float
    evidence: float
    inflation: float
    misfit_cm: float
    width_misfit: float
    correlated_cm: float
    rival: FloatArray | None
    quantile: float
    converged: bool
    history: tuple[Generation, ...]
    sighting: Sighting
    dithered: bool


def estimate(
    species: Species,
    points: FloatArray,
    starts: Sequence[tuple[FloatArray, FloatArray]],
    *,
    organ: NDArray[np.int8] | None = None,
    n_samples: int = 60,
    n_points: int = 200,
    n_generations: int = 4,
    elite_fraction: float = 0.1,
    covariance_noise: float = 0.5,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[Generation], None] | None = None,
) -> Estimate:
    """Search, then refine: first the paper's model, then the one that real leaves need, and keep what the cloud backs.

    Parameters
    ----------
    points : (n, 3) cm, as seen from the first start
    starts : mean (6 or 7,) and pose (4, 4) of the model's frame to begin from, each
    organ : (n,) 0 stem, 1 leaf, -1 unknown; None: all unknown
    n_samples, n_points, n_generations : of the cross-entropy search that finds the basin
    """
    given, points = points, _dithered(points, seed)
    plain = species.leading(len(starts[0][0]))
    search = CrossEntropy(
        plain.space,
        n_samples=n_samples,
        n_generations=n_generations,
        elite_fraction=elite_fraction,
        covariance_noise=covariance_noise,
        mean=starts[0][0],
        seed=seed,
    )
    stride = max(1, round(len(points) / n_points))
    objective = PaperObjective(
        plain.model,
        Reference.of(points[::stride], None),
        starts=[_at_junction(mean, pose) for mean, pose in starts],
        n_points=n_points,
        distance=chamfer,
        scout_stride=4,
        tilts_deg=(),
        seed=seed,
        executor=executor,
    )
    minimise(search, objective, progress)
    registration, _ = objective.register(search.mean)
    cloud = _Cloud(points, organ, executor)
    state = _drawn_in(plain, cloud, [(search.mean, registration.T_target_source), *starts])
    chosen = _at_surface(species, _choice(_candidates(plain, species, cloud, state)))
    return _estimate(chosen, tuple(search.history), dithered=points is not given)


class _Cloud(NamedTuple):
    """Points (n, 3), what their labels say (n,) or None, who works on them, and for how many each of them stands."""

    points: FloatArray
    organ: NDArray[np.int8] | None
    executor: Executor | None
    stride: int = 1

    def part(self, n: int) -> "_Cloud":
        """Every so-many-th point, n or a little more, with the weight of those that it stands for."""
        stride = max(1, len(self.points) // n)
        organ = None if self.organ is None else self.organ[::stride]
        return _Cloud(self.points[::stride], organ, self.executor, self.stride * stride)

    def likelihood(self, species: Species, **settings: Any) -> CloudLikelihood:
        weights = None if self.stride == 1 else np.full(len(self.points), float(self.stride))
        return CloudLikelihood(
            species.model,
            species.space,
            self.points,
            organ=self.organ,
            weights=weights,
            executor=self.executor,
            **settings,
        )


class _End(NamedTuple):
    """Where a refinement ended, evaluated there."""

    likelihood: CloudLikelihood
    state: State
    at: Evaluation
    converged: bool

    @property
    def fit_of_points(self) -> float:
        """Log probability of the points, each counted for those that it stands for."""
        weights = self.likelihood.weights
        return float(self.at.log_p.sum() if weights is None else weights @ self.at.log_p)


class _Elsewhere(NamedTuple):
    """Where the leaf ends up that is free to start elsewhere than at the stem's surface, and how probable it is."""

    end: _End
    dependence: Dependence
    probability: float


class _Chosen(NamedTuple):
    """The end that the cloud backs best."""

    end: _End
    evidence: float
    dependence: Dependence
    tip_doubtful: bool
    blunt: bool
    rival: FloatArray | None
    elsewhere: _Elsewhere | None = None


def _drawn_in(plain: Species, cloud: _Cloud, begun: Sequence[tuple[FloatArray, FloatArray]]) -> State:
    """The best of what the beginnings (parameters and pose) lead to, with a part of the points and wide noise.

    Where that leaves many points out, as beyond a hole, they are gone through again with wide noise and few outliers.
    """
    part = cloud._replace(executor=None).part(COARSE_POINTS)  # one thread a start
    coarse, held = part.likelihood(plain), part.likelihood(plain)
    noise_cm = START_NOISE * float(plain.space.mean[plain.space.index("leaf_length")])
    states = [coarse.start(mean, pose, noise_cm) for mean, pose in begun]
    run = map if cloud.executor is None else cloud.executor.map

    held.lower[NOISE], held.upper[OUTLIERS] = np.log(0.5 * noise_cm), np.log(HELD_OUTLIERS)

    def refined(
        states: Sequence[State], max_iterations: int, likelihood: CloudLikelihood = coarse
    ) -> list[tuple[float, State]]:
        call = partial(_refined, likelihood, max_iterations=max_iterations, tolerance=COARSE_TOLERANCE)
        ends = zip(run(call, states), states, strict=True)
        return [(end.error, State(end.theta, state.pose, state.center)) for end, state in ends]

    scouted = refined(states, SCOUT_ITERATIONS)
    enough = min(error for error, _ in scouted) + HOPELESS * len(cloud.points)
    found = refined([state for error, state in scouted if error <= enough], COARSE_ITERATIONS)
    if min(found, key=itemgetter(0))[1].share[2] > LEFT_OUT:
        found += refined([state for _, state in refined(states, HELD_ITERATIONS, held)], COARSE_ITERATIONS)
    return min(found, key=itemgetter(0))[1]


def _candidates(plain: Species, species: Species, cloud: _Cloud, state: State) -> list[_End]:
    """Refined: the paper's model, the same with its tip missing, and, if they promise enough, the two with all
    parameters of the species."""
    found = [_end(plain, state, cloud)]
    hidden = found[0].likelihood.hidden
    found.append(_end(plain, _cut(found[0].state), cloud, cut=True, hidden=hidden))
    if len(plain.space) == len(species.space):
        return found
    simple = found[1] if found[1].fit_of_points - found[0].fit_of_points > TIP_MISSING else found[0]
    if _promise(species, simple, cloud) > SHAPE_PROMISE:
        found += _rich(species, cloud, found[0])
    return found


def _rich(species: Species, cloud: _Cloud, simple: _End) -> tuple[_End, _End]:
    """With all parameters of the species, whole and with the tip missing: where the best of several beginnings leads
    to, which is found with a part of the points."""
    part = cloud.part(FEW_POINTS)
    begun = [simple.state, *turned_blade(species, simple.likelihood, simple.state, simple.at.scores)]
    best = max((_end(species, it, part, thick=True) for it in begun), key=lambda end: end.fit_of_points)
    best = _elsewhere(species, part, best, LOWER_ROUNDS)
    best = _end(species, best.state, cloud, thick=True, hidden=best.likelihood.hidden)
    best = _elsewhere(species, cloud, best, 1)
    hidden = best.likelihood.hidden
    begun = [_cut(best.state, share) for share in CUT_SHARES]
    cut = max(
        (_end(species, it, part, thick=True, cut=True, hidden=hidden) for it in begun),
        key=lambda end: end.fit_of_points,
    )
    return best, _end(species, cut.state, cloud, thick=True, cut=True, hidden=cut.likelihood.hidden)


def _elsewhere(species: Species, cloud: _Cloud, best: _End, rounds: int) -> _End:
    """The best so far, or where a midrib along the points, or an insertion lower down, leads to, if it fits better."""
    best = _better(species, cloud, best, along_points(species, best.likelihood, best.state, best.at.scores))
    for _ in range(rounds):
        lower = _better(species, cloud, best, lower_insertion(species, best.state))
        if lower is best:
            break
        best = lower
    return best


def _better(species: Species, cloud: _Cloud, best: _End, begun: Iterable[State]) -> _End:
    """Of the best so far and what other beginnings lead to, that which clearly fits better."""
    for state in begun:
        end = _end(species, state, cloud, thick=True, hidden=best.likelihood.hidden)
        if end.fit_of_points > best.fit_of_points + CLEARLY_BETTER:
            best = end
    return best


def _choice(found: Sequence[_End]) -> _Chosen:
    """Of models whole and with the tip missing, in turn, the one with the most evidence; a tip is missing only where
    that makes the points clearly more probable.

    Of a richer leaf the taper is estimated too, and says little of a tip that was not seen: it is taken as whole.
    """
    dependence = score_dependence(found[-1].likelihood, found[-1].state)  # the richest: least misfit
    fits = [end.fit_of_points / dependence.inflation for end in found]
    gains = [0.0] * len(found)  # by a missing tip
    for whole in range(0, len(found), 2):
        gain = fits[whole + 1] - fits[whole]
        if gain > TIP_DOUBTFUL:  # if the leaf's end says so too, not only its shape elsewhere
            end = found[whole]
            gain = min(gain, blunt_end(end.likelihood, end.state, end.at.scores).gain / dependence.inflation)
        gains[whole] = gains[whole + 1] = gain
    odds = [0.0, 0.0, RARE, RARE]
    evidence = [_evidence(end, dependence.inflation) + o for end, o in zip(found, odds, strict=False)]
    backed = [e if i % 2 == 0 or gains[i] > TIP_MISSING else -np.inf for i, e in enumerate(evidence)]
    best = int(np.argmax(backed))
    others = [i for i in range(len(found)) if i // 2 != best // 2 and backed[i] > backed[best] - ABOUT_AS_PROBABLE]
    rival = found[max(others, key=lambda i: backed[i])].state.x if others else None
    blunt = best == RICH_CUT
    best -= blunt
    if best < len(found) - 1:
        dependence = score_dependence(found[best].likelihood, found[best].state, dependence)
    doubtful = best % 2 == 0 and gains[best] > TIP_DOUBTFUL
    return _Chosen(found[best], evidence[best], dependence, doubtful, blunt, rival)


def _at_surface(species: Species, chosen: _Chosen) -> _Chosen:
    """Of a leaf that rises along its stem, a little inside it, the one that starts at its surface, if that is the more
    probable: there leaves grow, and a cloud hardly tells."""
    free, state = chosen.end.likelihood, chosen.end.state
    if not along_stem(free, state):
        return chosen
    start, place = state.theta.copy(), species.space.index(OFFSET)
    start[place] = 1.0
    held = free.holding(free.with_theta(state, start), np.arange(len(start)) == place)
    refined = _refined(held, free.with_theta(state, start))
    there = held.with_theta(state, refined.theta)
    end = _End(held, there, held.evaluate(there), refined.converged)
    lead = _evidence(end, chosen.dependence.inflation) - _evidence(chosen.end, chosen.dependence.inflation)
    if lead < 0.0:
        return chosen
    return chosen._replace(
        end=end,
        evidence=chosen.evidence + lead,
        dependence=score_dependence(held, there, chosen.dependence),
        elsewhere=_Elsewhere(chosen.end, chosen.dependence, float(expit(-lead))),
    )


def _end(
    species: Species,
    state: State,
    cloud: _Cloud,
    *,
    thick: bool = False,
    cut: bool = False,
    hidden: Hidden | None = None,
) -> _End:
    """Where the state leads to; `hidden` is what is known before of what was not seen."""
    for number in range(HOLE_ROUNDS):
        likelihood = cloud.likelihood(species, thick=thick, cut=cut, hidden=hidden)
        state = likelihood.extended(state)
        if number == 0 and len(cloud.points) >= 2 * FEW_POINTS:
            few = cloud.part(FEW_POINTS).likelihood(species, thick=thick, cut=cut, hidden=hidden)
            state = likelihood.with_theta(state, _refined(few, state, tolerance=COARSE_TOLERANCE).theta)
        end = _refined(likelihood, state)
        state = State(end.theta, state.pose, state.center)
        at = likelihood.evaluate(state)
        hidden = find_holes(likelihood, state, at.scores)
        if _alike(hidden, likelihood.hidden):
            break
    return _End(likelihood, state, at, end.converged)


def _alike(one: Hidden | None, other: Hidden | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.abs(one.share - other.share).max() <= SAME_SHARE)


def _dithered(points: FloatArray, seed: int) -> FloatArray:
    """The points (n, 3), with a little noise if they have next to none.

    Without noise the scores say nothing of how fast the likelihood falls off, and the refinement gets stuck.
    """
    some = points[:: max(1, len(points) // N_PROBED)]
    near = points[cKDTree(points).query(some, k=min(12, len(points)))[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    rough = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", offset, offset) / near.shape[1])[:, 0]
    if np.sqrt(max(0.0, float(np.median(rough)))) >= 0.5 * DITHER_CM:
        return points
    return points + np.random.default_rng(seed).normal(0.0, DITHER_CM, points.shape)


def _promise(species: Species, end: _End, cloud: _Cloud) -> float:
    """Log probability that a richer leaf is expected to gain over the fitted one, by Rao's score test."""
    likelihood = cloud.likelihood(species, cut=True, hidden=end.likelihood.hidden)
    state = likelihood.extended(end.state)
    state.theta[THICKNESS] = end.state.theta[THICKNESS]
    _, gradient, information = _terms(likelihood, state)
    free = np.arange(len(gradient)) != state.n_parameters  # the tip is another question
    inverse = pinvh(information[np.ix_(free, free)])  # with labels, points may say nothing of a share
    return 0.5 * float(gradient[free] @ inverse @ gradient[free])


def _cut(state: State, share: float = CUT_SHARES[0]) -> State:
    """The state with a longer leaf, of which as much is seen as of the one that it had."""
    theta = state.theta.copy()
    theta[[3, 5]] /= share  # the bend is a thirtieth of the leaf's
    theta[state.n_parameters] = share
    return State(theta, state.pose, state.center)


def _at_junction(mean: FloatArray, pose: FloatArray) -> FloatArray:
    """The start as :class:`PaperObjective` takes it: with the junction of leaf and stem as its origin."""
    at = pose.copy()
    at[:3, 3] += pose[:3, 2] * mean[1]
    return at


def _refined(likelihood: CloudLikelihood, state: State, **limits: Any) -> Refined:
    def evaluate(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        return _terms(likelihood, likelihood.with_theta(state, theta))

    return refine(evaluate, state.theta, lower=likelihood.lower, upper=likelihood.upper, **limits)


def _terms(likelihood: CloudLikelihood, state: State) -> tuple[float, FloatArray, FloatArray]:
    """Error, gradient (k,), and Fisher information by the scores' outer product, with the prior's (k, k)."""
    at = likelihood.evaluate(state)
    weighted = at.scores if likelihood.weights is None else at.scores * likelihood.weights[:, np.newaxis]
    return at.error, likelihood.gradient(state, at), at.scores.T @ weighted + np.diag(likelihood.precision)


def _evidence(end: _End, inflation: float) -> float:
    """Laplace's approximation of the log probability of the cloud under the model, up to a constant of the cloud.

    Points whose errors depend on each other count as `inflation` times fewer.
    """
    likelihood, theta, free, at = end.likelihood, end.state.theta, end.likelihood.free, end.at
    precision = likelihood.precision[free]
    information = (at.scores.T @ at.scores)[np.ix_(free, free)] / inflation + np.diag(precision)
    surprise = 0.5 * np.sum((theta - likelihood.mean)[free] ** 2 * precision)
    prior = 0.5 * np.sum(np.log(precision[precision > 0.0]))
    return float(at.log_p.sum() / inflation - surprise + prior - 0.5 * np.linalg.slogdet(information)[1])


def _estimate(chosen: _Chosen, history: tuple[Generation, ...], *, dithered: bool) -> Estimate:
    end, dependence = chosen.end, chosen.dependence
    likelihood, state, at = end.likelihood, end.state, end.at
    k = state.n_parameters
    covariance, left = covariance_of(likelihood, state, at, dependence)
    if chosen.elsewhere is not None:
        other, of_other, p = chosen.elsewhere
        there, _ = covariance_of(other.likelihood, other.state, other.at, of_other)
        covariance = mixed(covariance, there, other.state.theta - state.theta, p)
    x, covariance, converged = _with_width_of_whole_pieces(end, dependence, covariance[:k, :k])
    seen = sighting(likelihood, state, at.scores)
    too_long = state.seen == 1.0 and seen.short > EXPECTED_BEYOND * dependence.inflation
    return Estimate(
        x=x,
        covariance=covariance,
        pose=likelihood.pose_of(state),
        noise=state.noise,
        share=state.share,
        seen=state.seen,
        tip_seen=state.seen == 1.0 and not chosen.tip_doubtful and not seen.beyond and not too_long,
        blunt=chosen.blunt,
        ends_at=blunt_end(likelihood, state, at.scores).share if too_long else 1.0,
        log_p=at.log_p,
        error=at.error,
        evidence=chosen.evidence,
        inflation=dependence.inflation,
        misfit_cm=misfit_of(dependence, state.noise),
        width_misfit=width_misfit(likelihood, state, at.scores, dependence.leaf),
        correlated_cm=dependence.leaf.reach_cm,
        rival=chosen.rival,
        quantile=float(stdtrit(left, 0.975)),
        converged=converged,
        history=history,
        sighting=seen,
        dithered=dithered,
    )


def _with_width_of_whole_pieces(
    end: _End, dependence: Dependence, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """The model's parameters (k,) and the covariance (k, k) of their error, with the leaf's width as its whole pieces
    have it, and whether both refinements converged; as they are where there are no holes."""
    k = end.state.n_parameters
    whole = of_whole_pieces(end.likelihood, end.state)
    if whole is None:
        return end.state.x.copy(), covariance, end.converged
    refined = _refined(whole, end.state)
    state = whole.with_theta(end.state, refined.theta)
    of_part = score_dependence(whole, state, dependence)
    own, _ = covariance_of(whole, state, whole.evaluate(state), of_part)
    return state.x.copy(), grown(covariance, own[:k, :k], whole.free[:k]), end.converged and refined.converged
