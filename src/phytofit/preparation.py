"""Before a fit: the cloud is cleaned, its stem found, and what is left thinned as it looks from there."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from phytofit.cloud import PointCloud, remove_outliers, size_cm, thin
from phytofit.errors import SettingError
from phytofit.pose import StartPose, start_poses
from phytofit.species import Species

__all__ = ["AXES", "Prepared", "parse_points", "parse_up", "prepare"]

FloatArray = NDArray[np.float64]
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
STEM_MARGIN, STEM_MARGIN_CM = 1.3, 1.0  # of its radius, and more, around a stem within which points are the stem's
LINK, LINK_NEIGHBOR, LEAST_LINK_CM = 1.5, 8, 0.3  # points within so many typical distances of a neighbour are connected
LEAST_PIECE = 30  # points; fewer are no piece of anything, and are left to be told for outliers
NEAREST_CM = 3.0  # within which a seed point must have a point of a leaf
CANONICAL_DECIMALS = 6  # cm; hides the rounding of a rotated copy's coordinates


@dataclass(frozen=True)
class Prepared:
    """A cloud ready to be fitted.

    ``used`` is the cloud, without outliers unless they were to be kept, ``kept`` (m,) the indices of its points that
    are left when it is thinned, ``points`` (m, 3) those as seen from the best start pose, upright, in the prior's cm,
    ``organ`` (m,) what their labels say (0 stem, 1 leaf, -1 unknown) or None; ``starts`` the start poses in that
    frame; ``home`` (4, 4) maps it to the cloud's, ``scale`` of whose lengths make a cm.  ``notes`` tell what was left
    out.
    """

    used: PointCloud
    kept: NDArray[np.intp]
    points: FloatArray
    organ: NDArray[np.int8] | None
    starts: list[StartPose]
    home: FloatArray
    scale: float
    notes: tuple[str, ...] = ()


def prepare(
    cloud: PointCloud,
    species: Species,
    *,
    n_points: int,
    up: FloatArray | None = None,
    with_outliers: bool = False,
    seed_points: FloatArray | None = None,
) -> Prepared:
    """Clean a cloud, find where its stem stands, and thin it as it looks from there.

    The stem is looked for without outliers; `with_outliers` keeps them for the fit, in case that it accounts for them,
    and then thins the cloud at random: one point a voxel would change how points are spread around a surface.
    The coordinates are rounded, so that a rotated copy of the cloud gives the same numbers.

    seed_points : (k, 3) in the cloud's unit, on the leaf that is meant: beside the stem only points count that are
        connected with one of them
    """
    clean = used = cloud.take(remove_outliers(cloud.points))
    if with_outliers:
        used = cloud
    scale = size_cm(clean.points) / _expected_size(species) if cloud.unit == "none" else 1.0
    starts = start_poses(clean.points / scale, _largest_stem_radius(species), up=up)
    if seed_points is not None:
        meant = cloud.take(np.flatnonzero(_meant(cloud.points / scale, starts[0], seed_points / scale)))
        found = prepare(meant, species, n_points=n_points, up=up, with_outliers=with_outliers)
        left_out = f"{len(cloud) - len(meant)} of {len(cloud)} points left out: not connected with a seed point"
        return replace(found, notes=(left_out, *found.notes))
    home = starts[0].pose
    upright = np.round((used.points / scale - home[:3, 3]) @ home[:3, :3], CANONICAL_DECIMALS)
    kept = _some(len(upright), n_points) if with_outliers else thin(upright, n_points)
    return Prepared(
        used=used,
        kept=kept,
        points=upright[kept],
        organ=None if used.labels is None else _organ_numbers(used.labels[kept]),
        starts=[
            replace(start, pose=np.round(_rigid_inverse(home) @ start.pose, CANONICAL_DECIMALS)) for start in starts
        ],
        home=home,
        scale=scale,
        notes=tuple(_what_was_left_out(len(cloud), len(used), len(kept))),
    )


def _meant(points: FloatArray, start: StartPose, seed_points: FloatArray) -> NDArray[np.bool_]:
    """Which points (n, 3), cm, are not of pieces beside the stem that the seed points (k, 3) are not connected with."""
    upright = (points - start.pose[:3, 3]) @ start.pose[:3, :3]
    margin = STEM_MARGIN * start.radius + STEM_MARGIN_CM
    on_stem = np.hypot(upright[:, 0], upright[:, 1]) < margin
    on_stem &= (upright[:, 2] > start.foot - margin) & (upright[:, 2] < start.top + margin)
    beside = np.flatnonzero(~on_stem)
    tree = cKDTree(points[beside])
    gap, nearest = tree.query(seed_points)
    if np.any(gap > NEAREST_CM):
        raise SettingError(
            f"seed_point: expected a point within {NEAREST_CM:g} cm of a leaf's, found none for "
            f"{seed_points[np.argmax(gap)].round(2).tolist()} cm; the nearest is {gap.max():.1f} cm away"
        )
    typical = float(np.median(tree.query(points[beside], k=min(LINK_NEIGHBOR, len(beside)))[0][:, -1]))
    links = tree.query_pairs(max(LINK * typical, LEAST_LINK_CM), output_type="ndarray")
    graph = coo_array((np.ones(len(links), bool), links.T), shape=(len(beside), len(beside)))
    piece = connected_components(graph, directed=False)[1]
    small = np.bincount(piece)[piece] < LEAST_PIECE
    on_stem[beside[small | np.isin(piece, piece[nearest])]] = True
    return on_stem


def _some(n: int, n_wanted: int) -> NDArray[np.intp]:
    """Indices of so many of n points, drawn without regard to where they are; in order."""
    if n <= n_wanted:
        return np.arange(n)
    return np.sort(np.random.default_rng(n).permutation(n)[:n_wanted])


def _rigid_inverse(pose: FloatArray) -> FloatArray:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def _organ_numbers(labels: NDArray[np.int64]) -> NDArray[np.int8]:
    """Labels count 0 unknown, 1 stem, 2.. leaves; organs 0 stem, 1 leaf, -1 unknown."""
    return np.clip(labels - 1, -1, 1).astype(np.int8)


def _what_was_left_out(n_read: int, n_clean: int, n_kept: int) -> list[str]:
    said = []
    if n_clean < n_read:
        said.append(f"{n_read - n_clean} of {n_read} points removed as outliers")
    if n_kept < n_clean:
        said.append(f"{n_clean} points thinned to {n_kept}")
    return said


def _largest_stem_radius(species: Species) -> float:
    i = species.space.index("stem_diameter")
    return float(0.5 * (species.space.mean[i] + 2.0 * species.space.std[i]))


def _expected_size(species: Species) -> float:
    """Size, as :func:`size_cm` takes it, of the phytomer that the prior expects."""
    nodes = np.concatenate([o.axis[0] for o in species.model.organs(species.space.mean)])
    return size_cm(nodes)


def parse_up(up: str | ArrayLike | None) -> FloatArray | None:
    """A unit vector (3,) from ``"x" .. "-z"`` or three numbers; None stays None."""
    if up is None:
        return None
    if isinstance(up, str):
        if up not in AXES:
            raise SettingError(f"up: expected one of {', '.join(AXES)}, got {up!r}")
        return np.array(AXES[up], float)
    vector = np.asarray(up, float)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.any(vector):
        raise SettingError(f"up: expected three numbers that are not all zero, got {up!r}")
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def parse_points(points: ArrayLike) -> FloatArray:
    """(k, 3) of one or more points."""
    try:
        rows = np.atleast_2d(np.asarray(points, float))
    except ValueError:
        rows = np.empty((0, 0))
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all():
        raise SettingError(f"seed_point: expected three numbers, or several times three, got {points!r}")
    return rows
