"""The most probable phytomer of a cloud: refine from all starts, move on, choose the model."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh

from phytofit.engine.covariance import of_sensor
from phytofit.engine.dependence import Dependence, score_dependence
from phytofit.engine.layout import State
from phytofit.engine.outcome import Choice, Estimate, outcome
from phytofit.engine.posterior import Posterior
from phytofit.engine.refine import (
    COARSE_TOLERANCE,
    FEW_POINTS,
    Cloud,
    Optimum,
    optimum_near,
    optimum_of,
    refinement,
    terms,
)
from phytofit.engine.restarts import along_points, longer, longer_leaf, longer_stem, lower_insertion, turned_blade
from phytofit.engine.sighting import OFFSET, along_stem, sighting
from phytofit.engine.tip import gain_of_blunt_end
from phytofit.engine.visibility import Hidden
from phytofit.species import Species

__all__ = ["estimate"]

FloatArray = NDArray[np.float64]
COARSE_POINTS = 700  # that decide which start is the best
SCOUT_ITERATIONS, COARSE_ITERATIONS = 5, 25  # for each start; then for each that may still be the best
LEFT_OUT = 0.1  # share of outliers, above which all starts are tried again with few of them
HELD_OUTLIERS, HELD_ITERATIONS = 0.1, 12  # at most, then, for each point of the leaf
HOPELESS = 0.3  # nats for each point, by which a start is behind after the first
START_NOISE = 0.036  # of the expected leaf's length: wide, so that a start some cm off is drawn in
CUT_SHARES = (0.85, 0.97)  # of the midrib, from which the search for a missing tip starts
LEAST_GAIN = 12.0  # nats for which a richer leaf is tried: fourteen parameters gain seven by chance, and cost more
TIP_MISSING, TIP_DOUBTFUL = 5.0, 2.5  # nats by which a missing tip must fit better: by chance 1 in 1,300, 1 in 80
CLEARLY_BETTER = 5.0  # nats, by which what starts from another beginning must fit better
OF_START = (OFFSET, "leaf_base_bend", "leaf_angle")  # beyond its first twentieth a leaf tells the angles' sum at best
ROUNDS = 4  # of restarts, at most

LEAST_FACING = 1.0  # concentration, from which a stem was seen from one side: a half of it has 1.6


def estimate(
    species: Species,
    points: FloatArray,
    starts: Sequence[tuple[FloatArray, FloatArray]],
    *,
    organ: NDArray[np.int8] | None = None,
    executor: Executor | None = None,
) -> Estimate:
    """Refine from the starts: first the paper's model, then what real leaves need; keep what the cloud backs.

    Parameters
    ----------
    points : (n, 3) cm, which have some noise
    starts : mean (6 or 7,) and pose (4, 4) of the model's frame to begin from, each
    organ : (n,) 0 stem, 1 leaf, -1 unknown; None: all unknown
    """
    plain = species.leading(len(starts[0][0]))
    cloud = Cloud(points, organ, executor)
    hypotheses = _hypotheses(plain, species, cloud, _drawn_in(plain, cloud, starts))
    return outcome(_at_surface(_with_hidden_base(_one_sided(_choice(hypotheses)))))


def _drawn_in(plain: Species, cloud: Cloud, starts: Sequence[tuple[FloatArray, FloatArray]]) -> State:
    """The best of what the starts (parameters and pose) lead to, with a part of the points and wide noise.

    Where that leaves many points out, as beyond a hole, they are gone through again with wide noise and few outliers.
    """
    part = cloud._replace(executor=None).part(COARSE_POINTS)  # one thread a start
    coarse = part.posterior(plain)
    noise_cm = START_NOISE * float(plain.space.mean[plain.space.index("leaf_length")])
    states = [coarse.start(mean, pose, noise_cm) for mean, pose in starts]
    run = map if cloud.executor is None else cloud.executor.map

    least = np.log(0.5 * noise_cm)
    few_outliers = coarse.prior.bounded("stem_noise", lower=least).bounded("leaf_noise", lower=least)
    held = coarse.under(few_outliers.bounded("outlier_share", upper=np.log(HELD_OUTLIERS)))

    def refined(
        states: Sequence[State], max_iterations: int, posterior: Posterior = coarse
    ) -> list[tuple[float, State]]:
        call = partial(refinement, posterior, max_iterations=max_iterations, tolerance=COARSE_TOLERANCE)
        ends = zip(run(call, states), states, strict=True)
        return [(end.error, state.at(end.theta)) for end, state in ends]

    scouted = refined(states, SCOUT_ITERATIONS)
    enough = min(error for error, _ in scouted) + HOPELESS * len(cloud.points)
    found = refined([state for error, state in scouted if error <= enough], COARSE_ITERATIONS)
    if min(found, key=itemgetter(0))[1].share[2] > LEFT_OUT:
        found += refined([state for _, state in refined(states, HELD_ITERATIONS, held)], COARSE_ITERATIONS)
    return min(found, key=itemgetter(0))[1]


class _Hypothesis(NamedTuple):
    """A model of the leaf, with the logarithm of its odds before the cloud is seen: its optimum, and how far errors of
    neighbours depend on each other there; and, where the leaf's last points gain so many nats that its tip may be
    missing, points that err alike counted as few, the optimum of a leaf that goes on.

    ``tapers`` says whether the taper is estimated too: then the shape says too little of a tip that was not seen to
    tell how long it is, and the leaf is taken as whole.
    """

    log_odds: float
    tapers: bool
    whole: Optimum
    dependence: Dependence
    bluntness: float
    cut: Optimum | None

    @classmethod
    def of(cls, species: Species, cloud: Cloud, whole: Optimum, log_odds: float, *, tapers: bool) -> "_Hypothesis":
        dependence = score_dependence(whole.posterior, whole.state)
        bluntness = gain_of_blunt_end(whole.posterior, whole.state, whole.at) / dependence.inflation
        cut = _with_tip_missing(species, cloud, whole, thick=tapers) if bluntness > TIP_DOUBTFUL else None
        return cls(log_odds, tapers, whole, dependence, bluntness, cut)

    def gain(self, inflation: float) -> float:
        """Nats by which a missing tip is better: by the leaf's end, and by its shape elsewhere."""
        if self.cut is None:
            return 0.0
        return min(self.bluntness, (self.cut.log_likelihood - self.whole.log_likelihood) / inflation)

    def options(self, inflation: float) -> list[Optimum]:
        """What may be chosen."""
        if self.cut is None or self.tapers or self.gain(inflation) <= TIP_MISSING:
            return [self.whole]
        return [self.whole, self.cut]


def _hypotheses(plain: Species, species: Species, cloud: Cloud, state: State) -> list[_Hypothesis]:
    """The paper's leaf and, if it may gain enough, the one with all parameters of the species."""
    found = _Hypothesis.of(plain, cloud, optimum_near(plain, state, cloud, with_void=True), 0.0, tapers=False)
    if len(plain.space) == len(species.space):
        return [found]
    if _expected_gain(species, found.options(1.0)[-1], cloud) <= LEAST_GAIN:
        return [found]
    simple = found.whole
    with_noise = cloud._replace(leaf_noise_cm=float(simple.state.noise[0]))  # about that of the stem's points
    rich = _rich(species, with_noise, simple)
    if rich.posterior.void is not simple.posterior.void:  # all are to have the same
        whole = optimum_near(plain, simple.state, cloud, hidden=_void_alone(rich))
        found = _Hypothesis.of(plain, cloud, whole, 0.0, tapers=False)
    return [found, _Hypothesis.of(species, with_noise, rich, float(np.log(species.own_shape_odds)), tapers=True)]


def _with_tip_missing(species: Species, cloud: Cloud, whole: Optimum, *, thick: bool) -> Optimum:
    """The optimum near a whole one, of a leaf that goes on, from the best of some shares of the midrib."""
    hidden, part = whole.posterior.hidden, cloud.part(FEW_POINTS)
    coarse = partial(optimum_near, species, thick=thick, cut=True, tolerance=COARSE_TOLERANCE, hidden=hidden)
    best = max((coarse(_cut(whole.state, share), part) for share in CUT_SHARES), key=_log_likelihood)
    return optimum_near(species, best.state, cloud, thick=thick, cut=True, hidden=best.posterior.hidden)


def _void_alone(optimum: Optimum) -> Hidden | None:
    """What was not seen around the leaf's base, for a model that is to find its holes itself."""
    hidden = optimum.posterior.hidden
    return None if hidden is None or hidden.void is None else hidden.without_holes()


def _rich(species: Species, cloud: Cloud, simple: Optimum) -> Optimum:
    """The best optimum of several restarts with all parameters of the species, which is found with a part of the
    points."""
    part = cloud.part(FEW_POINTS)
    known = _void_alone(simple)
    richer = part.posterior(species, thick=True, hidden=known)
    extended = richer.extended(simple.state)
    starts = [extended, *turned_blade(Optimum(richer, extended, richer.evaluate(extended), converged=False))]
    coarse = partial(optimum_near, species, thick=True, tolerance=COARSE_TOLERANCE)
    best = max((coarse(it, part, hidden=known) for it in starts), key=_log_likelihood)
    best = _restarted(species, part, best)
    best = coarse(best.state, cloud, hidden=best.posterior.hidden, with_void=True)
    if best.posterior.void is not simple.posterior.void:  # beside it other hills may be higher
        best = _restarted(species, part, coarse(best.state, part, hidden=best.posterior.hidden))
    return optimum_near(species, best.state, cloud, thick=True, hidden=best.posterior.hidden)


def _log_likelihood(optimum: Optimum) -> float:
    return optimum.log_likelihood


def _restarted(species: Species, cloud: Cloud, best: Optimum) -> Optimum:
    """The best optimum so far, or that of a restart which fits better: with a turned blade, more leaf or stem, a
    midrib along the points, an insertion lower down; again from where these lead, as long as they lead anywhere."""
    for _ in range(ROUNDS):
        before = best
        for restart in (turned_blade, longer_leaf, longer_stem, along_points, lower_insertion):
            best = _better(species, cloud, best, restart)
        if best is before:
            break
    return best


def _better(species: Species, cloud: Cloud, best: Optimum, restart: Callable[[Optimum], Iterable[State]]) -> Optimum:
    """Of the best so far and the optima of a restart, that which clearly fits better."""
    for state in restart(best):
        hidden = best.posterior.hidden
        optimum = optimum_near(species, state, cloud, thick=True, hidden=hidden, tolerance=COARSE_TOLERANCE)
        if optimum.log_likelihood > best.log_likelihood + CLEARLY_BETTER:
            best = optimum
    return best


def _choice(hypotheses: Sequence[_Hypothesis]) -> Choice:
    """Of the hypotheses, whole or with the tip missing, the one with the most evidence, and the others by how probable
    they are; a tip is missing only where that makes the points clearly more probable."""
    last = hypotheses[-1]
    richest, dependence = last.whole, last.dependence  # least misfit
    inflation, sensors = dependence.inflation, of_sensor(dependence, richest.state.noise)
    if sensors.correlation < dependence.leaf.correlation:  # the rest is misfit, of which a better model has less
        without = replace(dependence, leaf=sensors)
        inflation = score_dependence(richest.posterior, richest.state, without).inflation
    options = [
        (it.log_odds + optimum.log_evidence(inflation), number, optimum)
        for number, it in enumerate(hypotheses)
        for optimum in it.options(dependence.inflation)
    ]
    evidence, best, optimum = max(options, key=itemgetter(0))
    whole, gain = optimum is hypotheses[best].whole, hypotheses[best].gain(dependence.inflation)
    chosen = Choice(
        optimum,
        dependence if optimum is richest else score_dependence(optimum.posterior, optimum.state, dependence),
        tip_doubtful=whole and gain > TIP_DOUBTFUL,
        blunt=whole and gain > TIP_MISSING,
    )
    for number in range(len(hypotheses)):
        if number != best:
            nats, _, rival = max((it for it in options if it[1] == number), key=itemgetter(0))
            chosen = chosen.beside(rival, nats - evidence)
    return chosen


def _one_sided(chosen: Choice) -> Choice:
    """Of a stem that was seen from one side, the fit that knows it, where it has more evidence."""
    posterior = chosen.optimum.posterior
    optimum = optimum_of(posterior.under(posterior.prior.one_sided()), chosen.optimum.state)
    lead = chosen.lead_of(optimum)
    if np.linalg.norm(optimum.state.facing) < LEAST_FACING or lead < 0.0:
        return chosen
    return chosen.giving_way(optimum, score_dependence(optimum.posterior, optimum.state), lead)


def _with_hidden_base(chosen: Choice) -> Choice:
    """Where a leaf starts, if that was not seen, as the prior has it beside what the rest of the leaf says: its points
    count as fewer for that, since they err alike, by noise or as the model does not fit them."""
    optimum, inflation = chosen.optimum, chosen.dependence.inflation
    if OFFSET not in optimum.posterior.space.names or inflation == 1.0:
        return chosen
    if sighting(optimum.posterior, optimum.state, optimum.at).shows_base:
        return chosen
    careful = optimum.posterior.under(optimum.posterior.prior.weighted(optimum.state.layout.mask(*OF_START), inflation))
    optimum = optimum_of(careful, optimum.state)
    return chosen._replace(optimum=optimum, dependence=score_dependence(careful, optimum.state, chosen.dependence))


def _at_surface(chosen: Choice) -> Choice:
    """Of a leaf that rises along its stem, a little inside it, the one that starts at its surface, if that is the more
    probable: there leaves grow, and a cloud hardly tells."""
    free, state = chosen.optimum.posterior, chosen.optimum.state
    if not along_stem(free, state):
        return chosen
    at_surface = state.changed(**{OFFSET: 1.0})
    held = free.under(free.prior.fixing(at_surface.theta, state.layout.mask(OFFSET)))
    optimum = optimum_of(held, at_surface)
    lead = chosen.lead_of(optimum)
    if lead < 0.0:
        return chosen
    dependence = score_dependence(held, optimum.state, chosen.dependence)
    return chosen.giving_way(optimum, dependence, lead).beside(chosen.optimum, -lead)


def _expected_gain(species: Species, optimum: Optimum, cloud: Cloud) -> float:
    """Log probability that a richer leaf is expected to gain over the fitted one, by Rao's score test."""
    posterior = cloud.posterior(species, cut=True, hidden=optimum.posterior.hidden)
    state = posterior.extended(optimum.state).changed(leaf_thickness=optimum.state["leaf_thickness"])
    _, gradient, information = terms(posterior, state)
    free = ~state.layout.mask("midrib_seen")  # the tip is another question
    inverse = pinvh(information[np.ix_(free, free)])  # with labels, points may say nothing of a share
    return 0.5 * float(gradient[free] @ inverse @ gradient[free])


def _cut(state: State, share: float) -> State:
    """The state with a longer leaf, of which as much is seen as of the one that it had."""
    return longer(state, 1.0 / share).changed(midrib_seen=share)
