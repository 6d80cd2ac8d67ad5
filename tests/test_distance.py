"""Hausdorff distances against scipy."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree
from scipy.spatial.distance import directed_hausdorff as scipy_directed

from phytofit.kernels.distance import directed_hausdorff, hausdorff, hausdorff_within
from phytofit.kernels.nearest import make_bins, nearest_grid

# relative; the maximum is chosen with bounds in float32, so another point that is as far to 7 digits may be returned
SINGLE = 1e-6

COORDINATE = st.one_of(st.floats(-20, 20, width=32), st.integers(-2, 2).map(float))


def clouds():
    return st.integers(1, 25).flatmap(lambda n: arrays(np.float64, (n, 3), elements=COORDINATE))


def searchable(target):
    return nearest_grid(target), make_bins(target)


def columns(points):
    return np.ascontiguousarray(points.T, np.float32)


def both_ways(a, b):
    return scipy_directed(a, b)[0], scipy_directed(b, a)[0]


def leaf_like(seed, n, noise=0.0):
    random = np.random.default_rng(seed)
    u, v = random.uniform(-1, 1, (2, n))
    points = np.stack([15 * u + 20.0, 3 * v - 5.0, 4 * u**2 + 8.0], axis=1) + random.normal(0, noise, (n, 3))
    return points.astype(np.float32).astype(float)


ONE = np.array([[3.0, -2.0, 5.0]])
SPREAD = leaf_like(0, 40)


@given(clouds(), clouds())
@example(ONE, ONE)
@example(ONE, SPREAD)
@example(SPREAD, ONE)  # one point has bins so small that their number over the other cloud overflows
@example(np.repeat(ONE, 5, axis=0), SPREAD)
@example(SPREAD, np.repeat(ONE, 5, axis=0))
@example(SPREAD, SPREAD)
@example(SPREAD, SPREAD[::-1] + np.array([500.0, -300.0, 1000.0]))
@example(SPREAD * 1e-3, SPREAD)
def test_both_directions_agree_with_scipy(source, target):
    source = source.astype(np.float32).astype(float)
    target = target.astype(np.float32).astype(float)
    grid, bins = searchable(target)
    forward, backward = both_ways(source, target)
    np.testing.assert_allclose(directed_hausdorff(columns(source), grid, bins), (forward, backward), rtol=SINGLE)
    np.testing.assert_allclose(hausdorff(columns(source), grid, bins), max(forward, backward), rtol=SINGLE)


@pytest.mark.parametrize(("n_source", "shift"), [(1, 200.0), (30, 0.3), (3000, 0.0), (3000, 5.0), (3000, 200.0)])
def test_clouds_of_thousands_of_points(n_source, shift):
    source = (leaf_like(1, n_source, noise=0.3) + shift).astype(np.float32).astype(float)
    target = leaf_like(2, 2500, noise=0.3)
    grid, bins = searchable(target)
    forward = cKDTree(target).query(source)[0].max()
    backward = cKDTree(source).query(target)[0].max()
    np.testing.assert_allclose(directed_hausdorff(columns(source), grid, bins), (forward, backward), rtol=SINGLE)
    np.testing.assert_allclose(hausdorff(columns(source), grid, bins), max(forward, backward), rtol=SINGLE)


@given(noise=st.sampled_from([0.05, 0.2, 0.5, 5.0]), seed=st.integers(0, 2**32 - 1), cells=st.integers(1, 4))
def test_however_coarse_the_grid_the_distance_is_exact(noise, seed, cells):
    """The grid gives bounds only: with a few cells over the whole cloud they are poor, and the answer the same."""
    random = np.random.default_rng(seed)
    target = random.uniform(0, 5, (60, 3)).astype(np.float32).astype(float)
    source = (target + random.normal(0, noise, (60, 3))).astype(np.float32).astype(float)
    coarse, bins = nearest_grid(target, cell=5.0 / cells), make_bins(target)
    forward, backward = both_ways(source, target)
    np.testing.assert_allclose(directed_hausdorff(columns(source), coarse, bins), (forward, backward), rtol=SINGLE)
    np.testing.assert_allclose(hausdorff(columns(source), coarse, bins), max(forward, backward), rtol=SINGLE)


def test_a_point_in_a_bin_with_another_may_still_be_the_furthest():
    """(1.1, 1.1, 1.1) is 1.9 cm from the source's first point, in the cube beside it, and no other point is as far."""
    source = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    target = np.array([[-1.2, 0.0, 0.0], [1.1, 1.1, 1.1], [10.0, 1.2, 0.0]])
    grid, bins = searchable(target)
    np.testing.assert_allclose(hausdorff(columns(source), grid, bins), 1.1 * np.sqrt(3.0), rtol=SINGLE)


def test_directions_differ_and_the_larger_counts():
    """A part of a cloud lies on the whole; the whole does not lie on the part."""
    whole = leaf_like(3, 400)
    part = whole[whole[:, 0] < 20.0]
    grid, bins = searchable(whole)
    forward, backward = directed_hausdorff(columns(part), grid, bins)
    assert forward == 0.0
    assert backward > 10.0
    np.testing.assert_allclose(hausdorff(columns(part), grid, bins), backward, rtol=SINGLE)


def test_one_stray_point_decides():
    target = leaf_like(4, 500)
    source = target.copy()
    source[123] += [0.0, 0.0, 30.0]
    grid, bins = searchable(target)
    expected = cKDTree(target).query(source[123])[0]
    np.testing.assert_allclose(hausdorff(columns(source), grid, bins), expected, rtol=SINGLE)


@given(clouds(), clouds(), st.floats(0.0, 2.0), st.integers(0, 3))
def test_limited_distance_is_exact_up_to_the_limit(source, target, share, how):
    """At or below the limit it is the distance; above, a lower bound that is still above the limit."""
    if how == 0:
        target = source + np.linspace(0, 0.1, len(source))[:, np.newaxis]  # near: most points are settled by bounds
    source = source.astype(np.float32).astype(float)
    target = target.astype(np.float32).astype(float)
    grid, bins = searchable(target)
    true = max(both_ways(source, target))
    limit = share * true
    found = hausdorff_within(columns(source), grid, bins, limit)
    if true <= limit * (1 - SINGLE):
        np.testing.assert_allclose(found, true, rtol=SINGLE)
    elif true > limit * (1 + SINGLE):
        assert limit < found <= true * (1 + SINGLE)


def test_limits_around_the_distance_of_larger_clouds():
    source, target = leaf_like(5, 2000, noise=0.5), leaf_like(6, 2000, noise=0.5)
    grid, bins = searchable(target)
    true = max(both_ways(source, target))
    for limit in (0.01, 0.5 * true, 0.999 * true):
        assert limit < hausdorff_within(columns(source), grid, bins, limit) <= true * (1 + SINGLE)
    for limit in (1.001 * true, 10 * true, np.inf):
        np.testing.assert_allclose(hausdorff_within(columns(source), grid, bins, limit), true, rtol=SINGLE)


def test_limit_zero_on_equal_clouds_is_exact():
    cloud = leaf_like(7, 100)
    assert hausdorff_within(columns(cloud), *searchable(cloud), 0.0) == 0.0
