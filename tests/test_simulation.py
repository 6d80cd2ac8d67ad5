"""Simulated clouds: noise, spheres, outliers, labels and pose as they were asked for, and their truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial import cKDTree

from phytofit.errors import SettingError
from phytofit.models import LEAF, STEM, Phytomer, SurfaceSampler, move
from phytofit.simulation import add_noise, add_outliers, occlude, random_pose, simulate, visible
from phytofit.species import load_species
from phytofit.traits import measure

SIGNIFICANCE = 1e-3  # of statistical tests; seeds are fixed
SINGLE = 2e-5  # cm; samples are float32

SPECIES = load_species()


def passes(p_value):
    return p_value > SIGNIFICANCE


def polyline_distance(points, nodes):
    start, step = nodes[:-1], np.diff(nodes, axis=0)
    offset = points[:, np.newaxis] - start
    share = np.clip(np.sum(offset * step, axis=2) / np.sum(step**2, axis=1), 0.0, 1.0)
    return np.linalg.norm(offset - share[..., np.newaxis] * step, axis=2).min(axis=1)


def test_one_seed_gives_the_same_bytes():
    settings = {"n_points": 300, "n_spheres": 2, "outlier_share": 0.1}
    a, b, c = (simulate(**settings, seed=seed) for seed in (5, 5, 6))
    for name in ("points", "labels", "x", "pose"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
        assert getattr(a, name).tobytes() != getattr(c, name).tobytes()


def test_points_without_noise_lie_on_the_organs_that_their_labels_name():
    made = simulate(noise_cm=0.0, random_orientation=False, seed=1)
    stem, leaf = made.organs
    assert (stem.kind, leaf.kind) == (STEM, LEAF)
    assert made.points.shape == (5000, 3)
    assert set(np.unique(made.labels)) == {1, 2}
    on_stem, on_leaf = made.points[made.labels == 1], made.points[made.labels == 2]
    np.testing.assert_allclose(np.hypot(on_stem[:, 0], on_stem[:, 1]), made.x[0] / 2, atol=SINGLE)
    np.testing.assert_allclose(polyline_distance(on_leaf * [1, 0, 1], leaf.axis), 0.0, atol=SINGLE)
    assert np.abs(on_leaf[:, 1]).max() <= made.x[4] / 2 + SINGLE
    share = float(stem.area / (stem.area + leaf.area))
    assert np.mean(made.labels == 1) == pytest.approx(share, abs=0.005)


def test_the_truth_is_in_the_clouds_frame():
    made = simulate(noise_cm=0.0, seed=2)
    upright = [organ.row(0) for organ in SPECIES.model.organs(made.x)]
    for organ, expected in zip(made.organs, move(upright, made.pose), strict=True):
        np.testing.assert_allclose(organ.axis, expected.axis, atol=1e-9)
    on_leaf = made.points[made.labels == 2]
    assert polyline_distance(on_leaf, made.organs[1].axis).max() <= made.x[4] / 2 + SINGLE


def test_traits_of_the_truth_are_the_parameters():
    """As far as they mean the same: leaf length and angle are measured from the stem's surface."""
    for seed in range(5):
        made = simulate(n_points=10, seed=seed)
        x = dict(zip(SPECIES.space.names, made.x, strict=True))
        found = {trait.name: trait.value for trait in measure(made.organs)}
        assert found["stem_diameter"] == pytest.approx(x["stem_diameter"])
        assert found["stem_length"] == pytest.approx(x["stem_length"] + x["stem_length_above"])
        assert found["leaf_width"] == pytest.approx(x["leaf_width"])
        radius = x["stem_diameter"] / 2
        inside = radius / math.sin(math.radians(x["leaf_angle"]))
        assert x["leaf_length"] - inside - 0.1 <= found["leaf_length"] <= x["leaf_length"] - radius + 1e-9
        assert x["leaf_angle"] < found["leaf_angle"] < x["leaf_angle"] + 10 * x["leaf_rotate_angle"]


def test_noise_has_the_standard_deviation_asked_for():
    """Clouds of one seed with and without noise differ by it alone."""
    clean, noisy = (simulate(noise_cm=std, seed=3) for std in (0.0, 0.7))
    np.testing.assert_array_equal(clean.labels, noisy.labels)
    noise = noisy.points - clean.points
    for column in noise.T:
        assert passes(stats.kstest(column, stats.norm(0, 0.7).cdf).pvalue)
    np.testing.assert_allclose(np.corrcoef(noise.T), np.eye(3), atol=4 / math.sqrt(5000))


def test_no_noise_leaves_points_alone():
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_array_equal(add_noise(points, 0.0, np.random.default_rng(1)), points)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 8.0), st.integers(1, 300))
def test_a_sphere_takes_a_ball_around_one_of_the_points(seed, diameter, n):
    random = np.random.default_rng(seed)
    points = random.normal(0, 3, (n, 3))
    stay = occlude(points, diameter, random)
    assert stay.shape == (n,)
    gone = points[~stay]
    to_gone = np.linalg.norm(points[:, np.newaxis] - gone[np.newaxis], axis=2)
    # a point that went is the centre: what went is within the radius of it, what stayed is not
    is_center = np.all((to_gone <= diameter / 2) == ~stay[:, np.newaxis], axis=0)
    assert is_center.any()


def test_spheres_take_their_points_out_of_the_cloud():
    whole = simulate(noise_cm=0.0, random_orientation=False, seed=4)
    cut = simulate(noise_cm=0.0, random_orientation=False, n_spheres=3, sphere_diameter_cm=5.0, seed=4)
    assert len(cut.points) == len(cut.labels) < len(whole.points)
    kept = {point.tobytes() for point in cut.points}
    stays = np.array([point.tobytes() in kept for point in whole.points])
    assert stays.sum() == len(cut.points)
    np.testing.assert_array_equal(whole.labels[stays], cut.labels)
    gone = whole.points[~stays]
    assert len(gone) > 0
    # three balls of radius 2.5 hold all that went: pick centres that leave none of what stayed nearer than that
    clear = [c for c in gone if np.linalg.norm(whole.points[stays] - c, axis=1).min() > 2.5]
    assert np.all(np.min(np.linalg.norm(gone[:, np.newaxis] - clear, axis=2), axis=1) <= 2.5)


def test_spheres_that_leave_nothing_are_named():
    with pytest.raises(SettingError, match=r"spheres: expected to leave some of the 100 points, but 2 of 1000 cm"):
        simulate(n_points=100, n_spheres=2, sphere_diameter_cm=1000.0)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.333, 0.99])
def test_outliers_are_a_share_of_the_points_and_labelled_0(share):
    made = simulate(n_points=2000, outlier_share=share, random_orientation=False, seed=5)
    stray = made.points[made.labels == 0]
    assert len(made.points) == 2000 + len(stray)
    assert len(stray) == round(share * 2000)
    plant = made.points[made.labels > 0]
    np.testing.assert_array_equal(plant, simulate(n_points=2000, random_orientation=False, seed=5).points)


def test_outliers_fill_a_larger_box_evenly():
    points = np.random.default_rng(6).uniform([0, 10, 20], [4, 18, 36], (1000, 3))
    points[:2] = [[0, 10, 20], [4, 18, 36]]
    stray = add_outliers(points, 2.0, np.random.default_rng(7))
    assert stray.shape == (2000, 3)
    for column, low, size in zip(stray.T, (-1.0, 8.0, 16.0), (6.0, 12.0, 24.0), strict=True):
        assert passes(stats.kstest(column, stats.uniform(low, size).cdf).pvalue)


def test_parameters_are_drawn_evenly_from_the_ranges():
    xs = np.array([simulate(n_points=1, seed=seed).x for seed in range(400)])
    for x, (low, high) in zip(xs.T, SPECIES.ranges, strict=True):
        assert np.all((x >= low) & (x <= high))
        if high > low:
            assert passes(stats.kstest(x, stats.uniform(low, high - low).cdf).pvalue)


def test_fixed_parameters_leave_the_others_as_drawn():
    free = simulate(n_points=10, seed=8)
    some = simulate(n_points=10, seed=8, fixed={"leaf_length": 33.0, "stem_length_above": 0.0})
    for i, name in enumerate(SPECIES.space.names):
        expected = {"leaf_length": 33.0, "stem_length_above": 0.0}.get(name, free.x[i])
        assert some.x[i] == expected
    np.testing.assert_array_equal(SPECIES.ranges, load_species().ranges)  # the species is as it was


def test_without_random_orientation_the_plant_stands_upright_in_the_models_frame():
    made = simulate(random_orientation=False, seed=9)
    np.testing.assert_array_equal(made.pose, np.eye(4))
    np.testing.assert_array_equal(made.organs[0].axis[0], [0.0, 0.0, 0.0])


def test_random_poses_are_uniform_rotations_and_shifts():
    random = np.random.default_rng(10)
    poses = np.array([random_pose(random, reach_cm=20.0) for _ in range(2000)])
    r = poses[:, :3, :3]
    np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=1e-12)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0, 0, 0, 1.0], (2000, 1)))
    # Archimedes: every coordinate of a uniform direction is uniform
    for entry in r.reshape(-1, 9).T:
        assert passes(stats.kstest(entry, stats.uniform(-1, 2).cdf).pvalue)
    # and the angle of a uniform rotation has the density (1 - cos) / pi
    angle = np.arccos(np.clip((np.trace(r, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert passes(stats.kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue)
    for shift in poses[:, :3, 3].T:
        assert passes(stats.kstest(shift, stats.uniform(-20, 40).cdf).pvalue)


def test_points_come_in_no_order():
    """Neither along the plant nor by organ, as `pose` and `thin` take points by their index."""
    made = simulate(noise_cm=0.0, random_orientation=False, seed=11)
    index = np.arange(len(made.points))
    for values in (*made.points.T, made.labels):
        assert passes(stats.spearmanr(index, values).pvalue)


def test_another_species_is_drawn_from_its_ranges_and_built_by_its_model():
    ranges = np.repeat(SPECIES.space.mean[:, np.newaxis] + 1.0, 2, axis=1)
    other = replace(SPECIES, model=Phytomer(n_pieces=12), ranges=ranges)
    made = simulate(other, n_points=7, seed=12)
    np.testing.assert_array_equal(made.x, ranges[:, 0])
    assert made.organs[1].axis.shape == (13, 3)


def test_one_point():
    made = simulate(n_points=1, noise_cm=0.0, seed=13)
    assert made.points.shape == (1, 3)
    assert np.all(np.isfinite(made.points))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_points": 0}, r"points: expected a whole number of 1 or more, got 0"),
        ({"n_points": -5}, r"points: expected a whole number of 1 or more, got -5"),
        ({"noise_cm": -0.1}, r"noise: expected a number of 0 or more, got -0\.1"),
        ({"noise_cm": np.nan}, r"noise: expected a number of 0 or more, got nan"),
        ({"noise_cm": np.inf}, r"noise: expected a number of 0 or more, got inf"),
        ({"n_spheres": -1}, r"spheres: expected a whole number of 0 or more, got -1"),
        ({"sphere_diameter_cm": 0.0}, r"sphere diameter: expected a positive number of cm, got 0"),
        ({"sphere_diameter_cm": np.nan}, r"sphere diameter: expected a number of 0 or more, got nan"),
        ({"outlier_share": 1.0}, r"outliers: expected a share from 0 to below 1, got 1"),
        ({"outlier_share": -0.5}, r"outliers: expected a number of 0 or more, got -0\.5"),
        ({"outlier_share": np.nan}, r"outliers: expected a number of 0 or more, got nan"),
        ({"fixed": {"leaf_colour": 3.0}}, r"no parameter is called 'leaf_colour'; there are stem_diameter, "),
        ({"fixed": {"leaf_angle": 181.0}}, r"leaf_angle: .*within the species' bounds \[0, 180\], got 181"),
        ({"fixed": {"leaf_length": np.nan}}, r"leaf_length: .*within the species' bounds \[5, 10000\], got nan"),
        ({"fixed": {"stem_diameter": -1.0}}, r"stem_diameter: .*within the species' bounds"),
        ({"fixed": {"leaf_length": np.inf}}, r"leaf_length: .*within the species' bounds \[5, 10000\], got inf"),
        ({"fixed": {"leaf_length": True}}, r"leaf_length: .*within the species' bounds .*, got True"),
        ({"fixed": {"leaf_length": "long"}}, r"leaf_length: .*within the species' bounds .*, got 'long'"),
        ({"n_points": True}, r"points: expected a whole number of 1 or more, got True"),
        ({"n_points": 10**15}, r"points: expected 10,000,000 at most, got 1,000,000,000,000,000"),
        ({"n_views": 2.5}, r"views: expected a whole number of 1 or more, got 2\.5"),
        ({"noise_cm": 1e300}, r"noise: expected 10000 at most, got 1e\+300"),
        ({"seed": 0.5}, r"seed: expected a whole number of 0 or more, got 0\.5"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(SettingError, match=message):
        simulate(**settings)


def test_noise_with_a_reach_is_shared_by_neighbours_and_as_large_as_asked_for():
    random = np.random.default_rng(0)
    points = random.uniform(0.0, 20.0, (6000, 3)) * [1.0, 1.0, 0.05]
    off = add_noise(points, 0.4, random, reach_cm=2.0) - points
    assert off.std() == pytest.approx(0.4, rel=0.15)  # some 36 independent patches
    _, near = cKDTree(points).query(points, k=2)
    assert np.corrcoef(off[:, 0], off[near[:, 1], 0])[0, 1] > 0.8
    far = random.permutation(6000)
    apart = np.linalg.norm(points - points[far], axis=1) > 4.5
    assert abs(np.corrcoef(off[apart, 0], off[far[apart], 0])[0, 1]) < 0.2


@given(st.floats(0.0, 2 * math.pi), st.floats(-1.0, 1.0))
def test_a_camera_sees_the_near_side_of_a_bare_stem(azimuth, height):
    """Closed form: a point on a cylinder is seen if its normal looks towards the camera."""
    stem = SPECIES.model.organs(SPECIES.space.mean)[0].row(0)
    radius, length = stem.half_width[0], stem.segment_lengths.sum()
    random = np.random.default_rng(1)
    turn, z = random.uniform(0, 2 * math.pi, 400), random.uniform(0.0, length, 400)
    points = stem.axis[0] + np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
    toward = np.array([math.cos(azimuth), math.sin(azimuth), height])
    facing = points[:, :2] @ toward[:2] / radius / np.linalg.norm(toward)
    inside = (z > 4 * radius) & (z < length - 4 * radius)  # through its open ends a tube's far side is seen
    surface, _ = SurfaceSampler(100_000, 0).draw([stem])
    seen = visible(points, surface, toward)
    assert seen[inside & (facing > 0.35)].all()  # where it is more slanted a pixel reaches too deep
    assert not seen[inside & (facing < -0.5)].any()


def test_more_cameras_see_more_and_all_points_asked_for_come():
    one, two = (simulate(n_points=2000, n_views=n, noise_cm=0.0, random_orientation=False, seed=8) for n in (1, 2))
    assert one.points.shape == two.points.shape == (2000, 3)
    np.testing.assert_array_equal(one.x, two.x)
    # the upper half is left out: from above, the far side is seen through the stem's open end
    on_stem = [p[p[:, 2] < np.median(p[:, 2])] for p in (made.points[made.labels == 1] for made in (one, two))]
    around = [np.unique(np.floor(np.degrees(np.arctan2(p[:, 1], p[:, 0])) / 10.0)).size for p in on_stem]
    assert around[0] < 24  # of 36 sectors: a camera sees half of a stem, and something beyond by the tolerance
    assert around[1] == 36


@pytest.mark.parametrize(("setting", "value"), [("n_views", 0), ("noise_reach_cm", -1.0)])
def test_a_sensor_that_can_not_be_is_refused(setting, value):
    with pytest.raises(SettingError, match=r"expected a (whole )?number"):
        simulate(**{setting: value})
