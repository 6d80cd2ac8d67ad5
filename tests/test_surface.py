"""Coordinates on a leaf's surface: against the places that they name, and against samples and meshes of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from phytofit.models import Organ, Phytomer, SurfaceSampler, mesh, move
from phytofit.models.surface import on_strip, places_on_strip, side_frames

EXACT = 1e-9  # cm
X = [3.0, 12.0, 40.0, 50.0, 6.0, 2.0, 8.0, 1.0, 5.0, 0.0, 0.0, 0.0, 10.0, 20.0, 0.6, 0.4, 2.0, 1.0, 0.0, 1.0, 0.0]


def leaf_with(fold):
    return Phytomer().organs([*X, fold])[1].row(0)


@given(
    st.floats(-60.0, 60.0),
    st.integers(3, 26),
    st.floats(0.3, 0.7),
    st.floats(-0.9, 0.9).filter(lambda across: abs(across) > 0.1),
)
def test_a_place_on_the_blade_has_the_coordinates_that_name_it(fold, segment, share, across):
    """Away from the ends of a segment, where a midrib that bends has two that are as near."""
    leaf = leaf_with(fold)
    along, sideways = share * leaf.segment_lengths[segment], across * leaf.half_width[segment]
    place = places_on_strip(leaf, np.array([segment]), np.array([along]), np.array([sideways]))
    by = on_strip(Organ(leaf.kind, leaf.axis[segment : segment + 2], leaf.frame[segment : segment + 1],
                        leaf.half_width[segment : segment + 2], leaf.fold), place)  # fmt: skip
    assert by.along == pytest.approx(along, abs=EXACT)
    assert by.across == pytest.approx(sideways, abs=EXACT)
    assert by.off == pytest.approx(0.0, abs=EXACT)
    np.testing.assert_allclose(by.frame[0], side_frames(leaf, np.sign(across))[segment], atol=EXACT)
    above = on_strip(leaf, place + 0.01 * by.frame[0, :, 2])
    assert above.off[0] > 0.0


@pytest.mark.parametrize("fold", [-40.0, 0.0, 25.0])
def test_samples_and_mesh_of_a_folded_leaf_lie_on_it(fold):
    """A straight one, so that each point has one nearest segment; half the points are of each half, at the angle."""
    straight = [*X[:5], 0.0, 8.0, 1.0, 0.0, 0.0, 0.0, 0.0, 10.0, 0.0, *X[14:], fold]
    leaf = Phytomer().organs(straight)[1].row(0)
    leaf = move([leaf], np.eye(4))[0]
    points, _ = SurfaceSampler(500, 3).draw([leaf])
    by = on_strip(leaf, points)
    np.testing.assert_allclose(by.off, 0.0, atol=1e-4)  # samples are float32
    assert abs(np.mean(by.across > 0.0) - 0.5) < 0.05
    vertices = np.asarray(mesh([leaf]).vertices)
    np.testing.assert_allclose(on_strip(leaf, vertices).off, 0.0, atol=EXACT)
    assert mesh([leaf]).area == pytest.approx(float(leaf.area), rel=1e-6)
    edge = leaf.half_width[12]
    raised = (vertices - leaf.axis[12])[np.abs((vertices - leaf.axis[12]) @ leaf.frame[0, :, 0]) < 1e-6] @ leaf.frame[0]
    np.testing.assert_allclose(raised[[0, 2], 2], edge * np.sin(np.deg2rad(fold)), atol=1e-6)
