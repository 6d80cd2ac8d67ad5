"""The log posterior of a phytomer in a cloud: each point of the stem, of the leaf, or an outlier."""

import copy
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation, Mixture, Side, Strip, Tube
from phytofit.engine.prior import Prior
from phytofit.engine.visibility import CELLS, N_STRIPS, Hidden
from phytofit.engine.voids import N_AROUND, Void, around_stem, facing_share
from phytofit.kernels.likelihood import CHANGES, seen_area, segment_changes
from phytofit.models import Organ, Phytomer
from phytofit.models.surface import Patches, side_frames
from phytofit.parameters import ParameterSpace
from phytofit.species import Species

__all__ = ["Posterior"]

FloatArray = NDArray[np.float64]
FOLD = "leaf_fold"  # the parameter of a blade that is folded along its midrib
STEP = 1e-4  # of a prior's spread, for the derivatives of the organs
PLACE_STEP, FACING_STEP = 1e-4, 1e-4  # cm, and concentration, for those of the area that was seen
RING = Patches.of_tube(1, 1)


class Posterior:
    """-log p(cloud | phytomer) - log p(phytomer), with derivatives.

    A point is uniform by area on the stem (a tube) or the leaf (a strip), displaced by isotropic normal
    noise of the organ's own level, or an outlier, uniform in the cloud's hull.  Being a density, it needs no distance
    from model to cloud: a model larger than its data spreads its points thin, and pays.  Noise and shares are
    parameters, and so is the pose.

    Parameters
    ----------
    prior : of the model's parameters, and of the phytomer in its cloud
    points : (n, 3) cm
    organ : (n,) 0 stem, 1 leaf, -1 unknown; None: all unknown
    weights : (n,) of the points; None: all 1
    hidden : where points of the leaf were not seen, and around its base those of both organs; None: nowhere
    """

    def __init__(
        self,
        model: Phytomer,
        prior: Prior,
        points: FloatArray,
        *,
        organ: NDArray[np.int8] | None = None,
        weights: FloatArray | None = None,
        hidden: Hidden | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.model = model
        self.prior = prior
        self.points = np.ascontiguousarray(points)
        self.organ = np.full(len(points), -1, np.int8) if organ is None else organ
        self.weights = weights
        self.hidden = hidden
        self.is_part = False  # whether points in hidden parts were left out on purpose; then all others were seen
        self.seen = self._seen_at(self.points)
        self.outlier_density = 1.0 / _volume(self.points)
        self._executor = executor

    @classmethod
    def of(
        cls,
        species: Species,
        points: FloatArray,
        *,
        thick: bool = False,
        cut: bool = False,
        leaf_noise_cm: float | None = None,
        **seen: Any,
    ) -> "Posterior":
        """Of a species' phytomer; see :meth:`phytofit.engine.prior.Prior.of` for what it may be."""
        prior = Prior.of(species.space, thick=thick, cut=cut, leaf_noise_cm=leaf_noise_cm)
        return cls(species.model, prior, points, **seen)

    def start(self, x: FloatArray, pose: FloatArray, noise_cm: float) -> State:
        """A state with the parameters x (k,) in a pose (4, 4)."""
        theta = self.prior.mean.copy()
        theta[: len(x)] = x
        state = State(theta, self.prior.layout, pose, np.zeros(3))
        center = pose[:3, :3] @ np.array([0.0, 0.0, state["stem_length"]]) + pose[:3, 3]
        return replace(state, center=center).changed(stem_noise=np.log(noise_cm), leaf_noise=np.log(noise_cm))

    def extended(self, state: State) -> State:
        """The state of a model with fewer parameters, with those that it lacks at the prior's mean."""
        layout, prior = self.prior.layout, self.prior
        k = len(state.layout.parameters)
        theta = np.concatenate([state.x, prior.mean[k : len(layout.parameters)], state.theta[k:]])
        extended = replace(state, theta=theta, layout=layout)
        i = layout.place("leaf_thickness")
        if prior.lower[i] <= theta[i] <= prior.upper[i]:
            return extended
        return extended.changed(leaf_thickness=prior.mean[i])

    def at(self, points: FloatArray) -> "Posterior":
        """The same posterior, of points that have moved."""
        moved = copy.copy(self)
        moved.points = np.ascontiguousarray(points)
        moved.seen = moved._seen_at(moved.points)
        return moved

    def hiding(self, hidden: Hidden) -> "Posterior":
        """The same posterior, where other points were not seen."""
        other = copy.copy(self)
        other.hidden = hidden
        other.seen = other._seen_at(other.points)
        return other

    def of_part(self, kept: NDArray[np.bool_], others: Hidden) -> "Posterior":
        """The posterior of the points that are `kept` (n,), all that there are but where `others` are hidden."""
        part = copy.copy(self)
        part.points, part.organ = self.points[kept], self.organ[kept]
        part.weights = None if self.weights is None else self.weights[kept]
        part.hidden, part.is_part, part.seen = others, True, np.ones(len(part.points))
        return part

    def under(self, prior: Prior) -> "Posterior":
        """The same cloud under another prior."""
        other = copy.copy(self)
        other.prior = prior
        return other

    def _seen_at(self, points: FloatArray) -> FloatArray:
        return np.ones(len(points)) if self.hidden is None or self.is_part else 1.0 - self.hidden.at(points)

    @property
    def space(self) -> ParameterSpace:
        """The model's parameters."""
        return self.prior.space

    @property
    def void(self) -> Void | None:
        """The ball around the leaf's base of which nothing was seen, if there is one."""
        return None if self.hidden is None else self.hidden.void

    def gradient(self, state: State, at: Evaluation) -> FloatArray:
        """Derivatives (m,) of the error, where the state was evaluated."""
        of_points = at.scores.sum(axis=0) if self.weights is None else self.weights @ at.scores
        gradient: FloatArray = self.prior.gradient(state.theta) - of_points
        return gradient

    def pose_of(self, state: State) -> FloatArray:
        """Pose (4, 4) from the model's frame to the cloud's."""
        turn = Rotation.from_rotvec(state.turn).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = turn @ state.pose[:3, :3]
        pose[:3, 3] = turn @ (state.pose[:3, 3] - state.center) + state.center + state.shift
        return pose

    def organs(self, state: State) -> tuple[Organ, ...]:
        """Stem and leaf in the model's frame."""
        return tuple(organ.row(0) for organ in self.model.organs(state.x))

    def evaluate(self, state: State, *, derivatives: bool = True) -> Evaluation:
        """The error, and the points' log densities, responsibilities and, if wanted, scores (n, m) of a state."""
        mixture = self._mixture(state, derivatives)
        agree = [self.organ != 1, self.seen * (self.organ != 0)]
        weights = [np.asarray(weight, float) for weight in agree]
        at = mixture.evaluate(
            self.points, weights, len(state.theta), derivatives=derivatives, executor=self._executor
        )  # fmt: skip
        of_points = at.error if self.weights is None else -float(self.weights @ at.log_p)
        return replace(at, error=self.prior.error(state.theta) + of_points)

    def _mixture(self, state: State, derivatives: bool) -> Mixture:
        layout = state.layout
        k = len(layout.parameters)
        stepped = np.arange(k + 1) if derivatives else np.arange(0)  # the model's parameters, and midrib_seen
        n_steps = len(stepped)
        columns = np.repeat(state.theta[np.newaxis, : k + 1], 2 * n_steps + 1, axis=0)
        steps = STEP * self.prior.std[stepped]
        columns[1 + np.arange(n_steps), stepped] += steps
        columns[1 + n_steps + np.arange(n_steps), stepped] -= steps
        stem, leaf = self.model.organs(columns[:, :k])
        length, half = _seen(leaf, columns[:, k])
        pose = self.pose_of(state)
        r, t = pose[:3, :3], pose[:3, 3]
        # axes of turning, shifts and centre as the model's frame sees them
        about = r.T @ _left_jacobian(state.turn), r.T, r.T @ (state.center + state.shift - t)

        def changes(organ: Organ, frame: FloatArray, long: FloatArray, wide: FloatArray) -> FloatArray:
            change = np.empty((frame.shape[1], CHANGES, n_steps + 6 if derivatives else 0))
            if derivatives:
                segment_changes(organ.axis, frame, long, wide, steps, *about, change)
            return change

        moved = (
            np.concatenate([stepped, np.arange(len(layout))[layout.mask("turn", "shift")]]) if derivatives else stepped
        )
        places = np.arange(len(layout))
        of_stem = changes(stem, stem.frame, stem.segment_lengths, stem.half_width)
        sides = tuple(
            Side(r @ frame[0], right, left, changes(leaf, frame, length, half))
            for frame, right, left in self._sides(leaf)
        )
        stem, leaf = stem.row(0), leaf.row(0)
        stem_area, stem_area_change = self._stem_area(stem, state, pose, of_stem)
        leaf_area, leaf_area_change = self._leaf_area(leaf, length[0], half[0], pose, sides)
        tube = Tube(
            columns=np.concatenate([moved, places[layout.mask("stem_facing", "stem_noise")]]),
            origin=stem.axis[:-1] @ r.T + t,
            frame=r @ stem.frame,
            length=stem.segment_lengths,
            radius=0.5 * (stem.half_width[1:] + stem.half_width[:-1]),
            area=stem_area,
            facing=state.facing,
            noise=float(state.noise[0]),
            change=of_stem,
            area_change=stem_area_change,
            area_by_facing=np.zeros(2) if self.void is None else self._by_facing(stem, self.void, state, pose),
        )
        strip = Strip(
            columns=np.concatenate([moved, places[layout.mask("leaf_noise", "leaf_thickness")]]),
            origin=leaf.axis[:-1] @ r.T + t,
            length=length[0],
            half=half[0],
            sides=sides,
            area=leaf_area,
            noise=state.noise[1:],
            area_change=leaf_area_change,
        )
        background = np.full(len(self.points), self.outlier_density)
        shares = np.array([layout.place("stem_share"), -1, layout.place("outlier_share")])
        return Mixture((tube, strip), state.share, shares, background)

    def _sides(self, leaf: Organ) -> Iterator[tuple[FloatArray, float, float]]:
        """Frames of what lies on either side of a leaf's fold, and how many half widths that reaches to the right and
        left; of a leaf that can't be folded, of all of it."""
        if FOLD not in self.prior.layout or not self.prior.free[self.prior.layout.place(FOLD)]:
            yield leaf.frame, 1.0, 1.0
            return
        for right, left in ((1.0, 0.0), (0.0, 1.0)):
            yield side_frames(leaf, right - left), right, left

    def _leaf_area(
        self, leaf: Organ, length: FloatArray, half: FloatArray, pose: FloatArray, sides: Sequence[Side]
    ) -> tuple[float, FloatArray]:
        """Area of one leaf, as far as it was seen, and the change (c,) of its logarithm."""
        changes = [(side.change, CELLS.right if side.right > side.left else ~CELLS.right) for side in sides]
        if len(sides) == 1:
            changes = [(sides[0].change, np.ones(N_STRIPS, bool))]
        hidden = None if self.hidden is None else self.hidden.around_cells
        return _log_seen(CELLS, CELLS.scale(leaf), leaf, length, half, hidden, pose, changes)

    def _stem_area(self, stem: Organ, state: State, pose: FloatArray, change: FloatArray) -> tuple[float, FloatArray]:
        """The same of one stem."""
        patches = around_stem(stem)[0] if self.void else RING
        scale = patches.scale(stem)
        if self.void:
            scale = scale * np.tile(facing_share(state.facing), len(scale) // N_AROUND)
        hidden = None if self.void is None else self.void.at
        changes = [(change, np.ones(len(scale), bool))]
        return _log_seen(patches, scale, stem, stem.segment_lengths, stem.half_width, hidden, pose, changes)

    def _by_facing(self, stem: Organ, void: Void, state: State, pose: FloatArray) -> FloatArray:
        """Change (2,) of the logarithm of the stem's area, as far as it was seen, by where its points face."""
        _, places, area = around_stem(stem)
        seen = (area * (1.0 - void.at(places @ pose[:3, :3].T + pose[:3, 3]))).reshape(-1, N_AROUND).sum(axis=0)
        moves = FACING_STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        log = np.log([float(seen @ facing_share(state.facing + move)) for move in moves])
        change: FloatArray = (log[::2] - log[1::2]) / (2.0 * FACING_STEP)
        return change


def _log_seen(
    patches: Patches,
    scale: FloatArray,
    organ: Organ,
    length: FloatArray,
    half: FloatArray,
    hidden: Callable[[FloatArray], FloatArray] | None,
    pose: FloatArray,
    changes: Sequence[tuple[FloatArray, NDArray[np.bool_]]],
) -> tuple[float, FloatArray]:
    """Area of an organ in the model's frame, as far as it was seen, and the change (c,) of its logarithm.

    `hidden` says which share is not seen of what lies at places (n, m, p, 3) of the cloud; `changes` are those of the
    segments (m, 9, c), each with the patches (p,) that change so.
    """
    shape = len(length), len(scale)
    seen, slope = np.ones(shape), np.zeros((*shape, 3))
    if hidden is not None:
        places = patches.places(organ, length, half) @ pose[:3, :3].T + pose[:3, 3]
        beside = PLACE_STEP * np.moveaxis(pose[:3, :3] @ patches.frames(organ), -1, 0)
        at, high, low = np.split(hidden(np.concatenate([places[np.newaxis], places + beside, places - beside])), [1, 4])
        seen, slope = 1.0 - at[0], np.moveaxis(low - high, 0, -1) / (2.0 * PLACE_STEP)
    area, total = 0.0, np.zeros(changes[0][0].shape[2])
    for change, those in changes:
        area += seen_area(
            patches.along[those], patches.across[those], scale[those], seen[:, those], slope[:, those],
            length, half, change, total,
        )  # fmt: skip
    return area, total / area


def _volume(points: FloatArray) -> float:
    """Volume, cm³, of the cloud's convex hull, in which outliers are uniform; of its box where it is flat."""
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        box = np.ptp(points, axis=0)
        return float(np.prod(box + 0.05 * box.max()))


def _seen(leaf: Organ, share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (n, m) of the segments and half widths (n, m + 1) at their ends, of that `share` (n,) of each leaf that
    was seen, from its base; what comes after has no length."""
    n_pieces = leaf.frame.shape[1]
    part = np.clip(share[:, np.newaxis] * n_pieces - np.arange(n_pieces), 0.0, 1.0)
    half = leaf.half_width.copy()
    half[:, 1:] = leaf.half_width[:, :-1] + part * np.diff(leaf.half_width, axis=1)
    return leaf.segment_lengths * part, half


def _left_jacobian(turn: FloatArray) -> FloatArray:
    """Of the exponential map: Exp(turn + d) = Exp(J d) Exp(turn), for small d."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        first, second = 0.5, 1.0 / 6.0
    else:
        first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    jacobian: FloatArray = np.eye(3) + first * cross + second * cross @ cross
    return jacobian
