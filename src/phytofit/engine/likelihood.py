"""The likelihood of a cloud under a phytomer's surface: each point of the stem, of the leaf, or an outlier."""

import copy
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from phytofit.engine.visibility import N_STRIPS, Hidden, cells
from phytofit.engine.voids import Void, around_stem, facing_share
from phytofit.kernels.likelihood import CHANGES, log_density, segment_changes
from phytofit.models import Organ, Phytomer
from phytofit.parameters import ParameterSpace

__all__ = ["LEAF_NOISE", "NOISE", "OUTLIERS", "SHARES", "SHIFT", "THICKNESS", "CloudLikelihood", "Evaluation", "State"]

FloatArray = NDArray[np.float64]
N_EXTRA = 14  # entries of theta after the model's parameters, see State
TURN, SHIFT, FACING = slice(-13, -10), slice(-10, -7), slice(-7, -5)  # their places in theta
NOISE, LEAF_NOISE, THICKNESS, SHARES, OUTLIERS = slice(-5, -3), -4, -3, slice(-2, None), -1
NO_THICKNESS_CM = 1e-6
LEAST_NOISE_CM = 0.05  # a midrib of straight pieces lies up to 0.02 cm off a curved one
LEAST_SEEN, SEEN_SPREAD = 0.3, 0.3  # of the midrib: bound, and the prior's spread below 1
BLOCK = 500  # points that a thread takes at a time
STEP = 1e-4  # of a prior's spread, for the derivatives of the organs
POSE_STEP = 1e-4  # cm and radians, for those of the area that was seen
NOISE_CM, NOISE_FACTOR = 0.3, 3.0  # of a surface's points: the prior's middle, and one spread of it
FACING_SPREAD, MOST_FACING = 1.0, 2.5  # of the concentrations around the stem: the prior's spread, and bound
SAME_NOISE = 1.3  # one spread of the leaf's noise about the stem's
SHARE_SPREAD = 2.5  # of the logits of the shares
STEM_SHARE, OUTLIER_SHARE = 0.3, 0.03  # before a cloud is seen; the rest is the leaf's
MOST_OUTLIERS = np.log(4.0)  # bound of logit_outlier


@dataclass(frozen=True)
class State:
    """A phytomer in a cloud.

    ``theta`` (k + 14,) are the model's k parameters, the share of the midrib that was seen, from its start (1 unless
    the tip is missing), a turn (rotation vector, radians) and a shift (cm) of the pose, the side that the stem's points
    face (von Mises concentration, in the frame across it), logarithms of the noise on stem and leaf and of the leaf's
    thickness (cm), logits of the shares of stem and outliers (relative to the leaf's).
    ``pose`` (4, 4) is the pose before it is turned about ``center`` (3,) and shifted.
    """

    theta: FloatArray
    pose: FloatArray
    center: FloatArray

    @property
    def n_parameters(self) -> int:
        """k, of the model."""
        return len(self.theta) - N_EXTRA

    @property
    def x(self) -> FloatArray:
        """Parameters (k,) of the model."""
        return self.theta[: self.n_parameters]

    @property
    def seen(self) -> float:
        """Share of the midrib that was seen."""
        return float(self.theta[self.n_parameters])

    @property
    def turn(self) -> FloatArray:
        """Rotation vector (3,), radians."""
        return self.theta[TURN]

    @property
    def shift(self) -> FloatArray:
        """(3,) cm."""
        return self.theta[SHIFT]

    @property
    def facing(self) -> FloatArray:
        """(2,) concentration of the stem's points around it."""
        return self.theta[FACING]

    @property
    def noise(self) -> FloatArray:
        """(3,) cm: on the stem, on the leaf, and what its thickness adds to that across the blade."""
        return np.exp(self.theta[-5:-2])

    def belongs(self, scores: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Probabilities (n,) of points to be of the stem, of the leaf, or outliers; scores (n, k + 14) as this state
        gives them."""
        on_stem, outlier = scores[:, -2] + self.share[0], scores[:, -1] + self.share[2]
        return on_stem, 1.0 - on_stem - outlier, outlier

    @property
    def share(self) -> FloatArray:
        """(3,) of the points: stem, leaf, outliers."""
        share = np.exp(np.array([self.theta[-2], 0.0, self.theta[-1]]))
        normed: FloatArray = share / share.sum()
        return normed


@dataclass(frozen=True)
class Evaluation:
    """``error``: minus the log posterior, nats; ``scores`` (n, k): derivatives of the points' log densities;
    ``log_p`` (n,)."""

    error: float
    scores: FloatArray
    log_p: FloatArray


class CloudLikelihood:
    """-log p(cloud | phytomer) - log p(phytomer), with derivatives.

    A point is uniform by area on the stem (a tube) or the leaf (a strip), displaced by isotropic normal
    noise of the organ's own level, or an outlier, uniform in the cloud's hull.  Being a density, it needs no distance
    from model to cloud: a model larger than its data spreads its points thin, and pays.  Noise and shares are
    parameters, and so is the pose.

    Parameters
    ----------
    space : prior of the model's parameters, normal, within bounds
    points : (n, 3) cm
    organ : (n,) 0 stem, 1 leaf, -1 unknown; None: all unknown
    weights : (n,) of the points; None: all 1
    thick : whether the leaf may have a thickness, which widens the noise across the blade
    cut : whether the leaf's tip may be missing
    hidden : where points of the leaf were not seen, and around its base those of both organs; None: nowhere
    leaf_noise_cm : about that of the leaf's points, which few of them can't tell from its shape; None: not known
    """

    def __init__(
        self,
        model: Phytomer,
        space: ParameterSpace,
        points: FloatArray,
        *,
        organ: NDArray[np.int8] | None = None,
        weights: FloatArray | None = None,
        thick: bool = False,
        cut: bool = False,
        hidden: Hidden | None = None,
        leaf_noise_cm: float | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.model = model
        self.space = space
        self.points = np.ascontiguousarray(points)
        self.organ = np.full(len(points), -1, np.int8) if organ is None else organ
        self.weights = weights
        self.hidden = hidden
        self.is_part = False  # whether the points were chosen by `hidden`: of those that are left all were seen
        self.seen = self._seen_at(self.points)
        self.outlier_density = 1.0 / _volume(self.points)
        self._executor = executor
        inside = 1.0 - STEM_SHARE - OUTLIER_SHARE
        shares = [np.log(STEM_SHARE / inside), np.log(OUTLIER_SHARE / inside)]
        self.mean = np.array([*space.mean, 1.0, *[0.0] * 8, *[np.log(NOISE_CM)] * 3, *shares])
        self.std = np.array(
            [
                *space.std,
                SEEN_SPREAD,
                *[np.inf] * 6,
                *[FACING_SPREAD] * 2,
                *[np.log(NOISE_FACTOR)] * 3,
                *[SHARE_SPREAD] * 2,
            ]
        )
        if leaf_noise_cm is not None:
            self.mean[LEAF_NOISE], self.std[LEAF_NOISE] = np.log(leaf_noise_cm), np.log(SAME_NOISE)
        self.precision = self.std**-2.0
        self.prior_weight = np.ones(len(self.std))  # how often the prior counts: points that err alike count too often
        self.lower = np.array(
            [
                *space.lower,
                LEAST_SEEN,
                *[-np.inf] * 6,
                *[0.0] * 2,
                *[np.log(LEAST_NOISE_CM)] * 2,
                np.log(0.005),
                *[-9.0] * 2,
            ]
        )
        self.upper = np.array([*space.upper, 1.0, *[np.inf] * 6, *[0.0] * 2, *[np.log(5.0)] * 3, 5.0, MOST_OUTLIERS])
        if not thick:
            self.mean[THICKNESS] = self.lower[THICKNESS] = self.upper[THICKNESS] = np.log(NO_THICKNESS_CM)
        if not cut:
            self.lower[len(space)] = 1.0

    def start(self, x: FloatArray, pose: FloatArray, noise_cm: float) -> State:
        """A state with the parameters x (k,) in a pose (4, 4)."""
        theta = self.mean.copy()
        theta[: len(x)] = x
        theta[-5:-3] = np.log(noise_cm)
        center = pose[:3, :3] @ np.array([0.0, 0.0, x[1]]) + pose[:3, 3]
        return State(theta, pose, center)

    def extended(self, state: State) -> State:
        """The state of a model with fewer parameters, with those that it lacks at the prior's mean."""
        k = state.n_parameters
        theta = np.concatenate([state.x, self.mean[k : len(self.space)], state.theta[k:]])
        theta[THICKNESS] = max(theta[THICKNESS], self.mean[THICKNESS])
        return State(theta, state.pose, state.center)

    def at(self, points: FloatArray) -> "CloudLikelihood":
        """The same likelihood, of points that have moved."""
        moved = copy.copy(self)
        moved.points = np.ascontiguousarray(points)
        moved.seen = moved._seen_at(moved.points)
        return moved

    def hiding(self, hidden: Hidden) -> "CloudLikelihood":
        """The same likelihood, where other points were not seen."""
        other = copy.copy(self)
        other.hidden = hidden
        other.seen = other._seen_at(other.points)
        return other

    def of_part(self, kept: NDArray[np.bool_], others: Hidden) -> "CloudLikelihood":
        """The likelihood of the points that are `kept` (n,), all that there are but where `others` are hidden."""
        part = copy.copy(self)
        part.points, part.organ = self.points[kept], self.organ[kept]
        part.weights = None if self.weights is None else self.weights[kept]
        part.hidden, part.is_part, part.seen = others, True, np.ones(len(part.points))
        return part

    def holding(self, state: State, held: NDArray[np.bool_]) -> "CloudLikelihood":
        """The same likelihood, with entries of theta `held` (k + 14,) where the state has them."""
        other = copy.copy(self)
        other.lower = np.where(held, state.theta, self.lower)
        other.upper = np.where(held, state.theta, self.upper)
        return other

    def one_sided(self) -> "CloudLikelihood":
        """The same likelihood, of a stem that may have been seen from one side."""
        other = copy.copy(self)
        other.lower, other.upper = self.lower.copy(), self.upper.copy()
        other.lower[FACING], other.upper[FACING] = -MOST_FACING, MOST_FACING
        return other

    def with_prior(self, those: NDArray[np.bool_], weight: float) -> "CloudLikelihood":
        """The same likelihood, in which the prior of `those` entries (k + 14,) of theta counts `weight` times."""
        other = copy.copy(self)
        other.prior_weight = np.where(those, weight, 1.0)
        return other

    @property
    def pull(self) -> FloatArray:
        """Second derivatives (k + 14,) of the error by theta that the prior brings."""
        return self.precision * self.prior_weight

    def _seen_at(self, points: FloatArray) -> FloatArray:
        return np.ones(len(points)) if self.hidden is None or self.is_part else 1.0 - self.hidden.at(points)

    def with_theta(self, state: State, theta: FloatArray) -> State:
        return State(theta, state.pose, state.center)

    @property
    def void(self) -> Void | None:
        """The ball around the leaf's base of which nothing was seen, if there is one."""
        return None if self.hidden is None else self.hidden.void

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which entries (k + 14,) of theta are not held fixed."""
        return self.lower < self.upper

    def gradient(self, state: State, at: Evaluation) -> FloatArray:
        """Derivatives (k + 14,) of the error, where the state was evaluated."""
        of_points = at.scores.sum(axis=0) if self.weights is None else self.weights @ at.scores
        gradient: FloatArray = (state.theta - self.mean) * self.pull - of_points
        return gradient

    def pose_of(self, state: State) -> FloatArray:
        """Pose (4, 4) from the model's frame to the cloud's."""
        turn = Rotation.from_rotvec(state.turn).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = turn @ state.pose[:3, :3]
        pose[:3, 3] = turn @ (state.pose[:3, 3] - state.center) + state.center + state.shift
        return pose

    def _leaf_area(
        self, leaf: Organ, length: FloatArray, half: FloatArray, state: State, steps: FloatArray
    ) -> tuple[float, FloatArray]:
        """Area of the leaf, as far as it was seen, and the change (k + 7,) of its logarithm by parameters and pose.

        The leaf is a population as :func:`segment_changes` takes it, in the model's frame; `steps` are empty where the
        change is not wanted.
        """
        middle = 0.5 * (half[:, 1:] + half[:, :-1])
        whole = 2.0 * length * middle
        if self.hidden is None:
            return _log_change(whole.sum(axis=1), steps)
        whole = np.repeat(whole[..., np.newaxis] / N_STRIPS, N_STRIPS, axis=2)
        return self._seen_area(
            cells(leaf.axis, leaf.frame, length, middle), whole, self.hidden.around_cells, state, steps
        )

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
        share is `hidden`; and the change (k + 7,) of its logarithm."""
        pose = self.pose_of(state)
        places = places @ pose[:3, :3].T + pose[:3, 3]
        rest = tuple(range(1, whole.ndim))
        area, change = _log_change(np.sum(whole * (1.0 - hidden(places)), axis=rest), steps)
        if len(steps):
            arm = places[0] - state.center - state.shift
            turned = [np.cross(axis, arm) for axis in _left_jacobian(state.turn).T]
            moves = POSE_STEP * np.array([*turned, *(np.broadcast_to(axis, arm.shape) for axis in np.eye(3))])
            share = np.sum(whole[0] * hidden(np.concatenate([places[0] + moves, places[0] - moves])), axis=rest)
            change[-6:] = (share[6:] - share[:6]) / (2.0 * POSE_STEP * area)
        return area, change

    def evaluate(self, state: State, *, derivatives: bool = True) -> Evaluation:
        """The error and, if wanted, the scores (n, k + 14) of a state."""
        k = len(self.space)
        n_steps = k + 1 if derivatives else 0
        columns = np.repeat(state.theta[np.newaxis, : k + 1], 2 * n_steps + 1, axis=0)
        steps = STEP * self.std[:n_steps]
        raised = np.arange(n_steps)
        columns[1 + raised, raised] += steps
        columns[1 + n_steps + raised, raised] -= steps
        stem, leaf = self.model.organs(columns[:, :k])
        length, half = _seen(leaf, columns[:, k])
        stem_length = stem.segment_lengths
        radius = 0.5 * (stem.half_width[:, 1:] + stem.half_width[:, :-1])
        pose = self.pose_of(state)
        r, t = pose[:3, :3], pose[:3, 3]
        n_columns = k + 7 if derivatives else 0
        leaf_area, leaf_area_change = self._leaf_area(leaf, length, half, state, steps)
        stem_area, stem_area_change = self._stem_area(stem, state, steps)
        leaf_change = np.empty((leaf.frame.shape[1], CHANGES, n_columns))
        stem_change = np.empty((stem.frame.shape[1], CHANGES, n_columns))
        if derivatives:
            # axes of turning, shifts and centre as the model's frame sees them
            about = r.T @ _left_jacobian(state.turn), r.T, r.T @ (state.center + state.shift - t)
            segment_changes(leaf.axis, leaf.frame, length, half, steps, *about, leaf_change)
            segment_changes(stem.axis, stem.frame, stem_length, stem.half_width, steps, *about, stem_change)
        n = len(self.points)
        log_p = np.empty(n)
        scores = np.empty((n if derivatives else 0, k + N_EXTRA))
        arguments = (
            leaf.axis[0, :-1] @ r.T + t, r @ leaf.frame[0], length[0], half[0], leaf_area, leaf_change,
            leaf_area_change,
            stem.axis[0, :-1] @ r.T + t, r @ stem.frame[0], stem_length[0], radius[0], stem_area,
            stem_change, stem_area_change,
            state.facing, state.noise, state.share, self.outlier_density,
        )  # fmt: skip

        def block(first: int) -> None:
            part = slice(first, first + BLOCK)
            log_density(self.points[part], self.organ[part], self.seen[part], *arguments, log_p[part], scores[part])

        firsts = range(0, n, BLOCK)
        done: Iterable[None] = map(block, firsts) if self._executor is None else self._executor.map(block, firsts)
        for _ in done:
            pass
        if derivatives and self.void is not None:
            scores[:, FACING] -= np.outer(scores[:, -2] + state.share[0], self._by_facing(stem, self.void, state))
        prior = 0.5 * float(np.sum((state.theta - self.mean) ** 2 * self.pull))
        return Evaluation(prior - float(log_p.sum() if self.weights is None else self.weights @ log_p), scores, log_p)


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
    """The first of areas (c,) of a population as :func:`segment_changes` takes it, and the change (k + 7,) of its
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
