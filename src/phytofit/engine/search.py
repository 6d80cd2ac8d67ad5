"""The most probable phytomer of a cloud: refine from all starts, move on, choose the model."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh
from scipy.special import expit

from phytofit.engine.covariance import of_sensor
from phytofit.engine.dependence import score_dependence
from phytofit.engine.layout import State
from phytofit.engine.outcome import Alternative, Choice, Estimate, outcome
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
CUT_SHARES = (0.85, 0.97)  # of the midrib, from which the search for a missing tip starts; the second of rich leaves
LEAST_GAIN = 12.0  # nats for which a richer leaf is tried: fourteen parameters gain seven by chance, and cost more
TIP_MISSING, TIP_DOUBTFUL = 5.0, 2.5  # nats by which a missing tip must fit better: by chance 1 in 1,300, 1 in 80
CLEARLY_BETTER = 5.0  # nats, by which what starts from another beginning must fit better
ABOUT_AS_PROBABLE = 2.5  # nats by which another model may have less evidence: one to twelve
OF_START = (OFFSET, "leaf_base_bend", "leaf_angle")  # beyond its first twentieth a leaf tells the angles' sum at best
RARE = 4.6  # nats, a hundred to one: before a cloud is seen, that a leaf is like those of the paper's model
RICH_CUT = 3  # place of the richer leaf without its tip among those that are chosen from
LOWER_ROUNDS = 3

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
    state = _drawn_in(plain, cloud, starts)
    chosen = _one_sided(_choice(_candidates(plain, species, cloud, state)))
    return outcome(_at_surface(_with_hidden_base(chosen)))


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


def _candidates(plain: Species, species: Species, cloud: Cloud, state: State) -> list[Optimum]:
    """Refined: the paper's model, the same with its tip missing, and, if they may gain enough, the two with all
    parameters of the species."""
    found = [optimum_near(plain, state, cloud, with_void=True)]
    hidden = found[0].posterior.hidden
    found.append(_with_tip_missing(plain, cloud, found[0], CUT_SHARES[:1], thick=False))
    if len(plain.space) == len(species.space):
        return found
    simple = found[1] if found[1].log_likelihood - found[0].log_likelihood > TIP_MISSING else found[0]
    if _expected_gain(species, simple, cloud) <= LEAST_GAIN:
        return found
    rich = _rich(species, cloud, found[0])
    if rich[0].posterior.void is not found[0].posterior.void:  # all are to have the same
        hidden = _void_alone(rich[0])
        found = [optimum_near(plain, it.state, cloud, cut=i == 1, hidden=hidden) for i, it in enumerate(found)]
    return [*found, *rich]


def _void_alone(optimum: Optimum) -> Hidden | None:
    """What was not seen around the leaf's base, for a model that is to find its holes itself."""
    hidden = optimum.posterior.hidden
    return None if hidden is None or hidden.void is None else hidden.without_holes()


def _rich(species: Species, cloud: Cloud, simple: Optimum) -> tuple[Optimum, Optimum]:
    """With all parameters of the species, whole and with the tip missing: the best optimum of several restarts, which
    is found with a part of the points."""
    cloud = cloud._replace(leaf_noise_cm=float(simple.state.noise[0]))
    part = cloud.part(FEW_POINTS)
    known = _void_alone(simple)
    richer = part.posterior(species, thick=True, hidden=known)
    extended = richer.extended(simple.state)
    starts = [extended, *turned_blade(Optimum(richer, extended, richer.evaluate(extended), converged=False))]
    coarse = partial(optimum_near, species, thick=True, tolerance=COARSE_TOLERANCE)
    best = max((coarse(it, part, hidden=known) for it in starts), key=_log_likelihood)
    best = _restarted(species, part, best)
    best = optimum_near(species, best.state, cloud, thick=True, hidden=best.posterior.hidden, with_void=True)
    return best, _with_tip_missing(species, cloud, best, CUT_SHARES, thick=True)


def _with_tip_missing(
    species: Species, cloud: Cloud, whole: Optimum, shares: Sequence[float], *, thick: bool
) -> Optimum:
    """The optimum near a whole one, of a leaf whose tip is missing, from the best of so many shares of its midrib; as a
    part of the points has it, where that has no use for it."""
    hidden, part = whole.posterior.hidden, cloud.part(FEW_POINTS)
    coarse = partial(optimum_near, species, thick=thick, cut=True, tolerance=COARSE_TOLERANCE, hidden=hidden)
    cut = max((coarse(_cut(whole.state, share), part) for share in shares), key=_log_likelihood)
    posterior = part.posterior(species, thick=thick, hidden=hidden)
    of_whole = Optimum(posterior, whole.state, posterior.evaluate(whole.state, derivatives=False), converged=False)
    if cut.log_likelihood - of_whole.log_likelihood > TIP_DOUBTFUL:
        return optimum_near(species, cut.state, cloud, thick=thick, cut=True, hidden=cut.posterior.hidden)
    posterior = cloud.posterior(species, thick=thick, cut=True, hidden=hidden)
    return Optimum(posterior, cut.state, posterior.evaluate(cut.state), converged=False)


def _log_likelihood(optimum: Optimum) -> float:
    return optimum.log_likelihood


def _restarted(species: Species, cloud: Cloud, best: Optimum) -> Optimum:
    """The best optimum so far, or that of a restart which fits better: with a turned blade, more leaf or stem, a
    midrib along the points, or, some times in a row, an insertion lower down."""
    for restart in (turned_blade, longer_leaf, longer_stem, along_points):
        best = _better(species, cloud, best, restart)
    for _ in range(LOWER_ROUNDS):
        lower = _better(species, cloud, best, lower_insertion)
        if lower is best:
            break
        best = lower
    return best


def _better(species: Species, cloud: Cloud, best: Optimum, restart: Callable[[Optimum], Iterable[State]]) -> Optimum:
    """Of the best so far and the optima of a restart, that which clearly fits better."""
    for state in restart(best):
        hidden = best.posterior.hidden
        optimum = optimum_near(species, state, cloud, thick=True, hidden=hidden, tolerance=COARSE_TOLERANCE)
        if optimum.log_likelihood > best.log_likelihood + CLEARLY_BETTER:
            best = optimum
    return best


def _choice(found: Sequence[Optimum]) -> Choice:
    """Of models whole and with the tip missing, in turn, the one with the most evidence; a tip is missing only where
    that makes the points clearly more probable.

    Of a richer leaf the taper is estimated too, and says little of a tip that was not seen: it is taken as whole.
    """
    richest = found[-1]  # least misfit
    dependence = score_dependence(richest.posterior, richest.state)
    inflation, sensors = dependence.inflation, of_sensor(dependence, richest.state.noise)
    if sensors.correlation < dependence.leaf.correlation:  # the rest is misfit, of which a better model has less
        without = replace(dependence, leaf=sensors)
        inflation = score_dependence(richest.posterior, richest.state, without).inflation
    fits = [optimum.log_likelihood / dependence.inflation for optimum in found]
    gains = [0.0] * len(found)  # by a missing tip
    for whole in range(0, len(found), 2):
        gain = fits[whole + 1] - fits[whole]
        if gain > TIP_DOUBTFUL:  # if the leaf's end says so too, not only its shape elsewhere
            optimum = found[whole]
            gain = min(gain, gain_of_blunt_end(optimum.posterior, optimum.state, optimum.at) / dependence.inflation)
        gains[whole] = gains[whole + 1] = gain
    odds = [0.0, 0.0, RARE, RARE]
    evidence = [optimum.log_evidence(inflation) + o for optimum, o in zip(found, odds, strict=False)]
    backed = [e if i % 2 == 0 or gains[i] > TIP_MISSING else -np.inf for i, e in enumerate(evidence)]
    best = int(np.argmax(backed))
    others = [i for i in range(len(found)) if i // 2 != best // 2 and backed[i] > backed[best] - ABOUT_AS_PROBABLE]
    rival = found[max(others, key=lambda i: backed[i])].state.x if others else None
    blunt = best == RICH_CUT
    best -= blunt
    if best < len(found) - 1:
        dependence = score_dependence(found[best].posterior, found[best].state, dependence)
    doubtful = best % 2 == 0 and gains[best] > TIP_DOUBTFUL
    return Choice(found[best], dependence, doubtful, blunt, rival)


def _one_sided(chosen: Choice) -> Choice:
    """Of a stem that was seen from one side, the fit that knows it, where it has more evidence."""
    posterior = chosen.optimum.posterior
    optimum = optimum_of(posterior.under(posterior.prior.one_sided()), chosen.optimum.state)
    if np.linalg.norm(optimum.state.facing) < LEAST_FACING or chosen.lead_of(optimum) < 0.0:
        return chosen
    return chosen._replace(optimum=optimum, dependence=score_dependence(optimum.posterior, optimum.state))


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
    return chosen._replace(
        optimum=optimum,
        dependence=score_dependence(held, optimum.state, chosen.dependence),
        alternative=Alternative(chosen.optimum, chosen.dependence, float(expit(-lead))),
    )


def _expected_gain(species: Species, optimum: Optimum, cloud: Cloud) -> float:
    """Log probability that a richer leaf is expected to gain over the fitted one, by Rao's score test."""
    posterior = cloud.posterior(species, cut=True, hidden=optimum.posterior.hidden)
    state = posterior.extended(optimum.state).changed(leaf_thickness=optimum.state["leaf_thickness"])
    _, gradient, information = terms(posterior, state)
    free = ~state.layout.mask("midrib_seen")  # the tip is another question
    inverse = pinvh(information[np.ix_(free, free)])  # with labels, points may say nothing of a share
    return 0.5 * float(gradient[free] @ inverse @ gradient[free])


def _cut(state: State, share: float = CUT_SHARES[0]) -> State:
    """The state with a longer leaf, of which as much is seen as of the one that it had."""
    return longer(state, 1.0 / share).changed(midrib_seen=share)
