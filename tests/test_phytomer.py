"""The phytomer of section IV-B against closed forms of Eq. (1) and (2)."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from phytofit.models import LEAF, STEM, Phytomer, move
from phytofit.traits import measure

EXACT = 1e-12  # relative or cm; a few sums in float64
LENGTH_CM = 0.15  # a leaf of 70 cm, in twice the segments, is elsewhere when it leaves the stem
AREA_SHARE = 0.005  # half of it from the length, half from the finer width profile
CURVATURE_SHARE = 0.05  # n segments turn at n - 1 nodes: 29/30 against 59/60, and as much where the stem cuts one

X = np.array([3.2, 14.0, 42.0, 54.0, 6.5, 3.4, 5.0])  # stem diameter, length, leaf angle, length, width, bend, above


LOW = [0.5, 2.0, 5.0, 10.0, 1.0, -6.0, 0.0]
HIGH = [5.0, 25.0, 150.0, 80.0, 9.0, 6.0, 20.0]


def plants(k, n, low=LOW, high=HIGH):
    low, high = np.array(low[:k], float), np.array(high[:k], float)
    return arrays(np.float64, (n, k), elements=st.floats(0, 1)).map(lambda u: low + u * (high - low))


def grow(x, **constants):
    return [organ.row(0) for organ in Phytomer(**constants).organs(x)]


def angles_of(axis):
    """Degrees from +z towards +x, of every segment of an axis in the x-z plane."""
    step = np.diff(axis, axis=0)
    return np.rad2deg(np.arctan2(step[:, 0], step[:, 2]))


# Eq. (2)


@pytest.mark.parametrize("concavity", [1.0, 1.7, 2.0, 3.0])
@pytest.mark.parametrize("n_pieces", [4, 30, 31, 60])
def test_width_is_widest_at_the_base_and_none_at_the_tip(concavity, n_pieces):
    width = Phytomer(n_pieces=n_pieces, concavity=concavity).width_profile()[0]
    i = np.arange(n_pieces + 1)
    assert width.shape == (n_pieces + 1,)
    np.testing.assert_allclose(width[i <= n_pieces / 2], 1.0, rtol=EXACT)  # w_0 = w_max, up to r = 0
    assert width[-1] == 0.0  # r = 1
    tapered = width[i >= n_pieces / 2]
    assert np.all(np.diff(tapered) < 0)
    assert np.all(np.diff(tapered, 2) < 0)  # concave


def test_width_at_a_node_is_that_of_the_equation():
    """Node 24 of 30: r = (24 - 15) / (30 - 15) = 0.6."""
    k = 2.5
    expected = (k + math.log(1 - 0.6 + math.exp(-k))) / (k + math.log(1 + math.exp(-k)))
    assert Phytomer(concavity=k).width_profile()[0, 24] == pytest.approx(expected, rel=EXACT)


def test_a_higher_k_keeps_the_leaf_wide_for_longer():
    low, high = (Phytomer(concavity=k).width_profile()[0, 16:-1] for k in (1.0, 3.0))
    assert np.all(high > low)


def test_the_widest_part_may_end_at_the_base():
    width = Phytomer(widest_share=0.0, n_pieces=10).width_profile()[0]
    assert width[0] == pytest.approx(1.0, rel=EXACT)
    assert np.all(np.diff(width) < 0)


# Eq. (1)


def test_angles_of_the_midrib():
    """X3 is the angle of the first piece, X6 is added a piece, and X6/2 over the last 20 %: pieces 25 to 30."""
    _, leaf = grow(X)
    piece = np.arange(1, 31)
    expected = np.where(piece <= 24, X[2] + (piece - 1) * X[5], X[2] + 23 * X[5] + (piece - 24) * X[5] / 2)
    np.testing.assert_allclose(angles_of(leaf.axis), expected, rtol=EXACT)


@pytest.mark.parametrize("n_pieces", [5, 10, 30, 35, 60, 100, 155])
def test_the_slow_fifth_is_a_fifth_of_any_number_of_pieces(n_pieces):
    steps = np.diff(Phytomer(n_pieces=n_pieces).midrib_angles(np.array([30.0]), np.array([6.0]))[0])
    bend = 6.0 * 30 / n_pieces
    slow = n_pieces // 5
    np.testing.assert_allclose(steps[-slow:], bend / 2, rtol=1e-9)
    np.testing.assert_allclose(steps[:-slow], bend, rtol=1e-9)


@given(plants(7, 1))
def test_lengths_widths_and_places(xs):
    diameter, below, _, length, width, _, above = xs[0]
    stem, leaf = grow(xs)
    assert (stem.kind, leaf.kind) == (STEM, LEAF)
    np.testing.assert_allclose(leaf.segment_lengths, length / 30, rtol=1e-9)
    np.testing.assert_allclose(2 * leaf.half_width.max(), width, rtol=EXACT)
    np.testing.assert_allclose(leaf.axis[0], [0.0, 0.0, below], atol=EXACT)
    np.testing.assert_allclose(stem.axis[[0, -1]], [[0.0, 0.0, 0.0], [0.0, 0.0, below + above]], atol=EXACT)
    np.testing.assert_allclose(2 * stem.half_width, diameter, rtol=EXACT)
    np.testing.assert_allclose(leaf.axis[:, 1], 0.0, atol=EXACT)
    np.testing.assert_allclose(np.abs(leaf.frame[:, 1, 1]), 1.0, rtol=EXACT)  # level across


@given(plants(7, 1))
def test_areas(xs):
    """The stem a cylinder, the leaf trapezoids between the widths at the nodes."""
    diameter, below, _, length, width, _, above = xs[0]
    stem, leaf = grow(xs)
    assert stem.area == pytest.approx(math.pi * diameter * (below + above), rel=1e-9)
    share = Phytomer().width_profile()[0]
    trapezoids = sum(0.5 * (share[i] + share[i + 1]) for i in range(30)) / 30
    assert leaf.area == pytest.approx(length * width * trapezoids, rel=1e-9)


def test_patches_are_rectangles_then_trapezoids_then_a_triangle():
    _, leaf = grow(X)
    change = np.diff(leaf.half_width)
    np.testing.assert_allclose(change[:15], 0.0, atol=EXACT)
    assert np.all(change[15:] < 0)
    assert leaf.half_width[-1] == 0.0


def test_a_straight_leaf():
    _, leaf = grow([3.0, 15.0, 40.0, 60.0, 6.0, 0.0])
    np.testing.assert_allclose(
        leaf.axis[-1],
        [60 * math.sin(math.radians(40)), 0.0, 15 + 60 * math.cos(math.radians(40))],
        rtol=1e-9,
        atol=EXACT,
    )


def test_the_stem_above_is_optional():
    six, seven = grow(X[:6]), grow([*X[:6], 0.0])
    for a, b in zip(six, seven, strict=True):
        np.testing.assert_array_equal(a.axis, b.axis)
        np.testing.assert_array_equal(a.half_width, b.half_width)
    assert six[0].axis[-1, 2] == X[1]
    assert grow(X)[0].axis[-1, 2] == X[1] + X[6]
    np.testing.assert_array_equal(grow(X)[1].axis, six[1].axis)  # the leaf stays where it was


@pytest.mark.parametrize("k", [6, 7])
@given(data=st.data())
def test_a_population_is_its_plants_one_by_one(k, data):
    xs = data.draw(plants(k, data.draw(st.integers(1, 5))))
    for organ, alone in zip(Phytomer().organs(xs), zip(*[Phytomer().organs(x) for x in xs], strict=True), strict=True):
        assert organ.axis.shape[0] == len(xs)
        for i, one in enumerate(alone):
            np.testing.assert_allclose(organ.row(i).axis, one.row(0).axis, atol=EXACT * 100)
            np.testing.assert_allclose(organ.row(i).frame, one.row(0).frame, atol=EXACT * 100)
            np.testing.assert_allclose(organ.row(i).half_width, one.row(0).half_width, atol=EXACT)


@pytest.mark.parametrize("k", [6, 7])
def test_no_plants(k):
    stem, leaf = Phytomer().organs(np.zeros((0, k)))
    assert (stem.axis.shape, leaf.axis.shape) == ((0, 2, 3), (0, 31, 3))
    assert leaf.area.shape == (0,)


@given(plants(7, 1))
def test_frames_are_rotations_along_the_axis(xs):
    for organ in grow(xs):
        frame = organ.frame
        products = frame @ np.swapaxes(frame, -1, -2)
        np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-9)
        along = np.diff(organ.axis, axis=0) / organ.segment_lengths[:, np.newaxis]
        np.testing.assert_allclose(frame[:, :, 0], along, atol=1e-9)


@given(plants(7, 1, low=[2, 10, 30, 40, 4, 3, 0], high=[5, 20, 60, 70, 8, 4, 12]))
def test_twice_the_segments_give_the_same_traits(xs):
    """Over the ranges of section V."""
    coarse, fine = ({t.name: t.value for t in measure(grow(xs, n_pieces=n))} for n in (30, 60))
    bend = xs[0, 5]
    for name in ("stem_diameter", "stem_length", "leaf_width"):
        assert fine[name] == pytest.approx(coarse[name], rel=EXACT)
    # the paper gives the first segment the angle X3; half as long, it lets the bend begin a quarter of X6 sooner
    assert fine["leaf_angle"] == pytest.approx(coarse["leaf_angle"], abs=0.30 * bend)
    assert fine["leaf_insertion_angle"] == pytest.approx(coarse["leaf_insertion_angle"], abs=0.55 * bend)
    assert fine["leaf_length"] == pytest.approx(coarse["leaf_length"], abs=LENGTH_CM)
    assert fine["leaf_area"] == pytest.approx(coarse["leaf_area"], rel=AREA_SHARE)
    assert fine["leaf_curvature"] == pytest.approx(coarse["leaf_curvature"], rel=CURVATURE_SHARE)


@given(plants(7, 1))
def test_upside_down_is_the_same_plant(xs):
    x = xs[0]
    turn, offset, pose = Phytomer().upside_down(x)
    stem, leaf = move(grow(turn @ x + offset), pose)
    np.testing.assert_allclose(stem.axis[::-1], grow(x)[0].axis, atol=1e-9)
    np.testing.assert_allclose(leaf.axis, grow(x)[1].axis, atol=1e-9)
    np.testing.assert_allclose(leaf.half_width, grow(x)[1].half_width, atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(pose), 1.0, atol=EXACT)
    again, back, _ = Phytomer().upside_down(turn @ x + offset)
    np.testing.assert_allclose(again @ (turn @ x + offset) + back, x, atol=1e-9)
