"""The start pose: where the stem stands in the cloud, which way is up, and on which side the leaf is.

ICP is only local: the model must begin near where it belongs.  Here the cloud may lie in any orientation, and nobody
turns it by hand.  Everything is computed from distances and inner products of the points, taken in the order in
which they are stored: a rotated copy of a cloud gets the rotated pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from phytofit.errors import NoPhytomerError
from phytofit.kernels.neighbors import near_line

__all__ = ["StartPose", "near_stem", "parts_of_stem", "start_poses", "with_tube"]

FloatArray = NDArray[np.float64]
N_POINTS = 2000  # of the cloud, evenly by index: enough to see a stem by
N_SEEDS = 160
LEAST_NEAR = 10  # points along a line
N_LINES = 2  # different lines that are handed on
LEAST_SCORE = 0.3  # cm; a sphere or a wall gets 0.2 by chance, a phytomer with little left of its stem 0.4
LEAST_SHARE = 0.6  # of the best line's score: a line that looks less like a stem is not handed on
LEAST_ROUNDNESS = 0.3  # thin over wide of a section: a blade in 0.5 cm of noise reaches about 0.4, a stem 0.7 to 1
MAX_AROUND = 1.5  # points close around a stem over those on it: a leaf's base gives up to about 1, plain noise 3
MAX_SLOPE = 2.0  # of a leaf's base, rise over run, when it is followed into the stem
MAX_TILT_COSINE = 0.34  # with `up` given, a stem leans by less than 70 degrees
STEM_MARGIN, STEM_MARGIN_CM = 1.3, 1.0  # of its radius, and more, around a stem within which points may be the stem's
BESIDE_CM = 8.0  # of a leaf, from its stem: so far it is nearly straight
N_TUBES, TUBE_NOISE_CM = 2, 0.4  # fits, each to the points around the one before; from where a point counts little
TUBE_SLOPE, TUBE_WIDER = 0.4, 1.5  # from the line that it starts from, at most: cm sideways per cm along; times


@dataclass(frozen=True)
class StartPose:
    """A rigid pose to start the search from, and what was seen of the stem.

    ``pose`` (4, 4) maps the model's directions to the cloud's (+z up the stem, +x to the leaf's side) and has the place
    where the leaf joins the stem's axis as its origin, cm.  ``foot`` and ``top`` are heights of the stem's ends from
    there, ``radius`` the stem's, cm; ``curl`` is negative where the leaf bends down (1/cm); ``score`` the length of
    line that looks like a stem, cm, weighted by roundness.
    """

    pose: FloatArray
    foot: float
    top: float
    radius: float
    curl: float
    score: float


def start_poses(points: FloatArray, stem_radius: float, *, up: FloatArray | None = None) -> list[StartPose]:
    """Candidate start poses, most stem-like line first, and of its two directions the one first that looks up.

    Where `up` is known, only directions that rise along it.

    Parameters
    ----------
    points : (n, 3) cm, cleaned
    stem_radius : the largest that is expected, cm
    up : (3,) the upward direction where known

    Raises NoPhytomerError where no line of the cloud has round sections along it, or nothing sticks out beside it.
    """
    sample = points[np.linspace(0, len(points) - 1, min(len(points), N_POINTS)).astype(int)]
    found = []
    for center, axis in _lines(sample, stem_radius):
        both = [_pose_on_line(sample, center, direction, stem_radius) for direction in (axis, -axis)]
        pair = [start for start in both if start is not None]
        if up is not None:
            pair = [start for start in pair if start.pose[:3, 2] @ up >= MAX_TILT_COSINE * np.linalg.norm(up)]
        found += sorted(pair, key=lambda start: start.curl)  # leaves bend down
    if not found:
        raise NoPhytomerError(
            "no stem with a leaf was found: expected a straight piece with round sections and a leaf beside it"
            + (", rising along the stated up" if up is not None else "")
        )
    return found


def near_stem(upright: FloatArray, start: StartPose) -> NDArray[np.bool_]:
    """Which points (n, 3), in the start pose's frame, are so near to the stem that they may be of it."""
    return _near_tube(upright, np.array([0.0, 0.0, 0.0, 0.0, start.radius]), start.foot, start.top)


def with_tube(points: FloatArray, start: StartPose) -> StartPose:
    """The start pose, its score and curl apart, on the tube that lies nearest to the points (n, 3) around its stem.

    Leaves beside a wide stem tilt the line that `start_poses` finds along it, by ten degrees and more.  Robust least
    squares (Cauchy's loss) of the points' distances from a tube, which the leaves' move little.  In a stem that is
    filled with points, it is two thirds as wide.
    """
    radius, middle = start.radius, 0.5 * (start.foot + start.top)
    upright = (points - start.pose[:3, 3]) @ start.pose[:3, :3] - [0.0, 0.0, middle]
    foot, top = start.foot - middle, start.top - middle
    limit = np.array([2.0 * radius, 2.0 * radius, TUBE_SLOPE, TUBE_SLOPE])
    bounds = np.stack([np.append(-limit, radius / TUBE_WIDER), np.append(limit, radius * TUBE_WIDER)])
    tube = np.array([0.0, 0.0, 0.0, 0.0, radius])
    for _ in range(N_TUBES):
        near = upright[_near_tube(upright, tube, foot, top)]
        if len(near) < len(tube):
            return start
        tube = least_squares(
            lambda tube, near=near: _off_tube(near, tube), tube, bounds=bounds, loss="cauchy", f_scale=TUBE_NOISE_CM
        ).x
        foot, top = np.quantile(near[_off_tube(near, tube) < TUBE_NOISE_CM, 2], [0.01, 0.99])
    axis = np.array([*tube[2:4], 1.0]) / np.sqrt(1.0 + tube[2] ** 2 + tube[3] ** 2)
    side = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
    side /= np.linalg.norm(side)
    pose = start.pose.copy()
    pose[:3, 3] += pose[:3, :3] @ [*(tube[:2] - tube[2:4] * middle), 0.0]
    pose[:3, :3] = pose[:3, :3] @ np.stack([side, np.cross(axis, side), axis], axis=1)
    foot, top = float((foot + middle) / axis[2]), float((top + middle) / axis[2])
    return replace(start, pose=pose, foot=foot, top=top, radius=float(tube[4]))


def _off_tube(points: FloatArray, tube: FloatArray) -> FloatArray:
    """Distance (n,) from the surface of a tube (5,): where its axis is at height 0, its slopes, its radius."""
    distance: FloatArray = np.hypot(*(points[:, :2] - tube[:2] - tube[2:4] * points[:, 2:]).T) - tube[4]
    return distance


def _near_tube(points: FloatArray, tube: FloatArray, foot: float, top: float) -> NDArray[np.bool_]:
    margin = STEM_MARGIN * tube[4] + STEM_MARGIN_CM
    beside = _off_tube(points, tube) < margin - tube[4]
    near: NDArray[np.bool_] = beside & (points[:, 2] > foot - margin) & (points[:, 2] < top + margin)
    return near


def _sections(points: FloatArray, center: FloatArray, axis: FloatArray, radius: float) -> tuple[FloatArray, ...]:
    """Sections of the points around a line, each half a radius high: height, count, roundness, offset, spread."""
    offset = points[near_line(points, center, axis, radius, np.inf)] - center
    along = offset @ axis
    across = offset - along[:, np.newaxis] * axis
    step = 0.5 * radius
    if len(along) < 6:
        empty = np.zeros(0)
        return empty, empty, empty, empty, empty
    first = np.floor(along.min() / step)
    section = (np.floor(along / step) - first).astype(int)
    n = int(section.max()) + 1
    count = np.bincount(section, minlength=n).astype(float)
    safe = np.maximum(count, 1.0)
    mean = np.stack([np.bincount(section, across[:, a], n) for a in range(3)], axis=1) / safe[:, np.newaxis]
    centered = across - mean[section]
    cov = np.empty((n, 3, 3))
    for a in range(3):
        for b in range(a + 1):
            cov[:, a, b] = cov[:, b, a] = np.bincount(section, centered[:, a] * centered[:, b], n) / safe
    values = np.linalg.eigvalsh(cov)  # the first is 0: along the line
    roundness = np.sqrt(np.maximum(values[:, 1], 0.0) / np.maximum(values[:, 2], 1e-12))
    height = (first + np.arange(n) + 0.5) * step
    spread = np.sqrt(np.maximum(values[:, 1] + values[:, 2], 0.0))
    return height, count, np.where(count >= 5, roundness, 0.0), np.linalg.norm(mean, axis=1), spread


def _stem_score(points: FloatArray, center: FloatArray, axis: FloatArray, radius: float) -> float:
    """Length of the line that looks like a stem: round, centred, with no long gaps; weighted by roundness."""
    height, count, roundness, offset, _ = _sections(points, center, axis, radius)
    if len(height) == 0:
        return 0.0
    worth = np.clip(roundness - LEAST_ROUNDNESS, 0.0, None) * np.clip(1.0 - 2.0 * offset / radius, 0.0, None)
    worth = np.where(count > 0, worth, -0.3)
    best = run = 0.0
    for value in np.where(worth > 0, worth, -0.15):  # the best run, in which a few poor sections are forgiven
        run = max(run + value, 0.0)
        best = max(best, run)
    return best * 0.5 * radius


def _lines(points: FloatArray, radius: float) -> list[tuple[FloatArray, FloatArray]]:
    """The few most stem-like lines: points on them and unit directions."""
    seeds = points[np.linspace(0, len(points) - 1, min(len(points), N_SEEDS)).astype(int)]
    centers, axes = seeds.copy(), np.zeros_like(seeds)  # of no direction yet
    followed = list(range(len(seeds)))
    for width, reach in ((2.0, 2.0), (1.0, 2.5), (1.0, 4.0), (1.0, 6.0), (1.0, 6.0)):
        near = {i: near_line(points, centers[i], axes[i], width * radius, reach * radius) for i in followed}
        followed = [i for i in followed if len(near[i]) >= LEAST_NEAR]
        if not followed:
            return []
        moments = np.empty((len(followed), 3, 3))
        for moment, i in zip(moments, followed, strict=True):
            chosen = points[near[i]]
            centers[i] = chosen.mean(axis=0)
            deviation = chosen - centers[i]
            moment[:] = deviation.T @ deviation
        axes[followed] = np.linalg.eigh(moments)[1][:, :, 2]
    lines = [(_stem_score(points, centers[i], axes[i], radius), centers[i], axes[i]) for i in followed]
    lines.sort(key=lambda line: -line[0])
    kept: list[tuple[FloatArray, FloatArray]] = []
    for score, center, axis in lines:
        if score < LEAST_SCORE or len(kept) == N_LINES or score < LEAST_SHARE * lines[0][0]:
            break
        if all(_differ(center, axis, other, direction, radius) for other, direction in kept):
            # the sign of an eigenvector is arbitrary: take it from the points, so that it turns with them
            kept.append((center, axis if (points.mean(axis=0) - center) @ axis >= 0 else -axis))
    return kept


def _height_at_axis(distance: FloatArray, height: FloatArray, n_bins: int = 8) -> float:
    """Height at which a leaf's base, given by its points near the stem, would meet the stem's axis.

    The median slope between medians of bins (Theil and Sen): what else sticks out near the stem does not decide.
    """
    edges = np.quantile(distance, np.linspace(0.0, 1.0, n_bins + 1))
    bins = np.clip(np.searchsorted(edges, distance, side="right") - 1, 0, n_bins - 1)
    present = np.unique(bins)
    d = np.array([np.median(distance[bins == k]) for k in present])
    h = np.array([np.median(height[bins == k]) for k in present])
    i, j = np.triu_indices(len(d), k=1)
    apart = d[j] > d[i]
    if not apart.any():
        return float(np.median(height))
    slope = np.median((h[j] - h[i])[apart] / (d[j] - d[i])[apart])
    return float(np.median(h - np.clip(slope, -MAX_SLOPE, MAX_SLOPE) * d))


def parts_of_stem(points: FloatArray, radius: float) -> tuple[float, float] | None:
    """How far a stem goes on below and above its leaf, cm, by points (n, 3) in the frame of a fitted model: the stem
    along z, the leaf on +x.  None where too few points are of the leaf beside it."""
    distance, margin = np.hypot(points[:, 0], points[:, 1]), STEM_MARGIN * radius + STEM_MARGIN_CM
    on_stem = distance < margin
    if on_stem.sum() < LEAST_NEAR:
        return None
    foot, top = np.quantile(points[on_stem, 2], [0.01, 0.99])
    beside = (np.abs(points[:, 1]) < points[:, 0]) & ~on_stem & (distance < margin + BESIDE_CM)
    beside &= (points[:, 2] > foot - radius) & (points[:, 2] < top + radius)
    if beside.sum() < LEAST_NEAR:
        return None
    collar = _height_at_axis(distance[beside], points[beside, 2])
    return max(collar - float(foot), 0.0), max(float(top) - collar, 0.0)


def _differ(c0: FloatArray, a0: FloatArray, c1: FloatArray, a1: FloatArray, radius: float) -> bool:
    if abs(a0 @ a1) < np.cos(np.deg2rad(20.0)):
        return True
    gap = (c1 - c0) - ((c1 - c0) @ a0) * a0
    return float(np.linalg.norm(gap)) > radius


def _pose_on_line(points: FloatArray, center: FloatArray, axis: FloatArray, radius: float) -> StartPose | None:
    """The pose that has the stem on this line: refined axis, ends of the stem, collar and leaf side."""
    _, count, roundness, offset, spread = _sections(points, center, axis, radius)
    stemlike = (roundness > LEAST_ROUNDNESS) & (offset < 0.5 * radius) & (count >= 5)
    if stemlike.sum() < 2:
        return None
    stem_radius = float(np.median(spread[stemlike]))  # of a ring, the radius; of a disc, 0.7 of it
    along = (points - center) @ axis
    across = points - center - along[:, np.newaxis] * axis
    distance = np.linalg.norm(across, axis=1)
    on_stem = distance < min(1.6 * stem_radius + 0.1 * radius, radius)
    ends = np.quantile(along[on_stem], [0.01, 0.99])
    inside = (along > ends[0] - radius) & (along < ends[1] + radius)
    around = inside & ~on_stem & (distance < 2.0 * radius)
    if around.sum() > MAX_AROUND * (inside & on_stem).sum():  # the line runs through a heap of points, not along a stem
        return None
    leaf = distance > 1.6 * stem_radius + 0.25 * radius
    if leaf.sum() < max(20, 0.05 * len(points)):
        return None
    side = across[leaf].sum(axis=0)
    beside = leaf & inside & (distance < stem_radius + 2.0 * radius)
    if beside.sum() < 5:  # the leaf's base is hidden: take what is nearest to the stem
        order = np.argsort(distance[leaf], kind="stable")[: max(5, leaf.sum() // 10)]
        beside = np.flatnonzero(leaf)[order]
    collar = float(np.clip(_height_at_axis(distance[beside], along[beside]), ends[0], ends[1]))
    curl = float(np.polynomial.polynomial.polyfit(distance[leaf], along[leaf], 2)[2])
    side -= (side @ axis) * axis
    if np.linalg.norm(side) < 1e-9:
        return None
    x = side / np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    pose[:3, 3] = center + collar * axis
    score = float(_stem_score(points, center, axis, radius))
    return StartPose(pose, float(ends[0]) - collar, float(ends[1]) - collar, stem_radius, curl, score)
