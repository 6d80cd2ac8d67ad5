"""The leaf's width by its whole pieces: many holes neither widen nor narrow it, and nothing else changes."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import ndtr
from scipy.stats import ttest_1samp

import phytofit
from phytofit.engine import outcome
from phytofit.engine.covariance import grown
from phytofit.engine.posterior import Posterior
from phytofit.engine.refine import refinement
from phytofit.engine.visibility import N_STRIPS, Hidden
from phytofit.engine.whole_pieces import WIDTHS, of_whole_pieces
from phytofit.models import move

SPECIES = phytofit.load_species().leading(7)
LENGTH, WIDTH = 56.0, 6.4  # cm
NOISE_CM = 0.4
FRACTION = 1e-9
SAME_CM = 0.08  # the oracle knows the noise, and of no stem or outliers; the width's standard error is as large
CHANCE = 1e-4  # that a mean is as far from none
REMOVED = 0.35  # of the leaf's points
HELD = 0.85  # share of the intervals that hold the truth, at least: 95 % of 12, but for chance


def made(seed, share=0.0):
    """A phytomer without spheres of 6 cm around points of its leaf, until so large a share of these is gone."""
    true = phytofit.simulate(
        fixed={"leaf_length": LENGTH, "leaf_width": WIDTH, "stem_length_above": 8.0}, noise_cm=NOISE_CM, seed=seed
    )
    leaf, keep = true.labels == 2, np.ones(len(true.points), bool)
    random = np.random.default_rng(seed)
    tip = np.linalg.norm(true.points - true.organs[1].axis[-1], axis=1) < 6.0
    while keep[leaf].mean() > 1.0 - share:
        center = true.points[random.choice(np.flatnonzero(keep & leaf & ~tip))]
        keep &= np.linalg.norm(true.points - center, axis=1) > 3.0
    return true, true.points[keep]


def at_the_truth(true, points, rows):
    """The likelihood, with holes in these pieces (m,) of the leaf, and the true state."""
    share = np.zeros((len(rows), N_STRIPS))
    share[rows, 2:7] = 0.8
    likelihood = Posterior.of(SPECIES, points, hidden=Hidden(true.organs[1], share))
    return likelihood, likelihood.start(true.x[:7], true.pose, NOISE_CM)


def width_of(result):
    return next(t for t in result.traits if t.name == "leaf_width")


def test_a_leaf_without_holes_has_nothing_to_tell_anew():
    true, points = made(1)
    likelihood = Posterior.of(SPECIES, points)
    assert of_whole_pieces(likelihood, likelihood.start(true.x[:7], true.pose, NOISE_CM)) is None


def test_where_hardly_a_piece_is_whole_nothing_better_is_known():
    rows = np.arange(30) % 3 == 1
    assert of_whole_pieces(*at_the_truth(*made(1), rows)) is None


@pytest.mark.parametrize("seed", range(3))
def test_the_width_is_that_of_a_strip_with_the_points_of_the_whole_pieces(seed):
    """The oracle: the most probable width of a strip, by the points' places across it, one number sought for."""
    true, points = made(seed)
    rows = np.isin(np.arange(30), [8, 9, 10, 18])
    whole = of_whole_pieces(*at_the_truth(true, points[true.labels > 0], rows))
    start = whole.start(true.x[:7], true.pose, NOISE_CM)
    found = refinement(whole, start).theta[4]

    leaf = move([SPECIES.model.organs(true.x[:7])[1].row(0)], true.pose)[0]
    blade = points[true.labels == 2]
    piece, along = leaf.nearest(blade)
    kept = ~np.isin(piece, [7, 8, 9, 10, 11, 17, 18, 19]) & (piece > 2) & (piece < 27)  # off the stem and the tip
    blade, piece, along = blade[kept], piece[kept], along[kept]
    across = np.einsum("ni,ni->n", blade - leaf.axis[piece], leaf.frame[piece][:, :, 1])
    place = (piece + along / leaf.segment_lengths[piece]) / 30.0
    half = np.interp(place, np.linspace(0.0, 1.0, 31), leaf.half_width / true.x[4])  # for each cm of the leaf's width

    def error(width):
        inside = ndtr((half * width + across) / NOISE_CM) + ndtr((half * width - across) / NOISE_CM) - 1.0
        return -np.sum(np.log(inside / width))

    oracle = minimize_scalar(error, bounds=(4.0, 9.0), method="bounded", options={"xatol": 1e-4}).x
    assert found == pytest.approx(oracle, abs=SAME_CM)
    assert found == pytest.approx(WIDTH, abs=0.3)


def test_points_of_a_part_that_have_moved_are_still_all_seen():
    true, points = made(1)
    whole = of_whole_pieces(*at_the_truth(true, points, np.isin(np.arange(30), [8, 9, 10, 18])))
    state = whole.start(true.x[:7], true.pose, NOISE_CM)
    np.testing.assert_array_equal(whole.at(whole.points).evaluate(state).log_p, whole.evaluate(state).log_p)


@pytest.mark.parametrize("n_leaves", [3, pytest.param(12, marks=pytest.mark.long)])
def test_many_holes_do_not_widen_the_leaf(n_leaves):
    errors, held = [], []
    for seed in range(n_leaves):
        width = width_of(phytofit.fit(made(seed, REMOVED)[1], "cm"))
        errors.append(width.value - WIDTH)
        held.append(width.low <= WIDTH <= width.high)
    assert ttest_1samp(errors, 0.0).pvalue > CHANCE
    assert abs(np.median(errors)) < 0.15
    assert np.mean(held) >= HELD


def test_only_the_width_changes_and_its_interval_does_not_shrink(monkeypatch):
    _, points = made(2, REMOVED)
    told = phytofit.fit(points, "cm")
    monkeypatch.setattr(outcome, "of_whole_pieces", lambda *of: None)
    before = phytofit.fit(points, "cm")
    others = ~np.isin(told.species.space.names, WIDTHS)
    np.testing.assert_array_equal(told.x[others], before.x[others])
    np.testing.assert_array_equal(told.pose, before.pose)
    assert told.parameters["leaf_width"] != before.parameters["leaf_width"]
    assert np.linalg.eigvalsh(told.covariance - before.covariance).min() > -FRACTION


def test_the_same_bytes_with_any_number_of_threads():
    _, points = made(2, REMOVED)
    one, two = (phytofit.fit(points, "cm", threads=n) for n in (1, 2))
    assert one.x.tobytes() == two.x.tobytes()
    assert one.covariance.tobytes() == two.covariance.tobytes()


def test_a_covariance_grows_along_the_axes_along_which_the_other_exceeds_it():
    covariance = np.diag([4.0, 1.0, 9.0])
    those = np.array([True, True, False])
    np.testing.assert_allclose(grown(covariance, np.diag([1.0, 3.0, 99.0]), those), np.diag([4.0, 3.0, 9.0]))
    np.testing.assert_array_equal(grown(covariance, covariance, those), covariance)
