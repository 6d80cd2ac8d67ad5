"""What of the views is the plant: the body that turns or stands in the middle, without pot, table and strays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phytofit.reconstruct.cameras import Camera
from phytofit.reconstruct.registration import move_points

__all__ = ["CORE_CM", "Support", "bodies", "cylinder", "find_support", "largest_body", "seen_through"]

FloatArray = NDArray[np.float64]
CORE_CM = 5.0  # nearer to the axis a stem may stand still while the plant turns


def largest_body(
    clouds: Sequence[FloatArray], *, cell_cm: float = 4.0, least_in_cell: int = 3
) -> list[NDArray[np.bool_]]:
    """Masks (n,) of the points of each cloud (n, 3), cm, that belong to the largest connected body of them all.

    Connected are cells of `cell_cm` that touch and hold at least `least_in_cell` points of all clouds together.
    """
    body = bodies(np.concatenate([np.zeros((0, 3)), *clouds]), cell_cm=cell_cm, least_in_cell=least_in_cell)
    return np.split(body == 0, np.cumsum([len(c) for c in clouds])[:-1])


def bodies(points: FloatArray, *, cell_cm: float, least_in_cell: int = 1) -> NDArray[np.intp]:
    """The connected body (n,) that each of the points (n, 3), cm, belongs to: 0 for the one of most points, then 1, …;
    -1 in cells of fewer than `least_in_cell`."""
    if not len(points):
        return np.zeros(0, np.intp)
    cells, cell, count = np.unique(
        np.floor(points / cell_cm).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    full = np.flatnonzero(count >= least_in_cell)
    body = np.full(len(cells), -1)
    if len(full):
        places = []
        for places_along in cells[full].T:  # what lies between cells that are far apart is empty, and left out
            known, index = np.unique(places_along, return_inverse=True)
            places.append(np.cumsum(np.minimum(np.diff(known, prepend=known[0]), 2))[index.ravel()])
        grid = np.zeros([place.max() + 1 for place in places], bool)
        grid[tuple(places)] = True
        label = ndimage.label(grid, np.ones((3, 3, 3)))[0][tuple(places)] - 1
        rank = np.argsort(np.argsort(-np.bincount(label, weights=count[full]), kind="stable"))
        body[full] = rank[label]
    return np.asarray(body[cell.ravel()])


def cylinder(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance from the z axis (n,), angle about it (n,), rad, and height (n,) of points (n, 3)."""
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0]), points[:, 2]


@dataclass(frozen=True, eq=False)
class Support:
    """What the plant stands in: round slices of ``slice_cm`` about the z axis from ``bottom`` up, each with a radius.

    ``radii`` (k,), cm, from the lowest slice to the highest; what is below counts as the lowest.
    """

    bottom: float
    slice_cm: float
    radii: FloatArray

    @property
    def top(self) -> float:
        """Where it ends, cm along z."""
        return self.bottom + len(self.radii) * self.slice_cm

    def covers(self, points: FloatArray, *, margin_cm: float = 1.0) -> NDArray[np.bool_]:
        """Which points (n, 3) belong to it, the margin included."""
        r, _, z = cylinder(points)
        wide = ndimage.maximum_filter1d(self.radii, 2 * int(np.ceil(margin_cm / self.slice_cm)) + 1, mode="nearest")
        level = np.floor((z - self.bottom) / self.slice_cm).astype(int).clip(0, len(wide) - 1)
        return np.asarray((z < self.top + margin_cm) & (r < wide[level] + margin_cm))

    def crumbs(self, points: FloatArray, *, cell_cm: float = 1.0, above_cm: float = 4.0) -> NDArray[np.bool_]:
        """Which points (n, 3) of a plant are pieces of the support that :meth:`covers` left, of a pot that leans or is
        not in the middle: bodies apart from the largest that lie by its rim, up to `above_cm` over it."""
        r, _, z = cylinder(points)
        body = bodies(points, cell_cm=cell_cm, least_in_cell=3) + 1  # 0: strays
        at_rim = (z < self.top + above_cm) & (r < self.radii.max() + above_cm)
        share = np.bincount(body, weights=at_rim, minlength=2) / np.maximum(np.bincount(body, minlength=2), 1)
        share[:2] = 1.0, 0.0
        return np.asarray(at_rim & (share > 0.9)[body])


def find_support(
    points: FloatArray,
    *,
    facing: float | None = None,
    slice_cm: float = 1.0,
    least_radius_cm: float = 3.0,
    most_radius_cm: float = 40.0,
    least_covered: float = 0.8,
    most_gap_cm: float = 5.0,
) -> Support | None:
    """Pot and table: slices across the z axis that are round about it, one upon the other; None if there are none.

    A slice is round if sectors of 15° nearly all (`least_covered`) hold points at about the same radius: within 1.5 cm
    or a fifth of it, so that square pots count.  A stem is thinner than `least_radius_cm`.  The support is the widest
    slice and the round ones above and below it, without a gap of more than `most_gap_cm`.

    Parameters
    ----------
    points
        (n, 3), cm, z along the plant's axis: what stands still while the plant turns, or all of it.
    facing
        The direction, rad about z, that the points were seen from; only 60° either side of it have to be covered.
    """
    r, azimuth, z = cylinder(points)
    if facing is not None:
        azimuth = (azimuth - facing + np.pi) % (2 * np.pi) - np.pi
    n_sectors = 24 if facing is None else 8
    sector = np.floor(azimuth / (np.pi / 12)).astype(int) + n_sectors // 2
    inside = (r >= least_radius_cm) & (r <= most_radius_cm) & (sector >= 0) & (sector < n_sectors)
    if inside.sum() < n_sectors:
        return None
    r, z, sector = r[inside], z[inside], sector[inside]
    bottom = float(z.min())
    level = np.floor((z - bottom) / slice_cm).astype(int)
    radii = np.array([_round_radius(r[level == k], sector[level == k], n_sectors, least_covered)
                      for k in range(level.max() + 1)])  # fmt: skip
    known = np.flatnonzero(np.isfinite(radii))
    if not len(known):
        return None
    runs = np.split(known, np.flatnonzero(np.diff(known) * slice_cm > most_gap_cm) + 1)
    run = max(runs, key=lambda levels: float(radii[levels].max()))
    between = np.interp(np.arange(run[-1] + 1), known, radii[known])
    return Support(bottom, slice_cm, between)


def _round_radius(r: FloatArray, sector: NDArray[np.intp], n_sectors: int, least_covered: float) -> float:
    """The radius of one slice, cm; not a number if it is not round."""
    nearest, farthest = np.full(n_sectors, np.inf), np.full(n_sectors, np.nan)
    for s in range(n_sectors):
        here = np.sort(r[sector == s])
        if len(here):
            nearest[s] = here[0]
            farthest[s] = here[np.append(np.diff(here) > 3.0, True).argmax()]  # up to the first gap
    known = np.isfinite(nearest)
    if known.mean() < least_covered:
        return float("nan")
    middle = np.median(nearest[known])
    alike = np.abs(nearest - middle) <= max(1.5, 0.2 * middle)
    return float(np.quantile(farthest[alike], 0.75)) if alike.mean() >= least_covered else float("nan")


def seen_through(
    points: FloatArray, poses: FloatArray, depths: Sequence[FloatArray], camera: Camera, *, margin_cm: float = 2.0
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For points (n, 3) of the world: how many views (n,) see something farther in their place, and how many see them.

    A view sees through a point if its pixel and the eight around it all came back from more than `margin_cm` behind;
    it sees the point if one of them came back from within half the margin.
    """
    through, seen = np.zeros(len(points), np.intp), np.zeros(len(points), np.intp)
    for pose, depth in zip(poses, depths, strict=True):
        there = move_points(np.linalg.inv(pose), points)
        u, v = camera.project(there)
        inside = (u > 0.5) & (v > 0.5) & (u < camera.width - 1.5) & (v < camera.height - 1.5)
        column, row = np.rint(u[inside]).astype(int), np.rint(v[inside]).astype(int)
        z = there[inside, 2]
        around = np.stack([depth[row + dv, column + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
        index = np.flatnonzero(inside)
        through[index] += ((around > z + margin_cm) & (around > 0)).all(axis=0)
        seen[index] += ((around > 0) & (np.abs(around - z) < margin_cm / 2)).any(axis=0)
    return through, seen
