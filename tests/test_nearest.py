"""Nearest-neighbour structures against scipy's cKDTree."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from phytofit.kernels import nearest
from phytofit.kernels.nearest import bin_points, exact_nearest, make_bins, nearest_distances, nearest_grid

ROUNDING = 1e-12  # relative; both sides take float32 coordinates and work in float64
SINGLE = 1e-5  # cm; coordinates up to 50 cm in float32 are good to 4e-6

COORDINATE = st.one_of(
    st.floats(-20, 20, width=32),
    st.integers(-2, 2).map(float),  # ties and duplicates
)


def clouds(max_points=30):
    """Clouds (m, 3) of at least one point, of coordinates that float32 holds exactly; some flat, some equal."""
    free = st.integers(1, max_points).flatmap(lambda m: arrays(np.float64, (m, 3), elements=COORDINATE))
    flat = free.map(lambda p: p * [1.0, 1.0, 0.0] + [0.0, 0.0, 3.0])
    equal = free.map(lambda p: np.repeat(p[:1], len(p), axis=0))
    return st.one_of(free, flat, equal)


def columns(points):
    return [np.ascontiguousarray(points[:, a], np.float32) for a in range(3)]


def lookup(grid, queries):
    """What the grid answers for queries (n, 3)."""
    cell = np.clip(((queries - grid.origin) * grid.inverse_cell).astype(int), 0, grid.dims - 1)
    return grid.nearest[np.ravel_multi_index(cell.T, grid.dims)]


def leafy(seed, n):
    """A curved surface with a spike: far from a cube, as plants are."""
    random = np.random.default_rng(seed)
    u, v = random.uniform(-1, 1, (2, n))
    surface = np.stack([12 * u + 5.0, 2 * v - 40.0, 3 * u**2 + v + 12.0], axis=1)
    surface[: n // 5] = np.stack([0 * u, 0 * u, 10 * u], axis=1)[: n // 5]
    return surface.astype(np.float32).astype(float)


@given(clouds(), st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 30.0, 1000.0]))
def test_exact_search_agrees_with_a_tree(points, seed, reach):
    """Queries inside the box, beside it and far away, and the points themselves."""
    queries = np.random.default_rng(seed).uniform(-reach, reach, (60, 3)) + points[0]
    queries = np.concatenate([queries, points]).astype(np.float32).astype(float)
    distance, index = nearest_distances(make_bins(points), *columns(queries))
    expected, _ = cKDTree(points).query(queries)
    np.testing.assert_allclose(distance, expected, rtol=ROUNDING, atol=0)
    # a tie may be answered by either point, so the index is judged by its distance
    np.testing.assert_allclose(np.linalg.norm(queries - points[index], axis=1), expected, rtol=ROUNDING, atol=0)


def test_exact_search_on_a_larger_cloud():
    points = leafy(0, 4000)
    random = np.random.default_rng(1)
    far, near = random.uniform(-60, 60, (2000, 3)), points + random.normal(0, 0.3, points.shape)
    queries = np.concatenate([far, near]).astype(np.float32).astype(float)
    distance, index = nearest_distances(make_bins(points), *columns(queries))
    expected, which = cKDTree(points).query(queries)
    np.testing.assert_allclose(distance, expected, rtol=ROUNDING)
    np.testing.assert_array_equal(index, which)


def test_no_queries():
    distance, index = nearest_distances(make_bins(leafy(0, 10)), *columns(np.zeros((0, 3))))
    assert distance.shape == index.shape == (0,)


@pytest.mark.parametrize("n_equal", [1, 7])
def test_one_point_and_equal_points(n_equal):
    points = np.repeat([[3.0, -7.0, 11.0]], n_equal, axis=0)
    queries = np.array([[3.0, -7.0, 11.0], [3.0, -7.0, 12.5], [1000.0, -7.0, 11.0]])
    bins = make_bins(points)
    distance, _ = nearest_distances(bins, *columns(queries))
    np.testing.assert_allclose(distance, [0.0, 1.5, 997.0], rtol=ROUNDING)
    which = lookup(nearest_grid(points), queries)
    assert np.all((which >= 0) & (which < n_equal))


def test_search_stops_at_its_limits():
    """`within2` leaves out what is further, `enough2` takes the first that is near enough."""
    points = leafy(2, 500)
    bins = make_bins(points)
    query = np.array([6.0, -39.0, 14.0])
    distances = np.linalg.norm(points - query, axis=1)
    nearest2 = distances.min() ** 2
    assert exact_nearest(bins, *query, 0.9 * nearest2, 0.0) == (0.9 * nearest2, -1)
    found2, at = exact_nearest(bins, *query, 1.1 * nearest2, 0.0)
    np.testing.assert_allclose([found2, distances[bins.order[at]] ** 2], nearest2, rtol=ROUNDING)
    enough2 = 25.0
    found2, at = exact_nearest(bins, *query, np.inf, enough2)
    assert nearest2 <= found2 * (1 + ROUNDING)
    assert found2 <= enough2
    np.testing.assert_allclose(distances[bins.order[at]] ** 2, found2, rtol=ROUNDING)


@given(clouds(), st.sampled_from([1e-6, 0.5, 100.0]))
def test_bins_hold_every_point_once_in_its_place(points, edge):
    """Also for edges so small that the number of bins would not fit an integer."""
    bins = nearest.Bins(*bin_points(*columns(points), edge))
    assert np.prod(bins.dims.astype(float)) <= nearest.MAX_BINS
    assert bins.edge >= edge
    assert bins.start[0] == 0
    assert bins.start[-1] == len(points)
    np.testing.assert_array_equal(np.sort(bins.order), np.arange(len(points)))
    np.testing.assert_array_equal(np.stack([bins.x, bins.y, bins.z], axis=1), points[bins.order])
    bin_of = np.repeat(np.arange(len(bins.start) - 1), np.diff(bins.start))
    corner = bins.origin + np.stack(np.unravel_index(bin_of, bins.dims), axis=1) * bins.edge
    offset = points[bins.order] - corner
    assert np.all((offset >= -SINGLE) & (offset <= bins.edge + SINGLE))


@given(clouds(), st.integers(0, 2**32 - 1), st.integers(4, 16), st.floats(0.1, 3.0))
def test_grid_answers_are_points_and_nearly_nearest(points, seed, cells, margin):
    """Both the query and its nearest point are at most half a diagonal further from the centre of the query's cell."""
    size = np.linalg.norm(np.ptp(points, axis=0)) + 2 * margin
    grid = nearest_grid(points, cell=size / cells, margin=margin)
    cell = 1.0 / grid.inverse_cell
    high = grid.origin + grid.dims * cell
    assert np.all(grid.origin <= points.min(axis=0) - margin + SINGLE)
    assert np.all(high >= points.max(axis=0) + margin - SINGLE)
    queries = np.random.default_rng(seed).uniform(grid.origin, high, (1000, 3))
    which = lookup(grid, queries)
    assert np.all((which >= 0) & (which < len(points)))
    excess = np.linalg.norm(queries - points[which], axis=1) - cKDTree(points).query(queries)[0]
    assert np.all(excess <= np.sqrt(3.0) * cell + SINGLE)


def test_a_point_alone_in_its_cell_is_found_there():
    """What ICP rests on: at a point of the cloud the answer is that point."""
    points = leafy(3, 300)
    crowded = cKDTree(points).query_pairs(0.5, output_type="ndarray")[:, 1]
    points = np.delete(points, crowded, axis=0)
    grid = nearest_grid(points, cell=0.25, margin=1.0)
    np.testing.assert_array_equal(lookup(grid, points), np.arange(len(points)))


def test_a_query_outside_the_box_gets_a_point():
    points = leafy(4, 200)
    grid = nearest_grid(points)
    far = np.array([[1e4, 0.0, 0.0], [0.0, -1e4, 0.0], [0.0, 0.0, 1e4], [-1e4, -1e4, -1e4]])
    which = lookup(grid, far)
    assert np.all((which >= 0) & (which < len(points)))


@pytest.mark.parametrize("n", [1, 2, 50, 3000])
def test_default_grid_keeps_to_its_size(n):
    points = leafy(5, n)
    grid = nearest_grid(points)
    assert len(grid.nearest) == np.prod(grid.dims)
    assert np.prod(grid.dims - 1) <= nearest.MAX_CELLS  # rounding up adds at most a cell a side
    np.testing.assert_array_equal(grid.points, np.column_stack([points, np.zeros(n)]).astype(np.float32))
