"""Organs: areas in closed form, rigid motion, and meshes against trimesh."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from phytofit.models import LEAF, STEM, Organ, Phytomer, mesh, move
from phytofit.models.organs import frames_along

EXACT = 1e-9  # relative; float64
STORED = 1e-5  # relative; PLY and GLB keep float32, OBJ eight digits

X = [3.2, 14.0, 42.0, 54.0, 6.5, 3.4, 5.0]


def tube(nodes, radius):
    axis = np.asarray(nodes, float)
    return Organ(STEM, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), np.asarray(radius, float))


def strip(nodes, half_width):
    return Organ(LEAF, *[getattr(tube(nodes, half_width), key) for key in ("axis", "frame", "half_width")])


def phytomer():
    return [organ.row(0) for organ in Phytomer().organs(X)]


def rigid(seed):
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=random).as_matrix()
    pose[:3, 3] = random.uniform(-100, 100, 3)
    return pose


def test_area_of_a_cone_is_that_of_its_side():
    """Radii 2 and 5 at a distance of 4: slant height 5, area pi (2 + 5) 5."""
    cone = tube([[1, 1, 1], [1, 1, 5]], [2.0, 5.0])
    assert cone.area == pytest.approx(math.pi * 7 * 5, rel=EXACT)


def test_area_of_a_tube_of_several_segments_is_their_sum():
    nodes, radius = np.array([[0, 0, 0], [0, 3, 4], [0, 3, 10.0]]), [1.0, 1.0, 2.0]
    assert tube(nodes, radius).area == pytest.approx(2 * math.pi * 5 + math.pi * 3 * math.hypot(6, 1), rel=EXACT)


def test_area_of_a_strip_is_one_side_of_its_trapezoids():
    leaf = strip([[0, 0, 1], [3, 0, 5], [3, 0, 7]], [2.0, 1.0, 0.0])  # segments of 5 and 2 cm
    assert leaf.area == pytest.approx(5 * (4 + 2) / 2 + 2 * (2 + 0) / 2, rel=EXACT)
    np.testing.assert_allclose(leaf.segment_lengths, [5.0, 2.0], rtol=EXACT)


def test_areas_and_lengths_of_a_population():
    xs = np.array([X, [2.0, 20.0, 60.0, 40.0, 4.0, -3.0, 0.0]])
    for organ in Phytomer().organs(xs):
        assert organ.area.shape == (2,)
        for i in range(2):
            assert organ.area[i] == pytest.approx(float(organ.row(i).area), rel=EXACT)
            np.testing.assert_allclose(organ.segment_lengths[i], organ.row(i).segment_lengths, rtol=EXACT)


def test_frames_follow_a_twisting_lateral():
    axis = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [2, 2, 2.0]])
    lateral = np.array([[0, 1, 0], [0, 1, 1], [1, 0, 0.0]])
    frame = frames_along(axis, lateral)
    np.testing.assert_allclose(frame @ np.swapaxes(frame, 1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, rtol=EXACT)
    np.testing.assert_allclose(frame[1, :, 0], [math.sqrt(0.5), math.sqrt(0.5), 0.0], atol=EXACT)
    assert np.all(np.sum(frame[:, :, 1] * lateral, axis=1) > 0)


def test_frame_of_a_segment_of_no_length_is_finite():
    frame = frames_along(np.array([[1, 2, 3], [1, 2, 3], [1, 2, 4.0]]), np.array([0.0, 1.0, 0.0]))
    assert np.all(np.isfinite(frame))


@given(st.integers(0, 2**32 - 1))
def test_moving_is_rigid(seed):
    pose = rigid(seed)
    for organ, moved in zip(phytomer(), move(phytomer(), pose), strict=True):
        np.testing.assert_allclose(moved.axis, organ.axis @ pose[:3, :3].T + pose[:3, 3], atol=EXACT * 100)
        np.testing.assert_allclose(moved.segment_lengths, organ.segment_lengths, rtol=EXACT)
        assert moved.area == pytest.approx(float(organ.area), rel=EXACT)
        along = np.diff(moved.axis, axis=0) / moved.segment_lengths[:, np.newaxis]
        np.testing.assert_allclose(moved.frame[:, :, 0], along, atol=EXACT * 100)
        np.testing.assert_allclose(np.linalg.det(moved.frame), 1.0, rtol=EXACT)
    back = move(move(phytomer(), pose), np.linalg.inv(pose))
    np.testing.assert_allclose(back[1].axis, phytomer()[1].axis, atol=EXACT * 100)
    np.testing.assert_allclose(back[1].frame, phytomer()[1].frame, atol=EXACT)


def test_moving_a_population_moves_every_plant():
    pose = rigid(1)
    xs = np.array([X, [2.0, 20.0, 60.0, 40.0, 4.0, -3.0, 0.0]])
    for organ, moved in zip(Phytomer().organs(xs), move(Phytomer().organs(xs), pose), strict=True):
        for i in range(2):
            alone = move([organ.row(i)], pose)[0]
            np.testing.assert_allclose(moved.row(i).axis, alone.axis, rtol=EXACT)
            np.testing.assert_allclose(moved.row(i).frame, alone.frame, atol=EXACT)


def test_mesh_of_a_leaf_has_its_area():
    leaf = phytomer()[1]
    assert mesh([leaf]).area == pytest.approx(float(leaf.area), rel=EXACT)


@pytest.mark.parametrize("n_around", [3, 24, 400])
def test_mesh_of_a_stem_is_a_prism_in_its_cylinder(n_around):
    """n sides of 2 r sin(pi / n); the cylinder's area as n grows."""
    stem = phytomer()[0]
    radius, height = X[0] / 2, X[1] + X[6]
    expected = n_around * 2 * radius * math.sin(math.pi / n_around) * height
    area = mesh([stem], n_around=n_around).area
    assert area == pytest.approx(expected, rel=EXACT)
    assert area == pytest.approx(float(stem.area), rel=2 / n_around**2)


def test_mesh_vertices_lie_on_the_organs():
    leaf = phytomer()[1]
    vertices = mesh([leaf]).vertices.reshape(31, 3, 3)
    np.testing.assert_allclose(vertices[:, 1], leaf.axis, atol=EXACT)
    np.testing.assert_allclose(np.linalg.norm(vertices[:, 2] - vertices[:, 0], axis=1), 2 * leaf.half_width, atol=EXACT)


def test_mesh_faces_of_a_stem_look_outwards():
    part = mesh([phytomer()[0]])
    outwards = part.triangles_center * [1.0, 1.0, 0.0]
    assert np.all(np.sum(part.face_normals * outwards, axis=1) > 0)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_mesh_survives_a_file(tmp_path, suffix):
    organs = move(phytomer(), rigid(2))
    path = tmp_path / f"model.{suffix}"
    made = mesh(organs)
    made.export(path)
    read = trimesh.load_mesh(path)
    assert read.area == pytest.approx(made.area, rel=STORED)
    np.testing.assert_allclose(read.bounds, made.bounds, rtol=STORED, atol=1e-3)
    assert len(read.faces) == len(made.faces)


def test_mesh_tells_stem_from_leaf_by_colour(tmp_path):
    mesh(phytomer()).export(tmp_path / "model.ply")
    colors = np.unique(trimesh.load_mesh(tmp_path / "model.ply").visual.vertex_colors, axis=0)
    assert len(colors) == 2


@pytest.mark.parametrize("share", [0.05, 0.25, 0.4, 0.77, 1.0])
def test_a_part_of_an_organ_ends_where_it_should(share):
    """A straight wedge: what is left of it is a trapezoid."""
    axis = np.zeros((5, 3))
    axis[:, 0] = [0.0, 1.0, 4.0, 6.0, 10.0]
    wedge = Organ(LEAF, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), 1.0 - axis[:, 0] / 10.0)
    part = wedge.until(share)
    assert part.axis[-1] == pytest.approx([10.0 * share, 0.0, 0.0])
    assert part.half_width[-1] == pytest.approx(1.0 - share)
    assert float(part.area) == pytest.approx(10.0 * share * (2.0 - share))
    assert len(part.frame) == len(part.axis) - 1 == len(part.half_width) - 1
