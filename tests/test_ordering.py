"""The order of a cloud's rows: one and the same after any permutation, and no number depends on it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import phytofit
from phytofit.ordering import canonical_order
from test_segmentation import cloud_of, plant

SEEDS = st.integers(0, 2**32 - 1)
SHAPES = st.sampled_from(["any", "grid", "copies", "line", "point", "far"])


def points_of(shape, random, n=80):
    """Some with ties: on a grid, every point three times, on a line, all in one place, as far from zero as maps are."""
    points = random.normal(0.0, [9.0, 4.0, 1.0], (n, 3)) ** 3
    return {
        "any": points,
        "grid": np.round(points),
        "copies": np.repeat(points, 3, axis=0),
        "line": points * [1.0, 0.0, 0.0],
        "point": np.ones_like(points),
        "far": points + np.array([4.5e7, -6.0e7, 3.0]),
    }[shape]


@given(SEEDS, SHAPES)
def test_points_in_any_order_come_out_in_the_same(seed, shape):
    random = np.random.default_rng(seed)
    points = points_of(shape, random)
    labels = random.integers(0, 3, len(points))
    order = canonical_order(points, labels)
    assert sorted(order) == list(range(len(points)))
    mixed = random.permutation(len(points))
    other = canonical_order(points[mixed], labels[mixed])
    assert points[order].tobytes() == points[mixed][other].tobytes()
    assert labels[order].tobytes() == labels[mixed][other].tobytes()
    assert points[canonical_order(points)].tobytes() == points[mixed][canonical_order(points[mixed])].tobytes()


@given(SEEDS, st.sampled_from(["any", "grid", "far"]), st.floats(1e-3, 1e3))
def test_a_turned_shifted_and_scaled_copy_comes_out_in_the_same(seed, shape, scale):
    random = np.random.default_rng(seed)
    points = np.unique(points_of(shape, random), axis=0)
    points -= points.mean(axis=0)
    turned = scale * Rotation.random(random_state=random).apply(points) + random.uniform(-50.0, 50.0, 3)
    mixed = random.permutation(len(points))
    np.testing.assert_array_equal(mixed[canonical_order(turned[mixed])], canonical_order(points))


@given(SEEDS)
def test_every_so_many_th_point_is_a_fair_sample(seed):
    """Of a leaf-like strip: neither its ends nor its sides are missed by a stride, as on a grid they might be."""
    random = np.random.default_rng(seed)
    points = random.uniform(0.0, 1.0, (2000, 3)) * [40.0, 4.0, 0.1]
    ordered = points[canonical_order(points)]
    for part in (ordered[::7], ordered[:300]):
        shares = np.histogram2d(part[:, 0], part[:, 1], bins=(4, 2), range=[[0.0, 40.0], [0.0, 4.0]])[0] / len(part)
        np.testing.assert_allclose(shares, 1.0 / 8.0, atol=0.08)


@pytest.fixture(scope="module")
def made():
    return phytofit.simulate(n_points=900, noise_cm=0.3, outlier_share=0.03, seed=11)


def numbers(result):
    """All that is stored of a fit."""
    errors = [result.covariance] if isinstance(result, phytofit.Fit) else []
    values = [result.x, *errors, result.pose, np.array([result.error])]
    values += [np.array([t.value, t.low or 0.0, t.high or 0.0]) for t in result.traits]
    values += [array for g in result.history for array in (g.mean, g.cov)]
    return b"".join(value.tobytes() for value in values), result.flags, result.notes


@pytest.mark.parametrize(
    ("method", "labelled"),
    [("likelihood", False), ("likelihood", True), ("paper", False)],
)
def test_rows_in_another_order_give_the_same_fit_to_the_last_bit(made, method, labelled):
    quick = {"method": method, "n_samples": 12, "n_generations": 2, "n_points": 700, "threads": 1}
    order = np.random.default_rng(0).permutation(len(made.points))
    one, other = (
        phytofit.fit(phytofit.from_points(made.points[i], "cm", labels=made.labels[i] if labelled else None), **quick)
        for i in (np.arange(len(order)), order)
    )
    assert numbers(one) == numbers(other)


def test_rows_in_another_order_give_the_same_organs():
    points, *_ = plant(n_leaves=3, n_points=3000)
    order = np.random.default_rng(0).permutation(len(points))
    one, other = phytofit.segment(cloud_of(points)), phytofit.segment(cloud_of(points[order]))
    np.testing.assert_array_equal(one.labels[order], other.labels)
    assert one.stem_path.tobytes() == other.stem_path.tobytes()
    assert len(one.leaves) == len(other.leaves) >= 2
    for leaf, same in zip(one.leaves, other.leaves, strict=True):
        assert leaf.midrib.tobytes() == same.midrib.tobytes()
        assert (leaf.length, leaf.azimuth, leaf.flags) == (same.length, same.azimuth, same.flags)
