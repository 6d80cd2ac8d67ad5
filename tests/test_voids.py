"""The space around a leaf's base of which nothing was seen, and that it takes neither angle nor diameter along."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import phytofit
from own_leaves import OWN_LEAVES
from phytofit.engine.holes import find_holes
from phytofit.engine.posterior import Posterior
from phytofit.engine.visibility import Hidden
from phytofit.engine.voids import Void, around_stem
from phytofit.models import Phytomer

SPECIES = phytofit.load_species().leading(7)
NOISE_CM = 0.4
BALL_CM = 3.0
TRAITS = ("leaf_length", "leaf_angle", "stem_diameter")


def made(seed):
    return phytofit.simulate(fixed={"stem_length_above": 9.0}, noise_cm=NOISE_CM, seed=seed)


def without_ball(true, center):
    return true.points[np.linalg.norm(true.points - center, axis=1) > BALL_CM]


def around_base(true, seed):
    """Near the leaf's base, off it by about a centimetre."""
    return true.organs[1].axis[0] + np.random.default_rng(seed).normal(0.0, 0.6, 3)


def void_in(true, points):
    likelihood = Posterior.of(SPECIES, points)
    state = likelihood.start(true.x[:7], true.pose, NOISE_CM)
    state.theta[-2] = np.log(0.4)
    hidden = find_holes(likelihood, state, likelihood.evaluate(state), with_void=True)
    return None if hidden is None else hidden.void


@pytest.mark.parametrize("seed", range(8))
def test_the_ball_that_was_taken_is_found(seed):
    true = made(seed)
    center = around_base(true, seed)
    void = void_in(true, without_ball(true, center))
    assert void is not None
    assert np.linalg.norm(void.center - center) < 1.0
    assert 0.75 * BALL_CM < void.radius < 1.1 * BALL_CM


@pytest.mark.parametrize("seed", range(8))
def test_nothing_is_missing_of_what_was_seen_whole(seed):
    true = made(seed)
    assert void_in(true, true.points) is None


@pytest.mark.parametrize("seed", range(4))
def test_the_back_of_a_stem_that_was_seen_from_one_side_is_no_void(seed):
    true = made(seed)
    upright = (true.points - true.pose[:3, 3]) @ true.pose[:3, :3]
    behind = (true.labels == 1) & (upright @ np.array([0.6, 0.8, 0.0]) > 0.0)
    assert void_in(true, true.points[~behind]) is None


@pytest.mark.parametrize("seed", range(4))
def test_the_same_ball_is_found_however_the_cloud_lies(seed):
    true = made(seed)
    points = without_ball(true, around_base(true, seed))
    turn = Rotation.random(random_state=seed).as_matrix()
    there = replace(true, pose=np.vstack([turn @ true.pose[:3], true.pose[3:]]))
    void, turned = void_in(true, points), void_in(there, points @ turn.T)
    np.testing.assert_allclose(turned.center, turn @ void.center, atol=1e-6)
    assert turned.radius == pytest.approx(void.radius, abs=1e-6)
    assert np.count_nonzero(np.linalg.norm(points - void.center, axis=1) < 0.999 * void.radius) <= 2


@pytest.mark.parametrize("seed", range(4))
def test_a_hole_in_the_leaf_is_not_one_around_its_base(seed):
    true = made(seed)
    assert void_in(true, without_ball(true, true.organs[1].axis[15])) is None


def test_the_edge_is_half_seen_and_blurred():
    void = Void(np.array([1.0, 2.0, 3.0]), 2.0, 0.5)
    outward = np.array([0.0, 0.6, 0.8])
    places = void.center + np.array([0.0, 1.5, 2.0, 2.5])[:, np.newaxis] * outward
    np.testing.assert_allclose(
        void.at(places), 0.98 * np.array([0.99997, 0.84134, 0.5, 0.15866]), atol=1e-5
    )  # normal quantiles
    assert void.smaller().at(places[2]) < 0.2
    assert void.larger().at(places[2]) > 0.8


@pytest.mark.parametrize("x", [[3.0, 10.0, 40.0, 50.0, 6.0, 3.0, 8.0], [2.0, 12.0, 40.0, 50.0, 6.0, 3.0, 4.0]])
def test_places_around_a_stem_share_its_area(x):
    stem = Phytomer().organs(x)[0].row(0)
    _, places, area = around_stem(stem)
    np.testing.assert_allclose(area.sum(), np.pi * x[0] * (x[1] + x[6]), rtol=1e-9)
    np.testing.assert_allclose(np.hypot(places[..., 0], places[..., 1]), 0.5 * x[0], rtol=1e-9)
    assert np.all((places[..., 2] > 0.0) & (places[..., 2] < x[1] + x[6]))


def test_what_is_left_is_denser_by_what_the_void_takes_of_each_organ():
    """The oracle counts points of a large sample that the ball holds."""
    true = made(1)
    x, center = true.x[:7], true.organs[1].axis[0] + 0.5
    void = Void(center, 2.5, 0.05)
    points = true.points[np.linalg.norm(true.points - center, axis=1) > 3.0][::20]
    sample = phytofit.simulate(
        fixed=dict(zip(SPECIES.space.names, x.tolist(), strict=True)), n_points=200_000, noise_cm=0.0, seed=1
    )
    upright = (sample.points - sample.pose[:3, 3]) @ sample.pose[:3, :3]
    inside = np.linalg.norm(upright @ true.pose[:3, :3].T + true.pose[:3, 3] - center, axis=1) < void.radius
    leaf = true.organs[1]
    for organ in (0, 1):
        taken = inside[sample.labels == organ + 1].mean()
        assert taken > 0.01
        density = []
        for hidden in (None, Hidden(leaf, np.zeros((30, 9)), void)):
            labels = np.full(len(points), organ, np.int8)
            likelihood = Posterior.of(SPECIES, points, organ=labels, hidden=hidden)
            state = likelihood.start(x, true.pose, NOISE_CM)
            at = likelihood.evaluate(state, derivatives=False)
            density.append(np.exp(at.log_p) - likelihood.outlier_density * state.share[2])
        near = density[0] > 0.01 * density[0].max()
        np.testing.assert_allclose((density[1] / density[0])[near], 1.0 / (1.0 - 0.98 * taken), rtol=0.01)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 6))])
def test_a_hidden_base_is_flagged_and_the_intervals_hold(seed):
    """A leaf and a stem that were given a shape of their own to avoid the empty ball would be off by degrees."""
    true = made(10 + seed)
    result = phytofit.fit(without_ball(true, around_base(true, seed)), "cm", species=OWN_LEAVES, seed=seed)
    measured = {t.name: t for t in phytofit.measure(true.organs)}
    assert "base_hidden" in result.flags
    assert len(result.x) == 7
    for trait in result.traits:
        if trait.name in TRAITS:
            half = trait.value - trait.low  # the other may be open, by a tip that is in doubt
            assert abs(measured[trait.name].value - trait.value) < 1.5 * half  # three standard errors
            assert half < {"leaf_length": 1.2, "leaf_angle": 1.5, "stem_diameter": 0.2}[trait.name]


@pytest.mark.parametrize("seed", [2, pytest.param(4, marks=pytest.mark.long)])
def test_where_a_leaf_of_its_own_shape_starts_is_not_read_off_errors_that_its_points_share(seed):
    """Counted one by one, the points would put the start outside the stem (at its bound), and be sure of it."""
    true = phytofit.simulate(
        fixed={
            "stem_length_above": 9.0,
            "collar_offset": 0.9,
            "leaf_base_bend": 30.0,
            "leaf_bow": 25.0,
            "leaf_side_bend": 25.0,
            "leaf_base_width": 0.6,
        },
        noise_cm=0.3,
        noise_reach_cm=1.5,
        seed=seed,
    )
    result = phytofit.fit(without_ball(true, around_base(true, seed)), "cm", seed=seed)
    assert "base_hidden" in result.flags
    assert result.parameters["collar_offset"] < 1.0
    low, high = result.parameter_intervals["collar_offset"]
    assert low < 0.9 < high
    found = next(t for t in result.traits if t.name == "leaf_length")
    length = next(t.value for t in phytofit.measure(true.organs) if t.name == "leaf_length")
    assert found.low < length < (np.inf if found.high is None else found.high)
    assert abs(found.value - length) < 2.0
