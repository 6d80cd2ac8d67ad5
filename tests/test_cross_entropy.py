"""The cross-entropy search: Algorithm 1 by hand, samples against truncated normals, minima against known ones."""

import math
import pickle
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from phytofit.errors import SettingError
from phytofit.paper.cross_entropy import CrossEntropy
from phytofit.parameters import Parameter, ParameterSpace

EXACT = 1e-12  # relative; two ways to sum a hundred numbers
SIGNIFICANCE = 1e-3  # of the tests of samples; seeds are fixed
FOUND = 0.05  # of the prior's std; what ten candidates in a shrunken cloud still scatter about a minimum


def space_of(mean, std, lower=None, upper=None):
    k = len(mean)
    lower = [-np.inf] * k if lower is None else lower
    upper = [np.inf] * k if upper is None else upper
    return ParameterSpace(
        [Parameter(f"p{i}", "cm", mean[i], std[i], lower[i], upper[i]) for i in range(k)],
    )


PLAIN = space_of([2.0, -7.0, 30.0], [1.0, 2.0, 10.0])


def run(search, objective):
    while not search.done:
        xs = search.ask()
        search.tell(xs, objective(xs))
    return search


# minima


@pytest.mark.parametrize("seed", [0, 1])
def test_finds_the_minimum_of_a_shifted_correlated_quadratic(seed):
    turn = Rotation.from_euler("xyz", [30, 40, 50], degrees=True).as_matrix()
    hessian = turn @ np.diag([1.0, 10.0, 100.0]) @ turn.T
    minimum = np.array([3.0, -4.0, 7.0])

    def objective(xs):
        return np.einsum("ni,ij,nj->n", xs - minimum, hessian, xs - minimum) + 11.0

    search = run(CrossEntropy(space_of([0.0, 0.0, 0.0], [4.0] * 3), n_generations=25, seed=seed), objective)
    np.testing.assert_allclose(search.mean, minimum, atol=4.0 * FOUND)
    assert 11.0 <= search.history[-1].best_error < 11.5  # the last noise, Z_0 / 25, spreads the candidates
    assert search.history[-1].threshold < search.history[0].threshold


@pytest.mark.parametrize("seed", [0, 1])
def test_finds_the_lowest_of_many_minima(seed):
    """Rastrigin's function: its minimum at (2.7, -1.3), and beside it others at every centimetre."""
    minimum = np.array([2.7, -1.3])

    def objective(xs):
        d = xs - minimum
        return np.sum(d**2 + 10 * (1 - np.cos(2 * np.pi * d)), axis=1)

    search = run(CrossEntropy(space_of([0.0, 0.0], [3.0, 3.0]), n_generations=30, seed=seed), objective)
    best = min(search.history, key=lambda generation: generation.best_error)
    np.testing.assert_allclose(best.best_x, minimum, atol=0.3)
    # the noise keeps some candidates in the basins next to it, and the mean between them
    np.testing.assert_allclose(search.mean, minimum, atol=0.5)


def test_covariance_follows_a_correlated_valley():
    """Along (1, 1) the error hardly grows, across it does: after some generations so does the search."""
    along, across = np.array([1.0, 1.0]) / math.sqrt(2), np.array([1.0, -1.0]) / math.sqrt(2)

    def valley(xs):
        return (0.05 * (xs @ along)) ** 2 + (xs @ across) ** 2

    search = run(CrossEntropy(space_of([4.0, 2.0], [3.0, 3.0]), covariance_noise=0.0, n_generations=3), valley)
    generation = search.history[-1]
    assert generation.cov[0, 1] / math.sqrt(generation.cov[0, 0] * generation.cov[1, 1]) > 0.9
    spread = [math.sqrt(v @ generation.cov @ v) for v in (along, across)]
    assert spread[0] > 5 * spread[1]
    drawn = search.ask()
    np.testing.assert_allclose(np.cov(drawn.T, bias=True), search.cov, atol=0.2 * search.cov.max())


# Algorithm 1


def by_hand(xs, errors, n_elite):
    """Mean and covariance of the elite: the maximum likelihood normal."""
    ranked = sorted(range(len(xs)), key=lambda i: errors[i])[:n_elite]
    elite = xs[ranked]
    return elite.mean(axis=0), np.cov(elite.T, bias=True), ranked


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 2.0), st.integers(1, 5))
def test_every_generation_by_hand(seed, noise, n_generations):
    """Elite mean and covariance, and Z_t = Z_0 (1 - t / t_max) on the diagonal."""
    search = CrossEntropy(
        PLAIN, n_samples=40, n_generations=n_generations, elite_fraction=0.2, covariance_noise=noise, seed=seed
    )
    random = np.random.default_rng(seed)
    z_0 = noise * np.diag([1.0, 4.0, 100.0])
    np.testing.assert_array_equal(search.cov, np.diag([1.0, 4.0, 100.0]))
    for t in range(1, n_generations + 1):
        assert not search.done
        xs, errors = search.ask(), random.normal(size=40)
        generation = search.tell(xs, errors)
        mean, cov, ranked = by_hand(xs, errors, 8)
        np.testing.assert_allclose(search.mean, mean, rtol=EXACT)
        np.testing.assert_allclose(search.cov, cov + z_0 * (1 - t / n_generations), rtol=1e-9, atol=1e-12)
        assert generation is search.history[-1]
        assert generation.index == t == len(search.history)
        np.testing.assert_allclose(generation.mean, mean, rtol=EXACT)
        np.testing.assert_allclose(generation.cov, cov, rtol=1e-9, atol=1e-12)  # before noise is added
        assert generation.threshold == errors[ranked[-1]]
        assert generation.best_error == errors[ranked[0]] == errors.min()
        np.testing.assert_array_equal(generation.best_x, xs[ranked[0]])
    assert search.done


def test_a_tiny_case_in_numbers():
    """Elite (1, 1) and (3, 5) of four; noise 0.5 x (1, 4) a half of which is left after the first of two."""
    search = CrossEntropy(space_of([0.0, 0.0], [1.0, 2.0]), n_samples=4, n_generations=2, elite_fraction=0.5)
    xs = np.array([[9.0, 9.0], [1.0, 1.0], [-9.0, 4.0], [3.0, 5.0]])
    search.tell(xs, [7.0, 2.0, 8.0, 1.0])
    np.testing.assert_allclose(search.mean, [2.0, 3.0])
    np.testing.assert_allclose(search.cov, [[1.0 + 0.25, 2.0], [2.0, 4.0 + 1.0]])
    search.tell(xs, [1.0, 2.0, 8.0, 9.0])
    np.testing.assert_allclose(search.mean, [5.0, 5.0])
    np.testing.assert_allclose(search.cov, [[16.0, 16.0], [16.0, 16.0]])  # Z is gone with the last generation
    assert search.done


@given(st.integers(2, 2000), st.sampled_from(["0.01", "0.05", "0.07", "0.1", "0.15", "0.25", "0.3", "0.55", "0.9"]))
@example(100, "0.07")  # 0.07 * 100 is a little more than 7 in floating point
@example(500, "0.1")
def test_elite_is_the_ceiling_of_its_share(n_samples, share):
    expected = math.ceil(Fraction(share) * n_samples)
    if expected < 2:
        with pytest.raises(SettingError, match=r"samples: expected \d+ or more, of which two are the elite"):
            CrossEntropy(PLAIN, n_samples=n_samples, elite_fraction=float(share))
    else:
        assert CrossEntropy(PLAIN, n_samples=n_samples, elite_fraction=float(share)).n_elite == expected


def test_the_papers_settings_are_the_defaults():
    search = CrossEntropy(PLAIN)
    assert (search.n_samples, search.n_generations, search.n_elite) == (500, 10, 50)
    search.tell(np.tile(PLAIN.mean, (500, 1)), np.zeros(500))
    np.testing.assert_allclose(search.cov, 0.5 * np.diag(PLAIN.std**2) * 0.9)


# samples


def test_samples_are_normal_with_the_full_covariance():
    """Whitened by the covariance after one generation they are independent standard normals."""
    search = CrossEntropy(PLAIN, n_samples=4000, n_generations=5, seed=3)
    xs = search.ask()
    assert xs.shape == (4000, 3)
    search.tell(xs, np.sum(((xs - [3.0, -8.0, 20.0]) @ [[1, 1, 0], [0, 1, 0], [0.3, 0, 1]]) ** 2, axis=1))
    white = np.linalg.solve(np.linalg.cholesky(search.cov), (search.ask() - search.mean).T)
    for row in white:
        assert stats.kstest(row, "norm").pvalue > SIGNIFICANCE
    np.testing.assert_allclose(np.corrcoef(white), np.eye(3), atol=4 / math.sqrt(4000))


@pytest.mark.parametrize(
    ("mean", "std", "lower", "upper"),
    [
        (6.0, 2.0, 4.5, np.inf),
        (6.0, 2.0, -np.inf, 7.0),
        (6.0, 2.0, 5.0, 9.0),
        (6.0, 2.0, 6.0, np.inf),  # the mean sits on the bound
        (6.0, 2.0, -np.inf, 6.0),
        (6.0, 2.0, 6.0, 7.0),
        (6.0, 2.0, 5.999, 6.002),  # few draws fall into so narrow an interval: they are mirrored into it
        (6.0, 2.0, 6.0, 6.001),
    ],
)
def test_samples_near_bounds_are_a_truncated_normal(mean, std, lower, upper):
    """All within the bounds, none of them piled up there."""
    n = 4000
    search = CrossEntropy(space_of([mean], [std], [lower], [upper]), n_samples=n, seed=4)
    x = search.ask()[:, 0]
    assert np.all((x >= lower) & (x <= upper))
    expected = stats.truncnorm((lower - mean) / std, (upper - mean) / std, mean, std)
    assert stats.kstest(x, expected.cdf).pvalue > SIGNIFICANCE
    for bound in (lower, upper):
        if np.isfinite(bound):
            assert np.sum(x == bound) <= 1
            edge = abs(expected.ppf(0.02 if bound == lower else 0.98) - bound)
            assert stats.binomtest(int(np.sum(np.abs(x - bound) <= edge)), n, 0.02).pvalue > SIGNIFICANCE


def test_each_of_many_bounded_parameters_is_truncated_on_its_own():
    """Seven means on seven bounds: one draw in 128 falls inside."""
    k = 7
    search = CrossEntropy(space_of([1.0] * k, [2.0] * k, [1.0] * k, [9.0] * k), n_samples=3000, seed=5)
    xs = search.ask()
    assert np.all((xs >= 1.0) & (xs <= 9.0))
    for x in xs.T:
        assert stats.kstest(x, stats.truncnorm(0.0, 4.0, 1.0, 2.0).cdf).pvalue > SIGNIFICANCE


def test_a_minimum_on_a_bound_is_found_there():
    search = CrossEntropy(space_of([3.0, 3.0], [1.0, 1.0], [2.0, -np.inf]), n_generations=20, seed=6)
    run(search, lambda xs: np.sum(xs**2, axis=1))
    np.testing.assert_allclose(search.mean, [2.0, 0.0], atol=FOUND)
    assert np.all(search.history[-1].best_x >= [2.0, -np.inf])


def test_an_elite_of_two_spans_a_line():
    """The covariance is then singular, and sampling goes on along it."""
    search = CrossEntropy(PLAIN, n_samples=4, elite_fraction=0.5, covariance_noise=0.0, n_generations=3)
    elite = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 7.0]])
    search.tell(np.concatenate([elite, elite + 50]), [1.0, 2.0, 3.0, 4.0])
    offset = search.ask() - elite.mean(axis=0)
    direction = np.array([1.0, 2.0, 4.0]) / math.sqrt(21)
    np.testing.assert_allclose(offset - np.outer(offset @ direction, direction), 0.0, atol=1e-6)
    assert np.ptp(offset @ direction) > 0.1


# the same again


def test_one_seed_one_search():
    a, b, c = (CrossEntropy(PLAIN, seed=seed) for seed in (7, 7, 8))
    for _ in range(3):
        xs = a.ask()
        np.testing.assert_array_equal(xs, b.ask())
        assert not np.any(xs == c.ask())
        for search in (a, b, c):
            search.tell(xs, np.sum(xs**2, axis=1))
    np.testing.assert_array_equal(a.cov, b.cov)


@pytest.mark.parametrize("between", ["generations", "ask and tell"])
def test_pickled_and_continued_it_is_the_same_search(between):
    search = CrossEntropy(PLAIN, n_samples=50, seed=9)
    xs = search.ask()
    search.tell(xs, np.sum(xs**2, axis=1))
    if between == "ask and tell":
        xs = search.ask()
    other = pickle.loads(pickle.dumps(search))
    if between == "ask and tell":
        for one in (search, other):
            one.tell(xs, np.sum(xs**2, axis=1))
    run(search, lambda xs: np.sum(xs**2, axis=1))
    run(other, lambda xs: np.sum(xs**2, axis=1))
    assert len(search.history) == len(other.history) == 10
    for a, b in zip(search.history, other.history, strict=True):
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.cov, b.cov)


def test_the_start_may_be_moved():
    search = CrossEntropy(PLAIN, mean=[5.0, 6.0, 7.0], n_samples=4000, seed=10)
    np.testing.assert_array_equal(search.mean, [5.0, 6.0, 7.0])
    np.testing.assert_allclose(search.ask().mean(axis=0), [5.0, 6.0, 7.0], atol=4 * PLAIN.std.max() / math.sqrt(4000))
    np.testing.assert_array_equal(PLAIN.mean, [2.0, -7.0, 30.0])


def test_tied_errors_keep_the_first():
    search = CrossEntropy(PLAIN, n_samples=10, elite_fraction=0.3)
    xs = search.ask()
    errors = np.ones(10)
    generation = search.tell(xs, errors)
    np.testing.assert_allclose(generation.mean, xs[:3].mean(axis=0), rtol=EXACT)
    assert generation.threshold == generation.best_error == 1.0
    errors[[4, 9]] = 0.5
    generation = search.tell(xs, errors)
    np.testing.assert_allclose(generation.mean, xs[[4, 9, 0]].mean(axis=0), rtol=EXACT)


def test_what_is_told_is_left_alone():
    search = CrossEntropy(PLAIN, n_samples=10, elite_fraction=0.3)
    xs = search.ask()
    kept = xs.copy()
    search.tell(xs, np.arange(10.0))
    np.testing.assert_array_equal(xs, kept)
    xs[:] = 0.0
    assert np.all(search.history[0].best_x == kept[0])


@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_candidates_without_an_error_are_never_elite(bad):
    search = CrossEntropy(PLAIN, n_samples=10, elite_fraction=0.3)
    xs = search.ask()
    errors = np.full(10, bad)
    errors[[2, 5, 7]] = [3.0, 1.0, 2.0]
    generation = search.tell(xs, errors)
    np.testing.assert_allclose(generation.mean, xs[[2, 5, 7]].mean(axis=0), rtol=EXACT)
    assert (generation.best_error, generation.threshold) == (1.0, 3.0)
    errors[5] = bad
    with pytest.raises(SettingError, match=r"tell: expected at least 3 finite errors, got 2"):
        search.tell(xs, errors)
    assert len(search.history) == 1


# settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_generations": 0}, r"generations: expected 1 or more, got 0"),
        ({"n_generations": -3}, r"generations: expected 1 or more, got -3"),
        ({"elite_fraction": 0.0}, r"elite_fraction: expected a number between 0 and 1, got 0"),
        ({"elite_fraction": 1.0}, r"elite_fraction: expected a number between 0 and 1, got 1"),
        ({"elite_fraction": -0.1}, r"elite_fraction: expected a number between 0 and 1, got -0\.1"),
        ({"elite_fraction": np.nan}, r"elite_fraction: expected a number between 0 and 1, got nan"),
        ({"covariance_noise": -0.5}, r"covariance_noise: expected 0 or more, got -0\.5"),
        ({"covariance_noise": np.nan}, r"covariance_noise: expected 0 or more, got nan"),
        ({"covariance_noise": np.inf}, r"covariance_noise: expected 0 or more, got inf"),
        (
            {"n_samples": 10},
            r"samples: expected 11 or more, of which two are the elite \(elite_fraction 0\.1\), got 10",
        ),
        ({"n_samples": 0}, r"samples: expected 11 or more, .* got 0"),
        ({"n_samples": -20}, r"samples: expected 11 or more, .* got -20"),
        ({"mean": [1.0, 2.0]}, r"mean: expected 3 numbers, got shape \(2,\)"),
        ({"mean": [[1.0, 2.0, 3.0]]}, r"mean: expected 3 numbers, got shape \(1, 3\)"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(SettingError, match=message):
        CrossEntropy(PLAIN, **settings)


@pytest.mark.parametrize(("n_xs", "n_errors"), [(499, 499), (500, 499), (499, 500), (0, 0)])
def test_a_wrong_number_of_answers_is_named(n_xs, n_errors):
    search = CrossEntropy(PLAIN)
    with pytest.raises(SettingError, match=rf"tell: expected xs \(500, 3\) and errors \(500,\), got \({n_xs}, 3\) and"):
        search.tell(np.zeros((n_xs, 3)), np.zeros(n_errors))
    assert search.history == []
