"""Holes in a leaf: where they are found, and that they neither widen nor narrow what is left."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp

import phytofit
from own_leaves import OWN_LEAVES
from phytofit.engine.holes import find_holes
from phytofit.engine.posterior import Posterior
from phytofit.engine.visibility import CELLS, Hidden
from phytofit.models import LEAF, Organ
from phytofit.models.organs import frames_along

SPECIES = phytofit.load_species().leading(7)
LENGTH, WIDTH = 56.0, 6.4  # cm
NOISE_CM = 0.3
FRACTION = 1e-9
EDGE = 0.6  # most of a cell's points; the holes' edges are blurred by noise and smoothing
CHANCE = 1e-4  # that a mean is as far from none


def flat(m=6, length=3.0, half=2.25):
    """A level strip along y, as broad as it is long but for a half; its cells are 0.5 cm wide."""
    axis = np.array([[0.0, length * i, 1.0] for i in range(m + 1)])
    return Organ(LEAF, axis, frames_along(axis, np.array([1.0, 0.0, 0.0])), np.full(m + 1, half))


def made(seed, hole=None, n_points=5000):
    """A phytomer without the points at a share of the midrib and of the half width, as (from, to, right, left) says."""
    true = phytofit.simulate(
        fixed={"leaf_length": LENGTH, "leaf_width": WIDTH, "stem_length_above": 8.0},
        n_points=n_points,
        noise_cm=NOISE_CM,
        seed=seed,
    )
    leaf = true.organs[1]
    piece, along = leaf.nearest(true.points)
    place = (piece + along / leaf.segment_lengths[piece]) / len(leaf.frame)
    across = np.einsum("ni,ni->n", true.points - leaf.axis[piece], leaf.frame[piece][:, :, 1])
    across /= np.maximum(np.interp(place * len(leaf.frame), np.arange(len(leaf.half_width)), leaf.half_width), 1e-9)
    keep = np.ones(len(true.points), bool)
    if hole is not None:
        start, end, right, left = hole
        inside = (place > start) & (place < end) & (across > right) & (across < left)
        keep = ~(inside & (true.labels == 2))
    return true, true.points[keep]


def found_in(true, points):
    likelihood = Posterior.of(SPECIES, points)
    state = likelihood.start(true.x[:7], true.pose, NOISE_CM)
    state.theta[-2] = np.log(0.4)
    return find_holes(likelihood, state, likelihood.evaluate(state))


def test_a_share_that_rises_evenly_is_given_back_in_between_and_stays_beyond_the_ends():
    leaf = flat()
    share = np.linspace(0.0, 0.5, 6)[:, np.newaxis] + np.linspace(0.0, 0.4, 9)
    hidden = Hidden(leaf, share)
    center = CELLS.places(leaf, leaf.segment_lengths, leaf.half_width)[np.newaxis]
    moved = center + 1.1 * leaf.frame[0, :, 0] - 0.2 * leaf.frame[0, :, 1]
    inside = (slice(1, -2), slice(2, -2))
    expected = (share + 0.1 * 1.1 / 3.0 - 0.05 * 0.4)[inside]
    np.testing.assert_allclose(hidden.around_cells(moved)[0][inside], expected, atol=FRACTION)
    np.testing.assert_allclose(hidden.at(moved[0][inside].reshape(-1, 3)), expected.ravel(), atol=FRACTION)
    far = hidden.around_cells(center + 50.0 * leaf.frame[0, :, 1])[0]
    np.testing.assert_allclose(far[1:-1], np.repeat(share[1:-1, -1:], 9, axis=1), atol=FRACTION)


def test_the_cells_lie_on_the_leaf_from_right_to_left():
    leaf = flat()
    center = CELLS.places(leaf, leaf.segment_lengths, leaf.half_width)
    assert np.ptp(center[:, :, 2]) == 0.0
    np.testing.assert_allclose(center[0, :, 1], 1.5)
    np.testing.assert_allclose((center[0] - leaf.axis[0]) @ leaf.frame[0, :, 1], np.arange(9) * 0.5 - 2.0)


@pytest.mark.parametrize("n_points", [500, 5000])
@pytest.mark.parametrize("seed", range(6))
def test_a_leaf_that_was_seen_whole_has_no_holes(seed, n_points):
    assert found_in(*made(seed, n_points=n_points)) is None


@pytest.mark.parametrize("hole", [(0.4, 0.6, -2.0, 2.0), (0.4, 0.6, -0.5, 0.5), (0.3, 0.55, 0.3, 2.0)])
def test_a_hole_is_found_where_it_is(hole):
    true, points = made(3, hole)
    share = found_in(true, points).share
    start, end, right, left = hole
    place = (np.arange(30)[:, np.newaxis] + 0.5) / 30.0
    across = (2.0 * np.arange(9) + 1.0) / 9.0 - 1.0
    deep = (place > start + 0.04) & (place < end - 0.04) & (across > right + 0.25) & (across < left - 0.25)
    apart = (place < start - 0.1) | (place > end + 0.1) | (across < right - 0.5) | (across > left + 0.5)
    assert deep.any()
    assert share[deep].min() > EDGE
    assert share[apart].max() == 0.0


@pytest.mark.parametrize("n_leaves", [5, pytest.param(24, marks=pytest.mark.long)])
@pytest.mark.parametrize("hole", [(0.25, 0.6, -0.55, 0.55), (0.3, 0.6, 0.2, 2.0)])
def test_a_hole_does_not_change_the_leaf(hole, n_leaves):
    """In the middle it would widen the leaf, at the edge narrow it; the intervals know of neither."""
    errors, held = [], []
    for seed in range(n_leaves):
        width = next(t for t in phytofit.fit(made(seed, hole)[1], "cm").traits if t.name == "leaf_width")
        errors.append(width.value - WIDTH)
        held.append(width.low <= WIDTH <= width.high)
    assert ttest_1samp(errors, 0.0).pvalue > CHANCE
    assert np.abs(errors).max() < 0.2
    assert np.mean(held) >= 0.8


@pytest.mark.parametrize(
    ("width", "share", "hole"),
    [
        (1.4, 1.0, (0.4, 0.6)),
        pytest.param(1.4, 0.5, (0.3, 0.7), marks=pytest.mark.long),
        pytest.param(2.0, 0.5, (0.3, 0.7), marks=pytest.mark.long),
    ],
)
def test_a_leaf_hardly_wider_than_its_noise_does_not_vanish_for_a_hole(width, share, hole):
    """Its strips can't be told apart: points that noise carried sideways lie on the outer ones."""
    widths = []
    for seed in range(4):
        fixed = {"leaf_length": LENGTH, "leaf_width": width, "stem_length_above": 8.0}
        true = phytofit.simulate(fixed=fixed, n_points=6000, noise_cm=0.6, seed=seed)
        leaf = true.organs[1]
        piece, along = leaf.nearest(true.points)
        place = (piece + along / leaf.segment_lengths[piece]) / len(leaf.frame)
        gone = (place > hole[0]) & (place < hole[1]) & (true.labels == 2)
        gone &= np.random.default_rng(seed).random(len(gone)) < share
        fitted = phytofit.fit(true.points[~gone], "cm")
        widths.append(next(t.value for t in fitted.traits if t.name == "leaf_width"))
    assert min(widths) > 0.7 * width


def test_holes_that_end_elsewhere_leave_more_or_less():
    hidden = found_in(*made(3, (0.4, 0.6, -0.5, 0.5)))
    assert np.all(hidden.smaller().share <= hidden.share)
    assert np.all(hidden.larger().share >= hidden.share)
    assert (hidden.smaller().share > EDGE).sum() < (hidden.share > EDGE).sum() < (hidden.larger().share > EDGE).sum()


def test_intervals_know_that_a_hole_may_end_elsewhere(monkeypatch):
    _, points = made(3, (0.25, 0.6, -0.55, 0.55))

    def spread():
        width = next(t for t in phytofit.fit(points, "cm", species=OWN_LEAVES).traits if t.name == "leaf_width")
        return width.high - width.low

    known = spread()
    monkeypatch.setattr("phytofit.engine.covariance._by_holes", lambda *of: np.zeros_like(of[-1]))
    assert known > 1.05 * spread()
