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

from phytofit.cloud import PointCloud, from_points, remove_outliers, size_cm, thin
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
    assert cloud.notes == ("3 non-finite points dropped",)


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
@pytest.mark.parametrize("units", ["cm", "none", None])
def test_what_is_no_cloud_is_refused(points: np.ndarray, message: str, units: str | None) -> None:
    with pytest.raises(CloudError, match="^" + re.escape(message)) as caught:
        from_points(points, units)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"labels": np.ones(399)}, "cloud: expected labels for 400 points, got shape (399,)"),
        ({"labels": np.full(400, 1.5)}, "cloud: found the label 1.5, expected whole numbers (0 unknown, 1 stem, 2.."),
        ({"labels": np.full(400, np.nan)}, "cloud: found the label nan, expected whole numbers"),
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
            "say --units cm, mm or m (none: relative lengths)",
        ),
        (79.1, "inch", "leaf: unknown unit 'inch'; say --units cm, mm or m (none: relative lengths)"),
        (79.1, "", "leaf: unknown unit ''; say --units cm, mm or m (none: relative lengths)"),
        (
            791,
            "cm",
            "leaf: the cloud is 791.0 cm across if in cm, expected 10 to 250 cm; "
            "if in mm it is 79.1 cm: say --units mm (none: relative lengths)",
        ),
        (
            0.791,
            "mm",
            "leaf: the cloud is 0.0791 cm across if in mm, expected 10 to 250 cm; "
            "if in m it is 79.1 cm: say --units m (none: relative lengths)",
        ),
        (
            5,
            "cm",
            "leaf: the cloud is 5.0 cm across if in cm, expected 10 to 250 cm; "
            "no other unit fits either; is it one plant, without stray points? (none: relative lengths)",
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


# remove_outliers


def brute_force_excess(points: np.ndarray, n_neighbors: int, std_ratio: float) -> np.ndarray:
    """Mean neighbour distance minus the limit; positive: an outlier."""
    distances = np.sort(cdist(points, points), axis=1)[:, 1 : n_neighbors + 1].mean(axis=1)
    return distances - distances.mean() - std_ratio * distances.std()


@settings(deadline=None)
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


@settings(deadline=None, max_examples=50)
@given(points=reasonable_clouds(0, 300), n_points=st.integers(1, 300))
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


@settings(deadline=None, max_examples=40)
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
@pytest.mark.parametrize(
    "pattern", ["sodhi2018/greenhouse/*.ply", "sodhi2018/field/*.ply", "*/*.txt", "trackplant3d/*/*.txt"]
)
def test_real_clouds_keep_almost_all_and_thin_to_the_count(pattern: str) -> None:
    from phytofit.cloud import read_cloud  # noqa: PLC0415

    for path in sorted(DATA.glob(pattern))[::3]:
        points = read_cloud(path, "none").points
        assert remove_outliers(points).mean() > 0.99, path.name
        assert len(thin(points, 2000)) == pytest.approx(min(2000, len(points)), rel=0.05), path.name
