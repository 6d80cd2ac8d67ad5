"""Points on surfaces: uniform by area, against analytic distributions and the areas of the mesh."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from phytofit.models import STEM, Organ, Phytomer, SurfaceSampler, mesh, move
from phytofit.models.organs import frames_along

N_POINTS = 6000
SIGNIFICANCE = 1e-3  # of a test that independent draws would pass; Halton points are more even than these
SINGLE = 2e-5  # cm; points are float32 up to 100 cm

X = np.array([3.2, 14.0, 42.0, 54.0, 6.5, 3.4, 5.0])
STRAIGHT = np.array([3.2, 14.0, 42.0, 54.0, 6.5, 0.0, 5.0])


def grow(x, **constants):
    return [organ.row(0) for organ in Phytomer(**constants).organs(x)]


def cone(low_radius, high_radius, height):
    axis = np.array([[0, 0, 0], [0, 0, height]], float)
    return Organ(STEM, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), np.array([low_radius, high_radius]))


def draw(organs, n=N_POINTS, seed=0):
    return SurfaceSampler(n, seed).draw(organs)


def passes(p_value):
    return p_value > SIGNIFICANCE


def leaf_area_passed(leaf):
    """Share of a straight leaf's area below a distance from its base: integral of a piecewise linear width."""
    node_at = np.concatenate([[0.0], np.cumsum(leaf.segment_lengths)])
    width = 2 * leaf.half_width

    def cdf(s):
        i = np.clip(np.searchsorted(node_at, s, side="right") - 1, 0, len(node_at) - 2)
        before = np.concatenate([[0.0], np.cumsum(np.diff(node_at) * (width[1:] + width[:-1]) / 2)])
        beyond = s - node_at[i]
        slope = (width[i + 1] - width[i]) / np.diff(node_at)[i]
        return (before[i] + width[i] * beyond + slope * beyond**2 / 2) / before[-1]

    return cdf


def test_along_a_leaf():
    _, leaf = grow(STRAIGHT)
    points, _ = draw([leaf])
    along = (points - leaf.axis[0]) @ leaf.frame[0, :, 0]
    assert passes(stats.kstest(along, leaf_area_passed(leaf)).pvalue)
    uniform_by_length = stats.uniform(0, STRAIGHT[3]).cdf
    assert not passes(stats.kstest(along, uniform_by_length).pvalue)  # the test can tell


def test_across_a_leaf():
    """On the blade, never outside; uniform over the width where the point lies."""
    _, leaf = grow(STRAIGHT)
    points, _ = draw([leaf])
    offset = points - leaf.axis[0]
    along, across, out = (offset @ leaf.frame[0]).T
    np.testing.assert_allclose(out, 0.0, atol=SINGLE)
    node_at = np.linspace(0, STRAIGHT[3], 31)
    share = across / np.interp(along, node_at, leaf.half_width)
    assert np.all(np.abs(across) <= np.interp(along, node_at, leaf.half_width) + SINGLE)
    inner = along < 0.9 * STRAIGHT[3]  # at the tip the share is of a width near nothing
    assert passes(stats.kstest(share[inner], stats.uniform(-1, 2).cdf).pvalue)


def test_along_and_around_a_stem():
    stem, _ = grow(X)
    points, _ = draw([stem])
    height, angle = points[:, 2], np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), X[0] / 2, atol=SINGLE)
    assert passes(stats.kstest(height, stats.uniform(0, X[1] + X[6]).cdf).pvalue)
    assert passes(stats.kstest(angle, stats.uniform(-math.pi, 2 * math.pi).cdf).pvalue)
    counts = np.histogram2d(height, angle, bins=(8, 8))[0]
    assert passes(stats.chi2_contingency(counts).pvalue)  # the two are independent


@pytest.mark.parametrize(("low", "high"), [(1.0, 4.0), (4.0, 1.0), (2.0, 0.0), (0.0, 2.0), (3.0, 3.0 + 1e-10)])
def test_along_a_cone(low, high):
    """The share of a frustum's side below height z is that of r^2, whichever end is wide."""
    points, _ = draw([cone(low, high, 5.0)])

    def passed(z):
        if abs(high - low) < 1e-9:
            return z / 5.0
        radius = low + (high - low) * z / 5.0
        return (radius**2 - low**2) / (high**2 - low**2)

    np.testing.assert_allclose(np.hypot(*points.T[:2]), low + (high - low) * points[:, 2] / 5.0, atol=SINGLE)
    assert passes(stats.kstest(points[:, 2], passed).pvalue)


def test_pieces_of_a_tube_get_points_by_their_slanting_sides():
    """A flat ring from radius 4 to 1, then 5 cm of tube of radius 1: areas of 15 pi and 10 pi."""
    axis = np.array([[0, 0, 0], [0, 0, 1e-6], [0, 0, 5]], float)
    tube = Organ(STEM, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), np.array([4.0, 1.0, 1.0]))
    points, _ = draw([tube])
    assert np.mean(points[:, 2] < 1e-5) == pytest.approx(15 / 25, abs=0.005)


@pytest.mark.parametrize("x", [X, np.array([1.0, 5.0, 80.0, 30.0, 9.0, -4.0, 0.0])])
def test_pieces_get_points_by_the_area_of_their_mesh(x):
    """Stem and every piece of the leaf, bent or not, against the areas of trimesh's triangles."""
    stem, leaf = grow(x)
    points, organ = draw([stem, leaf])
    made = mesh([leaf])
    # every triangle belongs to the piece that its centre is nearest to
    middle = 0.5 * (leaf.axis[1:] + leaf.axis[:-1])
    piece = np.argmin(np.linalg.norm((made.triangles_center * [1, 0, 1])[:, np.newaxis] - middle, axis=2), axis=1)
    areas = [float(stem.area), *np.bincount(piece, made.area_faces, minlength=30)]
    assert made.area == pytest.approx(float(leaf.area))
    blade = points[organ == 1]
    which = 1 + np.argmin(distance_to_pieces(blade[:, [0, 2]], leaf.axis[:, [0, 2]]), axis=1)
    counts = np.bincount(np.concatenate([np.zeros(np.sum(organ == 0), int), which]), minlength=31)
    assert counts.sum() == N_POINTS
    expected = N_POINTS * np.array(areas) / np.sum(areas)
    merged = np.array([counts[:-4], expected[:-4]])  # the last pieces expect too few for a chi-square
    merged = np.column_stack([merged, [counts[-4:].sum(), expected[-4:].sum()]])
    assert passes(stats.chisquare(*merged).pvalue)


def distance_to_pieces(points, nodes):
    """Distances (n, pieces) from points (n, 2) to the pieces of a polyline (m, 2)."""
    start, step = nodes[:-1], np.diff(nodes, axis=0)
    offset = points[:, np.newaxis] - start
    share = np.clip(np.sum(offset * step, axis=2) / np.sum(step**2, axis=1), 0.0, 1.0)
    return np.linalg.norm(offset - share[..., np.newaxis] * step, axis=2)


def test_points_of_a_bent_leaf_lie_on_its_pieces():
    _, leaf = grow(X)
    points, _ = draw([leaf])
    np.testing.assert_allclose(distance_to_pieces(points[:, [0, 2]], leaf.axis[:, [0, 2]]).min(axis=1), 0, atol=SINGLE)
    assert np.abs(points[:, 1]).max() <= X[4] / 2 + SINGLE


@given(st.integers(0, 2**32 - 1), st.integers(1, 500))
def test_labels_follow_the_areas_whatever_the_number(seed, n):
    """The first number of the sequence alone chooses the organ; its discrepancy is below (log2 n + 2) / n."""
    organs = grow(X)
    points, organ = draw(organs, n, seed % 1000)
    assert points.shape == (n, 3)
    assert np.all(np.isfinite(points))
    share = organs[0].area / (organs[0].area + organs[1].area)
    assert abs(np.mean(organ == 0) - share) <= (math.log2(n) + 2) / n


def test_one_seed_gives_one_cloud_and_another_seed_another():
    organs = grow(X)
    points, organ = draw(organs, seed=3)
    again, organ_again = draw(organs, seed=3)
    np.testing.assert_array_equal(points, again)
    np.testing.assert_array_equal(organ, organ_again)
    assert np.mean(np.linalg.norm(points - draw(organs, seed=4)[0], axis=1) > 0.1) > 0.5


def test_a_little_more_of_a_plant_moves_points_a_little():
    """Common random numbers: a millimetre more of leaf moves no point by more than a few millimetres."""
    points, organ = draw(grow(X))
    longer, organ_longer = draw(grow(X + np.array([0, 0, 0, 0.1, 0, 0, 0])))
    same = organ == organ_longer
    assert same.mean() > 0.99
    assert np.linalg.norm(points - longer, axis=1)[same].max() < 0.5


def test_a_population_is_drawn_as_its_plants_alone():
    xs = np.array([X, STRAIGHT, [1.0, 5.0, 80.0, 30.0, 9.0, -4.0, 0.0]])
    sampler = SurfaceSampler(200, 5)
    population = sampler.population(Phytomer().organs(xs))
    for i, x in enumerate(xs):
        points, organ = population.draw(i)
        alone, organ_alone = sampler.draw(grow(x))
        assert points.dtype == np.float32
        np.testing.assert_allclose(points.T, alone, atol=SINGLE)
        np.testing.assert_array_equal(organ, organ_alone)


def test_points_move_with_their_organs():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [20, -70, 130], degrees=True).as_matrix()
    pose[:3, 3] = [30.0, -20.0, 5.0]
    points, organ = draw(grow(X))
    moved, organ_moved = draw(move(grow(X), pose))
    np.testing.assert_array_equal(organ, organ_moved)
    np.testing.assert_allclose(moved, points @ pose[:3, :3].T + pose[:3, 3], atol=2 * SINGLE)


@pytest.mark.parametrize("place", [3, 4])
def test_a_leaf_without_area_gets_no_points(place):
    x = X.copy()
    x[place] = 0.0
    points, organ = draw(grow(x), 300)
    assert np.all(organ == 0)
    assert np.all(np.isfinite(points))


def test_a_plant_without_area_gives_finite_points():
    points, _ = draw(grow(np.zeros(7)), 10)
    np.testing.assert_array_equal(points, np.zeros((10, 3)))


def test_twice_the_pieces_give_the_same_cloud():
    """Of the straight leaf, whose blade differs only by the finer width profile."""
    coarse, _ = draw(grow(STRAIGHT))
    fine, _ = draw(grow(STRAIGHT, n_pieces=60))
    assert np.sqrt(np.mean(np.sum((coarse - fine) ** 2, axis=1))) < 0.15
