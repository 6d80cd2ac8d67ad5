"""What a cloud says of its phytomer: the optimum that it backs best, and how well it determines it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax, stdtrit

from phytofit.engine.covariance import covariance_of, grown, misfit_of, of_sensor, shared_by_neighbors
from phytofit.engine.dependence import Dependence, score_dependence, width_misfit
from phytofit.engine.leaf_end import Ending, ending
from phytofit.engine.refine import Optimum, optimum_of
from phytofit.engine.sighting import Sighting, sighting
from phytofit.engine.tip import gain_of_blunt_end
from phytofit.engine.whole_pieces import of_whole_pieces
from phytofit.parameters import ParameterSpace

__all__ = ["Alternative", "Choice", "Estimate", "Rival", "outcome"]

FloatArray = NDArray[np.float64]
EXPECTED_BEYOND = 7.0  # points that should lie beyond the last: of a whole leaf 1 in 1,100 has as many
BLUNTLY = 5.0  # nats by which the last points must say that a leaf ends bluntly
LEAST_PROBABLE = 0.01  # of an alternative; what one of less would add to an interval is lost beside its own width
TAPER = "leaf_taper"  # of a leaf that has one of its own, its last points tell where it ends


class Rival(NamedTuple):
    """Another optimum, and by how many nats it has more evidence than the chosen one: fewer than none."""

    optimum: Optimum
    lead: float


class Choice(NamedTuple):
    """The optimum that the cloud backs best, and others that it may back as well."""

    optimum: Optimum
    dependence: Dependence
    tip_doubtful: bool
    blunt: bool
    rivals: tuple[Rival, ...] = ()

    def lead_of(self, other: Optimum) -> float:
        """Nats by which another optimum has more evidence, points that err alike counted as few for both."""
        return other.log_evidence(self.dependence.inflation) - self.optimum.log_evidence(self.dependence.inflation)

    def beside(self, other: Optimum, lead: float) -> "Choice":
        """With another optimum that has more evidence by so many nats, fewer than none."""
        return self._replace(rivals=(*self.rivals, Rival(other, lead)))

    def giving_way(self, optimum: Optimum, dependence: Dependence, lead: float) -> "Choice":
        """Another optimum in place of this one, which has more evidence by so many nats."""
        rivals = tuple(rival._replace(lead=rival.lead - lead) for rival in self.rivals)
        return self._replace(optimum=optimum, dependence=dependence, rivals=rivals)


@dataclass(frozen=True)
class Estimate:
    """The maximum of the posterior; beside holes, with the leaf's width as its whole pieces have it.

    ``x`` (k,) with ``covariance`` (k, k) of its error; ``trait_covariance`` (k, k) the same, with what the leaf's last
    points tell of its end, and the discrepancy of real organs; ``pose`` (4, 4) from the model's frame to the cloud's;
    ``noise`` (3,) cm: on the stem, on the leaf, and what the leaf's thickness adds across it; ``share`` (3,) of stem,
    leaf and outliers; ``seen``: share of the midrib that was seen, 1 unless the tip is missing; ``tip_seen``: whether
    it clearly is not; ``blunt``: whether a leaf that is taken as whole ends as one without its tip; ``ends_at``: share
    of the midrib at which the leaf ends, by its last points; ``too_long``: whether these clearly end before its tip;
    ``log_p`` (n,) of the points;
    ``evidence``: Laplace's approximation of the log probability of the cloud, up to a constant of the cloud;
    ``inflation``: how many times more the errors vary than those of independent points would; ``misfit_cm``: how far
    the blade's surface lies off the model's, as the errors that neighbours on it share say, and those on the stem do
    not; ``width_misfit``: by what share its width is off the model's, place by place; ``correlated_cm``: how far errors
    of neighbours on the leaf are correlated, 0 if they are not; ``alternatives``: other estimates that are probable;
    ``quantile``: standard errors to either side of a 95 % interval, Student's; ``sighting``: what of the phytomer the
    cloud shows.
    """

    x: FloatArray
    covariance: FloatArray
    trait_covariance: FloatArray
    too_long: bool
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
    alternatives: tuple["Alternative", ...]
    quantile: float
    converged: bool
    sighting: Sighting


class Alternative(NamedTuple):
    """Another estimate, of the parameters in `space`, and how probable it is that it is the right one."""

    probability: float
    space: ParameterSpace
    estimate: Estimate


def outcome(chosen: Choice) -> Estimate:
    optimum, dependence = chosen.optimum, chosen.dependence
    posterior, state, at = optimum.posterior, optimum.state, optimum.at
    k = len(state.x)
    covariance, left = covariance_of(posterior, state, at, dependence)
    seen = sighting(posterior, state, at)
    too_long = state.seen == 1.0 and seen.short > EXPECTED_BEYOND * dependence.inflation
    ends = Ending(1.0, np.zeros_like(covariance))
    if state.seen == 1.0 and (too_long or TAPER in posterior.space.names):
        ends = ending(posterior, state, at, covariance, shared_by_neighbors(dependence, state.noise))
    blunt = ends.clearly_shorter and (gain_of_blunt_end(posterior, state, at) > BLUNTLY * dependence.inflation)
    x, covariance, converged = _with_width_of_whole_pieces(optimum, dependence, covariance[:k, :k])
    discrepancy = posterior.space.discrepancy_at(x)
    return Estimate(
        x=x,
        covariance=covariance,
        trait_covariance=covariance + ends.changed[:k, :k] + np.diag(discrepancy**2),
        too_long=too_long,
        pose=posterior.pose_of(state),
        noise=state.noise,
        share=state.share,
        seen=state.seen,
        tip_seen=state.seen == 1.0 and not chosen.tip_doubtful and not seen.beyond and not too_long and not blunt,
        blunt=chosen.blunt,
        ends_at=ends.share,
        log_p=at.log_p,
        error=at.error,
        evidence=optimum.log_evidence(dependence.inflation),
        inflation=dependence.inflation,
        misfit_cm=misfit_of(dependence, state.noise),
        width_misfit=width_misfit(posterior, state, at, of_sensor(dependence, state.noise)),
        correlated_cm=dependence.leaf.reach_cm,
        alternatives=_alternatives(chosen),
        quantile=float(stdtrit(left, 0.975)),
        converged=converged,
        sighting=seen,
    )


def _alternatives(chosen: Choice) -> tuple[Alternative, ...]:
    """What the cloud says of the rivals that are not out of the question, and how probable they are."""
    leads = np.array([0.0, *(rival.lead for rival in chosen.rivals)])
    found = []
    for (optimum, _), p in zip(chosen.rivals, softmax(leads)[1:].tolist(), strict=True):
        if p >= LEAST_PROBABLE:
            dependence = score_dependence(optimum.posterior, optimum.state, chosen.dependence)
            estimate = outcome(Choice(optimum, dependence, chosen.tip_doubtful, chosen.blunt))
            found.append(Alternative(p, optimum.posterior.space, estimate))
    return tuple(found)


def _with_width_of_whole_pieces(
    optimum: Optimum, dependence: Dependence, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """The model's parameters (k,) and the covariance (k, k) of their error, with the leaf's width as its whole pieces
    have it, and whether both refinements converged; as they are where there are no holes."""
    k = len(optimum.state.x)
    whole = of_whole_pieces(optimum.posterior, optimum.state)
    if whole is None:
        return optimum.state.x.copy(), covariance, optimum.converged
    refined = optimum_of(whole, optimum.state)
    state = refined.state
    of_part = score_dependence(whole, state, dependence)
    own, _ = covariance_of(whole, state, refined.at, of_part)
    return state.x.copy(), grown(covariance, own[:k, :k], whole.prior.free[:k]), optimum.converged and refined.converged
