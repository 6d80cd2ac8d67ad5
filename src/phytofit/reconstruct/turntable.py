"""A turntable in front of a fixed camera: what turns, its axis, and the angle of each view, from the data."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from phytofit.errors import InputError

__all__ = ["Turn", "find_turn", "moving_pixels", "scene_without_plant", "turn_model", "turn_poses"]

FloatArray = NDArray[np.float64]
CELL_CM = 1.0  # of the distance fields that the search looks up, at least
MOST_CELLS = 150  # of a field along each axis: a large plant gets larger cells
FAR_CM = 5.0  # distances beyond count as this: half hidden views have nothing near
GAPS = (1, 2, 3)  # views apart, whose agreement the search sums
UP_TILTS = np.radians(np.arange(-20.0, 81.0, 10.0))  # how far the camera looks down that is tried
STEPS_DEG = np.arange(6.0, 121.0, 3.0)  # that are tried where no step is given
BEST_KEPT = 8  # starts of the search that are refined a little; the best two to the end


@dataclass(frozen=True, eq=False)
class Turn:
    """An axis in the camera's frame, cm: ``up`` (3,), ``point`` (3,); and the ``angles`` (n,) of the views, rad."""

    up: FloatArray
    point: FloatArray
    angles: FloatArray


def scene_without_plant(depths: FloatArray, *, far_share: float = 0.75) -> FloatArray:
    """What stands still behind the plant: the depth (height, width) that each pixel shows where nothing is in front.

    That is the `far_share` quantile of what came back over the views (n, height, width), since a plant that turns
    leaves most pixels free in most views; infinite where less than a third of the views saw anything.
    """
    n_seen = (depths > 0).sum(axis=0)
    ordered = np.sort(np.where(depths > 0, depths, np.inf), axis=0)
    rank = np.floor(far_share * np.maximum(n_seen - 1, 0)).astype(int)
    scene = np.take_along_axis(ordered, rank[None], axis=0)[0]
    return np.where(3 * n_seen >= len(depths), scene, np.inf)


def moving_pixels(
    depth: FloatArray, scene: FloatArray, *, least_cm: float = 2.0, noise_share: float = 0.01
) -> NDArray[np.bool_]:
    """Pixels (height, width) that lie in front of the still scene by more than `least_cm` and a share of the depth."""
    return (depth > 0) & (depth < scene - least_cm - noise_share * np.where(np.isfinite(scene), scene, 0.0))


class _Fields:
    """Distances to the points of each view, cm, at most `FAR_CM`, looked up in grids of one shape."""

    def __init__(self, clouds: Sequence[FloatArray], centre: FloatArray, reach: float) -> None:
        self.low, self.cell = centre - reach, max(CELL_CM, 2 * reach / MOST_CELLS)
        n_cells = int(2 * reach / self.cell) + 1
        self.distance = np.full((len(clouds), *(n_cells + 2,) * 3), FAR_CM, dtype=np.float32)  # a rim all around
        for field, points in zip(self.distance, clouds, strict=True):
            free = np.ones((n_cells,) * 3, bool)
            cells = np.floor((points - self.low) / self.cell).astype(int)
            free[tuple(cells[((cells >= 0) & (cells < n_cells)).all(axis=1)].T)] = False
            field[1:-1, 1:-1, 1:-1] = np.minimum(ndimage.distance_transform_edt(free) * self.cell, FAR_CM)

    def rough(self, points: FloatArray, first: int) -> float:
        """The mean distance of points (k, m, 3) of k views to the views from `first` on, to the nearest cell."""
        cells = ((points - self.low) / self.cell + 1.0).astype(np.intp).clip(0, self.distance.shape[1] - 1)
        view = first + np.arange(len(points))[:, None]
        return float(self.distance[view, cells[..., 0], cells[..., 1], cells[..., 2]].mean())

    def smooth(self, points: FloatArray, first: int) -> float:
        """The same, between the cells."""
        places = np.empty((4, points.shape[0] * points.shape[1]))
        places[0] = np.repeat(first + np.arange(len(points)), points.shape[1])
        places[1:] = ((points - self.low) / self.cell + 0.5).reshape(-1, 3).T
        return float(ndimage.map_coordinates(self.distance, places, order=1, mode="constant", cval=FAR_CM).mean())


def _turned(points: FloatArray, up: FloatArray, point: FloatArray, angle: float) -> FloatArray:
    R = Rotation.from_rotvec(angle * up).as_matrix()
    return np.asarray((points - point) @ R.T + point)


def _axis(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Up and a point of the axis for tilt, roll and the point: x (5,)."""
    up = np.array([np.sin(x[1]), -np.cos(x[0]) * np.cos(x[1]), -np.sin(x[0]) * np.cos(x[1])])
    return up, x[2:5]


def find_turn(
    clouds: Sequence[FloatArray],
    *,
    step_deg: float | None = None,
    tolerance: float = 0.35,
    n_samples: int = 250,
    progress: Callable[[str], None] = lambda _: None,
) -> Turn:
    """The axis and the angles of views of something that turns by about the same step between each two.

    Tried are axes that are tilted as a camera looks down, at several depths, with every step either way; the best are
    refined, on how near the turned points of a view are to those of the next ones.  Then each view's own step
    is measured: one that is doubled turned by 0, one that is missing leaves a step of two.

    Parameters
    ----------
    clouds
        (m, 3) of each of n views, cm, in the camera's frame, y down: what turns.
    step_deg
        The nominal step; the true one is sought within a share `tolerance` of it, either way.
    n_samples
        Points of each view that are compared.

    Raises
    ------
    InputError
        If there are fewer than 3 views.
    """
    if len(clouds) < 3:
        raise InputError(f"found {len(clouds)} views with a plant, expected at least 3 of a turntable")
    samples = np.stack([c[np.linspace(0, len(c) - 1, n_samples).astype(int)] for c in clouds])
    centre = np.median(samples.reshape(-1, 3), axis=0)
    reach = float(np.quantile(np.linalg.norm(samples.reshape(-1, 3) - centre, axis=1), 0.99)) + 2 * FAR_CM
    fields = _Fields(clouds, centre, reach)
    few = samples[:, ::2]

    def cost(x: FloatArray) -> float:
        up, point = _axis(x)
        return float(np.mean([fields.smooth(_turned(samples[:-gap], up, point, gap * x[5]), gap) for gap in gaps]))

    progress("axis and step")
    tries = STEPS_DEG if step_deg is None else step_deg * np.linspace(1 - tolerance, 1 + tolerance, 15)
    steps = np.radians(np.concatenate([tries, -tries]))
    offsets = reach * np.linspace(-0.1, 0.3, 5)  # of the axis behind what is seen, which faces the camera
    starts: list[tuple[float, int, FloatArray]] = []
    for tilt in UP_TILTS:
        for offset in offsets:
            point = centre + np.array([0.0, 0.0, offset])
            for step in steps:
                x = np.array([tilt, 0.0, *point, step])
                rough = fields.rough(_turned(few[:-1], *_axis(x), step), 1)
                starts.append((rough, len(starts), x))
    starts.sort(key=lambda start: start[:2])
    gaps = [gap for gap in GAPS if gap < len(clouds)]
    hills = [_descend(cost, x, 70) for _, _, x in _apart(starts)]
    hills.sort(key=lambda hill: hill[0])
    best = min((_descend(cost, x, 250) for _, x in hills[:2]), key=lambda hill: hill[0])[1]
    up, point = _axis(best)
    progress("angles")
    return Turn(up, point, _angles(samples, fields, up, point, float(best[5])))


def _apart(starts: Sequence[tuple[float, int, FloatArray]]) -> list[tuple[float, int, FloatArray]]:
    """The best starts whose steps and tilts differ: of each hill one, as far as can be told."""
    kept: list[tuple[float, int, FloatArray]] = []
    for start in starts:
        if all(abs(start[2][5] - k[2][5]) > np.radians(4) or abs(start[2][0] - k[2][0]) > np.radians(25) for k in kept):
            kept.append(start)
        if len(kept) == BEST_KEPT:
            break
    return kept


def _descend(cost: Callable[[FloatArray], float], x: FloatArray, n_most: int) -> tuple[float, FloatArray]:
    """The least cost that Nelder and Mead's search finds with `n_most` looks, and where; the height of the point, along
    which nothing changes, stays."""
    free, first_steps = [0, 1, 2, 4, 5], [0.1, 0.1, 2.0, 2.0, 0.05]

    def part(y: FloatArray) -> float:
        whole = x.copy()
        whole[free] = y
        return cost(whole)

    simplex = x[free] + np.vstack([np.zeros(5), np.diag(first_steps)])
    options = {"initial_simplex": simplex, "maxfev": n_most, "xatol": 1e-3, "fatol": 1e-3}
    ended = minimize(part, x[free], method="Nelder-Mead", options=options)
    whole = x.copy()
    whole[free] = ended.x
    return float(ended.fun), whole


def _angles(samples: FloatArray, fields: _Fields, up: FloatArray, point: FloatArray, step: float) -> FloatArray:
    """The angle of each view: the common step, unless none, two or three steps fit a pair clearly better."""

    def cost(i: int, angle: float) -> float:
        there = fields.smooth(_turned(samples[i : i + 1], up, point, angle), i + 1)
        back = fields.smooth(_turned(samples[i + 1 : i + 2], up, point, -angle), i)
        return (there + back) / 2

    turned = [0.0]
    for i in range(len(samples) - 1):
        tries = step * (np.array([0.0, 1.0, 2.0, 3.0])[:, None] + np.array([-0.1, 0.0, 0.1]))
        costs = np.array([[cost(i, angle) for angle in row] for row in tries])
        multiple = int(np.argmin(costs.min(axis=1)))
        if costs[multiple].min() > 0.7 * costs[1].min():
            multiple = 1
        turned.append(turned[-1] + tries[multiple][np.argmin(costs[multiple])])
    return np.array(turned)


def turn_poses(turn: Turn) -> FloatArray:
    """Poses (n, 4, 4), camera to the frame of the first view's camera, for the views of a turn."""
    poses = np.tile(np.eye(4), (len(turn.angles), 1, 1))
    for pose, angle in zip(poses, turn.angles, strict=True):
        pose[:3, :3] = Rotation.from_rotvec(-angle * turn.up).as_matrix()
        pose[:3, 3] = turn.point - pose[:3, :3] @ turn.point
    return poses


def turn_model(turn: Turn) -> tuple[Callable[[FloatArray], Turn], int]:
    """Turns near this one, as a function of 4 + (n - 1) numbers: tilts (rad) and shifts (cm) of the axis across
    itself, then changes of the angles (rad) after the first; and how many numbers that are."""
    across = np.linalg.svd(turn.up[None])[2][1:]

    def moved(x: FloatArray) -> Turn:
        up = turn.up + x[:2] @ across
        angles = turn.angles + np.concatenate([[0.0], x[4:]])
        return Turn(up / np.linalg.norm(up), turn.point + x[2:4] @ across, angles)

    return moved, 3 + len(turn.angles)
