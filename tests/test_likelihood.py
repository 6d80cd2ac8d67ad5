"""The likelihood of a cloud: its density against integrals over the surface, its derivatives against differences."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from phytofit.engine import mixture as module
from phytofit.engine.layout import State
from phytofit.engine.mixture import Mixture, Side, Strip, Tube
from phytofit.engine.posterior import Posterior
from phytofit.engine.visibility import Hidden
from phytofit.engine.voids import Void
from phytofit.models import LEAF, STEM, Organ, Phytomer, SurfaceSampler, move
from phytofit.models.organs import frames_along
from phytofit.parameters import Parameter, ParameterSpace
from phytofit.species import load_species

EXACT = 1e-9  # relative; sums in float64
BESSEL = 1e-6  # relative; the tube's Bessel function is a polynomial, good to a few 1e-7
REACH = 1e-6  # of the greatest density: what lies beyond 5.5 noise levels is cut off, e^-15 = 3e-7
TAPER = 0.04  # of the greatest density: the blade's width is taken at one place of a patch, not integrated along it
WHOLE = 1e-6  # of an integral over space: the cut at 5.5 noise levels
SLOPE = 3e-4  # of the largest score of a parameter: rounding and curvature of the differences, and those of the organs
SUMMED = 5e-3  # of the same, for the sum over all points: the tube's Bessel ratio errs alike in all of them
STEP = 1e-6  # of a prior's spread, or radians, cm or nats: few pieces come into reach over it, with a small jump
CLEAR = 10.0  # nats; an error so much larger is no accident

SORGHUM = load_species()
FOLD = Parameter("leaf_fold", "deg", 0.0, 15.0, -70.0, 70.0)  # which no species has that comes with phytofit
SPECIES = replace(
    SORGHUM,
    space=ParameterSpace([*SORGHUM.space.parameters, FOLD]),
    ranges=np.vstack([SORGHUM.ranges, [0.0, 0.0]]),
)
N = len(SPECIES.space)
NEUTRAL = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 2.0, 1.0, 0.0, 1.0, 0.0, 0.0]
X = np.array([3.2, 14.0, 42.0, 54.0, 6.5, 3.4, 5.0, *NEUTRAL])
SHAPED = np.array(
    [
        3.2,
        14.0,
        42.0,
        54.0,
        6.5,
        3.4,
        5.0,
        0.8,
        9.0,
        -5.0,
        25.0,
        7.0,
        10.0,
        60.0,
        0.6,
        0.42,
        1.6,
        0.8,
        8.0,
        1.7,
        0.03,
        14.0,
    ]
)
LOW = np.array(
    [
        1.0,
        5.0,
        20.0,
        20.0,
        3.0,
        -5.0,
        1.0,
        0.0,
        -20.0,
        -10.0,
        -40.0,
        -15.0,
        -30.0,
        -90.0,
        0.4,
        0.21,
        1.0,
        0.7,
        -15.0,
        1.1,
        -0.03,
        -30.0,
    ]
)
HIGH = np.array(
    [
        5.0,
        25.0,
        120.0,
        70.0,
        9.0,
        5.0,
        20.0,
        1.4,
        20.0,
        10.0,
        40.0,
        15.0,
        30.0,
        90.0,
        1.2,
        0.72,
        4.0,
        1.3,
        20.0,
        3.0,
        0.02,
        40.0,
    ]
)

PHYTOMERS = arrays(np.float64, (N,), elements=st.floats(0, 1), fill=st.nothing()).map(lambda u: LOW + u * (HIGH - LOW))
SEEDS = st.integers(0, 2**32 - 1)


def tube(length, radius):
    axis = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, length]])
    return Organ(STEM, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), np.array([radius, radius]))


def strip(nodes, half_width):
    axis = np.asarray(nodes, float)
    return Organ(LEAF, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), np.asarray(half_width, float))


def grow(x):
    return [organ.row(0) for organ in Phytomer().organs(x)]


def rigid(random, reach_cm=30.0):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=random).as_matrix()
    pose[:3, 3] = random.uniform(-reach_cm, reach_cm, 3)
    return pose


def density(points, organs, noise, *, share=(0.3, 0.6, 0.1), outlier_density=0.0, organ=-1, facing=(0.0, 0.0)):
    """The kernel's density, without derivatives."""
    stem, leaf = organs
    none = np.zeros(0, int)
    radius = 0.5 * (stem.half_width[1:] + stem.half_width[:-1])
    around = 2.0 * np.pi * stem.segment_lengths @ radius
    facing = np.array(facing, float)
    unchanged = np.zeros((len(stem.frame), 9, 0)), np.zeros(0), np.zeros(2)
    segments = stem.axis[:-1], stem.frame, stem.segment_lengths, radius
    tube = Tube(none, *segments, float(around), facing, noise[0], *unchanged)
    area = leaf.segment_lengths @ (leaf.half_width[1:] + leaf.half_width[:-1])
    none_changed = np.zeros((len(leaf.frame), 9, 0))
    sides = (Side(leaf.frame, 1.0, 1.0, none_changed),)
    if leaf.fold:
        sides = tuple(Side(half_frame(leaf, s), 0.5 + 0.5 * s, 0.5 - 0.5 * s, none_changed) for s in (1, -1))
    strip = Strip(
        none,
        leaf.axis[:-1],
        leaf.segment_lengths,
        leaf.half_width,
        sides,
        area,
        np.array(noise[1:], float),
        np.zeros(0),
    )
    mixture = Mixture((tube, strip), np.array(share, float), np.full(3, -1), np.full(len(points), outlier_density))
    weights = [np.full(len(points), float(organ != other)) for other in (1, 0)]
    with np.errstate(divide="ignore", invalid="ignore"):  # where there is nothing, not even an outlier
        return np.exp(mixture.evaluate(np.array(points, float), weights, 0, derivatives=False).log_p)


def half_frame(leaf, side):
    """Frames (m, 3, 3) of the half of a leaf to one side of its fold: turned about the midrib, up on either side."""
    turned = Rotation.from_euler("x", side * leaf.fold, degrees=True).as_matrix()
    return leaf.frame @ turned


def gauss(low, high, noise):
    """Nodes and weights of an integral of normal densities of that noise."""
    n = 12 + int(np.ceil((high - low) / (0.6 * noise)))
    node, weight = np.polynomial.legendre.leggauss(n)
    return low + 0.5 * (high - low) * (node + 1.0), 0.5 * (high - low) * weight


def blurred(points, nodes, weights, frame, std):
    """Sum of normal densities about the nodes, of std (3,) along the frame's columns."""
    out = np.zeros(len(points))
    for i, offset in enumerate((points[:, np.newaxis] - nodes) @ frame):
        out[i] = np.exp(-0.5 * np.sum((offset / std) ** 2, axis=1)) @ weights
    return out / ((2.0 * np.pi) ** 1.5 * np.prod(std))


def over_leaf(points, leaf, noise, thickness=0.0):
    """Density of noisy points of a leaf, by quadrature over all its patches."""
    across = np.hypot(noise, thickness)
    total, area = np.zeros(len(points)), 0.0
    for j, side in product(range(len(leaf.frame)), (1, -1)):
        frame = half_frame(leaf, side)[j]
        s, along = gauss(0.0, leaf.segment_lengths[j], noise)
        start, end = leaf.half_width[j], leaf.half_width[j + 1]
        t, sideways = gauss(0.0, 1.0, noise / max(start, end))
        t = side * t
        half = start + (end - start) * s / leaf.segment_lengths[j]
        weights = np.outer(along * half, sideways).ravel()
        local = np.stack([np.repeat(s, len(t)), np.outer(half, t).ravel(), np.zeros(len(weights))], axis=1)
        total += blurred(points, leaf.axis[j] + local @ frame.T, weights, frame, np.array([noise, noise, across]))
        area += weights.sum()
    return total / area


def over_stem(points, stem, noise, facing=(0.0, 0.0)):
    """Density of noisy points of a stem, by quadrature along and around it, where their angle has a von Mises density;
    each segment has its mean radius."""
    total, area = np.zeros(len(points)), 0.0
    for j, frame in enumerate(stem.frame):
        s, along = gauss(0.0, stem.segment_lengths[j], noise)
        radius = 0.5 * (stem.half_width[j] + stem.half_width[j + 1])
        n = 24 + int(np.ceil(2.0 * np.pi * radius / (0.5 * noise)))
        angle = 2.0 * np.pi * (np.arange(n) + 0.5) / n
        ring = radius * np.stack([np.zeros(n), np.cos(angle), np.sin(angle)], axis=1)
        local = s[:, np.newaxis, np.newaxis] * [1.0, 0.0, 0.0] + ring
        around = np.exp(np.cos(angle) * facing[0] + np.sin(angle) * facing[1])
        weights = np.outer(along, around / around.sum()).ravel() * radius
        total += blurred(points, stem.axis[j] + local.reshape(-1, 3) @ frame.T, weights, frame, np.full(3, noise))
        area += weights.sum()
    return total / area


# density


@pytest.mark.parametrize("thickness", [0.0, 0.7])
@pytest.mark.parametrize("noise", [0.1, 0.5, 4.0])
def test_a_rectangular_patch_is_integrated_exactly(noise, thickness):
    """On it, at its edges and corners, beside it and above; noise far below its size and above it."""
    leaf = strip([[1, 2, 3], [1, 2, 5]], [1.5, 1.5])
    across = np.hypot(noise, thickness)
    u, v, w = np.meshgrid([-noise, 0, 1, 2, 2 + 2 * noise], [-1.5 - noise, 0.4, 1.5], [0, -across, 3 * across])
    points = np.stack([u.ravel(), v.ravel(), w.ravel()], axis=1) @ leaf.frame[0].T + leaf.axis[0]
    found = density(points, (tube(9.0, 1.0), leaf), [0.3, noise, thickness], share=(0.0, 1.0, 0.0), organ=1)
    np.testing.assert_allclose(found, over_leaf(points, leaf, noise, thickness), rtol=1e-7)


@pytest.mark.parametrize("thickness", [0.0, 0.7])
@pytest.mark.parametrize("noise", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("half", [(1.5, 1.2), (1.2, 1.5), (1.0, 0.2), (0.6, 0.0)])
def test_a_tapering_patch_is_integrated_nearly(half, noise, thickness):
    leaf = strip([[1, 2, 3], [1, 2, 5]], half)
    random = np.random.default_rng(0)
    local = random.uniform([0, -max(half), 0], [2, max(half), 0], (40, 3))
    local += random.normal(0.0, 1.0, (40, 3)) * [noise, noise, np.hypot(noise, thickness)]
    points = local @ leaf.frame[0].T + leaf.axis[0]
    expected = over_leaf(points, leaf, noise, thickness)
    found = density(points, (tube(9.0, 1.0), leaf), [0.3, noise, thickness], share=(0.0, 1.0, 0.0), organ=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=TAPER * expected.max())


@pytest.mark.parametrize(("length", "radius"), [(4.0, 1.5), (8.0, 0.3)])
@pytest.mark.parametrize("noise", [0.1, 0.5, 3.0])
def test_a_tube_is_integrated_exactly(length, radius, noise):
    """On its side, its axis, its rims, inside, beside, and beyond its ends."""
    stem = tube(length, radius)
    out = [max(0.0, radius - 2 * noise), max(0.0, radius - 0.5 * noise), radius, radius + 3 * noise]
    rho, height = np.meshgrid(out, [-2 * noise, 0.0, 0.6 * length, length + noise])
    angle = np.arange(rho.size)
    points = np.stack([rho.ravel() * np.cos(angle), rho.ravel() * np.sin(angle), height.ravel()], axis=1)
    leaf = strip([[0, 0, 2], [9, 0, 2]], [1.0, 1.0])
    found = density(points, (stem, leaf), [noise, 0.3, 0.0], share=(1.0, 0.0, 0.0), organ=0)
    np.testing.assert_allclose(found, over_stem(points, stem, noise), rtol=BESSEL)


@pytest.mark.parametrize("facing", [(0.4, -0.2), (-1.5, 2.0), (0.0, 2.5)])
@pytest.mark.parametrize("noise", [0.1, 0.5, 3.0])
def test_a_tube_that_faces_a_side_is_integrated_exactly(facing, noise):
    stem = tube(4.0, 1.5)
    rho, height = np.meshgrid([0.0, 1.2, 1.5, 1.5 + noise], [-noise, 0.0, 2.4, 4.0 + noise])
    angle = np.arange(rho.size)
    points = np.stack([rho.ravel() * np.cos(angle), rho.ravel() * np.sin(angle), height.ravel()], axis=1)
    leaf = strip([[0, 0, 2], [9, 0, 2]], [1.0, 1.0])
    found = density(points, (stem, leaf), [noise, 0.3, 0.0], share=(1.0, 0.0, 0.0), organ=0, facing=facing)
    expected = over_stem(points, stem, noise, facing)
    there = expected > REACH * expected.max()
    np.testing.assert_allclose(found[there], expected[there], rtol=3.0 * BESSEL)


def test_far_from_the_organs_only_outliers_are_left():
    organs = grow(SHAPED)
    random = np.random.default_rng(1)
    far = random.normal(0.0, 1.0, (20, 3))
    far *= 200.0 / np.linalg.norm(far, axis=1, keepdims=True)
    for organ in (-1, 0, 1):
        found = density(far, organs, [0.3, 0.4, 0.2], share=(0.3, 0.6, 0.1), outlier_density=2e-5, organ=organ)
        np.testing.assert_allclose(found, 0.1 * 2e-5, rtol=EXACT)


@pytest.mark.parametrize(("noise", "thickness"), [(0.3, 0.0), (0.5, 0.4)])
def test_a_whole_phytomer_is_a_mixture_of_stem_leaf_and_outliers(noise, thickness):
    """In a pose, and with organs of which the leaf bends, twists and tapers."""
    random = np.random.default_rng(2)
    stem, leaf = organs = move(grow(SHAPED), rigid(random))
    points, _ = SurfaceSampler(40, 3).draw(organs)
    points += random.normal(0.0, 1.2 * noise, points.shape)
    expected = 0.3 * over_stem(points, stem, 0.4) + 0.6 * over_leaf(points, leaf, noise, thickness) + 0.1 * 1e-4
    found = density(points, organs, [0.4, noise, thickness], share=(0.3, 0.6, 0.1), outlier_density=1e-4)
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.2 * TAPER * expected.max())
    assert np.mean(np.abs(np.log(found / expected))) < 0.01


@pytest.mark.parametrize("noise", [0.2, 0.8])
@pytest.mark.parametrize(("organ", "share", "thickness"), [(0, 0.3, 0.0), (1, 0.6, 0.0), (1, 0.6, 0.7), (-1, 0.9, 0.3)])
def test_the_density_of_each_organ_is_its_share_over_all_space(organ, share, noise, thickness):
    """On a grid no wider than the noise, on which sums of normal densities are exact."""
    small = [1.4, 4.0, 50.0, 16.0, 3.0, 4.0, 2.0, 1.0, 10.0, 5.0, 25.0, 5.0, 20.0, 60.0, 0.6, 0.4, 2.0]
    organs = grow(small)
    nodes = np.concatenate([o.axis for o in (organs if organ < 0 else organs[organ : organ + 1])])
    margin = 2.0 + 6.0 * np.hypot(noise, thickness)
    axes = [np.arange(low - margin, high + margin, noise) for low, high in zip(nodes.min(0), nodes.max(0), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = density(grid, organs, [noise, noise, thickness], organ=organ)
    assert found.sum() * noise**3 == pytest.approx(share, rel=WHOLE)


def test_labelled_points_count_only_on_their_organ():
    """What an unknown point may be, a stem point and a leaf point share out between them."""
    organs = grow(SHAPED)
    points, label = SurfaceSampler(200, 3).draw(organs)
    settings = {"noise": [0.5, 0.4, 0.2], "share": (0.3, 0.6, 0.1), "outlier_density": 1e-5}
    unknown, stem, leaf = (density(points, organs, **settings, organ=organ) for organ in (-1, 0, 1))
    np.testing.assert_allclose(unknown, stem + leaf - 0.1 * 1e-5, rtol=EXACT)
    np.testing.assert_allclose(stem[np.linalg.norm(points[:, :2], axis=1) > 6.0], 0.1 * 1e-5, rtol=EXACT)

    def at_leaf(diameter):
        return diameter * np.exp(-0.03 * 7.0 / diameter)

    other = grow([*SHAPED[:3], 30.0, 4.0, *SHAPED[5:]])
    np.testing.assert_array_equal(density(points, other, **settings, organ=0), stem)
    thicker = grow(
        [2.0, *SHAPED[1:7], 0.8 * at_leaf(3.2) / at_leaf(2.0), *SHAPED[8:]]
    )  # a thinner stem with the leaf where it was
    np.testing.assert_allclose(density(points, thicker, **settings, organ=1), leaf, rtol=EXACT)
    assert np.all(stem[label == 0] > leaf[label == 0])


# likelihood of a cloud


def scene(x, seed, *, n=150, noise_cm=0.4, thick=True, cut=False, one_sided=True, executor=None):
    """The likelihood of a noisy cloud of the phytomer x in some pose, a tenth of it outliers, and its true state.

    Of about every second point it is known which organ it is of.
    """
    random = np.random.default_rng(seed)
    species = SPECIES.leading(len(x))
    pose = rigid(random)
    points, organ = SurfaceSampler(n, seed, even=False).draw(move(grow(x), pose))
    points += random.normal(0.0, noise_cm, points.shape)
    organ = np.where(random.random(n) < 0.6, organ, -1).astype(np.int8)
    stray = n // 10
    points[:stray] = random.uniform(points.min(axis=0), points.max(axis=0), (stray, 3))
    organ[:stray] = -1
    likelihood = Posterior.of(species, points, organ=organ, thick=thick, cut=cut, executor=executor)
    likelihood = likelihood.under(likelihood.prior.one_sided()) if one_sided else likelihood
    return likelihood, likelihood.start(x, pose, noise_cm)


def at(state, theta, pose=None):
    return State(theta, state.layout, state.pose if pose is None else pose, state.center)


def disturbed(likelihood, state, random, turn=0.5):
    """The state some way off in all parameters that are not fixed, with a turn (radians) and a shift."""
    k = len(likelihood.space)
    theta = state.theta.copy()
    theta[:k] += 0.05 * likelihood.space.std * random.uniform(-1.0, 1.0, k)
    theta[k] = random.uniform(0.7, 0.99)
    layout = state.layout
    theta[layout["turn"]] = turn * np.array([2.0, -1.0, 2.0]) / 3.0
    theta[layout["shift"]] = random.uniform(-3.0, 3.0, 3)
    theta[layout["stem_facing"]] = random.uniform(-2.0, 2.0, 2)
    theta[-5:] += random.uniform(-0.5, 0.5, 5)
    fixed = likelihood.prior.lower == likelihood.prior.upper
    theta[fixed] = likelihood.prior.mean[fixed]
    # the pose makes up for turn and shift but for some mm, so that the organs are still where the points are
    turned = likelihood.pose_of(at(state, theta, np.eye(4)))
    pose = np.linalg.solve(turned, state.pose)
    pose[:3, 3] += random.normal(0.0, 0.2, 3)
    return at(state, theta, pose)


def differences(likelihood, state, scores):
    """Differences of the points' log densities (n, k) by all k entries of theta: to that side on which they are nearer
    to the scores, since a piece that comes into reach makes a small jump on one side."""
    here = likelihood.evaluate(state, derivatives=False).log_p
    steps = STEP * np.where(np.isfinite(likelihood.prior.std), likelihood.prior.std, 1.0)
    slopes = np.empty_like(scores)
    for i, step in enumerate(steps):
        theta = np.repeat(state.theta[np.newaxis], 2, axis=0)
        theta[:, i] += step, -step
        there = [likelihood.evaluate(at(state, row), derivatives=False).log_p for row in theta]
        sides = np.array([there[0] - here, here - there[1], 0.5 * (there[0] - there[1])]) / step
        nearest = np.argmin(np.abs(sides - scores[:, i]), axis=0)
        slopes[:, i] = sides[nearest, np.arange(len(here))]
    return slopes


def assert_scores_are_slopes(likelihood, state):
    scores = likelihood.evaluate(state).scores
    slopes = differences(likelihood, state, scores)
    assert scores.shape == (len(likelihood.points), len(state.theta))
    size = np.where(
        likelihood.prior.lower < likelihood.prior.upper, np.abs(scores).max(axis=0), np.inf
    )  # what is fixed may be
    size = np.where(size > 1e-4, size, 1.0)  # of a parameter that no point knows of, or next to nothing
    np.testing.assert_allclose(scores / size, slopes / size, rtol=0, atol=SLOPE)  # at a kink: all of a leaf is seen
    np.testing.assert_allclose(scores.sum(axis=0) / size, slopes.sum(axis=0) / size, rtol=1e-3, atol=SUMMED)
    return scores


@pytest.mark.parametrize("thick", [True, False])
@pytest.mark.parametrize("k", [7, N])
@settings(max_examples=15)
@given(x=PHYTOMERS, seed=SEEDS)
def test_scores_are_the_slopes_of_the_log_density(k, thick, x, seed):
    likelihood, state = scene(x[:k], seed, thick=thick)
    scores = assert_scores_are_slopes(likelihood, disturbed(likelihood, state, np.random.default_rng(seed)))
    if not thick:
        np.testing.assert_allclose(scores[:, state.layout["leaf_thickness"]], 0.0, atol=EXACT)


@settings(max_examples=15)
@given(x=PHYTOMERS, seed=SEEDS)
def test_scores_of_a_leaf_without_its_tip(x, seed):
    likelihood, state = scene(x, seed, cut=True)
    state = disturbed(likelihood, state, np.random.default_rng(seed))
    assert 0.7 <= state.seen < 1.0
    assert_scores_are_slopes(likelihood, state)


@pytest.mark.parametrize("turn", [0.0, 1e-6, 3.1])
def test_scores_of_no_turn_and_of_half_a_turn(turn):
    likelihood, state = scene(SHAPED, 4)
    assert_scores_are_slopes(likelihood, disturbed(likelihood, state, np.random.default_rng(4), turn=turn))


def test_the_error_is_the_same_without_derivatives():
    likelihood, state = scene(SHAPED, 5)
    full, short = likelihood.evaluate(state), likelihood.evaluate(state, derivatives=False)
    assert short.error == full.error
    np.testing.assert_array_equal(short.log_p, full.log_p)
    assert short.scores.shape == (0, len(state.theta))


def test_the_error_is_that_of_the_points_and_of_the_prior():
    """A normal prior of the species', of noise within a factor of 3, of shares; no pose is likelier than another."""
    likelihood, state = scene(SHAPED, 6)
    theta = disturbed(likelihood, state, np.random.default_rng(6)).theta
    layout = state.layout
    theta[layout["turn"]] += 1.0
    theta[layout["shift"]] += 100.0
    here = likelihood.evaluate(at(state, theta))
    distance = np.concatenate(
        [
            (theta[:N] - SPECIES.space.mean) / SPECIES.space.std,
            theta[layout["stem_facing"]],
            (theta[layout.mask("stem_noise", "leaf_noise", "leaf_thickness")] - np.log(0.3)) / np.log(3.0),
            (theta[-2:] - likelihood.prior.mean[-2:]) / 2.5,
        ]
    )
    assert here.error == pytest.approx(0.5 * np.sum(distance**2) - here.log_p.sum(), rel=EXACT)


def test_a_state_names_what_it_holds():
    """In the cloud's frame and in cm, whatever the parameters are."""
    _, state = scene(SHAPED, 6)
    theta = state.theta.copy()
    theta[N:-5] = [0.8, 0.1, 0.2, 0.3, 4.0, 5.0, 6.0, -1.0, 2.0]
    theta[-5:] = np.log([0.2, 0.4, 0.1, 2.0, 0.5])
    named = at(state, theta)
    assert (len(named.x), named.seen) == (N, 0.8)
    np.testing.assert_array_equal(named.x, SHAPED)
    np.testing.assert_array_equal(named.turn, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(named.shift, [4.0, 5.0, 6.0])
    np.testing.assert_array_equal(named.facing, [-1.0, 2.0])
    np.testing.assert_allclose(named.noise, [0.2, 0.4, 0.1], rtol=EXACT)
    np.testing.assert_allclose(named.share, [2.0 / 3.5, 1.0 / 3.5, 0.5 / 3.5], rtol=EXACT)


@pytest.mark.parametrize("cut", [False, True])
def test_the_likelihood_of_a_state_is_the_density_of_its_organs(cut):
    """The organs of its parameters in its pose, with its noise and shares; without the tip, where that is missing."""
    likelihood, state = scene(SHAPED, 7, n=60, cut=cut)
    state = disturbed(likelihood, state, np.random.default_rng(7))
    stem, leaf = grow(state.x)
    if cut:
        theta = state.theta.copy()
        theta[N] = 0.8  # 24 of 30 pieces
        state = at(state, theta)
        leaf = Organ(LEAF, leaf.axis[:25], leaf.frame[:24], leaf.half_width[:25], leaf.fold)
    organs = [
        Organ(o.kind, *(np.ascontiguousarray(a) for a in (o.axis, o.frame, o.half_width)), o.fold)
        for o in move([stem, leaf], likelihood.pose_of(state))
    ]
    for organ in (-1, 0, 1):
        one = likelihood.organ == organ
        outliers = 1.0 / ConvexHull(likelihood.points).volume
        expected = density(
            likelihood.points[one],
            organs,
            state.noise,
            share=state.share,
            outlier_density=outliers,
            organ=organ,
            facing=state.facing,
        )
        np.testing.assert_allclose(np.exp(likelihood.evaluate(state).log_p[one]), expected, rtol=1e-8)


def test_what_was_not_seen_takes_no_part_of_the_leaf():
    """The rest of it is the denser, by the share of the area that is gone; and the scores are the slopes still."""
    whole, state = scene(SHAPED, 8, n=60)
    leaf = move(grow(state.x), whole.pose_of(state))[1]
    share = np.linspace(0.1, 0.6, 30)[:, np.newaxis] + np.linspace(0.0, 0.3, 9)  # a spline gives straight lines back
    share[0], share[-1] = share[1], share[-2]
    organ = np.ones(60, np.int8)

    def of_leaf(hidden):
        likelihood = Posterior.of(SPECIES, whole.points, organ=organ, thick=True, hidden=hidden)
        return np.exp(likelihood.evaluate(state, derivatives=False).log_p) - likelihood.outlier_density * state.share[2]

    area = leaf.segment_lengths * (leaf.half_width[1:] + leaf.half_width[:-1])
    gone = area @ share.mean(axis=1) / area.sum()
    hidden = Hidden(leaf, share)
    expected = of_leaf(None) * (1.0 - hidden.at(whole.points)) / (1.0 - gone)
    np.testing.assert_allclose(of_leaf(hidden), expected, rtol=2e-3, atol=1e-15)
    hidden = Hidden(leaf, np.random.default_rng(9).uniform(0.0, 0.98, (30, 9)))
    likelihood = Posterior.of(SPECIES, whole.points, thick=True, hidden=hidden)
    assert_scores_are_slopes(likelihood, disturbed(likelihood, state, np.random.default_rng(8)))


@pytest.mark.parametrize("facing", [(0.0, 0.0), (0.8, -1.3)])
def test_scores_are_slopes_beside_a_void(facing):
    whole, state = scene(SHAPED, 8, n=60)
    leaf = move(grow(state.x), whole.pose_of(state))[1]
    void = Void(leaf.axis[0] + np.array([0.3, -0.2, 0.5]), 2.0, 0.6)
    hidden = Hidden(leaf, np.zeros((30, 9)), void)
    likelihood = Posterior.of(SPECIES, whole.points, thick=True, hidden=hidden)
    likelihood = likelihood.under(likelihood.prior.one_sided())
    state = disturbed(likelihood, state, np.random.default_rng(8))
    theta = state.theta.copy()
    theta[-7:-5] = facing
    assert_scores_are_slopes(likelihood, at(state, theta))


def test_a_part_of_a_piece_may_be_missing(clean):
    """The error changes without a jump as the tip is taken away, and is least where it was taken away."""
    whole, state = clean
    base = state.pose[:3, :3].T @ (whole.points - state.pose[:3, 3]).T
    far = np.linalg.norm(base.T - [0.0, 0.0, X[1]], axis=1)
    likelihood = Posterior.of(SPECIES, whole.points[far < 0.7 * far.max()], cut=True)
    seen = np.linspace(0.5, 1.0, 101)
    errors = []
    for share in seen:
        theta = state.theta.copy()
        theta[N] = share
        errors.append(likelihood.evaluate(at(state, theta), derivatives=False).error)
    assert np.abs(np.diff(errors, 2)).max() < 20.0
    assert 0.6 < seen[np.argmin(errors)] < 0.9
    assert min(errors) < errors[-1] - 20.0


def test_weights_count_points_more_than_once():
    likelihood, state = scene(X[:7], 7)
    weights = np.random.default_rng(7).integers(0, 4, len(likelihood.points)).astype(float)
    again = np.repeat(np.arange(len(weights)), weights.astype(int))
    weighted, repeated = copy.copy(likelihood), likelihood.at(likelihood.points[again])
    weighted.weights = weights
    repeated.organ = likelihood.organ[again]
    assert weighted.evaluate(state).error == pytest.approx(repeated.evaluate(state).error, rel=EXACT)


def test_a_cloud_may_lie_anywhere():
    """Turned and shifted with its pose it has the same density."""
    likelihood, state = scene(SHAPED, 8)
    there = rigid(np.random.default_rng(8))
    moved = likelihood.at(likelihood.points @ there[:3, :3].T + there[:3, 3])
    state_there = State(state.theta, state.layout, there @ state.pose, there[:3, :3] @ state.center + there[:3, 3])
    np.testing.assert_allclose(moved.evaluate(state_there).log_p, likelihood.evaluate(state).log_p, rtol=1e-8)


def test_the_pose_turns_about_the_junction_and_shifts():
    likelihood, state = scene(X, 9)
    junction = np.array([0.0, 0.0, X[1]])
    np.testing.assert_allclose(state.center, state.pose[:3, :3] @ junction + state.pose[:3, 3], rtol=EXACT)
    np.testing.assert_allclose(likelihood.pose_of(state), state.pose, atol=1e-12)
    pose = likelihood.pose_of(state.changed(turn=[0.3, -0.8, 0.4], shift=[1.0, -2.0, 3.0]))
    moved = pose[:3, :3] @ junction + pose[:3, 3] - state.center
    np.testing.assert_allclose(moved, [1.0, -2.0, 3.0], rtol=1e-9)
    turn = pose[:3, :3] @ state.pose[:3, :3].T
    np.testing.assert_allclose(Rotation.from_matrix(turn).as_rotvec(), [0.3, -0.8, 0.4], atol=EXACT)


def test_an_outlier_has_the_density_of_the_clouds_hull():
    """And a flat cloud has a box."""
    random = np.random.default_rng(10)
    points = random.uniform([0, 0, 0], [30, 20, 10], (50, 3)) + 500.0
    points[:8] = [[x, y, z] for x in (500, 530) for y in (500, 520) for z in (500, 510)]  # its hull is the box
    for cloud, volume in ((points, 30 * 20 * 10), (points * [1, 1, 0], 30 * 20 * 1.5)):
        likelihood = Posterior.of(SPECIES, cloud)
        state = likelihood.start(X, np.eye(4), 0.3)
        state.theta[-2:] = [0.0, np.log(2.0)]  # shares of stem, leaf and outliers as 1 : 1 : 2
        found = likelihood.evaluate(state, derivatives=False).log_p
        assert np.ptp(found) == 0.0
        assert 1.0 / 1.35 <= 2.0 * np.exp(found[0]) * volume <= 1.0 + EXACT


@pytest.fixture(scope="module")
def clean():
    """800 points of the plain phytomer X, unlabelled, and the true state."""
    pose = rigid(np.random.default_rng(11))
    points, _ = SurfaceSampler(800, 11).draw(move(grow(X), pose))
    points += np.random.default_rng(12).normal(0.0, 0.3, points.shape)
    likelihood = Posterior.of(SPECIES, points)
    return likelihood, likelihood.start(X, pose, 0.3)


@pytest.mark.parametrize("name", ["stem_diameter", "leaf_length", "leaf_width", "stem_length", "stem_length_above"])
def test_a_model_of_another_size_than_its_data_has_a_larger_error(clean, name):
    """A larger one too: it covers all the data, but spreads its points thin."""
    likelihood, state = clean
    i = SPECIES.space.index(name)
    error = likelihood.evaluate(state, derivatives=False).error
    for factor in (0.8, 1.25):
        theta, pose = state.theta.copy(), state.pose.copy()
        theta[i] *= factor
        if name == "stem_length":  # the leaf stays where it is
            pose[:3, 3] += pose[:3, 2] * (X[1] - theta[i])
        assert likelihood.evaluate(at(state, theta, pose), derivatives=False).error > error + CLEAR


@pytest.mark.parametrize(("i", "change"), [(-5, 0.5), (-5, -0.5), (-4, 0.5), (-4, -0.5), (-1, 2.0), (-2, 1.0)])
def test_other_noise_and_shares_than_the_datas_have_a_larger_error(clean, i, change):
    likelihood, state = clean
    theta = state.theta.copy()
    theta[i] += change
    error = likelihood.evaluate(state, derivatives=False).error
    assert likelihood.evaluate(at(state, theta), derivatives=False).error > error + CLEAR


def test_threads_and_blocks_change_no_bit(monkeypatch):
    likelihood, state = scene(SHAPED, 13, n=1300)
    state = disturbed(likelihood, state, np.random.default_rng(13))
    alone = likelihood.evaluate(state)
    with ThreadPoolExecutor(2) as executor:
        shared = scene(SHAPED, 13, n=1300, executor=executor)[0].evaluate(state)
    monkeypatch.setattr(module, "BLOCK", 77)
    small = likelihood.evaluate(state)
    for other in (shared, small):
        assert other.error == alone.error
        assert other.log_p.tobytes() == alone.log_p.tobytes()
        assert other.scores.tobytes() == alone.scores.tobytes()
        assert other.responsibilities.tobytes() == alone.responsibilities.tobytes()


@pytest.mark.parametrize("thick", [True, False])
def test_an_extended_state_has_the_same_organs(thick):
    plain, state = scene(X[:7], 14, thick=False)
    state = disturbed(plain, state, np.random.default_rng(14))
    rich = Posterior.of(SPECIES, plain.points, organ=plain.organ, thick=thick)
    extended = rich.extended(state)
    assert (len(extended.x), extended.theta.shape) == (N, rich.prior.mean.shape)
    (stem, few), (pieces, many) = grow(state.x), grow(extended.x)
    for name in ("axis", "frame", "half_width"):
        np.testing.assert_allclose(getattr(many, name), getattr(few, name), atol=1e-12)
    np.testing.assert_allclose(pieces.axis[[0, -1]], stem.axis, atol=1e-12)
    np.testing.assert_array_equal(pieces.half_width, stem.half_width[0])
    np.testing.assert_array_equal(rich.pose_of(extended), plain.pose_of(state))
    assert extended.seen == state.seen
    np.testing.assert_array_equal(extended.noise[:2], state.noise[:2])
    np.testing.assert_array_equal(extended.share, state.share)
    assert extended["leaf_thickness"] == rich.prior.mean[rich.prior.layout.place("leaf_thickness")]
    if not thick:
        np.testing.assert_allclose(rich.evaluate(extended).log_p, plain.evaluate(state).log_p, rtol=BESSEL)
    assert rich.extended(extended).theta.tobytes() == extended.theta.tobytes()


@pytest.mark.parametrize("thick", [True, False])
@pytest.mark.parametrize("cut", [True, False])
def test_a_start_lies_within_the_bounds(thick, cut):
    """All of a leaf is seen, and it has no thickness unless it may."""
    likelihood, state = scene(SHAPED, 15, thick=thick, cut=cut, one_sided=False)
    assert np.all((state.theta >= likelihood.prior.lower) & (state.theta <= likelihood.prior.upper))
    np.testing.assert_array_equal(state.x, SHAPED)
    np.testing.assert_allclose(state.noise[:2], 0.4, rtol=EXACT)
    assert state.seen == 1.0
    fixed = np.flatnonzero(likelihood.prior.lower == likelihood.prior.upper)
    assert set(fixed) == ({N} if not cut else set()) | ({N + 11} if not thick else set()) | {N + 7, N + 8}
    assert (state.noise[2] > 0.01) == thick
