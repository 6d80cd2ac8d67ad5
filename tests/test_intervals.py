"""Intervals of what is measured on fitted parameters, against closed forms and draws."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

import phytofit
from phytofit.engine.dependence import NONE, width_misfit
from phytofit.engine.intervals import Ends, covariance_of_independent, propagated
from phytofit.engine.posterior import Posterior
from phytofit.parameters import ParameterSpace

ROUNDING = 1e-9
DRAWN = 0.05  # relative; quantiles of a hundred thousand draws, and what is lost by looking along axes only
FREE = np.full(3, np.inf)
N_LINES = 1000  # of which 95 % are 950, 7 more or less


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
    likelihood = Posterior.of(species, points)
    state = likelihood.start(made.x, np.eye(4), 0.3)
    assert width_misfit(likelihood, state, likelihood.evaluate(state), NONE) < 0.03
    leaf = points[made.labels == 2]
    waved = points.copy()
    waved[made.labels == 2, 1] *= 1.0 + 0.1 * np.sqrt(2.0) * np.sin(leaf[:, 0])  # the blade lies across y
    moved = likelihood.at(waved)
    assert width_misfit(moved, state, moved.evaluate(state), NONE) == pytest.approx(0.1, abs=0.035)


def scores_of(n, seed, steeper=1.0):
    """Scores (n, 3) of n points of a right model, in units that differ, or `steeper` along one slanting axis; the
    curvature (3, 3); and that of one point, root @ root.T."""
    random = np.random.default_rng(seed)
    root = np.array([1.0, 30.0, 0.1])[:, np.newaxis] * random.normal(size=(3, 3))
    scores = random.normal(size=(n, 3)) * [1.0, 1.0, steeper] @ root.T
    return scores, n * root @ root.T, root


@pytest.mark.parametrize(("n", "seed"), [(20, 0), (20, 1), (5000, 2)])
def test_of_a_right_model_the_covariance_is_the_inverse_curvature(n, seed):
    """Also of few points, whose scores happen to vary less or more."""
    scores, curvature, root = scores_of(n, seed)
    found = covariance_of_independent(curvature, scores, np.zeros(3))
    np.testing.assert_allclose(n * root.T @ found @ root, np.eye(3), atol=ROUNDING)


@pytest.mark.parametrize("n", [300, 2500])
def test_of_many_parameters_chance_adds_little(n):
    """Of 26 some axes stand out, since they are chosen by the scores: the mean variance is a few per cent too large."""
    random = np.random.default_rng(n)
    found = [covariance_of_independent(n * np.eye(26), random.normal(size=(n, 26)), np.zeros(26)) for _ in range(10)]
    variance = n * np.mean([np.trace(one) / 26 for one in found])
    assert 1.0 - ROUNDING <= variance < 1.08
    assert all(np.linalg.eigvalsh(n * one)[0] > 1.0 - ROUNDING for one in found)


def test_of_a_wrong_model_the_covariance_is_the_sandwich():
    """Along one axis scores vary four times as much as they should."""
    n = 20_000
    scores, curvature, root = scores_of(n, 3, steeper=2.0)
    found = covariance_of_independent(curvature, scores, np.zeros(3))
    inverse = np.linalg.inv(curvature)
    for one in (found, inverse @ scores.T @ scores @ inverse):
        np.testing.assert_allclose(n * root.T @ one @ root, np.diag([1.0, 1.0, 4.0]), atol=0.15)


def test_of_what_nothing_is_known_there_is_no_covariance():
    scores, curvature, _ = scores_of(50, 4)
    scores[:, 1], curvature[1], curvature[:, 1] = 0.0, 0.0, 0.0
    found = covariance_of_independent(curvature, scores, np.zeros(3))
    known = np.ix_([0, 2], [0, 2])
    expected = np.zeros((3, 3))
    expected[known] = np.linalg.inv(curvature[known])
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


def test_the_end_of_a_blurred_line_is_within_its_interval_as_often_as_it_should():
    """Few points tell where it ends, as of a leaf's tip: with the scores' outer product the interval is too short."""
    random, n, length, step = np.random.default_rng(0), 40, 10.0, 1e-3
    held = []
    for _ in range(N_LINES):
        z = random.uniform(0.0, length, n) + random.normal(size=n)

        def log_p(end, z=z):
            return np.log(norm.cdf(z) - norm.cdf(z - end)) - np.log(end)

        end = minimize_scalar(lambda end: -log_p(end).sum(), bounds=(5.0, 20.0), method="bounded").x
        low, middle, high = (log_p(end + by) for by in (-step, 0.0, step))
        scores = (high - low)[:, np.newaxis] / (2.0 * step)
        curvature = np.full((1, 1), -np.sum(low - 2.0 * middle + high) / step**2)
        sandwich = np.sum(scores**2) / curvature[0, 0] ** 2
        errors = np.sqrt([covariance_of_independent(curvature, scores, np.zeros(1))[0, 0], sandwich])
        held.append(np.abs(end - length) < 1.96 * errors)
    ours, outer = np.mean(held, axis=0)
    assert ours == pytest.approx(0.95, abs=0.03)
    assert outer < ours - 0.02


def test_intervals_of_traits_know_the_discrepancy_of_real_organs_and_those_of_parameters_do_not():
    """The closed form for traits that are a parameter times a constant, as diameter and width are."""
    made = phytofit.simulate(fixed={"leaf_length": 50.0, "leaf_width": 6.0}, n_points=2000, noise_cm=0.4, seed=3)
    species = phytofit.load_species()

    def fitted(discrepancy):
        parameters = [
            replace(p, discrepancy=discrepancy if p.name in ("leaf_width", "stem_diameter") else 0.0)
            for p in species.space.parameters
        ]
        return phytofit.fit(made.points, "cm", species=replace(species, space=ParameterSpace(parameters)), threads=2)

    none, some = fitted(0.0), fitted(0.05)
    assert none.parameter_intervals == some.parameter_intervals
    half = {name: _half(none, name) for name in ("leaf_width", "stem_diameter", "leaf_angle")}
    quantile = none.estimate.quantile
    for name in ("leaf_width", "stem_diameter"):
        added = quantile * 0.05 * next(t.value for t in none.traits if t.name == name)
        assert _half(some, name) == pytest.approx(np.hypot(half[name], added), rel=1e-3)
    assert half["leaf_angle"] < _half(some, "leaf_angle") < 1.5 * half["leaf_angle"]  # a thicker stem moves the base


def _half(result, name):
    trait = next(t for t in result.traits if t.name == name)
    return 0.5 * (trait.high - trait.low)


def test_the_interval_where_one_of_two_estimates_is_right():
    """Mean squares of errors that are drawn: the truth is about one estimate or, three times in ten, the other."""
    random = np.random.default_rng(0)
    n, quantile = 400_000, 1.96
    apart = np.array([1.5, -0.5, 0.0])
    here, there = np.array([1.0, 0.7, 0.2]), np.array([0.4, 1.4, 0.1])
    other = random.random((n, 1)) < 0.3
    truth = np.where(other, apart + there * random.normal(size=(n, 3)), here * random.normal(size=(n, 3)))
    mixed = Ends(quantile * here, quantile * here).mixed(
        [(0.3, apart, Ends(quantile * there, quantile * there))], quantile
    )
    # the two sides together are as far as the root mean square: what lies to one side widens that side alone
    square = (mixed.below**2 + mixed.above**2 - (quantile**2 * (0.7 * here**2 + 0.3 * there**2))) / quantile**2
    np.testing.assert_allclose(square, np.mean(truth**2, axis=0), rtol=0.01)
    assert mixed.above[0] > mixed.below[0]
    assert mixed.below[1] > mixed.above[1]
    assert mixed.below[2] == mixed.above[2]
