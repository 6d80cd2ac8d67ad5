"""What is no phytomer is refused, with a sentence that says what it is; what is one never is."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import phytofit
import phytofit.simulation
from phytofit.engine.unexplained import on_something_else
from phytofit.results.review import MUCH_ELSEWHERE, reviewed

SEEDS = st.integers(0, 2**32 - 1)
FIXED = {"leaf_length": 50.0, "leaf_angle": 50.0, "leaf_width": 6.0, "stem_diameter": 3.0, "stem_length": 15.0}


# what lies on something else


@given(SEEDS, st.integers(0, 3000), st.floats(0.01, 100.0))
def test_points_that_lie_anywhere_lie_on_nothing(seed, n, size):
    points = np.random.default_rng(seed).uniform(0.0, size, (n, 3))
    assert np.count_nonzero(on_something_else(points, 1.0 / size**3)) <= 0.01 * n + 5.0 * np.sqrt(0.01 * n)


@given(SEEDS, st.floats(0.01, 100.0), st.integers(0, 2000))
def test_points_on_a_sheet_lie_on_something_whatever_lies_around(seed, size, n_around):
    """A sheet of a third of the cube's side; scale and rotation change nothing."""
    random = np.random.default_rng(seed)
    around = random.uniform(-0.5, 0.5, (n_around, 3))
    sheet = random.uniform(-0.17, 0.17, (400, 3)) * [1.0, 1.0, 0.01]
    turned = Rotation.random(random_state=random).apply(np.concatenate([sheet, around]))
    crowded = on_something_else(size * turned, 1.0 / size**3)
    assert np.mean(crowded[:400]) > 0.9
    assert np.array_equal(crowded, on_something_else(turned, 1.0))


# fits


@pytest.fixture(scope="module")
def made():
    return phytofit.simulate(fixed=FIXED, n_points=1000, noise_cm=0.3, random_orientation=False, seed=4)


@pytest.fixture(scope="module")
def fitted(made):
    return phytofit.fit(made.points, "cm", threads=2)


def with_another_leaf(made, lower=4.0, turn=180.0, every=1):
    """Points and labels of the phytomer with a second leaf, labelled 3, of which every so-many-th point is there."""
    leaf = made.points[made.labels == 2][::every]
    other = Rotation.from_euler("z", turn, degrees=True).apply(leaf) - [0.0, 0.0, lower]
    return np.concatenate([made.points, other]), np.append(made.labels, np.full(len(other), 3))


def others(made):
    random = np.random.default_rng(5)
    box = np.random.default_rng(2).uniform(-20.0, 20.0, (3000, 3))  # in it a line looks like a stem, by chance
    return {
        "leaf alone": made.points[made.labels == 2],
        "stem alone": made.points[made.labels == 1],
        "two leaves on a stem": with_another_leaf(made)[0],
        "two phytomers": np.concatenate([made.points, made.points + np.array([40.0, 10.0, 3.0])]),
        "box of noise": box,
        "wall": random.uniform(0.0, 1.0, (3000, 3)) * [40.0, 30.0, 0.2],
        "line": random.uniform(0.0, 1.0, (500, 3)) * [40.0, 0.0, 0.0] + random.normal(0.0, 0.1, (500, 3)),
        "lattice": np.sqrt(2.0) * np.stack(np.meshgrid(*[np.arange(10.0)] * 3), axis=-1).reshape(-1, 3),
    }


SENTENCE = {
    "two leaves on a stem": "more than one leaf",
    "two phytomers": "more than one leaf",
}


@pytest.mark.parametrize(
    "kind",
    ["leaf alone", "stem alone", "two leaves on a stem", "two phytomers", "box of noise", "wall", "line", "lattice"],
)
def test_what_is_no_phytomer_is_refused_with_a_plain_sentence(made, kind):
    cloud = phytofit.PointCloud(others(made)[kind])
    with pytest.raises(phytofit.NoPhytomerError, match=SENTENCE.get(kind, "stem|leaf")) as refused:
        phytofit.fit(cloud, threads=2)
    assert "--" not in str(refused.value)
    if kind in SENTENCE:
        assert "measure a whole plant with phytofit.run, or give a seed point" in str(refused.value)


def test_a_phytomer_among_outliers_and_without_a_piece_is_measured(made):
    """Of the points a third is of no organ; 6 cm of the leaf's middle are missing."""
    whole = np.linalg.norm(made.points - made.organs[1].axis[12], axis=1) > 3.0
    points = np.concatenate(
        [made.points[whole], phytofit.simulation.add_outliers(made.points, 0.5, np.random.default_rng(0))]
    )
    found = phytofit.fit(points, "cm", threads=2)
    assert found.estimate.sighting.elsewhere < 0.25 * MUCH_ELSEWHERE
    assert "other_surfaces" not in found.flags
    assert next(t.value for t in found.traits if t.name == "leaf_length") == pytest.approx(48.0, abs=2.0)


def test_labels_of_several_leaves_are_those_of_a_plant(made):
    points, labels = with_another_leaf(made)
    with pytest.raises(phytofit.NoPhytomerError, match="the labels name 2 leaves, expected one"):
        phytofit.fit(phytofit.from_points(points, "cm", labels=labels))


def test_labels_of_a_stub_beside_the_leaf_are_fitted(made):
    points, labels = with_another_leaf(made, every=30)
    found = phytofit.fit(phytofit.from_points(points, "cm", labels=labels), threads=2)
    assert next(t.value for t in found.traits if t.name == "leaf_length") == pytest.approx(48.0, abs=2.0)


def test_a_fit_that_leaves_the_labelled_leaf_over_is_poor(made):
    """A second leaf without a label may be of any organ, and is fitted here in place of the one that has its label."""
    points, labels = with_another_leaf(made)
    cloud = phytofit.from_points(points, "cm", labels=np.where(labels == 3, 0, labels))
    found = phytofit.fit(cloud, threads=2)
    blade = found.organs[1].axis
    left_over = np.linalg.norm(made.points[made.labels == 2][:, np.newaxis] - blade, axis=2).min(axis=1) > 5.0
    assert ("other_surfaces" in found.flags) == (np.mean(left_over) > 0.5)


def test_what_is_labelled_as_the_leaf_and_lies_on_another_makes_every_trait_poor(made):
    points, labels = with_another_leaf(made)
    cloud = phytofit.from_points(points, "cm", labels=np.where(labels == 3, 2, labels))
    found = phytofit.fit(cloud, threads=2)
    assert all("other_surfaces" in t.flags and t.quality == "poor" for t in found.traits)


def test_what_a_seed_point_leaves_of_others_makes_every_trait_poor(made):
    found = phytofit.fit(made.points, "cm", seed_point=made.organs[1].axis[12], threads=2)
    assert "other_surfaces" not in found.flags
    seen = dataclasses.replace(found.estimate.sighting, elsewhere=0.3)
    crowded = reviewed(dataclasses.replace(found, estimate=dataclasses.replace(found.estimate, sighting=seen)))
    assert all("other_surfaces" in t.flags and t.quality == "poor" for t in crowded.traits)
    assert any("30 % of the points lie on surfaces" in one.text for one in crowded.remarks)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("stem_diameter", 8.0, "no stem in this cloud: .* 8 cm thick, far thicker than a stem of sorghum"),
        ("leaf_length", 5.0, "no leaf in this cloud: .* as short as a leaf of sorghum can be, 5 cm"),
    ],
)
def test_what_is_too_large_for_a_stem_or_too_short_for_a_leaf_is_none(fitted, name, value, said):
    x = fitted.x.copy()
    x[fitted.species.space.index(name)] = value
    with pytest.raises(phytofit.NoPhytomerError, match=said):
        reviewed(dataclasses.replace(fitted, x=x))
    reviewed(dataclasses.replace(fitted, x=x), labelled=True)  # then it is known what is stem and leaf


def test_without_a_unit_no_stem_is_too_thick(fitted):
    x = fitted.x.copy()
    x[0] = 8.0
    assert reviewed(dataclasses.replace(fitted, x=x, relative=True)).flags
