"""The noun and its cleaning, against closed forms and brute force."""

import dataclasses
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from phytofit.cloud import PointCloud, from_points, read_cloud, remove_outliers, size_cm, thin
from phytofit.errors import CloudError, SettingError, UnitError

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real clouds in ../shared/data")

ROUNDING_CM = 1e-9  # of sums of a few thousand coordinates below 1 m

seeds = st.integers(0, 2**32 - 1)
rotations = seeds.map(lambda seed: Rotation.random(rng=np.random.default_rng(seed)).as_matrix())


def leaf(n_points: int = 400, seed: int = 0) -> np.ndarray:
    """A curved strip, 40 cm long and 4 cm wide, away from the origin."""
    along, across = np.random.default_rng(seed).random((2, n_points))
    return np.stack([40 * along + 5, 4 * across - 7, 10 * along * (1 - along) + 3], axis=1)


def reasonable_clouds(min_points: int, max_points: int) -> st.SearchStrategy[np.ndarray]:
    """Clouds with copies, ties, planes and lines among them."""
    coordinates = st.one_of(st.integers(-9, 9).map(float), st.floats(-50, 50, width=32))
    return st.integers(min_points, max_points).flatmap(lambda n: arrays(np.float64, (n, 3), elements=coordinates))


# from_points


@pytest.mark.parametrize(("units", "factor"), [("mm", 0.1), ("cm", 1.0), ("m", 100.0), ("none", 1.0)])
def test_lengths_become_centimetres(units: str, factor: float) -> None:
    cloud = from_points(leaf() / factor, units)
    np.testing.assert_allclose(cloud.points, leaf(), atol=ROUNDING_CM)
    assert (cloud.unit, cloud.name, cloud.source, cloud.notes, len(cloud)) == (units, "cloud", None, (), 400)
    assert cloud.labels is cloud.normals is cloud.colors is None
    np.testing.assert_allclose(cloud.to_input_frame(cloud.points), leaf() / factor, rtol=1e-12)


def test_arrays_are_read_only_copies() -> None:
    given_points, given_labels = leaf(), np.arange(400)
    cloud = from_points(given_points, "cm", labels=given_labels)
    given_points[:], given_labels[:] = 0, 0
    assert cloud.points.max() > 1
    assert cloud.labels is not None
    assert cloud.labels[7] == 7
    with pytest.raises(ValueError, match="read-only"):
        cloud.points[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        cloud.labels[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        cloud.name = "other"  # type: ignore[misc]


def test_rows_that_are_not_finite_go_with_all_they_carry() -> None:
    points = leaf()
    points[3, 1], points[10, 0], points[399] = np.nan, np.inf, -np.inf
    labels = np.arange(400.0)
    labels[3] = np.nan
    colors = np.stack([np.arange(400) % 256] * 3, axis=1)
    with pytest.warns(UserWarning, match=r"^leaf: 3 non-finite points dropped$") as caught:
        cloud = from_points(points, "cm", labels=labels, normals=points, colors=colors, name="leaf")
    assert len(caught) == 1
    kept = np.delete(np.arange(400), [3, 10, 399])
    np.testing.assert_array_equal(cloud.points, leaf()[kept])
    np.testing.assert_array_equal(cloud.labels, kept)
    np.testing.assert_array_equal(cloud.normals, leaf()[kept])
    np.testing.assert_array_equal(cloud.colors, colors[kept])
    assert cloud.notes[0] == "3 non-finite points dropped"


def test_normals_that_are_not_finite_are_unknown() -> None:
    normals = np.tile([0.0, np.nan, np.inf], (400, 1))
    np.testing.assert_array_equal(from_points(leaf(), "cm", normals=normals).normals, np.zeros((400, 3)))


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ([0, 128, 255], [0, 128, 255]),
        ([0, 1, 1], [0, 1, 1]),
        ([0.0, 0.5, 1.0], [0, 128, 255]),
        ([0, 257 * 128, 65535], [0, 128, 255]),
        ([np.nan, -3, 300.0], [0, 0, 1]),
    ],
)
def test_colors_are_bytes(color: list[float], expected: list[int]) -> None:
    colors = from_points(leaf(), "cm", colors=np.tile(color, (400, 1))).colors
    assert colors is not None
    assert colors.dtype == np.uint8
    assert colors[0].tolist() == expected


@pytest.mark.parametrize("units", ["cm", "none"])
def test_map_coordinates_lose_their_offset_and_no_precision(units: str) -> None:
    map_origin = np.array([4.5e7 + 0.25, -5.4e8, 12.0])
    cloud = from_points(leaf() + map_origin, units)
    np.testing.assert_array_equal(cloud.offset, np.floor((leaf() + map_origin).min(axis=0)))
    assert (cloud.points >= 0).all()
    assert (cloud.points.min(axis=0) < 1).all()
    np.testing.assert_allclose(cloud.points + cloud.offset, leaf() + map_origin, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (leaf()[:, :2], "cloud: expected points of shape (n, 3), got (400, 2); is this a 2-D export?"),
        (leaf().ravel(), "cloud: expected points of shape (n, 3), got (1200,)"),
        (leaf()[None], "cloud: expected points of shape (n, 3), got (1, 400, 3)"),
        ([["a", "b", "c"]], "cloud: expected points of shape (n, 3), got something else: "),
        ([[1, 2, 3], [4, 5]], "cloud: expected points of shape (n, 3), got something else: "),
        (np.full((120, 3), np.nan), "cloud: none of its 120 points is finite; was the scan empty?"),
        (leaf(99), "cloud: found 99 points, at least 100 are needed to fit; is this the whole cloud?"),
        (np.empty((0, 3)), "cloud: found 0 points, at least 100 are needed to fit; is this the whole cloud?"),
        (np.full((120, 3), 0.1), "cloud: all 120 points are equal; was it exported with too few digits?"),
        (leaf() * 1e300, "cloud: coordinates reach 4.49e+301, expected a plant's size; is the file damaged?"),
    ],
)
def test_what_is_no_cloud_is_refused(points: np.ndarray, message: str) -> None:
    for units in ("cm", "none", None):
        with pytest.raises(CloudError, match="^" + re.escape(message)) as caught:
            from_points(points, units)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"labels": np.ones(399)}, "cloud: expected labels for 400 points, got shape (399,)"),
        ({"labels": np.full(400, 1.5)}, "cloud: found the label 1.5, expected whole numbers (0 unknown, 1 stem, 2.."),
        ({"labels": np.full(400, 2.0**40)}, "cloud: found the label 1.09951e+12, expected whole numbers"),
        ({"labels": ["stem"] * 400}, "cloud: expected numbers as labels, got something else: "),
        ({"labels": np.ones((400, 2))}, "cloud: expected labels of shape (400,), got (400, 2)"),
        ({"normals": np.ones((400, 2))}, "cloud: expected normals of shape (400, 3), got (400, 2)"),
        ({"colors": np.ones((3, 3))}, "cloud: expected colors for 400 points, got shape (3, 3)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(arrays: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(CloudError, match="^" + re.escape(message)):
        from_points(leaf(), "cm", **arrays)


def cloud_of_size(size: float) -> np.ndarray:
    """A ring in a plane, so that the size is exact."""
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    return size / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


@pytest.mark.parametrize(
    ("size", "units", "message"),
    [
        (
            79.1,
            None,
            "leaf: no unit given; the cloud is 79.1 cm across if in cm, 7.9 cm if in mm, 7910 cm if in m; "
            "state its unit: mm, cm, m, or none for relative lengths",
        ),
        (79.1, "inch", "leaf: unknown unit 'inch'; state its unit: mm, cm, m, or none for relative lengths"),
        (79.1, "", "leaf: unknown unit ''; state its unit: mm, cm, m, or none for relative lengths"),
        (
            791,
            "cm",
            "leaf: the cloud is 791.0 cm across if in cm, expected 10 to 250 cm; "
            "if in mm it is 79.1 cm; state its unit: mm, cm, m, or none for relative lengths",
        ),
        (
            0.791,
            "mm",
            "leaf: the cloud is 0.0791 cm across if in mm, expected 10 to 250 cm; "
            "if in m it is 79.1 cm; state its unit: mm, cm, m, or none for relative lengths",
        ),
        (
            5,
            "cm",
            "leaf: the cloud is 5.0 cm across if in cm, expected 10 to 250 cm; "
            "no other unit fits either; is it one plant, without stray points?; "
            "state its unit: mm, cm, m, or none for relative lengths",
        ),
    ],
)
def test_a_missing_or_wrong_unit_is_refused(size: float, units: str | None, message: str) -> None:
    with pytest.raises(UnitError, match="^" + re.escape(message) + "$"):
        from_points(cloud_of_size(size), units, name="leaf")


def test_the_plausible_size_is_a_setting_and_not_for_relative_lengths() -> None:
    assert from_points(cloud_of_size(5), "cm", plausible_cm=(1, 9)).unit == "cm"
    assert size_cm(from_points(cloud_of_size(1e-3), "none").points) == pytest.approx(1e-3)


# PointCloud


@given(seed=seeds)
def test_take_carries_every_array(seed: int) -> None:
    random = np.random.default_rng(seed)
    cloud = PointCloud(
        leaf(), np.arange(400), leaf(seed=1), random.integers(0, 256, (400, 3)), "a", Path("a.ply"), "mm", np.ones(3)
    )
    mask = random.random(400) < 0.5
    by_mask, by_index = cloud.take(mask), cloud.take(np.flatnonzero(mask))
    for key in ("points", "labels", "normals", "colors"):
        np.testing.assert_array_equal(getattr(by_mask, key), getattr(cloud, key)[mask])
        np.testing.assert_array_equal(getattr(by_mask, key), getattr(by_index, key))
    assert (by_mask.name, by_mask.source, by_mask.unit) == ("a", Path("a.ply"), "mm")
    np.testing.assert_array_equal(by_mask.offset, np.ones(3))
    assert len(cloud.take(np.zeros(400, dtype=bool))) == 0


def test_notes_add_up() -> None:
    cloud = PointCloud(leaf())
    assert cloud.with_note("one").with_note("two").notes == ("one", "two")
    assert cloud.notes == ()


@pytest.mark.parametrize(
    "arrays",
    [{"points": np.ones((4, 2))}, {"labels": [1]}, {"normals": np.ones((3, 3))}, {"offset": [0.0]}],
    ids=str,
)
def test_shapes_are_checked(arrays: dict[str, np.ndarray]) -> None:
    with pytest.raises(CloudError, match=r"^cloud: expected \w+ of shape "):
        PointCloud(**({"points": np.ones((4, 3))} | arrays))


# points that share a place


@given(seed=seeds, copies=st.integers(2, 5))
def test_exact_copies_are_one_point_with_what_the_first_carries(seed: int, copies: int) -> None:
    random = np.random.default_rng(seed)
    points, order = leaf(150, seed), random.permutation(150 * copies) % 150
    order = np.concatenate([np.arange(150), order[order < 100]])
    cloud = from_points(points[order], "cm", labels=np.concatenate([np.arange(150), np.full(len(order) - 150, -7)]))
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.labels, np.arange(150))
    assert cloud.notes[0] == f"{len(order) - 150} exact copies of points dropped"


@pytest.mark.parametrize("n_stacked", [1, 9, 10, 500])
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (-9.99, 250.0, 3.0)])
def test_a_stack_of_points_is_dropped_and_said(n_stacked: int, at: tuple[float, float, float]) -> None:
    points = np.concatenate([leaf(200), np.tile(at, (n_stacked, 1)), leaf(200, 1)])
    labels = np.concatenate([np.full(200, 1), np.zeros(n_stacked), np.full(200, 2)])
    if n_stacked < 10:
        assert len(from_points(points, "none", labels=labels)) == 401
        return
    where = ", ".join(f"{value:g}" for value in at)
    note = (
        f"{n_stacked} points stacked at ({where}) dropped: no surface, most likely places where the sensor saw nothing"
    )
    with pytest.warns(UserWarning, match=f"^cloud: {re.escape(note)}$"):
        cloud = from_points(points, "cm", labels=labels)
    np.testing.assert_array_equal(cloud.points, np.concatenate([leaf(200), leaf(200, 1)]))
    np.testing.assert_array_equal(cloud.labels, [1] * 200 + [2] * 200)
    assert cloud.notes[0] == note


def test_a_cloud_each_of_whose_points_is_repeated_has_no_stacks() -> None:
    cloud = from_points(np.repeat(leaf(150), 40, axis=0), "cm")
    np.testing.assert_array_equal(cloud.points, leaf(150))


@pytest.mark.parametrize(
    ("units", "digits", "step"), [("m", 2, 1.0), ("cm", 0, 1.0), ("mm", -1, 1.0), ("none", 0, 1.0)]
)
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_coordinates_with_few_digits_keep_their_copies_and_lose_their_steps(
    units: str, digits: int, step: float, kind: type
) -> None:
    points = leaf(3000)
    scale = {"m": 100, "cm": 1, "mm": 0.1, "none": 1}[units]
    rounded = np.round(points / scale, digits).astype(kind)
    with pytest.warns(
        UserWarning, match=r"^cloud: coordinates are in steps of .*: digits are missing; export it with m"
    ):
        cloud = from_points(rounded, units)
    assert len(cloud) == 3000
    np.testing.assert_allclose(cloud.step, step, rtol=1e-5)
    spread = cloud.unrounded()
    assert np.abs(spread.points - cloud.points).max() <= step / 4
    assert len(np.unique(spread.points, axis=0)) == 3000
    assert np.std(spread.points - points, axis=0) == pytest.approx(step * np.sqrt(1.25 / 12), rel=0.05)
    order = np.random.default_rng(0).permutation(3000)
    again = cloud.take(order).unrounded().points
    assert {*map(tuple, again.tolist())} == {*map(tuple, spread.points.tolist())}


@pytest.mark.parametrize("digits", [1, 3, 9])
def test_coordinates_with_enough_digits_stay_as_they_are(digits: int) -> None:
    cloud = from_points(np.round(leaf(400), digits), "cm")
    assert not cloud.step.any()
    assert cloud.unrounded() is cloud


def test_map_coordinates_in_single_precision_say_what_is_missing() -> None:
    corner = np.array([512_345.0, 412_345.0, 321.0])
    note = (
        r"coordinates are in steps of 0.0312 m \(map coordinates in single precision\): digits are missing; subtract an"
    )
    with pytest.warns(UserWarning, match=note):
        from_points((leaf(3000) / 100 + corner).astype(np.float32), "m")
    refused = (
        r"^cloud: coordinates are in steps of 0.5 m .*, so that 3000 points share \d+ positions; subtract an offset"
    )
    with pytest.raises(CloudError, match=refused):
        from_points((leaf(3000) / 100 + 10 * corner).astype(np.float32), "m")
    assert from_points(leaf(3000) / 100 + corner, "m").notes == ()


def test_a_regular_lattice_passes_all_that_comes_before_a_fit() -> None:
    axis = np.linspace(0, 26.9, 12)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    with pytest.warns(UserWarning, match="in steps of 2.45 cm"):
        cloud = from_points(lattice, "cm")
    assert len(cloud) == 12**3
    assert remove_outliers(cloud.points).mean() > 0.9
    assert 100 <= len(thin(cloud.points, 500)) <= 12**3


# remove_outliers


def brute_force_excess(points: np.ndarray, n_neighbors: int, std_ratio: float) -> np.ndarray:
    """Mean neighbour distance minus the limit; positive: an outlier."""
    distances = np.sort(cdist(points, points), axis=1)[:, 1 : n_neighbors + 1].mean(axis=1)
    return distances - distances.mean() - std_ratio * distances.std()


@settings(deadline=None, max_examples=25)
@given(points=reasonable_clouds(2, 60), n_neighbors=st.integers(1, 70), std_ratio=st.floats(0.1, 6), rotation=rotations)
def test_outliers_against_brute_force_and_rotated(
    points: np.ndarray, n_neighbors: int, std_ratio: float, rotation: np.ndarray
) -> None:
    excess = brute_force_excess(points, n_neighbors, std_ratio)
    assume((np.abs(excess) > 1e-6).all())  # cdist and the tree round differently
    np.testing.assert_array_equal(remove_outliers(points, n_neighbors=n_neighbors, std_ratio=std_ratio), excess < 0)
    moved = 3.7 * points @ rotation.T + [30, -40, 50]
    np.testing.assert_array_equal(remove_outliers(moved, n_neighbors=n_neighbors, std_ratio=std_ratio), excess < 0)


def test_stray_points_go_and_the_leaf_stays() -> None:
    stray = np.array([[60.0, 0, 0], [0, 0, 60], [20, 20, 20]])
    keep = remove_outliers(np.concatenate([leaf(3000), stray]))
    assert not keep[3000:].any()
    assert keep[:3000].mean() > 0.99


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.ones((1, 3)),
        leaf(2),
        np.full((500, 3), 0.1),
        cloud_of_size(30) @ Rotation.from_euler("xyz", [1, 2, 3]).as_matrix(),
    ],
    ids=["none", "one", "two", "copies", "ring"],
)
def test_an_even_cloud_is_kept_whole(points: np.ndarray) -> None:
    keep = remove_outliers(points)
    assert keep.dtype == np.bool_
    assert keep.shape == (len(points),)
    assert keep.all()


@pytest.mark.parametrize("setting", [{"n_neighbors": 0}, {"std_ratio": 0.0}, {"std_ratio": float("nan")}], ids=str)
def test_outlier_settings_out_of_range(setting: dict[str, float]) -> None:
    with pytest.raises(SettingError, match="expected n_neighbors >= 1 and std_ratio > 0"):
        remove_outliers(leaf(), **setting)  # type: ignore[arg-type]


# thin


def n_voxels_by_hand(points: np.ndarray, edge: float) -> int:
    return len({tuple(np.floor(point / edge).astype(int)) for point in points})


@settings(deadline=None, max_examples=15)
@given(points=reasonable_clouds(0, 120), n_points=st.integers(1, 120))
def test_thin_returns_sorted_indices_and_small_clouds_whole(points: np.ndarray, n_points: int) -> None:
    index = thin(points, n_points)
    assert (np.diff(index) > 0).all()
    assert index.size == 0 or (index[0] >= 0 and index[-1] < len(points))
    np.testing.assert_array_equal(index, thin(points.copy(), n_points))
    if len(points) <= n_points:
        np.testing.assert_array_equal(index, np.arange(len(points)))
    else:
        assert index.size >= 1
        assert len(np.unique(points[index], axis=0)) == len(index)  # no copies: they share a voxel


@settings(deadline=None, max_examples=10)
@given(seed=seeds, n_points=st.integers(200, 1500), rotation=rotations)
def test_thin_meets_the_count(seed: int, n_points: int, rotation: np.ndarray) -> None:
    points = leaf(2000, seed) @ rotation.T
    assert abs(len(thin(points, n_points)) - n_points) <= 0.05 * n_points


@settings(deadline=None, max_examples=15)
@given(seed=seeds, n_points=st.integers(20, 200))
def test_thin_is_as_near_the_count_as_any_voxel_grid(seed: int, n_points: int) -> None:
    points = leaf(300, seed) - 20
    nearest = min(abs(n_voxels_by_hand(points, edge) - n_points) for edge in np.geomspace(0.05, 50, 60))
    assert abs(len(thin(points, n_points)) - n_points) <= max(1.5 * nearest, 0.05 * n_points)


@settings(deadline=None, max_examples=15)
@given(seed=seeds)
def test_thin_keeps_the_most_central_point_of_each_voxel(seed: int) -> None:
    random = np.random.default_rng(seed)
    centers = np.stack(np.meshgrid(*[np.arange(-3, 3) + 0.5] * 3), axis=-1).reshape(-1, 1, 3)
    clusters = centers + random.uniform(-1e-4, 1e-4, (216, 7, 3))
    away = np.linalg.norm(clusters - clusters.mean(axis=1, keepdims=True), axis=2)
    best, second = np.sort(away, axis=1)[:, :2].T
    assume((second - best > 1e-8).all())  # no ties
    order = random.permutation(216 * 7)
    central = np.flatnonzero(np.isin(order, 7 * np.arange(216) + away.argmin(axis=1)))
    np.testing.assert_array_equal(thin(clusters.reshape(-1, 3)[order], 216), central)


def test_thin_ties_go_to_the_first() -> None:
    pairs = np.repeat(np.arange(60.0), 2)
    points = np.stack([pairs + 0.1 + 0.3 * (np.arange(120) % 2), 0 * pairs, 0 * pairs], axis=1)
    np.testing.assert_array_equal(thin(points, 60), np.arange(0, 120, 2))


def test_thin_of_copies() -> None:
    assert thin(np.full((500, 3), 0.1), 100).tolist() == [0]
    stacked = np.repeat(leaf(50), 10, axis=0)
    assert thin(stacked, 100).tolist() == list(range(0, 500, 10))


def test_thin_far_from_the_origin() -> None:
    assert len(thin(leaf(3000) + 1e6, 1000)) == pytest.approx(1000, rel=0.05)


def test_thin_to_nothing_is_refused() -> None:
    with pytest.raises(SettingError, match=r"^thin: expected n_points >= 1, got 0$"):
        thin(leaf(), 0)


# size_cm


@given(points=reasonable_clouds(1, 40), rotation=rotations)
def test_size_bounds_the_diameter_and_does_not_turn(points: np.ndarray, rotation: np.ndarray) -> None:
    size, diameter = size_cm(points), cdist(points, points).max()
    assert diameter - ROUNDING_CM <= size <= 2 * diameter + ROUNDING_CM
    assert size_cm(points @ rotation.T + 10) == pytest.approx(size, abs=ROUNDING_CM)


def test_size_of_a_ring_and_of_nothing() -> None:
    assert size_cm(cloud_of_size(30)) == pytest.approx(30)
    assert size_cm(np.empty((0, 3))) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not np.isfinite(size_cm(leaf() * 1e300))


# real clouds


@needs_data
def test_real_clouds_keep_almost_all_and_thin_to_the_count() -> None:
    patterns = ("sodhi2018/greenhouse/0003.ply", "sodhi2018/field/01*.ply", "*/v-6-1*.txt", "trackplant3d/*/30*.txt")
    for path in [path for pattern in patterns for path in DATA.glob(pattern)]:
        points = read_cloud(path, "none").points
        assert remove_outliers(points).mean() > 0.99, path.name
        assert len(thin(points, 2000)) == pytest.approx(min(2000, len(points)), rel=0.05), path.name
