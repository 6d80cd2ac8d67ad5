"""Where a leaf ends: strips of known ends, holes before them, and what they do to the length and its interval."""

from dataclasses import replace

import numpy as np
import pytest

import phytofit
from phytofit.engine import leaf_end
from phytofit.engine.leaf_end import MISFIT, PointsEnd, combined, ending, points_end
from phytofit.engine.posterior import Posterior
from phytofit.engine.visibility import N_STRIPS, Hidden
from phytofit.models import Organ, move
from phytofit.models.organs import frames_along
from phytofit.results import reviewed
from phytofit.traits import measure

SPECIES = phytofit.load_species()
NOISE_CM = 0.3
FLAT = {"leaf_length": 60.0, "leaf_width": 6.0, "leaf_angle": 50.0, "leaf_rotate_angle": 0.0}


def scene(seed, *, end=0.85, power=1.0, gone=(1.0, 1.0), told=True, n_points=6000):
    """A straight leaf whose blade, from 0.6 of the fitted midrib on, narrows as a power of the way left to an `end`;
    without its points between two shares of the midrib, which the likelihood may be told.  Likelihood and state."""
    made = phytofit.simulate(fixed=FLAT, n_points=n_points, noise_cm=0.0, seed=seed)
    stem, leaf = made.organs
    piece, along = leaf.nearest(made.points)
    length = float(leaf.segment_lengths.sum())
    place = (leaf.segment_lengths[0] * piece + along) / length
    lateral = np.abs(np.einsum("ni,ni->n", made.points - leaf.axis[piece], leaf.frame[piece][:, :, 1]))
    half = np.interp(0.6, np.linspace(0.0, 1.0, len(leaf.half_width)), leaf.half_width)
    left = np.clip((end - place) / (end - 0.6), 0.0, 1.0)
    inside = (lateral <= half * left**power) & (place < end) & ((place < gone[0]) | (place > gone[1]))
    points = made.points[(made.labels == 1) | inside]
    points += np.random.default_rng(seed).normal(0.0, NOISE_CM, points.shape)
    middle = (np.arange(len(leaf.frame)) + 0.5) / len(leaf.frame)
    share = np.where((middle > gone[0]) & (middle < gone[1]), 1.0, 0.0)
    hidden = Hidden(leaf, np.repeat(share[:, np.newaxis], N_STRIPS, axis=1)) if told and share.any() else None
    likelihood = Posterior.of(SPECIES, points, hidden=hidden)
    state = likelihood.start(made.x, made.pose, NOISE_CM)
    theta = state.theta.copy()
    theta[-2:] = np.log(float(stem.area) / float(leaf.area)), -6.0
    return likelihood, state.at(theta), end * length


def end_of(likelihood, state):
    return points_end(likelihood, state, likelihood.evaluate(state))


@pytest.mark.parametrize("power", [0.2, 0.6, 1.0, 1.6])
def test_last_points_tell_where_a_leaf_ends(power):
    """Blunt, round, pointed or hollow, and far from where the model ends; errors as large as they are said to be."""
    off, error = [], []
    for seed in range(12):
        likelihood, state, true = scene(seed, power=power)
        told = end_of(likelihood, state)
        off.append(told.at - true)
        error.append(told.error)
    assert np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.median(error) < 1.6
    assert 0.4 < np.sqrt(np.mean((np.array(off) / error) ** 2)) < 1.4
    assert abs(np.mean(off)) < 0.5 * np.mean(error) + 0.1


@pytest.mark.parametrize("short", [0.99, 0.97, 0.95])
def test_a_model_that_is_too_short_has_no_part_in_it(short):
    """Points beyond its tip are none of its leaf's, but lie straight on."""
    off, error = [], []
    for seed in range(12):
        likelihood, state, true = scene(seed, end=0.95, power=0.6)
        theta = state.theta.copy()
        theta[3] *= 0.95 * short
        told = end_of(likelihood, state.at(theta))
        off.append(told.at - true)
        error.append(told.error)
    assert abs(np.mean(off)) < 0.6
    assert np.sqrt(np.mean((np.array(off) / error) ** 2)) < 1.8


def test_an_error_that_the_points_share_is_the_ends_too():
    likelihood, state, _ = scene(6, end=0.97)
    at, covariance = likelihood.evaluate(state), 1e-9 * np.eye(len(state.theta))
    covariance[3, 3] = 4.0
    own, shared = (ending(likelihood, state, at, covariance, cm) for cm in (0.0, 1.0))
    assert (covariance + shared.changed)[3, 3] > (covariance + own.changed)[3, 3] + 0.1


@pytest.mark.parametrize("end", [0.7, 0.95])
def test_the_model_has_no_part_in_it(end):
    likelihood, state, true = scene(3, end=end)
    told = end_of(likelihood, state)
    assert abs(told.at - true) < 3.0 * told.error
    theta = state.theta.copy()
    theta[4] *= 1.3  # its width
    theta[3] *= 1.05
    longer = end_of(likelihood, state.at(theta))
    assert longer.at == pytest.approx(told.at, abs=told.error)


def test_a_hole_before_the_end_is_no_end():
    """Half of the last points are gone; where that is known, the end is nearer, and more certain."""
    off, error = {True: [], False: []}, {True: [], False: []}
    for seed in range(10):
        for told in (True, False):
            likelihood, state, true = scene(seed, gone=(0.68, 0.76), told=told)
            end = end_of(likelihood, state)
            off[told].append(end.at - true)
            error[told].append(end.error)
    assert np.sqrt(np.mean(np.square(off[True]))) < np.sqrt(np.mean(np.square(off[False])))
    assert np.mean(error[True]) < np.mean(error[False])
    assert np.sqrt(np.mean((np.array(off[True]) / error[True]) ** 2)) < 1.4


def test_too_few_points_tell_nothing():
    likelihood, state, _ = scene(1, n_points=150)
    assert end_of(likelihood, state) is None
    covariance = 1e-9 * np.eye(len(state.theta))
    covariance[3, 3] = 0.01
    alone = ending(likelihood, state, likelihood.evaluate(state), covariance)
    assert alone.share == 1.0
    assert (covariance + alone.changed)[3, 3] == pytest.approx(0.01 + (MISFIT * state.x[3]) ** 2, rel=0.01)


def test_more_points_tell_more():
    few, many = (end_of(*scene(2, n_points=n)[:2]) for n in (2000, 20000))
    assert many.error < few.error


def test_two_ends_that_agree_are_weighted_by_their_precision():
    end, error = combined(50.0, 0.6, PointsEnd(50.5, 0.3))
    weights = np.array([0.6, 0.3]) ** -2.0
    assert end == pytest.approx(np.average([50.0, 50.5], weights=weights))
    assert error == pytest.approx(np.average([0.6, 0.3], weights=weights))


def test_where_they_disagree_the_points_are_right():
    """However sure of itself the model is; and the more so, the more they differ."""
    for apart, most in ((2.0, 0.13), (10.0, 0.026)):
        end, error = combined(60.0 + apart, 0.01, PointsEnd(60.0, 0.5))
        assert 0.0 < end - 60.0 < most
        assert 0.5 < error < 0.5 + 1.2 * most


def test_the_end_narrows_what_is_known_of_the_tip_and_nothing_else():
    likelihood, state, _ = scene(4, end=0.99, power=0.6)
    at = likelihood.evaluate(state)
    k = len(state.theta)
    covariance = np.diag(np.full(k, 1e-4))
    covariance[3, 3] = 4.0  # of the length: of a straight leaf, the tip's place
    found = ending(likelihood, state, at, covariance)
    told = end_of(likelihood, state)
    after = covariance + found.changed
    assert np.linalg.eigvalsh(after).min() > 0.0
    by_model = np.hypot(2.0, MISFIT * state.x[3])
    assert np.sqrt(after[3, 3]) == pytest.approx(combined(state.x[3], by_model, told)[1], rel=0.02)
    others = np.arange(k) != 3
    np.testing.assert_allclose(np.diag(after)[others], np.diag(covariance)[others], rtol=0.02)


def test_an_organ_goes_straight_on_beyond_its_end():
    axis = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    leaf = Organ("leaf", axis, frames_along(axis, np.array([0.0, 0.0, 1.0])), np.array([1.0, 0.5, 0.0]))
    longer = leaf.until(1.5)
    np.testing.assert_allclose(longer.axis[-1], [3.0, 7.5, 0.0])
    assert longer.segment_lengths.sum() == pytest.approx(1.5 * 7.0)
    assert longer.half_width[-1] == 0.0


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.long)])
def test_a_leaf_with_a_hollow_tip_has_its_own_length(seed):
    """What no taper of the model is like: a blade that is bent and twisted, and thin over its last quarter."""
    shape = {"leaf_bow": 25.0, "leaf_side_bend": 20.0, "leaf_twist": 40.0, "leaf_base_width": 0.5, "leaf_taper": 1.0}
    made = phytofit.simulate(fixed=FLAT | shape, n_points=8000, noise_cm=0.0, seed=seed)
    leaf = made.organs[1]
    piece, along = leaf.nearest(made.points)
    place = (piece + along / leaf.segment_lengths[0]) / len(leaf.frame)
    lateral = np.abs(np.einsum("ni,ni->n", made.points - leaf.axis[piece], leaf.frame[piece][:, :, 1]))
    half = np.interp(place, np.linspace(0.0, 1.0, len(leaf.half_width)), leaf.half_width)
    thin = np.clip((1.0 - place) / 0.25, 0.0, 1.0) ** 0.5
    points = made.points[(made.labels == 1) | (lateral <= half * thin)]
    points += np.random.default_rng(seed).normal(0.0, 0.2, points.shape)
    result = phytofit.fit(points, "cm", up=made.pose[:3, 2], threads=2)
    true = next(t.value for t in measure(made.organs) if t.name == "leaf_length")
    length = next(t for t in result.traits if t.name == "leaf_length")
    assert len(result.x) > 7
    assert length.low <= true <= (length.high or np.inf)
    assert abs(length.value - true) < 1.5
    organ = move([result.species.model.organs(result.x)[1].row(0)], result.pose)[0]
    assert result.organs[1].segment_lengths.sum() == pytest.approx(
        result.estimate.ends_at * organ.segment_lengths.sum()
    )


def test_only_a_leaf_that_is_clearly_too_long_is_called_cut_back():
    made = phytofit.simulate(n_points=1500, noise_cm=0.3, seed=3)
    result = phytofit.fit(made.points, "cm", threads=2)
    for too_long in (True, False):
        cut = replace(result, observed=(), estimate=replace(result.estimate, ends_at=0.9, too_long=too_long))
        assert any("on the last 10 % of the fitted leaf" in one.text for one in reviewed(cut).remarks) == too_long


def test_upside_down_the_leaf_ends_where_it_does():
    """Seen upside down, the leaf is the same, and as certain."""
    shape = {"leaf_side_bend": 30.0, "leaf_twist": 40.0, "leaf_base_width": 0.5, "leaf_taper": 1.0}
    made = phytofit.simulate(fixed=FLAT | shape, n_points=2500, noise_cm=0.3, seed=3)
    right, wrong = (phytofit.fit(made.points, "cm", up=sign * made.pose[:3, 2], threads=2) for sign in (1.0, -1.0))
    assert len(right.x) > 7
    assert np.abs(right.trait_covariance - right.covariance).max() > 0.0
    one, other = (next(t for t in it.traits if t.name == "leaf_length") for it in (right, wrong))
    assert (other.value, other.low, other.high) == pytest.approx((one.value, one.low, one.high), rel=1e-2)


def test_a_leaf_that_ends_bluntly_may_lack_its_tip():
    """What is left of a leaf of its own shape without its last fifth has no upper end, and a flag."""
    shape = {"leaf_side_bend": 30.0, "leaf_twist": 60.0, "leaf_bow": 20.0, "leaf_base_width": 0.5, "leaf_taper": 1.0}
    made = phytofit.simulate(fixed=FLAT | shape, n_points=5000, noise_cm=0.2, seed=7)
    piece, _ = made.organs[1].nearest(made.points)
    result = phytofit.fit(made.points[(made.labels == 1) | (piece < 24)], "cm", up=made.pose[:3, 2], threads=2)
    assert len(result.x) > 7
    assert not result.estimate.tip_seen
    assert next(t for t in result.traits if t.name == "leaf_length").high is None


def test_bands_in_which_no_points_are_expected_say_nothing_of_unevenness():
    """All that is expected lies in one step, and half of the points with it: seven bands of eight have no width."""
    steps = leaf_end._Steps(np.arange(60) + 0.5, 1.0, np.ones(60))
    expected = np.zeros(60)
    expected[5] = 1.0
    with np.errstate(all="raise"):
        assert leaf_end._unevenness(np.full(100, 5.5), expected, steps) == 1.0
        uneven = leaf_end._unevenness(np.repeat([5.5, 30.5], 50), expected + 1e-3, steps)
    assert 1.0 <= uneven < np.inf


def test_a_strip_that_ends_before_all_points_is_improbable_not_undefined():
    """As of points on a lattice, of which those near the end are all beyond the strip that is tried."""
    middles = 0.5 * (np.arange(20.0) + 0.5)
    steps = leaf_end._Steps(middles, 0.5, np.ones(20))
    fits = leaf_end._of_strips(np.array([0.4, 4.0]), np.array([2.9, 3.0, 3.1]), np.array([-1.0, 0.0, 1.0]), steps)
    assert np.isfinite(fits).all()
    assert fits[0].max() < fits[1].max()
