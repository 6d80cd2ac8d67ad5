"""How a leaf ends: in a point, bluntly, or before its model does; and what that does to its length."""

from dataclasses import replace

import numpy as np
import pytest

import phytofit
from phytofit.engine.posterior import Posterior
from phytofit.engine.sighting import sighting
from phytofit.engine.tip import gain_of_blunt_end

SPECIES = phytofit.load_species()
TAPERS_EVENLY = {"leaf_taper": 0.3, "leaf_length": 50.0, "leaf_width": 6.0, "leaf_angle": 50.0}
CLEAR, DOUBTFUL = 5.0, 2.5  # nats


def scene(seed, *, until=1.0, longer=1.0, noise_cm=0.3, **shape):
    """A phytomer whose leaf narrows evenly, seen up to a share of its midrib; the likelihood, and the true state, but
    that the leaf may be longer."""
    made = phytofit.simulate(fixed=TAPERS_EVENLY | shape, n_points=4000, noise_cm=noise_cm, seed=seed)
    leaf = made.organs[1]
    piece, _ = leaf.nearest(made.points)
    points = made.points[(made.labels == 1) | (piece < until * len(leaf.segment_lengths))]
    likelihood = Posterior.of(SPECIES, points)
    x = made.x.copy()
    x[[3, 5]] *= longer  # the bend is a thirtieth of the leaf's
    state = likelihood.start(x, made.pose, noise_cm)
    theta = state.theta.copy()
    theta[-2:] = np.log(float(made.organs[0].area) / float(leaf.area)), -6.0
    return likelihood, state.at(theta)


def gain(likelihood, state):
    return gain_of_blunt_end(likelihood, state, likelihood.evaluate(state))


def test_a_leaf_that_ends_in_a_point_does_not_end_bluntly():
    gains = [gain(*scene(seed)) for seed in range(8)]
    assert np.median(gains) < DOUBTFUL
    assert max(gains) < 2.0 * CLEAR  # half a chi-squared number each: 5 is exceeded once in 1,300


@pytest.mark.parametrize("until", [0.9, 0.8])
def test_a_leaf_without_its_tip_ends_bluntly(until):
    assert min(gain(*scene(seed, until=until)) for seed in range(4)) > CLEAR


def test_the_end_alone_decides():
    """Half of the leaf's first two thirds is missing, which tells nothing of its tip."""
    likelihood, state = scene(1)
    base = likelihood.model.organs(state.x)[1].row(0)
    points = (likelihood.points - state.pose[:3, 3]) @ state.pose[:3, :3]
    piece, _ = base.nearest(points)
    side = np.einsum("ni,ni->n", points - base.axis[piece], base.frame[piece][:, :, 1])
    left = likelihood.at(likelihood.points[(piece > 20) | (side > 0.0) | (np.hypot(points[:, 0], points[:, 1]) < 3.0)])
    left.organ, left.seen = left.organ[: len(left.points)], left.seen[: len(left.points)]
    assert gain(left, state) == pytest.approx(gain(likelihood, state), abs=0.5)


def test_where_few_points_are_at_the_end_they_decide_nothing():
    likelihood, state = scene(1, until=0.7)
    assert gain(likelihood, state) == np.inf


@pytest.mark.parametrize("seed", [1, 2])
def test_a_missing_tip_is_noticed_by_few_points(seed):
    """120 points without the last 30 % of the midrib, which no few of them can show to end bluntly."""
    made = phytofit.simulate(n_points=130, noise_cm=0.3, seed=seed)
    piece, _ = made.organs[1].nearest(made.points)
    result = phytofit.fit(made.points[(made.labels == 1) | (piece < 21)], "cm", threads=2)
    assert not result.estimate.tip_seen
    length = trait(result, "leaf_length")
    assert length.high is None
    assert length.low < next(t.value for t in phytofit.measure(made.organs) if t.name == "leaf_length")


def test_points_that_would_be_expected_beyond_the_last():
    """As many as the area there has, of all that are the leaf's."""
    likelihood, state = scene(2, longer=1.2, noise_cm=0.1, leaf_rotate_angle=0.0)
    seen = sighting(likelihood, state, likelihood.evaluate(state))
    leaf = likelihood.model.organs(state.x)[1].row(0)
    area = leaf.segment_lengths * (leaf.half_width[1:] + leaf.half_width[:-1])
    beyond = float(area[25:].sum() / area.sum())  # the last of thirty pieces, from 1 / 1.2 on
    n = np.count_nonzero(1.0 - likelihood.evaluate(state).responsibilities[:, 0] > 0.5)
    assert seen.end == pytest.approx(1.0 / 1.2, abs=0.02)
    assert seen.short == pytest.approx(n * beyond, rel=0.25)  # the last point lies a little before the end


def test_no_more_points_are_expected_beyond_the_end_of_a_whole_leaf():
    likelihood, state = scene(2, noise_cm=0.1)
    seen = sighting(likelihood, state, likelihood.evaluate(state))
    assert seen.end > 0.97
    assert seen.short < CLEAR


@pytest.fixture(scope="module")
def result():
    made = phytofit.simulate(n_points=2500, noise_cm=0.3, seed=3)
    return phytofit.fit(made.points, "cm", threads=2)


def trait(result, name):
    return next(t for t in result.traits if t.name == name)


def with_estimate(result, **changes):
    sighting = replace(result.estimate.sighting, end=changes.pop("end", 1.0))
    return replace(result, estimate=replace(result.estimate, sighting=sighting, **changes))


def test_a_leaf_that_is_longer_than_its_points_is_cut_back(result):
    """Length and area are those of what is left; where it lies, and its other traits, stay."""
    whole = result.organs[1]
    cut = with_estimate(result, ends_at=0.8)
    organ = cut.organs[1]
    assert organ.segment_lengths.sum() == pytest.approx(0.8 * whole.segment_lengths.sum())
    gone = 0.2 * whole.segment_lengths.sum()
    assert trait(result, "leaf_length").value - trait(cut, "leaf_length").value == pytest.approx(gone)
    assert trait(cut, "leaf_area").value < trait(result, "leaf_area").value
    for name in ("leaf_width", "leaf_angle", "stem_diameter"):
        assert trait(cut, name).value == pytest.approx(trait(result, name).value)


def test_of_a_blunt_leaf_the_lower_end_is_at_the_last_point(result):
    blunt = with_estimate(result, blunt=True, end=0.9)
    whole = float(result.organs[1].segment_lengths.sum())
    before, after = trait(result, "leaf_length"), trait(blunt, "leaf_length")
    assert before.low - after.low == pytest.approx(0.1 * whole)
    assert after.value == before.value


def test_a_blunt_leaf_with_a_rich_shape_is_flagged_and_open_above():
    """Sideways bent, twisted, a plateau of width that ends early, as a broken leaf: no taper to go on with."""
    shape = {"leaf_side_bend": 30.0, "leaf_twist": 60.0, "leaf_bow": 20.0, "leaf_base_width": 0.5, "leaf_taper": 4.0}
    made = phytofit.simulate(
        fixed=shape | {"leaf_length": 60.0, "leaf_angle": 50.0}, n_points=5000, noise_cm=0.2, seed=7
    )
    piece, _ = made.organs[1].nearest(made.points)
    points = made.points[(made.labels == 1) | (piece < 24)]
    result = phytofit.fit(points, "cm", up=made.pose[:3, 2], threads=2)
    assert len(result.x) > 7
    length = trait(result, "leaf_length")
    true = next(t.value for t in phytofit.measure(made.organs) if t.name == "leaf_length")
    seen = true - 0.2 * float(made.organs[1].segment_lengths.sum())
    assert length.high is None
    assert length.low <= seen + 1.0
    assert seen - 1.0 < length.value < true + 1.0
    assert {"tip_blunt", "tip_cut_back"} & set(result.flags)
