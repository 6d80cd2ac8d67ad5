"""What `speed.py` measures phytofit against: ICP and the Hausdorff distance composed from other libraries.

A peer is made for one reference cloud, builds there whatever it can build once, and is then given the points of one
candidate after the other.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

FAR_CM = 1e3  # every point has a match, as in the paper's ICP


class Peer(NamedTuple):
    """Two steps on points (n, 3) float64, with poses (4, 4).

    ``align(points, pose, iterations)`` gives the pose where ICP ends and how often it has matched the points;
    ``distance(points, pose)`` is the Hausdorff distance of the points there.
    """

    name: str
    align: Callable[[np.ndarray, np.ndarray, int], tuple[np.ndarray, int]]
    distance: Callable[[np.ndarray, np.ndarray], float]


def small_gicp_peer(reference: np.ndarray) -> Peer:
    """ICP of small_gicp on its k-d tree, and two queries of SciPy's."""
    target = small_gicp.PointCloud(reference)
    tree = small_gicp.KdTree(target)

    def align(points: np.ndarray, pose: np.ndarray, iterations: int) -> tuple[np.ndarray, int]:
        result = small_gicp.align(
            target,
            small_gicp.PointCloud(points),
            tree,
            init_T_target_source=pose,
            registration_type="ICP",
            max_correspondence_distance=FAR_CM,
            num_threads=1,
            max_iterations=iterations,
            rotation_epsilon=0.0,
            translation_epsilon=0.0,
        )
        # its iterations count from 0; with nothing left to gain in its damped steps it ends although the limits are 0
        return result.T_target_source, result.iterations + 1

    return Peer("small_gicp + cKDTree", align, _tree_distance(reference))


def scipy_peer(reference: np.ndarray) -> Peer:
    """The loop of Besl and McKay (1992) with SciPy's k-d tree and a singular value decomposition."""
    tree = cKDTree(reference)

    def align(points: np.ndarray, pose: np.ndarray, iterations: int) -> tuple[np.ndarray, int]:
        r, t = pose[:3, :3], pose[:3, 3]
        for _ in range(iterations):
            _, match = tree.query(points @ r.T + t)
            r, t = best_motion(points, reference[match])
        return as_pose(r, t), iterations

    return Peer("NumPy and SciPy", align, _tree_distance(reference))


def open3d_peer(reference: np.ndarray) -> Peer:
    """Open3D's ICP and cloud distances; it builds its trees anew in every call.  ImportError where it is absent."""
    import open3d  # noqa: PLC0415  an extra

    registration = open3d.pipelines.registration
    target = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(reference))

    def align(points: np.ndarray, pose: np.ndarray, iterations: int) -> tuple[np.ndarray, int]:
        result = registration.registration_icp(
            open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)),
            target,
            FAR_CM,
            pose,
            registration.TransformationEstimationPointToPoint(),
            registration.ICPConvergenceCriteria(relative_fitness=0.0, relative_rmse=0.0, max_iteration=iterations),
        )
        return result.transformation, iterations

    def distance(points: np.ndarray, pose: np.ndarray) -> float:
        source = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        source.transform(pose)
        to_target, from_target = (
            source.compute_point_cloud_distance(target),
            target.compute_point_cloud_distance(source),
        )
        return float(max(np.max(to_target), np.max(from_target)))

    return Peer("Open3D", align, distance)


def _tree_distance(reference: np.ndarray) -> Callable[[np.ndarray, np.ndarray], float]:
    tree = cKDTree(reference)

    def distance(points: np.ndarray, pose: np.ndarray) -> float:
        moved = points @ pose[:3, :3].T + pose[:3, 3]
        return float(max(tree.query(moved)[0].max(), cKDTree(moved).query(reference)[0].max()))

    return distance


class AtRest(NamedTuple):
    """Where ICP ended: error is the Hausdorff distance there, cm, and rmse that of the points' matches."""

    error: float
    rmse: float
    pose: np.ndarray


def icp_to_rest(
    points: np.ndarray,
    reference: np.ndarray,
    tree: cKDTree,
    pose: np.ndarray,
    *,
    max_iterations: int = 500,
    tolerance_cm: float = 1e-4,
) -> AtRest:
    """Plain ICP of points (n, 3) until a round moves them by less than `tolerance_cm`, root mean square.

    The matches are exact, but they are looked for no more often than they may have changed.  No match changes while
    its point is within half of what the second nearest is further away than the nearest; and it is one of the few
    nearest of the last look-up in the tree as long as one of these is nearer than any other can have become.
    """
    r, t = pose[:3, :3], pose[:3, 3]
    moved = points @ r.T + t
    few = min(8, len(reference) - 1)  # neighbours kept of each point
    match = np.empty(len(points), int)
    near = np.zeros((len(points), few), int)
    others = np.full(len(points), -np.inf)  # distance of the nearest point that is not kept, at the last look-up
    slack = np.full(len(points), -1.0)
    asked_at, checked_at = moved.copy(), moved.copy()
    for _ in range(max_iterations):
        stale = np.flatnonzero(_lengths(moved - checked_at) >= slack)
        distance = _lengths(reference[near[stale]] - moved[stale, np.newaxis])
        gap = others[stale] - _lengths(moved[stale] - asked_at[stale])
        lost = np.flatnonzero(distance.min(axis=1) >= gap)
        if len(lost):
            which = stale[lost]
            found, index = tree.query(moved[which], k=few + 1)
            near[which], others[which], asked_at[which] = index[:, :few], found[:, few], moved[which]
            distance[lost], gap[lost] = found[:, :few], found[:, few]
        match[stale] = near[stale, distance.argmin(axis=1)]
        two = np.partition(np.column_stack([distance, gap]), 1, axis=1)
        slack[stale] = 0.5 * (two[:, 1] - two[:, 0])
        checked_at[stale] = moved[stale]
        r, t = best_motion(points, reference[match])
        before, moved = moved, points @ r.T + t
        if np.sqrt(np.mean(_lengths(moved - before) ** 2)) < tolerance_cm:
            break
    to_reference = tree.query(moved)[0]
    error = max(to_reference.max(), cKDTree(moved).query(reference)[0].max())
    return AtRest(float(error), float(np.sqrt(np.mean(to_reference**2))), as_pose(r, t))


def yardstick(job: tuple[np.ndarray, np.ndarray, np.ndarray, Sequence[np.ndarray], int, int]) -> tuple[float, float]:
    """The error of a candidate by ICP from several starts to rest, as good as patience makes it.

    job : points (n, 3); the junction (3,) of leaf and stem among them; reference (m, 3); start poses (4, 4), each
    with the place of the junction; how many starts; a seed.

    The start pose that looks best to a short ICP of every 10th point is the first start; the others are tilted from
    it by 7 degrees about a random line through the junction, and shifted by 1.5 cm in a random direction.  Returns
    the Hausdorff distance, cm, where the root mean square distance is least, and the least of all starts.
    """
    points, junction, reference, starts, n_starts, seed = job
    tree = cKDTree(reference)
    few = points[::10]
    scouted = [icp_to_rest(few, reference, tree, placed(junction, s), max_iterations=30).rmse for s in starts]
    start = starts[int(np.argmin(scouted))]
    random = np.random.default_rng(seed)
    ends = [icp_to_rest(points, reference, tree, placed(junction, start))]
    for _ in range(n_starts - 1):
        other = start.copy()
        other[:3, :3] = _tilt(random, 7.0) @ start[:3, :3]
        other[:3, 3] += 1.5 * _direction(random)
        ends.append(icp_to_rest(points, reference, tree, placed(junction, other)))
    return min(ends, key=lambda end: end.rmse).error, min(end.error for end in ends)


def placed(junction: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of the model's frame that brings its junction (3,) to the origin of the start."""
    return as_pose(start[:3, :3], start[:3, 3] - start[:3, :3] @ junction)


def best_motion(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rigid motion r (3, 3), t (3,) that brings points (n, 3) nearest to their partners (n, 3) (Kabsch 1976)."""
    p, q = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - p).T @ (target - q))
    r = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return r, q - r @ p


def as_pose(r: np.ndarray, t: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = r, t
    return pose


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Of vectors (..., 3); faster than NumPy's norm."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _direction(random: np.random.Generator) -> np.ndarray:
    vector = random.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _tilt(random: np.random.Generator, degrees: float) -> np.ndarray:
    """Rotation (3, 3) by so much about a random line (Rodrigues)."""
    x, y, z = _direction(random)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
