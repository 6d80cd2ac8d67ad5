"""Traits in closed form: straight and circular leaves on a stem, in any pose."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from phytofit.models import LEAF, STEM, Organ, Phytomer, move
from phytofit.models.organs import frames_along
from phytofit.traits import CHORD_CM, measure

EXACT = 1e-9  # relative; float64
ARC_CM = 1e-3  # of 400 straight segments instead of an arc of up to 80 cm
ARC_DEG = 0.15  # half the turn of one of these segments
ARC_CURVATURE = 0.01  # share; 400 segments turn at 399 nodes, and the stem hides part of one

Y = np.array([0.0, 1.0, 0.0])


def stem(radius=1.5, height=40.0):
    axis = np.array([[0, 0, 0], [0, 0, height]], float)
    return Organ(STEM, axis, frames_along(axis, Y), np.full(2, radius))


def leaf(axis, half_width=3.0):
    axis = np.asarray(axis, float)
    return Organ(LEAF, axis, frames_along(axis, Y), np.broadcast_to(half_width, len(axis)).astype(float))


def straight(degrees, length, pieces=30, height=15.0, half_width=3.0):
    s = np.linspace(0, length, pieces + 1)[:, np.newaxis]
    a = math.radians(degrees)
    return leaf([0, 0, height] + s * [math.sin(a), 0, math.cos(a)], half_width)


def arc(degrees, length, radius, pieces=400, height=15.0):
    """Midrib on a circle: its tangent starts at `degrees` from the stem and turns by s / radius."""
    a = math.radians(degrees)
    angle = a + np.linspace(0, length, pieces + 1) / radius
    x, z = radius * (math.cos(a) - np.cos(angle)), radius * (np.sin(angle) - math.sin(a))
    return leaf(np.stack([x, np.zeros_like(x), height + z], axis=1))


def values(*organs, **settings):
    return {trait.name: trait.value for trait in measure(organs, **settings)}


def rigid(seed):
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=random).as_matrix()
    pose[:3, 3] = random.uniform(-100, 100, 3)
    return pose


@given(st.floats(10, 170), st.floats(30, 80), st.floats(0.3, 2.0), st.integers(1, 60))
def test_straight_leaf(degrees, length, radius, pieces):
    """It leaves the stem's surface after r / sin(angle), whatever the number of segments."""
    inside = radius / math.sin(math.radians(degrees))
    found = values(stem(radius), straight(degrees, length, pieces))
    assert found["leaf_length"] == pytest.approx(length - inside, rel=EXACT)
    assert found["leaf_angle"] == pytest.approx(degrees, rel=1e-6)
    assert found["leaf_insertion_angle"] == pytest.approx(degrees, rel=1e-6)
    assert found["leaf_curvature"] == pytest.approx(0.0, abs=1e-5)
    assert found["leaf_width"] == pytest.approx(6.0, rel=EXACT)
    assert found["leaf_area"] == pytest.approx(6.0 * (length - inside), rel=EXACT)  # a rectangle


@given(st.floats(15, 60), st.floats(30, 60), st.floats(30, 90), st.floats(0.5, 2.0))
def test_circular_leaf(degrees, length, rho, radius):
    a = math.radians(degrees)
    inside = rho * (math.acos(math.cos(a) - radius / rho) - a)
    found = values(stem(radius, height=80.0), arc(degrees, length, rho))
    rest = length - inside
    assert found["leaf_length"] == pytest.approx(rest, abs=5 * ARC_CM)
    at_stem = degrees + math.degrees(inside / rho)
    chord = min(8.0, rest / 5)
    assert found["leaf_insertion_angle"] == pytest.approx(at_stem, abs=ARC_DEG)
    assert found["leaf_angle"] == pytest.approx(at_stem + math.degrees(chord / (2 * rho)), abs=ARC_DEG)
    assert found["leaf_curvature"] == pytest.approx(math.degrees(1 / rho), rel=ARC_CURVATURE)


@pytest.mark.parametrize(("rest", "chord"), [(60.0, 8.0), (40.0, 8.0), (30.0, 6.0), (10.0, 2.0), (1.0, 0.2)])
def test_leaf_angle_is_over_8_cm_or_a_fifth_of_a_shorter_leaf(rest, chord):
    """It leaves the stem at right angles and turns down on a circle from there: the chord turns half as much."""
    on_circle = arc(90.0, rest, 50.0).axis + np.array([1.6, 0.0, 0.0])
    found = values(stem(1.6), leaf(np.concatenate([[[0.0, 0.0, 15.0]], on_circle])))
    assert found["leaf_length"] == pytest.approx(rest, abs=ARC_CM)
    assert found["leaf_angle"] == pytest.approx(90 + math.degrees(chord / (2 * 50)), abs=1e-3)


def test_the_chord_is_a_setting():
    organs = stem(1.0), arc(30.0, 60.0, 40.0)
    angles = [values(*organs, chord_cm=c)["leaf_angle"] for c in (1.0, CHORD_CM, 11.0)]
    np.testing.assert_allclose(np.diff(angles), np.degrees([3.5 / 40, 1.5 / 40]), atol=ARC_DEG)
    assert values(*organs)["leaf_angle"] == angles[1]
    # no chord is longer than a fifth of the leaf
    assert values(*organs, chord_cm=50.0)["leaf_angle"] == values(*organs, chord_cm=12.0)["leaf_angle"]


def test_length_and_area_count_from_the_surface_of_the_stem():
    leaf_of = straight(90.0, 50.0)
    thin, thick = values(stem(0.5), leaf_of), values(stem(3.0), leaf_of)
    assert thin["leaf_length"] - thick["leaf_length"] == pytest.approx(2.5, rel=EXACT)
    assert thin["leaf_area"] - thick["leaf_area"] == pytest.approx(2.5 * 6, rel=EXACT)


def test_area_of_a_tapering_blade():
    """Half-width 4 at the base to 0 at the tip of 40 cm; the first 4 cm are inside the stem."""
    tapering = straight(90.0, 40.0, pieces=8, half_width=np.linspace(4.0, 0.0, 9))
    assert values(stem(4.0), tapering)["leaf_area"] == pytest.approx(36 * (2 * 3.6) / 2, rel=EXACT)


@pytest.mark.parametrize("off", [0.0, 1e-9, -1e-9])
def test_a_leaf_that_starts_on_the_surface_and_rises_along_it_is_whole(off):
    """5 cm up the stem's surface, then 20 cm straight away from it; rounding must not take the first 5."""
    line = np.array([[1.5 + off, 0.0, 5.0], [1.5 + off, 0.0, 10.0], [21.5 + off, 0.0, 10.0]])
    assert values(stem(1.5), leaf(line))["leaf_length"] == pytest.approx(25.0, rel=EXACT)
    inside = line - np.array([0.01, 0.0, 0.0])
    assert values(stem(1.5), leaf(inside))["leaf_length"] == pytest.approx(19.99, abs=0.2)  # a step


def test_a_stem_that_ends_at_the_leaf_ends_rounded():
    """Its end is taken as half a sphere, so an erect leaf leaves it after one radius and not never."""
    for degrees in (0.0, 20.0, 60.0):
        found = values(stem(1.5, height=15.0), straight(degrees, 50.0))
        assert found["leaf_length"] == pytest.approx(48.5, rel=EXACT)
        assert found["leaf_angle"] == pytest.approx(degrees, abs=1e-6)


@pytest.mark.parametrize("organ", [straight(90.0, 1.4), straight(1.0, 20.0, height=5.0)])
def test_a_leaf_that_never_leaves_the_stem(organ):
    found = values(stem(1.5), organ)
    assert found["leaf_length"] == 0.0
    assert found["leaf_area"] == 0.0
    assert found["leaf_width"] == pytest.approx(6.0)
    assert all(math.isnan(found[name]) for name in ("leaf_angle", "leaf_insertion_angle", "leaf_curvature"))


def test_a_leaf_that_starts_outside_the_stem_counts_from_its_base():
    axis = straight(60.0, 40.0).axis + np.array([5.0, 0.0, 0.0])
    found = values(stem(1.5), leaf(axis))
    assert found["leaf_length"] == pytest.approx(40.0, rel=EXACT)
    assert found["leaf_angle"] == pytest.approx(60.0, rel=EXACT)


def test_a_leaf_counts_from_where_it_first_leaves():
    """It hangs back through the stem: what matters is where it came out."""
    axis = [[0, 0, 30], [10, 0, 30], [10, 0, 20], [-10, 0, 20]]
    assert values(stem(2.0), leaf(axis))["leaf_length"] == pytest.approx(38.0, rel=EXACT)


@given(st.integers(0, 2**32 - 1), st.floats(-5, 5), st.floats(20, 120))
def test_traits_do_not_depend_on_the_pose(seed, bend, degrees):
    organs = [organ.row(0) for organ in Phytomer().organs([3.0, 15.0, degrees, 50.0, 6.0, bend, 6.0])]
    there = values(*move(organs, rigid(seed)))
    for name, value in values(*organs).items():
        assert there[name] == pytest.approx(value, rel=1e-7, abs=1e-6), name


def test_curvature_in_space_is_that_of_a_helix():
    """Radius 6 and rise 2 a radian: curvature 6 / (36 + 4)."""
    t = np.linspace(0, 5, 1001)
    helix = leaf(np.stack([6 * np.cos(t) + 20, 6 * np.sin(t), 2 * t + 10], axis=1))
    found = values(stem(), helix)
    assert found["leaf_length"] == pytest.approx(5 * math.sqrt(40), rel=1e-4)
    assert found["leaf_curvature"] == pytest.approx(math.degrees(6 / 40), rel=2e-3)


def test_an_s_shaped_leaf_turns_both_ways():
    """Turning counts whichever way: 30 degrees one way and 30 back are 60."""
    axis = np.array([[0, 0, 20], [10, 0, 20], [18.66, 0, 15], [28.66, 0, 15]])
    found = values(stem(1.0), leaf(axis))
    assert found["leaf_curvature"] * found["leaf_length"] == pytest.approx(60.0, abs=0.1)


@given(st.floats(10, 60), st.floats(30, 70), st.floats(-60, 60), st.integers(8, 40))
def test_twice_the_segments_give_the_same_traits(degrees, length, turn, pieces):
    """The same polyline with its segments halved; what turns at a node keeps turning there."""
    angle = np.deg2rad(degrees + np.linspace(0, turn, pieces))
    steps = length / pieces * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    coarse = np.cumsum(np.concatenate([[[0.0, 0.0, 15.0]], steps]), axis=0)
    fine = np.empty((2 * pieces + 1, 3))
    fine[::2], fine[1::2] = coarse, 0.5 * (coarse[1:] + coarse[:-1])
    one, two = values(stem(1.2), leaf(coarse)), values(stem(1.2), leaf(fine))
    for name in one:
        assert two[name] == pytest.approx(one[name], rel=1e-3, abs=1e-3, nan_ok=True), name


def test_stem_of_several_and_tapering_pieces():
    """6 cm tapering from 4 to 2 cm and 2 cm at 2 cm: (6 x 3 + 2 x 2) / 8."""
    axis = np.array([[0, 0, 0], [0, 0, 6], [0, 0, 8]], float)
    tapering = Organ(STEM, axis, frames_along(axis, Y), np.array([2.0, 1.0, 1.0]))
    found = values(tapering)
    assert set(found) == {"stem_diameter", "stem_length"}
    assert found["stem_diameter"] == pytest.approx(22 / 8, rel=EXACT)
    assert found["stem_length"] == pytest.approx(8.0, rel=EXACT)


def test_leaf_angle_is_from_the_piece_of_stem_that_carries_it():
    """A stem that leans by 30 degrees above 20 cm, and a level leaf on that part."""
    a = math.radians(30)
    axis = np.array([[0, 0, 0], [0, 0, 20], [20 * math.sin(a), 0, 20 + 20 * math.cos(a)]])
    leaning = Organ(STEM, axis, frames_along(axis, Y), np.ones(3))
    base = axis[1] + 0.5 * (axis[2] - axis[1])
    found = values(leaning, leaf(base + np.linspace(0, 30, 31)[:, np.newaxis] * [1.0, 0, 0]))
    assert found["leaf_angle"] == pytest.approx(60.0, abs=1e-6)


def test_leaves_are_ranked_from_the_base_and_named_with_units():
    traits = measure(
        [stem(), straight(40.0, 30.0, height=5.0), straight(60.0, 50.0, height=20.0)],
        method="cross-entropy",
    )
    assert [(t.organ, t.rank) for t in traits] == [(STEM, 0)] * 2 + [(LEAF, 1)] * 6 + [(LEAF, 2)] * 6
    assert {(t.method, t.quality, t.flags, t.low, t.high) for t in traits} == {("cross-entropy", "", (), None, None)}
    units = {t.name: t.unit for t in traits}
    assert units == {
        "stem_diameter": "cm",
        "stem_length": "cm",
        "leaf_length": "cm",
        "leaf_angle": "deg",
        "leaf_insertion_angle": "deg",
        "leaf_width": "cm",
        "leaf_curvature": "deg/cm",
        "leaf_area": "cm²",
    }
    angles = [t.value for t in traits if t.name == "leaf_angle"]
    np.testing.assert_allclose(angles, [40.0, 60.0], atol=1e-6)
