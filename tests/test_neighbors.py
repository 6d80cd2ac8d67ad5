"""Points along a line, nearest pieces of a polyline and sums over pairs of points, against brute force in NumPy."""

from itertools import pairwise

import numpy as np
import pytest

from phytofit.kernels.neighbors import near_line, nearest_pieces, sum_by_distance
from phytofit.models import LEAF, Organ
from phytofit.models.organs import frames_along

SAME = 1e-9  # cm; coordinates of some tens of cm in float64


def bent_leaf(n_pieces=7):
    random = np.random.default_rng(3)
    axis = 20.0 + np.cumsum(random.normal(1.0, 0.7, (n_pieces + 1, 3)), axis=0)
    return Organ(LEAF, axis, frames_along(axis, np.array([0.0, 1.0, 0.3])), np.ones(n_pieces + 1))


@pytest.mark.parametrize("n", [0, 1, 400])
def test_the_nearest_piece_is_that_of_a_dense_sampling(n):
    leaf = bent_leaf()
    points = np.random.default_rng(4).uniform(leaf.axis.min() - 3.0, leaf.axis.max() + 3.0, (n, 3))
    piece, along = leaf.nearest(points)
    share = np.linspace(0.0, 1.0, 2001)[:, np.newaxis]
    for p, j, s in zip(points, piece, along, strict=True):
        gaps = [np.linalg.norm(a + share * (b - a) - p, axis=1).min() for a, b in pairwise(leaf.axis)]
        there = leaf.axis[j] + s * leaf.frame[j, :, 0]
        assert np.linalg.norm(there - p) <= min(gaps) + SAME
        assert 0.0 <= s <= leaf.segment_lengths[j]


def test_of_pieces_as_near_as_each_other_the_first_counts():
    straight = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    piece, along = np.empty(1, np.intp), np.empty(1)
    nearest_pieces(
        np.array([[1.0, 5.0, 0.0]]), straight[:-1], np.tile([1.0, 0.0, 0.0], (2, 1)), np.ones(2), piece, along
    )
    assert piece[0] == 0
    assert along[0] == 1.0


@pytest.mark.parametrize(("n", "every"), [(1, 1), (2, 1), (150, 1), (150, 7)])
def test_sums_by_distance_are_those_of_all_pairs(n, every):
    random = np.random.default_rng(5)
    points, errors = random.uniform(-4.0, 4.0, (n, 3)), random.normal(1.0, 2.0, n)
    probed = np.arange(0, n, every)
    count, total = np.full(12, 9.0), np.full(12, 9.0)
    sum_by_distance(points, errors, probed, 0.5, count, total)
    gap = np.linalg.norm(points[probed, np.newaxis] - points, axis=-1)
    others = probed[:, np.newaxis] != np.arange(n)
    for k in range(12):
        those = others & (gap >= 0.5 * k) & (gap < 0.5 * (k + 1))
        assert count[k] == those.sum()
        assert total[k] == pytest.approx(np.sum((errors[probed, np.newaxis] * errors)[those]), rel=SAME, abs=SAME)


@pytest.mark.parametrize("axis", [np.array([0.6, 0.0, 0.8]), np.zeros(3)])
def test_what_is_near_a_line(axis):
    random = np.random.default_rng(6)
    points, center = 50.0 + random.normal(0.0, 2.0, (300, 3)), np.array([50.0, 51.0, 49.0])
    along = (points - center) @ axis
    gap = np.linalg.norm(points - center - along[:, np.newaxis] * axis, axis=1)
    found = near_line(points, center, axis, 2.0, 1.5)
    np.testing.assert_array_equal(found, np.flatnonzero((gap < 2.0) & (np.abs(along) < 1.5)))
    assert 0 < len(found) < 300
    assert len(near_line(points[:0], center, axis, 2.0, 1.5)) == 0
