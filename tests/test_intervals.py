"""Intervals of what is measured on fitted parameters, against closed forms and draws."""

import numpy as np
import pytest

import phytofit
from phytofit.dependence import NONE, width_misfit
from phytofit.intervals import propagated
from phytofit.likelihood import CloudLikelihood

ROUNDING = 1e-9
DRAWN = 0.05  # relative; quantiles of a hundred thousand draws, and what is lost by looking along axes only
FREE = np.full(3, np.inf)


def covariance(seed):
    root = np.random.default_rng(seed).normal(size=(3, 3)) * [1.0, 30.0, 0.1]
    return root.T @ root


@pytest.mark.parametrize("seed", range(4))
def test_linear_functions_have_the_interval_of_the_delta_method(seed):
    """Whatever the parameters' units."""
    slopes = np.random.default_rng(seed + 10).normal(size=(5, 3))
    cov = covariance(seed)
    ends = propagated(lambda x: slopes @ x + 3.0, np.ones(3), cov, 1.96, -FREE, FREE)
    half = 1.96 * np.sqrt(np.diag(slopes @ cov @ slopes.T))
    np.testing.assert_allclose(ends.below, half, rtol=ROUNDING)
    np.testing.assert_allclose(ends.above, half, rtol=ROUNDING)


def test_a_function_that_bends_has_the_interval_of_draws():
    """A leaf's exit from its stem: nearly parallel to it, a small step sideways is a long way along."""
    x, cov = np.array([1.0, 0.0, 0.0]), np.diag([0.04, 0.0, 0.0])
    ends = propagated(lambda x: 1.0 / x[:1], x, cov, 1.96, -FREE, FREE)
    drawn = 1.0 / np.random.default_rng(0).normal(1.0, 0.2, 100_000)
    assert 1.0 - ends.below[0] == pytest.approx(np.quantile(drawn, 0.025), rel=DRAWN)
    assert 1.0 + ends.above[0] == pytest.approx(np.quantile(drawn, 0.975), rel=DRAWN)
    assert ends.above[0] > 1.5 * ends.below[0]


def test_no_interval_reaches_beyond_the_bounds():
    ends = propagated(lambda x: x, np.zeros(3), np.eye(3), 2.0, np.array([0.0, -np.inf, -0.5]), FREE)
    np.testing.assert_allclose(ends.below, [0.0, 2.0, 0.5])
    np.testing.assert_allclose(ends.above, [2.0, 2.0, 2.0])


def test_an_independent_error_adds_in_squares():
    ends = propagated(lambda x: x, np.zeros(3), np.diag([9.0, 1.0, 0.0]), 1.0, -FREE, FREE)
    wider = ends.with_error(np.array([-4.0, 0.0, -2.0]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(wider.below, [5.0, 1.0, 2.0])
    np.testing.assert_allclose(wider.above, [3.0, 1.0, 1.0])


def test_width_is_as_the_model_has_it_or_it_is_not():
    """A leaf whose width goes up and down by a tenth, about that of the model."""
    species = phytofit.load_species()
    made = phytofit.simulate(n_points=5000, noise_cm=0.3, seed=3)
    points = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    likelihood = CloudLikelihood(species.model, species.space, points)
    state = likelihood.start(made.x, np.eye(4), 0.3)
    assert width_misfit(likelihood, state, likelihood.evaluate(state).scores, NONE) < 0.03
    leaf = points[made.labels == 2]
    waved = points.copy()
    waved[made.labels == 2, 1] *= 1.0 + 0.1 * np.sqrt(2.0) * np.sin(leaf[:, 0])  # the blade lies across y
    moved = likelihood.at(waved)
    assert width_misfit(moved, state, moved.evaluate(state).scores, NONE) == pytest.approx(0.1, abs=0.035)
