"""The phytomer of section IV-B: a straight stem piece and one leaf, six parameters of Eq. (1) and one more."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.models.organs import LEAF, STEM, Organ, frames_along

__all__ = ["Phytomer"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Phytomer:
    """G(X) of section IV-B, up to the sampling of points: parameters to organs, for a whole population at once.

    The model's frame: the stem rises along +z from its foot at the origin; the leaf lies in the x-z plane, starts at
    the stem's axis at height X2 and leans towards +x; its blade is level across, along y.

    ``n_pieces`` midrib segments, of which the last ``slow_share`` (the paper's 20 %) bend half as much;
    ``widest_share`` n_pieces is the paper's i_max; ``concavity`` is k of Eq. (2), 1 to 3.  The bend is X6 per thirtieth
    of the leaf, so another `n_pieces` gives the same leaf, more or less finely.
    """

    n_pieces: int = 30
    widest_share: float = 0.5
    slow_share: float = 0.2
    concavity: float = 2.0

    PARAMETERS = (  # Eq. (1), in its order; the last is not the paper's: 0 without it
        "stem_diameter",
        "stem_length",
        "leaf_angle",
        "leaf_length",
        "leaf_width",
        "leaf_rotate_angle",
        "stem_length_above",
    )
    UNITS = ("cm", "cm", "deg", "cm", "cm", "deg", "cm")

    def width_profile(self) -> FloatArray:
        """Width at the nodes 0 .. n_pieces as a share of the widest, Eq. (2)."""
        k = self.concavity
        i = np.arange(self.n_pieces + 1)
        i_max = self.widest_share * self.n_pieces
        r = np.clip((i - i_max) / (self.n_pieces - i_max), 0.0, 1.0)
        profile: FloatArray = (k + np.log(1.0 - r + np.exp(-k))) / (k + np.log(1.0 + np.exp(-k)))  # Eq. (2)
        profile[-1] = 0.0  # exactly: k + log(e^-k)
        return profile

    def midrib_angles(self, leaf_angle: FloatArray, leaf_rotate_angle: FloatArray) -> FloatArray:
        """Angle from the stem's axis of every midrib segment, (n, n_pieces) degrees, of (n,) parameters."""
        bend = leaf_rotate_angle * 30.0 / self.n_pieces
        piece = np.arange(1, self.n_pieces + 1)
        share = np.where(piece > (1.0 - self.slow_share) * self.n_pieces, 0.5, 1.0)
        share[0] = 0.0  # X3 is the angle of the first segment
        angles: FloatArray = leaf_angle[:, np.newaxis] + bend[:, np.newaxis] * np.cumsum(share)
        return angles

    def organs(self, xs: ArrayLike) -> tuple[Organ, Organ]:
        """Stem and leaf of a population: xs (n, 6) as Eq. (1), or (n, 7) with the stem's length above the leaf.

        Every array of the organs has a leading n; lengths are cm, angles degrees.
        """
        xs = np.atleast_2d(np.asarray(xs, float))
        diameter, below, leaf_angle, leaf_length, leaf_width, rotate = xs.T[:6]
        above = xs[:, 6] if xs.shape[1] > 6 else np.zeros(len(xs))

        stem_axis = np.zeros((len(xs), 2, 3))
        stem_axis[:, 1, 2] = below + above
        stem = Organ(
            STEM,
            stem_axis,
            frames_along(stem_axis, np.array([0.0, 1.0, 0.0])),
            np.repeat(0.5 * diameter[:, np.newaxis], 2, axis=1),
        )

        angle = np.deg2rad(self.midrib_angles(leaf_angle, rotate))
        piece = (leaf_length / self.n_pieces)[:, np.newaxis]
        midrib = np.zeros((len(xs), self.n_pieces + 1, 3))
        midrib[:, 1:, 0] = np.cumsum(piece * np.sin(angle), axis=1)
        midrib[:, 1:, 2] = np.cumsum(piece * np.cos(angle), axis=1)
        midrib[:, :, 2] += below[:, np.newaxis]
        leaf = Organ(
            LEAF,
            midrib,
            frames_along(midrib, np.array([0.0, 1.0, 0.0])),
            0.5 * leaf_width[:, np.newaxis] * self.width_profile(),
        )
        return stem, leaf

    @staticmethod
    def upside_down(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The other parameters x (7,) of the same organs, seen upside down: ``turn @ x + offset``.

        Returns turn (7, 7), offset (7,) and the pose (4, 4) from the other plant's frame to this one's.  Without what
        is known of leaves (they leave the stem upwards and bend down) no cloud can tell the two apart.
        """
        turn = np.eye(7)[[0, 6, 2, 3, 4, 5, 1]]  # what was below the leaf is above it
        turn[2, 2] = turn[5, 5] = -1.0
        offset = np.array([0.0, 0.0, 180.0, 0.0, 0.0, 0.0, 0.0])
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[2, 3] = x[1] + x[6]
        return turn, offset, pose
