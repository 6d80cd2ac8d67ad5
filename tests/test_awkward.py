"""Awkward clouds, as people's tools wrote them: the points and the traits of the cloud that they were made from."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import phytofit
from phytofit.cloud import PointCloud, read_cloud
from phytofit.errors import CloudError

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
AWKWARD = DATA / "awkward"
pytestmark = pytest.mark.skipif(not AWKWARD.is_dir(), reason="needs the real clouds in ../shared/data")

DIGITS_CM = 1e-4  # by which what is written with four decimals, or in single precision, may be off
SAME = [
    ("01_decimal_comma/leaf_head.csv", ()),
    ("01_decimal_comma/leaf_bare.txt", ()),
    ("03_intensity_taken_for_label/leaf_few.txt", ()),
    ("03_intensity_taken_for_label/leaf_plain.txt", ()),
    ("04_ply_duplicate_property/leaf.ply", ()),
    ("05_ply_name_with_space/leaf.ply", ()),
    ("06_msvc_nan/leaf_ind.ply", ("91 non-finite points dropped",)),
    ("06_msvc_nan/leaf_qnan.ply", ("91 non-finite points dropped",)),
    ("09_trailing_separator/leaf_bare.csv", ()),
    ("14_doubled_points/leaf_x2.ply", ("3481 exact copies of points dropped",)),
]


@pytest.fixture(scope="module")
def original() -> PointCloud:
    return read_cloud(DATA / "sodhi2018" / "greenhouse" / "0003.ply", "cm")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_points_are_those_of_the_original(original: PointCloud) -> None:
    for name, notes in SAME:
        cloud = read_cloud(AWKWARD / name, "cm")
        np.testing.assert_allclose(cloud.points, original.points, rtol=0, atol=DIGITS_CM, err_msg=name)
        assert (cloud.notes, cloud.labels) == (notes, None), name
    utf16 = read_cloud(AWKWARD / "10_utf16" / "leaf.txt", "cm")  # three decimals
    np.testing.assert_allclose(utf16.points, original.points, rtol=0, atol=5.1e-4)


def test_two_scans_are_one_cloud(original: PointCloud) -> None:
    cloud = read_cloud(AWKWARD / "08_pts_two_scans" / "leaf.pts", "cm")
    assert cloud.notes == ("2 scans, read as one cloud",)
    assert len(cloud) == 870 + 871
    assert cKDTree(original.points).query(cloud.points)[0].max() < DIGITS_CM
    assert cloud.colors is not None


def test_a_cloud_that_lost_its_end_is_refused() -> None:
    with pytest.raises(
        CloudError, match=r"^leaf.txt: truncated: it declares 3481 points and holds 1700; copy it again"
    ):
        read_cloud(AWKWARD / "02_cc_comment_header" / "leaf.txt", "cm")


def test_a_header_that_is_wrong_is_named() -> None:
    with pytest.raises(
        CloudError, match=r"^legacy_count_only.las: its LAS 1.4 header declares 0 points, yet 118354 byt"
    ):
        read_cloud(AWKWARD / "50_las_odd_headers" / "legacy_count_only.las")


def test_labels_as_cloudcompare_writes_them() -> None:
    cloud = read_cloud(AWKWARD / "63_cloudcompare_relabelled" / "plant_scalar_label.ply", "mm")
    assert cloud.labels_from == "scalar_label"
    assert cloud.labels is not None
    assert cloud.labels.min() >= 0
    assert len(np.unique(cloud.labels)) > 2


def test_two_plants_are_read_as_they_are() -> None:
    cloud = read_cloud(AWKWARD / "60_two_plants" / "two.xyz", "mm")
    assert (len(cloud), cloud.notes, cloud.unit) == (5000, (), "mm")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_two_decimals_of_a_metre_still_give_the_leafs_length() -> None:
    cloud = read_cloud(AWKWARD / "13_two_decimals_metres" / "leaf.xyz", "m")
    np.testing.assert_allclose(cloud.step, 1.0)
    fit = phytofit.fit(cloud, threads=2)
    assert fit.notes[0] == "coordinates are in steps of 0.01 m: digits are missing; export it with more digits"
    assert not any("no noise" in note for note in fit.notes)
    length = next(trait for trait in fit.traits if trait.name == "leaf_length")
    assert length.value == pytest.approx(47.5, abs=0.5)
    assert length.low is not None
    assert length.low < 47.5
    assert length.high is None or length.high > 47.5


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", [name for name, _ in SAME])
def test_the_traits_are_those_of_the_original(name: str) -> None:
    traits = {trait.name: trait.value for trait in phytofit.fit(read_cloud(AWKWARD / name, "cm"), threads=2).traits}
    for trait, value, tolerance in (
        ("stem_diameter", 3.56, 0.05),
        ("leaf_length", 47.5, 0.25),
        ("leaf_angle", 78.83, 0.5),
        ("leaf_width", 4.66, 0.1),
    ):
        assert traits[trait] == pytest.approx(value, abs=tolerance), trait
