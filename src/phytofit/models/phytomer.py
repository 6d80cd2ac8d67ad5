"""The phytomer of section IV-B: a straight stem piece and one leaf, six parameters of Eq. (1) and some more."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.models.organs import LEAF, STEM, Organ, frames_along

__all__ = ["N_PAPER", "Phytomer"]

FloatArray = NDArray[np.float64]
N_PAPER = 6  # parameters of Eq. (1)
COLLAR_CM = 0.5  # above and below the junction, where the stem's diameter changes, if it does
N_TAPERED = 3  # pieces of a stem that tapers, above the leaf and below it
MOST_TAPERED = 2.0  # of the logarithm of the diameter, at the ends of a stem that tapers
BASE_SHARE = 0.05  # of the midrib, over which the bend of its base falls to 1 / e
UPRIGHT = frames_along(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, 1.0, 0.0]))


@dataclass(frozen=True)
class Phytomer:
    """G(X) of section IV-B, up to the sampling of points: parameters to organs, for a whole population at once.

    The model's frame: the stem rises along +z from its foot at the origin; the leaf starts at the stem's axis at
    height X2, in the x-z plane, and leans towards +x; its blade is level across, along y.

    ``n_pieces`` midrib segments, of which the last ``slow_share`` (the paper's 20 %) bend half as much;
    ``widest_share`` n_pieces is the paper's i_max; ``concavity`` is k of Eq. (2), 1 to 3.  The bend is X6 per thirtieth
    of the leaf, so another `n_pieces` gives the same leaf, more or less finely.  The paper does not say where along
    the stem the leaf joins: without `stem_length_above` the stem above the leaf is ``stem_above`` times as long as X2.

    What follows Eq. (1) is not the paper's.  A parameter that is left out has the value that gives the paper's model:
    a leaf that starts at the stem's axis and stays in one plane, and Eq. (2) as it is.

    ====================== ===== =================================================================================
    stem_length_above      cm    of the stem above the height at which the leaf starts
    collar_offset          share of the stem's radius there, at which the leaf starts; 1 is the stem's surface
    leaf_bow               deg   that the middle of the midrib points lower than by an even bend
    leaf_wave              deg   that a quarter of the midrib points lower, three quarters higher, than by an even bend
    leaf_side_bend         deg   that the midrib turns sideways, from base to tip
    leaf_side_bow          deg   that its middle is turned more than by an even side bend
    leaf_roll              deg   of the blade about the midrib, at the base
    leaf_twist             deg   of the blade about the midrib, from base to tip
    leaf_base_width        share of the widest, at the base
    leaf_widest_at         share of the midrib, from its start; ``widest_share``
    leaf_taper             -     ``concavity``
    stem_diameter_above    share of the stem's diameter, above the leaf: its sheath ends there
    leaf_base_bend         deg   that the midrib turns down close to its start, over a twentieth of it or so
    leaf_shoulder          -     power of r in Eq. (2): above 1 the blade stays wide for longer, and is rounded there
    stem_taper             -     cm of its diameter that the stem loses with each cm, half-way below the leaf
    leaf_fold              deg   that each half of the blade is raised along the midrib, to a V
    ====================== ===== =================================================================================
    """

    n_pieces: int = 30
    widest_share: float = 0.5
    slow_share: float = 0.2
    concavity: float = 2.0
    stem_above: float = 0.0

    PARAMETERS = (  # Eq. (1), in its order; then what is not the paper's
        "stem_diameter",
        "stem_length",
        "leaf_angle",
        "leaf_length",
        "leaf_width",
        "leaf_rotate_angle",
        "stem_length_above",
        "collar_offset",
        "leaf_bow",
        "leaf_wave",
        "leaf_side_bend",
        "leaf_side_bow",
        "leaf_roll",
        "leaf_twist",
        "leaf_base_width",
        "leaf_widest_at",
        "leaf_taper",
        "stem_diameter_above",
        "leaf_base_bend",
        "leaf_shoulder",
        "stem_taper",
        "leaf_fold",
    )
    UNITS = (
        "cm",
        "cm",
        "deg",
        "cm",
        "cm",
        "deg",
        "cm",
        "share",
        *["deg"] * 6,
        "share",
        "share",
        "1",
        "share",
        "deg",
        "1",
        "1",
        "deg",
    )

    @property
    def neutral(self) -> FloatArray:
        """Values (k,) of the parameters; those after the sixth give the paper's model, with no stem above the leaf."""
        return np.array([*[np.nan] * 6, *[0.0] * 8, 1.0, self.widest_share, self.concavity, 1.0, 0.0, 1.0, 0.0, 0.0])

    def width_profile(
        self,
        base: FloatArray | None = None,
        widest: FloatArray | None = None,
        taper: FloatArray | None = None,
        shoulder: FloatArray | None = None,
    ) -> FloatArray:
        """Width at the nodes 0 .. n_pieces as a share of the widest, Eq. (2); (n, n_pieces + 1) of (n,) parameters.

        With a `base` narrower than the widest, the width rises to it as a quarter of a sine.
        """
        base = np.ones(1) if base is None else base
        widest = np.full(1, self.widest_share) if widest is None else widest
        k = (np.full(1, self.concavity) if taper is None else taper)[:, np.newaxis]
        i = np.arange(self.n_pieces + 1)
        i_max = widest[:, np.newaxis] * self.n_pieces
        r = np.clip((i - i_max) / (self.n_pieces - i_max), 0.0, 1.0)
        if shoulder is not None:
            r = r ** shoulder[:, np.newaxis]
        profile: FloatArray = (k + np.log(1.0 - r + np.exp(-k))) / (k + np.log(1.0 + np.exp(-k)))  # Eq. (2)
        profile[:, -1] = 0.0  # exactly: k + log(e^-k)
        rise = np.sin(0.5 * np.pi * np.clip(i / np.maximum(i_max, 1e-9), 0.0, 1.0))
        narrowed: FloatArray = profile * (1.0 - (1.0 - base[:, np.newaxis]) * (1.0 - rise))
        return narrowed

    def midrib_angles(self, leaf_angle: FloatArray, leaf_rotate_angle: FloatArray) -> FloatArray:
        """Angle from the stem's axis of every midrib segment, (n, n_pieces) degrees, of (n,) parameters."""
        bend = leaf_rotate_angle * 30.0 / self.n_pieces
        piece = np.arange(1, self.n_pieces + 1)
        share = np.where(piece > (1.0 - self.slow_share) * self.n_pieces, 0.5, 1.0)
        share[0] = 0.0  # X3 is the angle of the first segment
        angles: FloatArray = leaf_angle[:, np.newaxis] + bend[:, np.newaxis] * np.cumsum(share)
        return angles

    def organs(self, xs: ArrayLike) -> tuple[Organ, Organ]:
        """Stem and leaf of a population: xs (n, 6) as Eq. (1), or with more of `PARAMETERS`.

        Every array of the organs has a leading n; lengths are cm, angles degrees.
        """
        xs = np.atleast_2d(np.asarray(xs, float))
        n, given = xs.shape
        if given == N_PAPER:
            xs, given = np.hstack([xs, self.stem_above * xs[:, 1:2]]), given + 1
        rest = np.broadcast_to(self.neutral[given:], (n, len(self.PARAMETERS) - given))
        diameter, below, leaf_angle, leaf_length, leaf_width, rotate, above, offset, *shape = np.hstack([xs, rest]).T
        bow, wave, side_bend, side_bow, roll, twist, *profile, ratio, base_bend, shoulder, stem_taper, fold = shape
        base, widest, taper = profile
        log_slope = stem_taper / np.where(diameter > 0.0, diameter, 1.0)
        at_leaf = diameter * np.exp(-np.clip(0.5 * log_slope * below, -MOST_TAPERED, MOST_TAPERED))
        if given <= self.PARAMETERS.index("stem_diameter_above"):
            height = np.stack([0.0 * below, below + above], 1)
            half_width = np.repeat(0.5 * diameter[:, np.newaxis], 2, 1)
        else:  # one diameter goes over into the other around the junction
            step = np.minimum(COLLAR_CM, 0.5 * np.minimum(below, above))
            node = np.linspace(0.0, 1.0, 1 + (N_TAPERED if given > self.PARAMETERS.index("stem_taper") else 1))
            under = np.outer(below - step, node)
            over = (below + above)[:, np.newaxis] - np.outer(above - step, 1.0 - node)
            height = np.hstack([under, over])
            lost = log_slope[:, np.newaxis] * (height - 0.5 * below[:, np.newaxis])
            there = diameter[:, np.newaxis] * np.exp(-np.clip(lost, -MOST_TAPERED, MOST_TAPERED))
            there[:, len(node) :] *= ratio[:, np.newaxis]
            half_width = 0.5 * there
        stem_axis = np.zeros((*height.shape, 3))
        stem_axis[..., 2] = height
        stem = Organ(STEM, stem_axis, np.tile(UPRIGHT, (n, height.shape[1] - 1, 1, 1)), half_width)

        s = np.arange(self.n_pieces) / (self.n_pieces - 1)  # 0 at the first segment, 1 at the last
        hump, swing = 4.0 * s * (1.0 - s), 10.392304845413264 * s * (1.0 - s) * (1.0 - 2.0 * s)  # of height 1
        turned = 1.0 - np.exp(-s / BASE_SHARE)
        bent = np.outer(bow, hump) + np.outer(wave, swing) + np.outer(base_bend, turned)
        pitch = np.deg2rad(self.midrib_angles(leaf_angle, rotate) + bent)
        yaw = np.deg2rad(np.outer(side_bend, s) + np.outer(side_bow, hump))
        frame = _turned(pitch, yaw, np.deg2rad(roll[:, np.newaxis] + np.outer(twist, s)))
        midrib = np.zeros((n, self.n_pieces + 1, 3))
        midrib[:, 1:] = np.cumsum((leaf_length / self.n_pieces)[:, np.newaxis, np.newaxis] * frame[..., 0], axis=1)
        midrib[:, :, 2] += below[:, np.newaxis]
        midrib[:, :, 0] += (0.25 * at_leaf * (1.0 + ratio) * offset)[:, np.newaxis]
        share = self.width_profile(base, widest, taper, shoulder)
        leaf = Organ(LEAF, midrib, frame, 0.5 * leaf_width[:, np.newaxis] * share, fold)
        return stem, leaf

    def upside_down(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """The other parameters x (k,) of the same organs, seen upside down: ``turn @ x + offset``; or None, where this
        model can't have it: its stem must be longer on one side of the leaf.

        Returns turn (k, k), offset (k,) and the pose (4, 4) from the other plant's frame to this one's.  Without what
        is known of leaves (they leave the stem upwards and bend down) no cloud can tell the two apart.  Of plants near
        x it is true to first order, where the stem has two diameters.
        """
        names = self.PARAMETERS[: len(x)]
        turn = np.eye(len(x))
        if len(x) > N_PAPER:
            turn[[1, 6]] = turn[[6, 1]]  # what was below the leaf is above it
        elif self.stem_above != 1.0:
            return None
        for name in (
            "leaf_angle",
            "leaf_rotate_angle",
            "leaf_bow",
            "leaf_wave",
            "leaf_side_bend",
            "leaf_side_bow",
            "leaf_base_bend",
            "leaf_fold",
        ):
            if name in names:
                turn[names.index(name), names.index(name)] = -1.0
        there = turn @ x
        there[2] += 180.0
        if "stem_diameter_above" in names:
            above, taper = names.index("stem_diameter_above"), self.PARAMETERS.index("stem_taper")
            diameter, ratio, slope = x[0], x[above], x[taper] if taper < len(x) else 0.0
            half = 0.5 * (x[1] + x[6])  # from the middle of what is below the leaf to that of what is above it
            other = ratio * diameter * np.exp(-slope * half / diameter)
            of_log = np.zeros(len(x))  # derivatives of the logarithm of the other diameter
            of_log[[1, 6]] = -0.5 * slope / diameter
            of_log[[0, above]] = (1.0 + slope * half / diameter) / diameter, 1.0 / ratio
            if taper < len(x):
                of_log[taper] = -half / diameter
                there[taper] = -slope * other / diameter
                turn[taper] = there[taper] * of_log
                turn[taper, [0, taper]] += slope * other / diameter**2, -other / diameter
            turn[0] = other * of_log
            turn[above, above] = -1.0 / ratio**2
            there[[0, above]] = other, 1.0 / ratio
        offset = there - turn @ x
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[2, 3] = x[1] + (x[6] if len(x) > N_PAPER else self.stem_above * x[1])
        return turn, offset, pose


def _turned(pitch: FloatArray, yaw: FloatArray, roll: FloatArray) -> FloatArray:
    """Frames (n, m, 3, 3), columns tangent, lateral, normal, of angles (n, m) from the stem's axis (+z) in the x-z
    plane, then sideways out of that plane, then of the blade about its midrib."""
    cp, sp, cy, sy, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    zero = np.zeros_like(pitch)
    ahead = np.stack([sp, zero, cp], axis=-1)
    normal = np.stack([-cp, zero, sp], axis=-1)
    across = np.array([0.0, 1.0, 0.0])
    tangent = cy[..., np.newaxis] * ahead + sy[..., np.newaxis] * across
    level = cy[..., np.newaxis] * across - sy[..., np.newaxis] * ahead
    lateral = cr[..., np.newaxis] * level + sr[..., np.newaxis] * normal
    return np.stack([tangent, lateral, cr[..., np.newaxis] * normal - sr[..., np.newaxis] * level], axis=-1)
