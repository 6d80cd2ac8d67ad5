"""Refinement by damped scoring: closed forms, other minimisers' minima, bounds, kinks, and when it says it is done."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize

from phytofit.engine.scoring import refine

TOLERANCE = 1e-3  # nats; what an error may lie above its minimum when a step is expected to gain no more
NEAR = 0.03  # standard errors of a parameter; 0.5 x 0.03² is less than half of TOLERANCE
DAMPED = 2e-3  # of a first step: the damping that it starts with is a thousandth
SAME = 1e-9  # relative; sums in float64
KINK = 0.1  # nats; refine's default

RATES = {"lower": np.array([-np.inf, 0.0, -np.inf]), "upper": np.array([np.inf, 4.0, np.inf])}
SEEDS = st.integers(0, 2**32 - 1)


class Residuals:
    """Half the sum of squared residuals r (n,) with derivatives j (n, k), its information of them; counts its calls."""

    def __init__(self, residuals, jacobian, turn=None):
        self.residuals, self.jacobian, self.turn = residuals, jacobian, turn
        self.seen = []

    def error(self, theta):
        self.seen.append(theta.copy())
        return 0.5 * float(np.sum(self.residuals(theta) ** 2))

    def terms(self, theta):
        error, j = self.error(theta), self.jacobian(theta)
        informing = j if self.turn is None else j @ self.turn
        return error, j.T @ self.residuals(theta), informing.T @ informing

    def refine(self, theta, **settings):
        theta = np.asarray(theta, float)
        free = {"lower": np.full(len(theta), -np.inf), "upper": np.full(len(theta), np.inf)}
        return refine(self.terms, theta, **{**free, "tolerance": TOLERANCE, **settings})


def line(seed, n=20, k=4, turn=None):
    """A linear problem with columns of very different size, and its solution."""
    random = np.random.default_rng(seed)
    a = random.normal(size=(n, k)) * np.geomspace(0.1, 10.0, k)
    b = random.normal(0.0, 3.0, n)
    return Residuals(lambda x: a @ x - b, lambda x: a, turn), np.linalg.lstsq(a, b, rcond=None)[0], a, b


def decay(turn=None):
    """Amplitude, rate and offset of an exponential, seen with some misfit; to be refined within RATES."""
    t = np.linspace(0.0, 5.0, 30)
    seen = 3.0 * np.exp(-0.8 * t) + 1.0 + 0.1 * np.cos(7.0 * t)

    def residuals(x):
        return 20.0 * (x[0] * np.exp(-x[1] * t) + x[2] - seen)

    def jacobian(x):
        return 20.0 * np.stack([np.exp(-x[1] * t), -x[0] * t * np.exp(-x[1] * t), np.ones_like(t)], axis=1)

    return Residuals(residuals, jacobian, turn)


def valley(bend=3.0):
    """Rosenbrock's, with its minimum of 0 at (1, 1)."""
    return Residuals(
        lambda x: np.array([bend * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-2.0 * bend * x[0], bend], [-1.0, 0.0]]),
    )


def corner(slope, smooth=1.0):
    """slope |x| + smooth x² / 2, of which the information knows the smooth part only."""

    def error(x):
        return float(slope * abs(x[0]) + 0.5 * smooth * x[0] ** 2)

    def terms(x):
        return error(x), slope * np.sign(x) + smooth * x, np.array([[smooth]])

    return terms


# minima


@given(SEEDS)
def test_the_first_step_is_the_closed_form(seed):
    problem, solution, a, _ = line(seed)
    start = solution + 10.0
    one = problem.refine(start, max_iterations=1)
    std = 1.0 / np.sqrt(np.diag(a.T @ a))
    assert np.all(np.abs(one.theta - solution) <= DAMPED * np.linalg.norm((start - solution) / std) * std * 10.0)
    assert one.error - problem.error(solution) < 1e-4 * (problem.error(start) - problem.error(solution))
    end = problem.refine(start)
    assert end.converged
    assert end.iterations <= 4
    assert end.error - problem.error(solution) < TOLERANCE
    assert end.error == pytest.approx(problem.error(end.theta), rel=SAME)


def test_at_the_minimum_it_stays():
    problem, solution, _, _ = line(0)
    end = problem.refine(solution)
    assert (end.iterations, end.converged) == (1, True)
    np.testing.assert_array_equal(end.theta, solution)


@given(st.floats(1.0, 6.0), st.floats(0.3, 1.5), st.floats(-1.0, 2.0))
def test_an_exponential_as_scipy_fits_it(amplitude, rate, offset):
    problem = decay()
    start = np.array([amplitude, rate, offset])
    end = problem.refine(start, **RATES)
    best = optimize.minimize(problem.error, [3.0, 0.8, 1.0], jac=lambda x: problem.terms(x)[1], method="BFGS", tol=1e-4)
    assert end.converged
    assert end.error < best.fun + TOLERANCE
    inverse = np.linalg.inv(problem.terms(best.x)[2])
    np.testing.assert_allclose((end.theta - best.x) / np.sqrt(np.diag(inverse)), 0.0, atol=2.0 * NEAR)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (2.0, -1.0), (0.0, 3.0), (-2.0, -2.0)])
def test_along_a_bent_valley(start):
    end = valley().refine(start)
    assert end.converged
    assert end.error < 3.0 * TOLERANCE
    np.testing.assert_allclose(end.theta, 1.0, atol=0.15)


@pytest.mark.parametrize("factor", [0.003, 0.03, 0.3, 3.0, 30.0, 300.0])
@pytest.mark.parametrize("direction", range(4))
def test_information_that_is_wrong_in_one_direction_costs_steps_only(factor, direction):
    """Too little of it, and steps are too long; too much, and they are too short: the gradients tell."""
    problem, solution, a, _ = line(1)
    root = np.linalg.cholesky(a.T @ a)
    axis = np.random.default_rng(direction).normal(size=4)
    axis /= np.linalg.norm(axis)
    wrong = np.eye(4) + (np.sqrt(factor) - 1.0) * np.outer(axis, axis)
    problem.turn = np.linalg.solve(root.T, wrong @ root.T)  # in units of standard errors
    end = problem.refine(solution + 3.0)
    assert end.converged
    assert end.error - problem.error(solution) < 5.0 * TOLERANCE
    assert end.iterations <= 25


@pytest.mark.parametrize("factor", [0.03, 30.0])
def test_wrong_information_of_something_bent(factor):
    exact = decay().refine([2.0, 1.5, 0.5], tolerance=1e-6, **RATES).error
    problem = decay(turn=np.diag([1.0, np.sqrt(factor), 1.0]))
    end = problem.refine([2.0, 1.5, 0.5], **RATES)
    assert end.converged
    assert end.error - exact < 5.0 * TOLERANCE


def test_a_direction_of_no_information_is_left_alone():
    """Two columns that are the same, and one of nothing: only their sum is known, and the least step is taken."""
    random = np.random.default_rng(2)
    column = random.normal(size=20)
    a = np.stack([column, column, np.zeros(20), random.normal(size=20)], axis=1)
    b = random.normal(size=20)
    problem = Residuals(lambda x: a @ x - b, lambda x: a)
    end = problem.refine([1.0, 2.0, 3.0, 4.0])
    best = np.linalg.lstsq(a, b, rcond=None)[0]
    assert end.converged
    assert end.error - problem.error(best) < TOLERANCE
    assert end.theta[2] == 3.0
    assert end.theta[0] - end.theta[1] == pytest.approx(-1.0, abs=1e-6)


def test_errors_that_are_no_number_are_stepped_back_from():
    """The logarithm's likelihood of a Poisson number: a step to below 0 has none."""

    def error(x):
        return float(x[0] - 7.0 * np.log(x[0])) if x[0] > 0.0 else np.nan

    def terms(x):
        return error(x), 1.0 - 7.0 / x, np.array([[0.01]])  # of a long first step

    end = refine(terms, np.array([20.0]), lower=np.array([-np.inf]), upper=np.array([np.inf]), tolerance=1e-5)
    assert end.converged
    np.testing.assert_allclose(end.theta, 7.0, atol=NEAR * np.sqrt(7.0))


# bounds


@given(SEEDS)
def test_bounds_as_scipy_minds_them(seed):
    """Some of them active at the solution; and nothing is ever tried beyond them."""
    problem, solution, a, b = line(seed)
    random = np.random.default_rng(seed)
    std = 1.0 / np.sqrt(np.diag(a.T @ a))
    lower = solution + std * random.uniform(-3.0, 1.0, 4)
    upper = lower + std * random.uniform(0.5, 4.0, 4)
    problem.seen.clear()
    end = problem.refine(random.uniform(lower, upper), lower=lower, upper=upper)
    assert end.converged
    assert end.error - optimize.lsq_linear(a, b, (lower, upper), tol=1e-12).cost < 3.0 * TOLERANCE
    assert np.all((problem.seen >= lower) & (problem.seen <= upper))


def test_bounds_all_active():
    """A corner from which the error falls outwards in every direction: there is nothing left to solve."""
    problem, solution, a, _ = line(3)
    outwards = np.array([1.0, -1.0, 1.0, 1.0])
    corner = solution + np.linalg.solve(a.T @ a, -5.0 * outwards)
    lower, upper = np.where(outwards > 0, -np.inf, corner), np.where(outwards > 0, corner, np.inf)
    np.testing.assert_allclose(problem.terms(corner)[1], -5.0 * outwards, rtol=1e-6)
    for start in (corner, corner - 2.0 * outwards):
        end = problem.refine(start, lower=lower, upper=upper)
        assert end.converged
        np.testing.assert_array_equal(end.theta, corner)


def test_a_fixed_parameter_stays_and_the_others_do_without():
    problem, solution, a, b = line(4)
    fixed = solution[1] + 2.0 / np.linalg.norm(a[:, 1])
    lower, upper = np.full(4, -np.inf), np.full(4, np.inf)
    lower[1] = upper[1] = fixed
    end = problem.refine(solution + 1.0, lower=lower, upper=upper)
    rest = np.linalg.lstsq(np.delete(a, 1, axis=1), b - a[:, 1] * fixed, rcond=None)[0]
    assert end.converged
    assert end.theta[1] == fixed
    assert end.error - problem.error(np.insert(rest, 1, fixed)) < TOLERANCE


def test_a_start_beyond_the_bounds_is_taken_to_them():
    problem, solution, _, _ = line(5)
    lower, upper = solution - 2.0, solution + 2.0
    start = solution + 50.0 * np.array([1.0, -1.0, 1.0, 0.0])
    given_start = start.copy()
    end = problem.refine(start, lower=lower, upper=upper)
    np.testing.assert_array_equal(problem.seen[0], np.clip(start, lower, upper))
    assert np.all((problem.seen >= lower) & (problem.seen <= upper))
    assert end.converged
    assert end.error - problem.error(solution) < TOLERANCE
    np.testing.assert_array_equal(start, given_start)


def test_a_bound_is_left_again_when_the_error_falls_inwards():
    problem, solution, _, _ = line(6)
    end = problem.refine(solution - 1.0, lower=solution - 1.0, upper=solution + 1.0)
    assert end.converged
    assert end.error - problem.error(solution) < TOLERANCE


# kinks


@pytest.mark.parametrize("slope", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("start", [-2.0, 1.0, 3.0])
def test_a_kink_is_a_minimum(slope, start):
    """The smooth part alone would gain slope² / 2 by another step, which is less than `kink`."""
    assert 0.5 * slope**2 < KINK
    terms = corner(slope)
    end = refine(terms, np.array([start]), lower=np.array([-np.inf]), upper=np.array([np.inf]))
    assert end.converged
    assert end.error < 0.01
    assert abs(end.theta[0]) < 0.1


def test_the_absolute_value_alone():
    """Of which 0.05 nats are expected still at its minimum, 1² / (2 x 10)."""
    terms = corner(1.0, smooth=0.0)
    known = np.full((1, 1), 10.0)
    end = refine(lambda x: (*terms(x)[:2], known), np.array([1.7]), lower=np.array([-np.inf]), upper=np.array([np.inf]))
    assert end.converged
    assert end.error < 0.01


def test_a_start_in_a_strong_kink_is_not_called_converged():
    """Every step promises 4.5 nats and none keeps its promise: gradient and error do not belong together."""
    terms = corner(3.0)
    end = refine(terms, np.array([1e-9]), lower=np.array([-np.inf]), upper=np.array([np.inf]))
    assert not end.converged
    np.testing.assert_array_equal(end.theta, 1e-9)
    gentle = refine(terms, np.array([1e-9]), lower=np.array([-np.inf]), upper=np.array([np.inf]), kink=5.0)
    assert gentle.converged


# when it ends


def test_too_few_iterations_have_not_converged():
    """But every one of them is nearer."""
    problem = valley()
    errors = []
    for n in range(1, 5):
        end = problem.refine([-1.2, 1.0], max_iterations=n)
        assert (end.iterations, end.converged) == (n, False)
        errors.append(end.error)
    assert np.all(np.diff([problem.error(np.array([-1.2, 1.0])), *errors]) < 0.0)


def test_a_finer_tolerance_ends_nearer():
    problem, solution, _, _ = line(7, turn=np.diag([3.0, 1.0, 1.0, 0.2]))
    least = problem.error(solution)
    ends = [problem.refine(solution + 1.0, tolerance=tolerance) for tolerance in (1.0, 1e-3, 1e-8)]
    assert all(end.converged for end in ends)
    assert ends[0].iterations < ends[1].iterations <= ends[2].iterations
    assert ends[2].error - least < 1e-6 < ends[0].error - least


def test_nothing_is_evaluated_twice_and_the_best_is_kept():
    problem, solution, _, _ = line(8, turn=np.diag([0.05, 1.0, 1.0, 1.0]))
    asked = []

    def terms(theta):
        asked.append(theta.copy())
        return problem.terms(theta)

    end = refine(terms, solution + 5.0, lower=np.full(4, -np.inf), upper=np.full(4, np.inf))
    assert len(np.unique(asked, axis=0)) == len(asked) > end.iterations  # a step that was too long has been taken back
    errors = [problem.error(theta) for theta in asked]
    np.testing.assert_array_equal(asked[int(np.argmin(errors))], end.theta)
    assert end.error == min(errors)


# what no step can be made of


@pytest.mark.parametrize(
    "information",
    [
        np.diag([1.0, -1.0]),
        np.array([[1.0, 3.0], [3.0, 1.0]]),
        np.array([[0.0, 1.0], [1.0, 0.0]]),
        -np.eye(2),
    ],
)
def test_an_indefinite_information_ends_and_is_not_called_converged(information):
    """Of a bowl, so that steps that are damped enough go down: it never ends higher than it began."""
    asked = []

    def terms(x):
        asked.append(x)
        return float(x @ x), 2.0 * x, information

    free = {"lower": np.full(2, -np.inf), "upper": np.full(2, np.inf)}
    end = refine(terms, np.array([2.0, -1.0]), **free)
    assert not end.converged
    assert end.error <= 5.0
    assert len(asked) <= 1500  # 100 iterations of 10 dampings at most, and some


def test_an_indefinite_information_is_damped_until_steps_go_down():
    free = {"lower": np.full(2, -np.inf), "upper": np.full(2, np.inf)}
    indefinite = np.array([[1.0, 3.0], [3.0, 1.0]])
    end = refine(lambda x: (float(x @ x), 2.0 * x, indefinite), np.array([2.0, -1.0]), **free)
    assert end.error < 0.5


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_terms_that_are_not_finite_end_it_where_it_is(place, value):
    """From the start, or beyond it: what is returned is the last state of which everything was known."""

    def terms(x):
        known = [float(x @ x), 2.0 * x, np.diag([2.0, 2.0])]
        if x[0] < beyond:
            known[place] = np.full_like(known[place], value)
        return known

    free = {"lower": np.full(2, -np.inf), "upper": np.full(2, np.inf)}
    beyond = 10.0
    start = np.array([4.0, 1.0])
    end = refine(terms, start, **free)
    assert (end.iterations, end.converged) == (0, False)
    np.testing.assert_array_equal(end.theta, start)
    beyond = 1.0
    end = refine(terms, start, **free)
    assert not end.converged
    assert np.isfinite(end.error)
    assert 1.0 <= end.theta[0] < 4.0
