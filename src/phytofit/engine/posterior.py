"""The log posterior of a phytomer in a cloud: each point of the stem, of the leaf, or an outlier."""

import copy
from collections.abc import Callable, Iterator
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
from phytofit.engine.visibility import N_STRIPS, Hidden, cells
from phytofit.engine.voids import Void, around_stem, facing_share
from phytofit.kernels.likelihood import CHANGES, segment_changes
from phytofit.models import Organ, Phytomer
from phytofit.models.surface import side_frames
from phytofit.parameters import ParameterSpace
from phytofit.species import Species

__all__ = ["Posterior"]

FloatArray = NDArray[np.float64]
FOLD = "leaf_fold"  # the parameter of a blade that is folded along its midrib
STEP = 1e-4  # of a prior's spread, for the derivatives of the organs
POSE_STEP = 1e-4  # cm and radians, for those of the area that was seen


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
        leaf_area, leaf_area_change = self._leaf_area(leaf, length, half, state, steps)
        stem_area, stem_area_change = self._stem_area(stem, state, steps)
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
        radius = 0.5 * (stem.half_width[:, 1:] + stem.half_width[:, :-1])
        tube = Tube(
            columns=np.concatenate([moved, places[layout.mask("stem_facing", "stem_noise")]]),
            origin=stem.axis[0, :-1] @ r.T + t,
            frame=r @ stem.frame[0],
            length=stem.segment_lengths[0],
            radius=radius[0],
            area=stem_area,
            facing=state.facing,
            noise=float(state.noise[0]),
            change=changes(stem, stem.frame, stem.segment_lengths, stem.half_width),
            area_change=stem_area_change,
            area_by_facing=np.zeros(2) if self.void is None else self._by_facing(stem, self.void, state),
        )
        strip = Strip(
            columns=np.concatenate([moved, places[layout.mask("leaf_noise", "leaf_thickness")]]),
            origin=leaf.axis[0, :-1] @ r.T + t,
            length=length[0],
            half=half[0],
            sides=tuple(
                Side(r @ frame[0], right, left, changes(leaf, frame, length, half))
                for frame, right, left in self._sides(leaf)
            ),
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
        self, leaf: Organ, length: FloatArray, half: FloatArray, state: State, steps: FloatArray
    ) -> tuple[float, FloatArray]:
        """Area of the leaf, as far as it was seen, and the change (c + 6,) of its logarithm by parameters and pose.

        The leaf is a population as :func:`segment_changes` takes it, in the model's frame; `steps` are empty where the
        change is not wanted.
        """
        middle = 0.5 * (half[:, 1:] + half[:, :-1])
        whole = 2.0 * length * middle
        if self.hidden is None:
            return _log_change(whole.sum(axis=1), steps)
        whole = np.repeat(whole[..., np.newaxis] / N_STRIPS, N_STRIPS, axis=2)
        return self._seen_area(cells(leaf, length, middle), whole, self.hidden.around_cells, state, steps)

    def _stem_area(self, stem: Organ, state: State, steps: FloatArray) -> tuple[float, FloatArray]:
        """The same of the stem."""
        if self.void is None:
            half = 0.5 * (stem.half_width[:, 1:] + stem.half_width[:, :-1])
            return _log_change(2.0 * np.pi * np.sum(stem.segment_lengths * half, axis=1), steps)
        places, area = around_stem(stem)
        return self._seen_area(places, area * facing_share(state.facing), self.void.at, state, steps)

    def _by_facing(self, stem: Organ, void: Void, state: State) -> FloatArray:
        """Change (2,) of the logarithm of the stem's area, as far as it was seen, by where its points face."""
        places, area = around_stem(stem.row(0).as_population)
        pose = self.pose_of(state)
        seen = (area * (1.0 - void.at(places @ pose[:3, :3].T + pose[:3, 3]))).sum(axis=(0, 1))
        moves = POSE_STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        log = np.log([float(seen @ facing_share(state.facing + move)) for move in moves])
        change: FloatArray = (log[::2] - log[1::2]) / (2.0 * POSE_STEP)
        return change

    def _seen_area(
        self,
        places: FloatArray,
        whole: FloatArray,
        hidden: Callable[[FloatArray], FloatArray],
        state: State,
        steps: FloatArray,
    ) -> tuple[float, FloatArray]:
        """What is seen of a population's areas (c, ...) around places (c, ..., 3), in the model's frame, of which a
        share is `hidden`; and the change (c + 6,) of its logarithm.

        Only the first plant's places are looked at, and a little beside them: how the others change what is seen
        follows from the slope of `hidden` there.
        """
        pose = self.pose_of(state)
        r = pose[:3, :3]
        there = places[0] @ r.T + pose[:3, 3]
        seen = 1.0 - hidden(there[np.newaxis])[0]
        area = float(np.sum(whole[0] * seen))
        n = len(steps)
        if not n:
            return area, np.zeros(0)
        beside = POSE_STEP * np.concatenate([np.eye(3), -np.eye(3)]).reshape(6, *[1] * (there.ndim - 1), 3)
        high, low = hidden(there + beside).reshape(2, 3, *seen.shape)
        lost = whole[0] * (high - low) / (2.0 * POSE_STEP)  # (3, ...) by a move along each axis of the cloud's frame
        rest = tuple(range(1, whole.ndim))
        twice = 2.0 * steps.reshape(-1, *[1] * (whole.ndim - 1))
        larger = np.sum((whole[1 : n + 1] - whole[n + 1 :]) / twice * seen, axis=rest)
        moved = (places[1 : n + 1] - places[n + 1 :]) / twice[..., np.newaxis]
        in_frame = np.tensordot(r, lost, axes=(0, 0))  # by a move along each axis of the model's
        by_parameters = larger - moved.reshape(n, -1) @ np.moveaxis(in_frame, 0, -1).ravel()
        arm = there - state.center - state.shift
        turned = [np.sum(np.moveaxis(np.cross(axis, arm), -1, 0) * lost) for axis in _left_jacobian(state.turn).T]
        by_pose = -np.array([*turned, *lost.reshape(3, -1).sum(axis=1)])
        return area, np.concatenate([by_parameters, by_pose]) / area


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


def _log_change(area: FloatArray, steps: FloatArray) -> tuple[float, FloatArray]:
    """The first of areas (c,) of a population as :func:`segment_changes` takes it, and the change (c + 6,) of its
    logarithm, which the pose does not change; (0,) without steps."""
    if not len(steps):
        return float(area[0]), np.zeros(0)
    return float(area[0]), np.append(_slope(np.log(area), steps), np.zeros(6))


def _slope(values: FloatArray, steps: FloatArray) -> FloatArray:
    """Change (k,) of values (2 k + 1,) of a population as :func:`segment_changes` takes it, per unit."""
    high, low = values[1:].reshape(2, len(steps))
    slope: FloatArray = (high - low) / (2.0 * steps)
    return slope


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
