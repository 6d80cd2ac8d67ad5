"""A whole fit by the default method: what it recovers, how sure it says it is, and what it flags."""

import dataclasses
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import phytofit
import phytofit.models
import phytofit.parameters
import phytofit.simulation
from phytofit import Status
from phytofit.engine.outcome import Alternative
from phytofit.results import beside_its_rival

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "sodhi2018"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data/sodhi2018 is absent")
GENTLE = {"leaf_length": 55.0, "leaf_angle": 50.0, "leaf_width": 6.0, "stem_diameter": 3.0, "stem_length": 15.0}
WITHIN_STD = 4.0  # standard errors: one in 16,000 is further off
SAME_CM = 0.02  # a rotated copy is rounded elsewhere, and its refinement stops elsewhere within its tolerance
N_POINTS = 2500


@pytest.fixture(scope="module")
def made():
    return phytofit.simulate(fixed=GENTLE, n_points=N_POINTS, noise_cm=0.3, seed=3)


@pytest.fixture(scope="module")
def result(made):
    return phytofit.fit(made.points, "cm", threads=2)


def values(result):
    return {t.name: t.value for t in result.traits}


def along(made):
    """Share of the midrib at which each point of a simulated phytomer lies."""
    leaf = made.organs[1]
    nearest = np.argmin(np.linalg.norm(made.points[:, np.newaxis] - leaf.axis, axis=2), axis=1)
    return nearest / (len(leaf.axis) - 1)


def on_leaf(made):
    return made.labels == 2


def without(made, gone):
    return phytofit.fit(made.points[~gone], "cm", threads=2)


def says(result, text):
    return any(text in str(one) for one in result.remarks)


def test_a_leaf_that_holes_cut_in_two_is_followed_beyond_them():
    """Without points in four spheres: a first guess ends at one of them, and leaves a fifth of the points out."""
    made = phytofit.simulate(n_points=5000, noise_cm=0.5, seed=900013)
    centers = made.points[[4422, 4200, 3995, 4157]]  # at 0.71, 0.65, 0.5, 0.21 of the midrib
    gone = (np.linalg.norm(made.points[:, np.newaxis] - centers, axis=2) < 3.0).any(axis=1)
    result = without(made, gone)
    assert abs(result.parameters["leaf_length"] - made.x[3]) < 1.0
    assert result.estimate.share[2] < 0.03


def test_recovers_a_simulated_phytomer_within_its_own_errors(made, result):
    assert len(result.x) == 7  # the paper's model, and the stem above the leaf: the data ask for nothing more
    std = np.sqrt(np.diag(result.covariance))
    assert np.all(np.abs(result.x - made.x[:7]) < WITHIN_STD * std)
    assert np.all(std < [0.05, 0.3, 1.0, 0.6, 0.2, 0.06, 0.3])
    assert result.status is Status.AT_REST
    assert result.flags == ()
    np.testing.assert_allclose(result.estimate.noise[:2], 0.3, rtol=0.05)
    np.testing.assert_allclose(result.pose, made.pose, atol=0.3)


def test_intervals_are_those_of_the_covariance(result):
    for i, (low, high) in enumerate(result.parameter_intervals.values()):
        std = np.sqrt(result.covariance[i, i])
        assert (low, high) == pytest.approx((result.x[i] - 1.96 * std, result.x[i] + 1.96 * std), abs=2e-3 * std)
    for trait in result.traits:
        assert trait.low < trait.value < trait.high
        assert trait.method == "likelihood, 95 % sandwich interval"
    diameter = next(t for t in result.traits if t.name == "stem_diameter")  # the same thing as parameter and as trait
    space, i = result.species.space, result.species.space.index("stem_diameter")
    std = np.hypot(np.sqrt(result.covariance[i, i]), space.parameters[i].discrepancy * result.x[i])
    ends = diameter.value - 1.96 * std, diameter.value + 1.96 * std
    assert (diameter.low, diameter.high) == pytest.approx(ends, abs=2e-3 * std)


def test_a_rotated_copy_has_the_same_fit(made, result):
    turn = phytofit.simulation.random_pose(np.random.default_rng(1))
    moved = phytofit.fit(made.points @ turn[:3, :3].T + turn[:3, 3], "cm", threads=2)
    np.testing.assert_allclose(moved.x, result.x, atol=SAME_CM)
    np.testing.assert_allclose(moved.pose, turn @ result.pose, atol=SAME_CM)


def test_same_seed_same_result_with_any_number_of_threads(made, result):
    alone = phytofit.fit(made.points, "cm", threads=1)
    np.testing.assert_array_equal(alone.x, result.x)
    np.testing.assert_array_equal(alone.covariance, result.covariance)


def test_millimetres_and_relative_lengths(made, result):
    in_mm = phytofit.fit(made.points * 10.0, "mm", threads=2)
    np.testing.assert_allclose(in_mm.x, result.x, atol=SAME_CM)
    relative = phytofit.fit(made.points * 0.1, "none", threads=2)
    length = next(t for t in relative.traits if t.name == "leaf_length")
    assert length.unit == "rel"
    assert length.value == pytest.approx(0.1 * values(result)["leaf_length"], rel=0.01)
    assert length.low < length.value < length.high


def test_a_leaf_that_no_paper_draws_is_fitted_with_more_parameters():
    shape = {
        "leaf_side_bend": 35.0,
        "leaf_twist": -60.0,
        "leaf_bow": 12.0,
        "leaf_base_width": 0.5,
        "leaf_widest_at": 0.4,
    }
    real = phytofit.simulate(fixed=GENTLE | shape, n_points=N_POINTS, noise_cm=0.3, seed=5)
    found = phytofit.fit(real.points, "cm", up=real.pose[:3, 2], threads=2)
    assert len(found.x) == len(phytofit.load_species().space)
    names = phytofit.models.Phytomer.PARAMETERS
    for name, value in shape.items():
        i = names.index(name)
        assert abs(abs(found.x[i]) - abs(value)) < WITHIN_STD * np.sqrt(found.covariance[i, i]), name
    true = {t.name: t.value for t in phytofit.measure(real.organs)}
    for name in ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter"):
        trait = next(t for t in found.traits if t.name == name)
        assert abs(trait.value - true[name]) < WITHIN_STD * (trait.high - trait.low) / (2 * 1.96), name


def test_outliers_are_told_apart(made, result):
    random = np.random.default_rng(0)
    stray = phytofit.simulation.add_outliers(made.points, 0.3, random)
    among = phytofit.fit(np.concatenate([made.points, stray]), "cm", threads=2)
    assert among.estimate.share[2] == pytest.approx(0.3 / 1.3, abs=0.04)
    assert says(among, "does not explain 2")
    assert values(among)["leaf_length"] == pytest.approx(values(result)["leaf_length"], abs=1.0)


def test_labels_decide_where_points_count(made):
    cloud = phytofit.from_points(made.points, "cm", labels=made.labels)
    labelled = phytofit.fit(cloud, threads=2)
    share = np.mean(made.labels == 1)
    assert labelled.estimate.share[0] == pytest.approx(share, abs=0.01)
    std = np.sqrt(np.diag(labelled.covariance))
    assert np.all(np.abs(labelled.x - made.x[:7]) < WITHIN_STD * std)


def test_correlated_errors_widen_the_intervals(made, result):
    clean = phytofit.simulate(fixed=GENTLE, n_points=N_POINTS, noise_cm=0.0, seed=3)
    near = np.linalg.norm(clean.points[:, np.newaxis] - clean.points, axis=2) < 2.0
    smooth = near @ np.random.default_rng(0).standard_normal(clean.points.shape) / np.sqrt(near.sum(1))[:, np.newaxis]
    rough = phytofit.fit(clean.points + 0.3 * smooth, "cm", threads=2)
    assert rough.estimate.inflation > 3.0
    assert result.estimate.inflation == 1.0
    assert rough.estimate.correlated_cm == pytest.approx(1.5, abs=1.0)
    assert rough.covariance[0, 0] > 4.0 * result.covariance[0, 0]


def test_six_parameters(made):
    plain = phytofit.simulate(fixed=GENTLE | {"stem_length_above": 0.0}, n_points=N_POINTS, noise_cm=0.3, seed=4)
    six = phytofit.fit(plain.points, "cm", stem_above="none", threads=2)
    assert len(six.x) == 6
    assert np.all(np.abs(six.x - plain.x[:6]) < WITHIN_STD * np.sqrt(np.diag(six.covariance)))


# flags


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_missing_tip_is_flagged_and_opens_the_upper_end(made, share):
    cut = without(made, on_leaf(made) & (along(made) > 1.0 - share))
    assert "tip_unseen" in cut.flags
    length = next(t for t in cut.traits if t.name == "leaf_length")
    assert length.high is None
    true = {t.name: t.value for t in phytofit.measure(made.organs)}["leaf_length"]
    assert length.low < true
    assert cut.estimate.seen == pytest.approx(1.0 - share, abs=0.05)


def test_a_leaf_mostly_hidden_is_flagged(made):
    place = along(made)
    hidden = without(made, on_leaf(made) & (place > 0.15) & (place < 0.75))
    assert "leaf_mostly_unseen" in hidden.flags


def test_few_points_on_the_stem_are_flagged(made):
    stem = np.flatnonzero(made.labels == 1)
    gone = np.zeros(len(made.points), bool)
    gone[np.random.default_rng(0).permutation(stem)[40:]] = True
    try:
        bare = without(made, gone)
    except phytofit.NoPhytomerError:
        return
    assert "stem_few_points" in bare.flags


def test_a_stem_seen_from_one_side_is_flagged(made):
    local = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    one_sided = without(made, (made.labels == 1) & (local[:, 1] > 0.2))
    assert "stem_one_sided" in one_sided.flags


def test_much_noise_is_flagged():
    rough = phytofit.simulate(fixed=GENTLE, n_points=N_POINTS, noise_cm=1.4, seed=6)
    assert "much_noise" in phytofit.fit(rough.points, "cm", threads=2).flags


def test_a_narrow_leaf_in_much_noise_is_flagged():
    narrow = phytofit.simulate(fixed=GENTLE | {"leaf_width": 0.8}, n_points=N_POINTS, noise_cm=0.5, seed=7)
    assert "leaf_edge_on" in phytofit.fit(narrow.points, "cm", threads=2).flags


def bounded(name, **bounds):
    species = phytofit.load_species()
    i = species.space.index(name)
    narrow = [dataclasses.replace(p, **bounds) if j == i else p for j, p in enumerate(species.space.parameters)]
    ranges = species.ranges.copy()
    ranges[i] = np.clip(ranges[i], narrow[i].lower, narrow[i].upper)
    return dataclasses.replace(species, space=phytofit.parameters.ParameterSpace(narrow), ranges=ranges)


def test_a_parameter_at_its_bound_is_flagged(made):
    species = bounded("leaf_length", upper=50.0, mean=45.0)
    found = phytofit.fit(made.points, "cm", species=species, threads=2)
    assert says(found, "leaf_length is at the limit of the species")
    assert {t.name for t in found.traits if "at_limit" in t.flags} == {"leaf_length", "leaf_area"}


def test_an_angle_of_a_leafs_own_shape_at_its_bound_is_flagged():
    aside = phytofit.simulate(fixed=GENTLE | {"leaf_side_bend": 45.0}, n_points=N_POINTS, noise_cm=0.3, seed=7)
    found = phytofit.fit(aside.points, "cm", species=bounded("leaf_side_bend", upper=20.0), threads=2)
    assert says(found, "leaf_side_bend is at the limit of the species, 20 deg")
    assert {t.organ for t in found.traits if "shape_at_limit" in t.flags} == {"leaf"}
    assert "shape_at_limit" not in phytofit.fit(aside.points, "cm", threads=2).flags


def test_a_cloud_without_noise_is_fitted():
    clean = phytofit.simulate(fixed=GENTLE, n_points=N_POINTS, noise_cm=0.0, seed=8)
    found = phytofit.fit(clean.points, "cm", threads=2)
    assert found.status is Status.AT_REST
    assert any("had no noise" in note for note in found.notes)
    np.testing.assert_allclose(found.x[:7], clean.x[:7], atol=0.5)


def no_phytomers():
    """Clouds that hold none, 3,000 points each, cm."""
    random = np.random.default_rng(3)
    ball = random.standard_normal((3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    angle = random.uniform(0, 2 * np.pi, 3000)
    tube = np.stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), random.uniform(0, 30, 3000)], axis=1)
    return {
        "sphere": 20.0 * ball,
        "small sphere": 5.0 * ball,
        "bare stem": tube,
        "blade": random.uniform(-1, 1, (800, 3)) * [30.0, 3.0, 0.1],
    }


@pytest.mark.parametrize("shape", no_phytomers())
def test_a_cloud_with_no_phytomer_is_refused(shape):
    """More of them, and what is said, in test_no_phytomer.py."""
    points = phytofit.simulation.add_noise(no_phytomers()[shape], 0.5, np.random.default_rng(1))
    with pytest.raises(phytofit.NoPhytomerError):
        phytofit.fit(points, "cm", threads=2)


@needs_data
@pytest.mark.parametrize(
    "name", ["0003", "0006", *(pytest.param(name, marks=pytest.mark.long) for name in ("0007", "0015_occl1"))]
)
def test_real_phytomers_are_measured_near_the_hand(name):
    """Loose on purpose: that the right thing is measured, not how well (that is benchmarks/trust.py)."""
    hand = {"0003": (74.0, 51.7), "0006": (68.5, 61.8), "0007": (64.4, 72.9), "0015_occl1": (67.4, 75.0)}[name]
    cloud = phytofit.read_cloud(DATA / "greenhouse" / f"{name}.ply", "mm" if "occl" in name else "cm")
    found = values(phytofit.fit(cloud, threads=2))
    assert found["leaf_length"] == pytest.approx(hand[1], rel=0.12)
    assert found["leaf_angle"] == pytest.approx(hand[0], abs=15.0)


@needs_data
@pytest.mark.long
@pytest.mark.parametrize("path", sorted(DATA.rglob("*.ply")), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_every_cloud_of_the_paper_in_three_orientations(path):
    cloud = phytofit.read_cloud(path, "mm" if "0015" in path.stem else "cm")
    given = phytofit.fit(cloud)
    for seed in range(3):
        turn = phytofit.simulation.random_pose(np.random.default_rng(seed))
        turned = dataclasses.replace(cloud, points=cloud.points @ turn[:3, :3].T + turn[:3, 3])
        assert values(phytofit.fit(turned))["leaf_length"] == pytest.approx(values(given)["leaf_length"], abs=2.0)


def beside(result, length_cm, probability):
    """The result, where with some probability its leaf is so much longer."""
    longer = result.x.copy()
    longer[3] += length_cm
    other = Alternative(probability, result.species.space, replace(result.estimate, x=longer))
    return replace(result, estimate=replace(result.estimate, alternatives=(other,)))


def test_two_solutions_are_told(result):
    """Where another estimate is about as probable, and its traits lie beyond the intervals; not where they lie
    within, or hardly may be."""
    assert result.estimate.alternatives == ()
    (one,) = (it for it in beside_its_rival(beside(result, 10.0, 0.4)).remarks if it.code == "two_fits")
    assert one.text.startswith("two fits are about equally probable: leaf_length may be ")
    assert float(one.text.split()[9]) == pytest.approx(values(result)["leaf_length"] + 10.0, abs=0.5)
    assert "leaf_length" in one.traits
    assert "stem_diameter" not in one.traits
    assert "two_fits" not in beside_its_rival(beside(result, 10.0, 0.05)).flags
    assert beside_its_rival(beside(result, 0.0, 0.4)).remarks == beside_its_rival(result).remarks == ()


@pytest.mark.parametrize("probability", [0.1, 0.6])
def test_the_same_estimate_again_changes_no_interval(result, probability):
    """Whatever an interval allows for, that of the other estimate does too: here all that can be allowed for."""
    made = replace(result.estimate, misfit_cm=0.3, width_misfit=0.05, blunt=True, tip_seen=False, ends_at=0.97)
    alone = replace(result, estimate=made)
    both = beside(alone, 0.0, probability)
    for one, other in zip(alone.traits, both.traits, strict=True):
        assert other.low == pytest.approx(one.low, rel=1e-9)
        assert (other.high is None) == (one.high is None)
        assert one.high is None or other.high == pytest.approx(one.high, rel=1e-9)
    for name, ends in alone.parameter_intervals.items():
        assert both.parameter_intervals[name] == pytest.approx(ends, rel=1e-9)


@pytest.mark.parametrize("probability", [0.01, 0.3, 0.5])
def test_intervals_reach_as_far_as_two_estimates_differ(result, probability):
    """In the root mean square, to the side where the other lies; other traits hardly change."""
    both = beside(result, 10.0, probability)
    alone, mixed = ({t.name: t for t in it.traits} for it in (result, both))
    above = mixed["leaf_length"].high - mixed["leaf_length"].value
    assert above > result.estimate.quantile * 10.0 * np.sqrt(probability)
    assert mixed["leaf_length"].low == pytest.approx(alone["leaf_length"].low, abs=0.5)
    assert mixed["stem_diameter"].high == pytest.approx(alone["stem_diameter"].high, rel=1e-3)
    low, high = both.parameter_intervals["leaf_length"]
    assert high - both.parameters["leaf_length"] > both.parameters["leaf_length"] - low


def test_the_same_bytes_however_many_threads_blas_may_use(tmp_path):
    """More threads round sums in another order, and a leaf with a shape of its own takes another path by that."""
    script = tmp_path / "fit.py"
    script.write_text(
        "import phytofit\n"
        "shape = {'leaf_bow': 15.0, 'leaf_side_bend': 30.0, 'leaf_base_width': 0.5, 'leaf_length': 60.0}\n"
        "made = phytofit.simulate(fixed=shape, n_points=2000, noise_cm=0.3, seed=5)\n"
        "print(phytofit.fit(made.points, 'cm', threads=2).x.tobytes().hex())\n"
    )
    said = {
        subprocess.run(
            [sys.executable, script],
            env={**os.environ, "OPENBLAS_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)},
            capture_output=True,
            check=True,
        ).stdout
        for threads in (1, 2)
    }
    assert len(said) == 1
