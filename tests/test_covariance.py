"""Covariance of an estimate where a parameter lies at its bound, and the misfit of a blade."""

from dataclasses import replace

import numpy as np
import pytest

import phytofit
from phytofit.engine.covariance import covariance_of, misfit_of
from phytofit.engine.dependence import NONE, Dependence, GaussianCorrelation, score_dependence
from phytofit.engine.posterior import Posterior
from phytofit.engine.refine import refinement
from phytofit.engine.scoring import refine

SPECIES = phytofit.load_species()
NAMES = SPECIES.space.names
NOISE = np.array([0.3, 0.4, 0.3])
SURER = 300.0  # times, a prior that says as much as so small a cloud


def dependence(stem, leaf):
    return Dependence(np.eye(2), 1.0, 100.0, stem, leaf)


def test_errors_that_stem_and_leaf_share_are_no_misfit_of_the_blade():
    assert misfit_of(dependence(NONE, NONE), NOISE) == 0.0
    assert misfit_of(dependence(NONE, GaussianCorrelation(0.36, 1.0)), NOISE) == pytest.approx(0.6 * 0.5)
    sensor = GaussianCorrelation(0.9, 1.0)
    assert misfit_of(dependence(sensor, sensor), np.array([0.5, 0.5, 0.0])) == 0.0
    assert misfit_of(dependence(sensor, GaussianCorrelation(0.2, 1.0)), np.full(3, 0.2)) == 0.0  # not less than none
    both = misfit_of(dependence(GaussianCorrelation(0.5, 1.0), GaussianCorrelation(0.5, 1.0)), NOISE)
    assert both == pytest.approx(np.sqrt(0.5 * (0.25 - 0.09)))


def at_rest(made, upper_taper):
    """The full model at its maximum, with a bound of the taper; the blade is known to be wide, not how it narrows."""
    likelihood = Posterior.of(SPECIES, made.points)
    likelihood = likelihood.under(likelihood.prior.bounded("leaf_taper", upper=upper_taper))
    state = likelihood.start(made.x, made.pose, 0.3)

    def evaluate(theta):
        at = likelihood.evaluate(state.at(theta))
        information = at.scores.T @ at.scores + np.diag(likelihood.prior.precision)
        return at.error, likelihood.gradient(state.at(theta), at), information

    theta = refine(evaluate, state.theta, lower=likelihood.prior.lower, upper=likelihood.prior.upper).theta
    state = state.at(theta)
    return likelihood, state, likelihood.evaluate(state)


def at_maximum(likelihood, start):
    state = start.at(refinement(likelihood, start, max_iterations=200, tolerance=1e-9).theta)
    return state, likelihood.evaluate(state)


@pytest.mark.parametrize("seed", range(3))
def test_points_that_err_alike_and_a_prior_that_counts_as_often_say_what_the_points_say_once(seed):
    """The oracle is the cloud itself: each of its points three times over tells nothing new."""
    species = SPECIES.leading(7)
    once = phytofit.simulate(fixed={"stem_length_above": 9.0}, n_points=300, noise_cm=0.5, seed=seed)
    few = Posterior.of(species, once.points)
    mean = np.append(once.x[:7], few.prior.mean[7:])
    few = few.under(replace(few.prior, mean=mean, std=few.prior.std / np.sqrt(SURER)))
    state, at = at_maximum(few, few.start(once.x[:7], once.pose, 0.5))
    one, _ = covariance_of(few, state, at, Dependence(at.scores.T @ at.scores, 1.0, 1e12, NONE, NONE))

    many = Posterior.of(species, np.tile(once.points, (3, 1)))
    many = many.under(few.prior)
    light, _ = at_maximum(many, state)
    assert np.abs(light.x - state.x).max() > 0.02  # there the prior counts for less
    many = many.under(many.prior.weighted(np.ones(len(few.prior.mean), bool), 3.0))
    there, at = at_maximum(many, light)
    np.testing.assert_allclose(there.theta, state.theta, atol=1e-3)
    alike = Dependence(3.0 * at.scores.T @ at.scores, 3.0, 1e12, NONE, NONE)
    three, _ = covariance_of(many, there, at, alike)
    ratio = np.sqrt(np.diag(three)[:7] / np.diag(one)[:7])
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)
    assert ratio[SPECIES.space.index("leaf_width")] == pytest.approx(1.0, abs=0.05)


def test_what_a_prior_takes_to_a_bound_is_as_uncertain_as_the_prior(made):
    """Of the leaf's start nothing was seen, and what else its points say counts little: that it is near the axis, where
    the prior has its middle and about its end, is no news."""
    i = NAMES.index("collar_offset")
    kept = np.linalg.norm(made.points - made.organs[1].axis[0], axis=1) > 4.0
    likelihood = Posterior.of(SPECIES, made.points[kept])
    careful = likelihood.under(
        likelihood.prior.weighted(likelihood.prior.layout.mask("collar_offset"), 500.0).bounded(
            "collar_offset", lower=0.05
        )
    )
    state, at = at_maximum(careful, likelihood.start(made.x, made.pose, 0.3))
    assert state.theta[i] == 0.05
    alike = Dependence(500.0 * at.scores.T @ at.scores, 500.0, 1e12, NONE, NONE)
    covariance, _ = covariance_of(careful, state, at, alike)
    assert np.sqrt(covariance[i, i]) == pytest.approx(SPECIES.space.std[i], rel=0.1)
    longer = -covariance[i, NAMES.index("leaf_length")]  # by which a leaf is that starts further in
    assert longer > 0.5 * covariance[i, i]


@pytest.fixture(scope="module")
def made():
    return phytofit.simulate(fixed={"leaf_taper": 3.0, "collar_offset": 0.5}, n_points=1500, noise_cm=0.3, seed=4)


def test_others_do_not_follow_a_parameter_that_its_bound_holds(made):
    """The same as of a model without it, but for its own entry: the oracle takes it out of the free ones."""
    likelihood, state, at = at_rest(made, 2.0)
    i = NAMES.index("leaf_taper")
    assert state.theta[i] == 2.0
    assert likelihood.gradient(state, at)[i] < 0.0
    known = score_dependence(likelihood, state)
    found, _ = covariance_of(likelihood, state, at, known)
    others = np.arange(len(found)) != i
    assert np.all(np.abs(found[i, others]) < 0.1 * np.sqrt(found[i, i] * np.diag(found)[others] + 1e-12))
    assert found[i, i] > 0.0

    likelihood.prior.lower[i] = likelihood.prior.upper[i]
    without, _ = covariance_of(likelihood, state, at, known)
    np.testing.assert_allclose(np.diag(found)[others], np.diag(without)[others], rtol=0.05)


def test_a_parameter_within_its_bounds_is_followed(made):
    likelihood, state, at = at_rest(made, 6.0)
    i, j = NAMES.index("leaf_taper"), NAMES.index("leaf_length")
    found, _ = covariance_of(likelihood, state, at, score_dependence(likelihood, state))
    assert abs(found[i, j]) / np.sqrt(found[i, i] * found[j, j]) > 0.2
