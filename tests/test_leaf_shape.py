"""What real leaves do and the paper's model does not: the parameters of the phytomer after the seventh."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from phytofit.models import STEM, Phytomer, move

EXACT = 1e-12  # relative or cm; a few sums in float64
ANGLE = 1e-9  # degrees; an arc cosine near 1 loses digits
ROTATION = 1e-9  # frames are products of three rotations
QUARTER = 0.03  # of the greatest: the wave's extreme lies at 0.21 of the midrib, not at 0.25

NAMES = Phytomer.PARAMETERS
LOW_SHAPE = [-80.0, -60.0, -90.0, -270.0, 0.1, 0.05, 0.3, 0.5, -30.0, 1.0, -0.02, -60.0]
HIGH_SHAPE = [80.0, 60.0, 90.0, 270.0, 1.3, 0.9, 6.0, 1.5, 40.0, 4.0, 0.02, 60.0]
X = np.array(
    [3.2, 14.0, 42.0, 54.0, 6.5, 3.4, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 2.0, 1.0, 0.0, 1.0, 0.0, 0.0]
)
LOW = np.array([*[0.5, 2.0, 5.0, 10.0, 1.0, -6.0, 0.1, 0.0, -40.0, -20.0], *LOW_SHAPE])
HIGH = np.array([*[5.0, 25.0, 150.0, 80.0, 9.0, 6.0, 20.0, 1.5, 40.0, 20.0], *HIGH_SHAPE])

SHAPES = arrays(np.float64, (22,), elements=st.floats(0, 1), fill=st.nothing()).map(lambda u: LOW + u * (HIGH - LOW))


def grow(x, **constants):
    return [organ.row(0) for organ in Phytomer(**constants).organs(x)]


def shaped(x=X, **values):
    """The leaf of x with other values of some parameters."""
    x = x.copy()
    for name, value in values.items():
        x[NAMES.index(name)] = value
    return grow(x)[1]


def heading(leaf):
    """Degrees of every segment from +z in the x-z plane, and out of that plane, towards +y."""
    tangent = leaf.frame[:, :, 0]
    return np.rad2deg(np.arctan2(tangent[:, 0], tangent[:, 2])), np.rad2deg(np.arcsin(tangent[:, 1]))


def turned_about_the_midrib(leaf, other):
    """Degrees by which each segment's blade of the one is turned about its tangent against the other's."""
    between = np.swapaxes(other.frame, 1, 2) @ leaf.frame
    np.testing.assert_allclose(between[:, 0, 0], 1.0, atol=ROTATION)  # the tangents are the same
    return np.rad2deg(np.unwrap(np.arctan2(between[:, 2, 1], between[:, 1, 1])))


def assert_same(organs, others, atol):
    for organ, other in zip(organs, others, strict=True):
        assert organ.kind == other.kind
        ends = slice(None)
        if len(organ.axis) != len(other.axis):  # a stem of one diameter, in one piece and in three
            assert organ.kind == STEM
            assert np.ptp(organ.half_width) == np.ptp(other.half_width) == 0.0
            ends = [0, -1]
        np.testing.assert_allclose(organ.axis[ends], other.axis[ends], rtol=0, atol=atol)
        np.testing.assert_allclose(organ.half_width[ends], other.half_width[ends], rtol=0, atol=atol)
        np.testing.assert_allclose(organ.frame[ends], other.frame[ends], rtol=0, atol=atol)


# all of them


def test_neutral_values_are_those_of_the_constants():
    neutral = Phytomer(widest_share=0.3, concavity=1.5).neutral
    assert neutral.shape == (len(NAMES),) == (22,)
    assert len(Phytomer.UNITS) == 22
    assert np.all(np.isnan(neutral[:6]))  # the paper's have none
    np.testing.assert_array_equal(neutral[6:], [0.0] * 8 + [1.0, 0.3, 1.5, 1.0, 0.0, 1.0, 0.0, 0.0])


@given(SHAPES, st.integers(6, 22), st.sampled_from([0.3, 0.5, 0.62]), st.floats(1.0, 3.0))
def test_neutral_values_give_the_papers_organs(x, given_parameters, widest, concavity):
    """However many of them are left out."""
    constants = {"widest_share": widest, "concavity": concavity}
    full = np.concatenate([x[:7], Phytomer(**constants).neutral[7:]])
    if given_parameters == 6:
        full[6] = 0.0
    assert_same(grow(full[:given_parameters], **constants), grow(full, **constants), 0.0)
    assert_same(grow(full[: min(given_parameters, 7)], **constants), grow(full, **constants), 0.0)


def test_neutral_values_give_a_leaf_that_starts_at_the_axis_and_stays_level_in_a_plane():
    leaf = shaped()
    np.testing.assert_allclose(leaf.axis[0], [0.0, 0.0, X[1]], atol=EXACT)
    np.testing.assert_array_equal(leaf.axis[:, 1], 0.0)
    np.testing.assert_array_equal(leaf.frame[:, :, 1], np.tile([0.0, 1.0, 0.0], (30, 1)))
    np.testing.assert_allclose(leaf.half_width[:16], X[4] / 2, rtol=EXACT)


@given(SHAPES)
def test_frames_are_right_handed_rotations_along_the_midrib(x):
    stem, leaf = grow(x)
    for organ in (stem, leaf):
        products = np.swapaxes(organ.frame, 1, 2) @ organ.frame
        np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=ROTATION)
        np.testing.assert_allclose(np.linalg.det(organ.frame), 1.0, atol=ROTATION)
        along = np.diff(organ.axis, axis=0) / organ.segment_lengths[:, np.newaxis]
        np.testing.assert_allclose(organ.frame[:, :, 0], along, atol=ROTATION)
    np.testing.assert_allclose(leaf.segment_lengths, x[3] / 30, rtol=ROTATION)  # whatever its shape


@given(SHAPES)
def test_widths_are_those_of_a_leaf(x):
    """None below 0, the widest at most as stated or as its base, a tip of no width."""
    _, leaf = grow(x)
    half, base = 0.5 * x[4], x[NAMES.index("leaf_base_width")]
    assert np.all(leaf.half_width >= 0.0)
    assert leaf.half_width.max() <= half * max(1.0, base) * (1.0 + EXACT)
    assert leaf.half_width[-1] == 0.0
    np.testing.assert_allclose(leaf.half_width[0], half * base, rtol=1e-9)


@given(arrays(np.float64, (4, 22), elements=st.floats(0, 1)).map(lambda u: LOW + u * (HIGH - LOW)))
def test_a_population_is_its_plants_one_by_one(xs):
    stem, leaf = Phytomer().organs(xs)
    for i, x in enumerate(xs):
        assert_same([stem.row(i), leaf.row(i)], grow(x), 1e-10)


@given(SHAPES)
def test_upside_down_is_the_same_plant(x):
    turn, offset, pose = Phytomer().upside_down(x)
    twin = turn @ x + offset
    stem, leaf = move(grow(twin), pose)
    expected_stem, expected_leaf = grow(x)
    np.testing.assert_allclose(stem.axis[::-1], expected_stem.axis, atol=1e-9)
    np.testing.assert_allclose(stem.half_width[::-1], expected_stem.half_width, rtol=EXACT)
    np.testing.assert_allclose(leaf.axis, expected_leaf.axis, atol=1e-9)
    np.testing.assert_allclose(leaf.half_width, expected_leaf.half_width, atol=EXACT)
    np.testing.assert_allclose(leaf.frame[:, :, 0], expected_leaf.frame[:, :, 0], atol=ROTATION)
    np.testing.assert_allclose(leaf.frame[:, :, 1:], -expected_leaf.frame[:, :, 1:], atol=ROTATION)  # seen from below
    assert leaf.fold == -expected_leaf.fold
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(pose), 1.0, rtol=EXACT)
    again, back, pose_back = Phytomer().upside_down(twin)
    np.testing.assert_allclose(again @ twin + back, x, atol=1e-9)
    np.testing.assert_allclose(pose @ pose_back, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("k", range(7, 23))
def test_upside_down_with_any_number_of_parameters(k):
    """As with all of them, and the others neutral."""
    x = X.copy()
    x[7:k] = (0.3 * LOW + 0.7 * HIGH)[7:k]
    turn, offset, pose = Phytomer().upside_down(x[:k])
    assert (turn.shape, offset.shape, pose.shape) == ((k, k), (k,), (4, 4))
    all_turn, all_offset, all_pose = Phytomer().upside_down(x)
    np.testing.assert_array_equal(turn @ x[:k] + offset, (all_turn @ x + all_offset)[:k])
    np.testing.assert_array_equal(pose, all_pose)


# one by one


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0, 1.5])
def test_the_collar_is_offset_by_a_share_of_the_radius(share):
    """Towards the side that the leaf leans to; the rest of the leaf goes with it, and the stem stays."""
    leaf = shaped(collar_offset=share)
    np.testing.assert_allclose(leaf.axis - shaped().axis, np.tile([share * 1.6, 0.0, 0.0], (31, 1)), atol=1e-10)
    x = X.copy()
    x[7] = share
    assert_same(grow(x)[:1], grow(X)[:1], 0.0)


@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.4])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_an_offset_of_1_is_the_surface_whatever_the_stem_is_like_above(ratio, share):
    x = X.copy()
    x[7], x[NAMES.index("stem_diameter_above")] = share, ratio
    stem, leaf = grow(x)
    x0, y0, height = leaf.axis[0]
    assert (x0, y0) == (pytest.approx(share * np.interp(height, stem.axis[:, 2], stem.half_width)), 0.0)


@pytest.mark.parametrize("degrees", [-60.0, 0.1, 25.0, 80.0])
def test_side_bend_turns_the_tip_sideways(degrees):
    """By that angle out of the upright plane, evenly from the base on, and not down."""
    pitch, yaw = heading(shaped(leaf_side_bend=degrees))
    np.testing.assert_allclose(yaw, degrees * np.arange(30) / 29, atol=ANGLE)
    np.testing.assert_allclose(pitch, heading(shaped())[0], atol=ANGLE)


@pytest.mark.parametrize("degrees", [-30.0, 12.0])
def test_side_bow_turns_the_middle_sideways(degrees):
    pitch, yaw = heading(grow([*X[:11], degrees, *X[12:]], n_pieces=31)[1])  # piece 16 is in the middle
    np.testing.assert_allclose(yaw[[0, 15, 30]], [0.0, degrees, 0.0], atol=ANGLE)
    assert np.all(np.diff(np.abs(yaw))[:15] > 0)
    np.testing.assert_allclose(yaw, yaw[::-1], atol=ANGLE)
    np.testing.assert_allclose(pitch, heading(grow(X, n_pieces=31)[1])[0], atol=ANGLE)


@pytest.mark.parametrize("degrees", [-30.0, 12.0])
def test_bow_points_the_middle_lower(degrees):
    even, bowed = (heading(grow([*X[:8], value, *X[9:]], n_pieces=31)[1]) for value in (0.0, degrees))
    lower = bowed[0] - even[0]  # farther from the vertical
    np.testing.assert_allclose(lower[[0, 15, 30]], [0.0, degrees, 0.0], atol=ANGLE)
    np.testing.assert_allclose(lower, lower[::-1], atol=ANGLE)
    np.testing.assert_allclose(bowed[1], 0.0, atol=ANGLE)


def test_wave_points_a_quarter_lower_and_three_quarters_higher():
    waved, even = (heading(grow([*X[:9], value, *X[10:]], n_pieces=101)[1])[0] for value in (10.0, 0.0))
    lower = waved - even
    np.testing.assert_allclose(lower[[0, 50, 100]], 0.0, atol=ANGLE)
    np.testing.assert_allclose(lower[[25, 75]], [10.0, -10.0], rtol=QUARTER)
    np.testing.assert_allclose(lower, -lower[::-1], atol=ANGLE)
    assert np.abs(lower).max() == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize("degrees", [-20.0, 30.0])
def test_base_bend_turns_the_midrib_down_close_to_its_start(degrees):
    """The first segment keeps its angle; two thirds of the bend are done after a twentieth of the leaf, and all of it
    is there over most of it."""
    lower = heading(grow([*X[:18], degrees], n_pieces=101)[1])[0] - heading(grow(X, n_pieces=101)[1])[0]
    assert lower[0] == pytest.approx(0.0, abs=ANGLE)
    assert lower[5] == pytest.approx(degrees * (1.0 - np.exp(-1.0)), rel=1e-9)
    np.testing.assert_allclose(lower[30:], degrees, rtol=3e-3)


@pytest.mark.parametrize("degrees", [-70.0, 25.0])
def test_roll_turns_the_whole_blade_about_its_midrib(degrees):
    bent = shaped(leaf_side_bend=30.0)
    rolled = shaped(leaf_side_bend=30.0, leaf_roll=degrees)
    np.testing.assert_allclose(turned_about_the_midrib(rolled, bent), degrees, atol=ANGLE)
    np.testing.assert_allclose(rolled.axis, bent.axis, atol=1e-10)
    np.testing.assert_array_equal(rolled.half_width, bent.half_width)


@pytest.mark.parametrize("degrees", [-200.0, 60.0, 270.0])
def test_twist_turns_the_last_blade_about_its_midrib(degrees):
    """And the others evenly less, the first not at all."""
    bent = shaped(leaf_side_bend=30.0, leaf_roll=-15.0)
    twisted = shaped(leaf_side_bend=30.0, leaf_roll=-15.0, leaf_twist=degrees)
    np.testing.assert_allclose(turned_about_the_midrib(twisted, bent), degrees * np.arange(30) / 29, atol=ANGLE)
    np.testing.assert_allclose(twisted.axis, bent.axis, atol=1e-10)


@pytest.mark.parametrize("base", [0.2, 0.7, 1.3])
def test_base_width_is_a_share_of_the_widest(base):
    """From there the width comes to the widest as a quarter of a sine, and beyond it nothing changes."""
    half, plain = shaped(leaf_base_width=base).half_width, shaped().half_width
    assert half[0] == pytest.approx(base * X[4] / 2, rel=EXACT)
    np.testing.assert_allclose(half[15:], plain[15:], rtol=EXACT)
    rise = (half[:16] - half[0]) / (half[15] - half[0])
    np.testing.assert_allclose(rise, np.sin(0.5 * np.pi * np.arange(16) / 15), atol=1e-9)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.41, 0.9])
def test_widest_at_is_where_the_leaf_begins_to_taper(share):
    """As the constant of the model; at a share that falls between two nodes too."""
    leaf = shaped(leaf_widest_at=share, leaf_base_width=0.5)
    before = int(share * 30 + 1e-9)
    assert np.all(np.diff(leaf.half_width)[:before] > 0)
    assert np.all(np.diff(leaf.half_width)[before + 1 :] < 0)
    assert abs(np.argmax(leaf.half_width) - share * 30) < 1.0
    np.testing.assert_array_equal(
        shaped(leaf_widest_at=share).half_width, grow(X[:7], widest_share=share)[1].half_width
    )


@pytest.mark.parametrize("taper", [1.0, 1.7, 3.0])
def test_taper_is_the_concavity_of_the_equation(taper):
    np.testing.assert_array_equal(shaped(leaf_taper=taper).half_width, grow(X[:7], concavity=taper)[1].half_width)


def test_a_higher_taper_keeps_the_leaf_wide_for_longer():
    widths = [shaped(leaf_taper=taper).half_width[16:-1] for taper in (0.3, 1.0, 3.0, 6.0)]
    assert np.all(np.diff(widths, axis=0) > 0)


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
def test_shoulder_is_a_power_of_the_way_from_the_widest_place_to_the_tip(power):
    """Where Eq. (2) has the width of a share r of that way, the leaf has it at r to the power 1 / shoulder."""
    fine = {"n_pieces": 3000}
    half, plain = (grow([*X[:19], value, X[20]], **fine)[1].half_width for value in (power, 1.0))
    r = (np.arange(3001) - 1500) / 1500
    at = np.array([0.1, 0.4, 0.8, 0.95])
    np.testing.assert_allclose(np.interp(at ** (1.0 / power), r, half), np.interp(at, r, plain), rtol=1e-3)
    np.testing.assert_array_equal(half[:1501], plain[:1501])
    assert half[-1] == 0.0


@pytest.mark.parametrize("ratio", [0.7, 1.0])
@pytest.mark.parametrize("taper", [-0.05, 0.03, 0.1])
def test_taper_of_the_stem_is_what_its_diameter_loses_upwards(taper, ratio):
    """Cm per cm, half-way below the leaf, where it is the stem's diameter; it falls by the same share with each cm,
    above the leaf there is another, and a leaf that starts at its surface does so."""
    x = X.copy()
    x[[7, NAMES.index("stem_diameter_above"), NAMES.index("stem_taper")]] = 1.0, ratio, taper
    stem, leaf = grow(x)
    height = stem.axis[:, 2]
    expected = x[0] * (1.0 - taper / x[0]) ** (height - x[1] / 2) * np.where(height > x[1], ratio, 1.0)
    np.testing.assert_allclose(2.0 * stem.half_width, expected, rtol=0.02)  # compounded by the cm
    close = np.interp([x[1] / 2 - 0.01, x[1] / 2 + 0.01], height, stem.half_width)
    assert -np.diff(close)[0] / 0.01 == pytest.approx(taper, rel=0.05)
    assert height[0] == 0.0
    assert height[-1] == pytest.approx(x[1] + x[6])
    assert np.all(np.diff(height) > 0.0)
    at_leaf = np.interp(x[1], height, stem.half_width)
    assert leaf.axis[0, 0] == pytest.approx(at_leaf, rel=0.01)


@pytest.mark.parametrize("taper", [0.3, -0.2])
def test_a_stem_never_tapers_to_nothing(taper):
    x = X.copy()
    x[[0, NAMES.index("stem_taper")]] = 0.5, taper
    stem, _ = grow(x)
    assert 0.5 * 0.5 * np.exp(-2.0) <= stem.half_width.min() < stem.half_width.max() <= 0.5 * 0.5 * np.exp(2.0)


@given(SHAPES)
def test_plants_near_one_are_upside_down_near_its_twin(x):
    """To first order: the slopes by differences of the twins themselves."""
    turn, _, _ = Phytomer().upside_down(x)
    step = 1e-6
    for i in range(len(x)):
        both = [x + sign * step * (np.arange(len(x)) == i) for sign in (1.0, -1.0)]
        there, back = (turned @ near + offset for near in both for turned, offset, _ in [Phytomer().upside_down(near)])
        np.testing.assert_allclose((there - back) / (2.0 * step), turn[:, i], rtol=1e-4, atol=1e-5)
