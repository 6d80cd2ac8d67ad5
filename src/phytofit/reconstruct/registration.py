"""Registration of several views at once: point-to-plane ICP between all views that overlap."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

__all__ = ["Pair", "Surface", "exp_pose", "log_pose", "move_points", "pair_quality", "register"]

FloatArray = NDArray[np.float64]
REACHES_CM = (3.0, 2.0, 1.5, 1.0)  # how far apart matches may be, from coarse to fine
ROUNDS, LAST_ROUNDS = 2, 8  # of matching at each reach, and at the last, at most
SAME_SIDE = 0.5  # least cosine between the normals of a match: leaves and stems have two sides
AT_REST = 5e-3  # cm, at the plant's rim for rotations: smaller steps end a reach


class Surface:
    """Points (n, 3), cm, and unit normals (n, 3) of one view in its camera's frame, ready to be matched.

    Of the points `n_samples` at most, evenly by index, are matched to other views; all of them are matched to.
    """

    def __init__(self, points: FloatArray, normals: FloatArray, *, n_samples: int = 1000) -> None:
        self.points, self.normals = points, normals
        self.tree = cKDTree(points)
        self.sample = np.unique(np.linspace(0, len(points) - 1, min(n_samples, len(points))).round().astype(int))


@dataclass(frozen=True)
class Pair:
    """How well two views agree: ``overlap`` is the share of the first's points with a match within 1 cm,
    ``residual_cm`` the median distance of these to the other's surface along its normal."""

    first: int
    second: int
    overlap: float
    residual_cm: float


def move_points(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3) moved by a pose (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def exp_pose(twist: FloatArray) -> FloatArray:
    """The pose (4, 4) of a twist (6,): rotation vector, then translation."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    pose[:3, 3] = twist[3:]
    return pose


def log_pose(pose: FloatArray) -> FloatArray:
    """The twist (6,) of a pose (4, 4)."""
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def register(
    surfaces: Sequence[Surface],
    poses: FloatArray,
    pairs: Sequence[tuple[int, int]],
    model: Callable[[FloatArray], FloatArray],
    n_parameters: int,
    *,
    stiffness: FloatArray | None = None,
    reaches_cm: Sequence[float] = REACHES_CM,
) -> FloatArray:
    """Parameters (k,) of the poses that bring the surfaces of all pairs together.

    Damped Gauss-Newton on point-to-plane distances, matches anew each round.

    Parameters
    ----------
    surfaces, poses
        n views and where they start, (n, 4, 4): camera to world.
    pairs
        Views that may overlap, each once; matches are sought both ways.
    model
        Poses (n, 4, 4) for parameters (k,); zeros give the start.  What a model can't do, no view does: with the
        parameters of a turntable the views can only turn, with six for each they are free.
    n_parameters
        k.
    stiffness
        (k,) in points (matches a unit squared of the parameter): pulls each parameter to 0; none by default.
    reaches_cm
        From coarse to fine, how far apart matches may be.
    """
    x = np.zeros(n_parameters)
    stiff = np.zeros(n_parameters) if stiffness is None else stiffness
    centre = np.mean(
        [move_points(p, s.points.mean(axis=0)[None])[0] for p, s in zip(poses, surfaces, strict=True)], axis=0
    )
    size = max(float(np.linalg.norm(np.ptp(s.points, axis=0))) for s in surfaces)
    for reach in reaches_cm:
        for _ in range(LAST_ROUNDS if reach == reaches_cm[-1] else ROUNDS):
            now = model(x)
            H, b = _normal_equations(surfaces, now, pairs, reach, centre)
            J = _jacobian(model, x, now, centre)
            A = J.T @ H @ J + np.diag(stiff)
            step = -np.linalg.solve(A + 1e-6 * np.trace(A) / len(A) * np.eye(len(A)), J.T @ b + stiff * x)
            x = x + step
            moved = (J @ step).reshape(-1, 6)
            if np.abs(moved * np.repeat([size / 2, 1.0], 3)).max() < AT_REST:
                break
    return x


def _normal_equations(
    surfaces: Sequence[Surface], poses: FloatArray, pairs: Sequence[tuple[int, int]], reach: float, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """H (6n, 6n) and b (6n,) for twists of each view about the plant's centre, in the world's axes."""
    n = len(surfaces)
    H, b = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
    for i, j in [*pairs, *((j, i) for i, j in pairs)]:
        x, y, normal, residual = _matches(surfaces, poses, i, j, reach)
        # Welsch's weights; the scale shrinks with the reach, so that far matches lead at first and fade out
        weight = np.exp(-((residual / (0.5 * reach)) ** 2)) * np.exp(-((np.linalg.norm(x - y, axis=1) / reach) ** 2))
        a = np.concatenate([np.cross(x - centre, normal), normal], axis=1)
        Haa, ba = (a * weight[:, None]).T @ a, (a * weight[:, None]).T @ residual
        H[i, :, i] += Haa
        H[j, :, j] += Haa
        H[i, :, j] -= Haa
        H[j, :, i] -= Haa
        b[i] += ba
        b[j] -= ba
    return H.reshape(6 * n, 6 * n), b.ravel()


def _matches(
    surfaces: Sequence[Surface], poses: FloatArray, i: int, j: int, reach: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Sampled points of i, their matches on j, the normals there, and distances along these, in the world's frame."""
    source, target = surfaces[i], surfaces[j]
    T = np.linalg.inv(poses[j]) @ poses[i]
    moved = move_points(T, source.points[source.sample])
    turned = source.normals[source.sample] @ T[:3, :3].T
    distance, index = target.tree.query(moved, distance_upper_bound=reach)
    found = np.isfinite(distance)
    index = index[found]
    good = np.sum(turned[found] * target.normals[index], axis=1) >= SAME_SIDE
    x, y, normal = moved[found][good], target.points[index[good]], target.normals[index[good]]
    R = poses[j][:3, :3]
    return move_points(poses[j], x), move_points(poses[j], y), normal @ R.T, np.sum((x - y) * normal, axis=1)


def _jacobian(
    model: Callable[[FloatArray], FloatArray], x: FloatArray, now: FloatArray, centre: FloatArray
) -> FloatArray:
    """(6n, k): twists about the centre that a parameter's change makes, by small steps."""
    step = 1e-5
    back = np.linalg.inv(now)
    columns = []
    for k in range(len(x)):
        there = x.copy()
        there[k] += step
        change = model(there) @ back  # world to world
        twist = Rotation.from_matrix(change[:, :3, :3]).as_rotvec()
        shift = change[:, :3, :3] @ centre + change[:, :3, 3] - centre
        columns.append(np.concatenate([twist, shift], axis=1).ravel() / step)
    return np.stack(columns, axis=1)


def pair_quality(surfaces: Sequence[Surface], poses: FloatArray, i: int, j: int, *, reach_cm: float = 1.0) -> Pair:
    """How well the views i and j agree, of the points of both."""
    one, two = (_matches(surfaces, poses, a, b, reach_cm)[3] for a, b in ((i, j), (j, i)))
    both = np.abs(np.concatenate([one, two]))
    overlap = len(both) / (len(surfaces[i].sample) + len(surfaces[j].sample))
    return Pair(i, j, overlap, float(np.median(both)) if len(both) else float("nan"))
