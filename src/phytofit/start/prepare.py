"""Before a fit: the cloud is cleaned, its stem found, and what is left thinned as it looks from there."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.cloud import PointCloud, remove_outliers, size_cm, thin
from phytofit.errors import ONE_LEAF_ONLY, NoPhytomerError
from phytofit.ordering import canonical_order
from phytofit.species import Species
from phytofit.start.pose import StartPose, start_poses
from phytofit.start.target_leaf import target_leaf_points

__all__ = ["DITHER_CM", "Prepared", "dithered", "prepare"]

FloatArray = NDArray[np.float64]
DITHER_CM = 0.1  # added to points without noise
N_PROBED = 300  # points around which it is seen whether there is any noise
N_LOOKED_AT = 100_000  # points, if they are all kept for the fit, in which the stem is looked for
CANONICAL_DECIMALS = 6  # cm; hides the rounding of a rotated copy's coordinates
STUB = 0.1  # of the points of the largest labelled leaf, up to which another is but a stub


@dataclass(frozen=True)
class Prepared:
    """A cloud ready to be fitted.

    ``used`` is the cloud in canonical order, without outliers unless they were to be kept, ``kept`` (m,) the indices of
    its points that are left when it is thinned, ``points`` (m, 3) those as seen from the best start pose, upright, in
    the prior's cm, ``organ`` (m,) what their labels say (0 stem, 1 leaf, -1 unknown) or None; ``starts`` the start
    poses in that frame; ``home`` (4, 4) maps it to the cloud's, ``scale`` of whose lengths make a cm.  ``notes`` tell
    what was left out, ``others_touch`` whether that came near the rest.
    """

    used: PointCloud
    kept: NDArray[np.intp]
    points: FloatArray
    organ: NDArray[np.int8] | None
    starts: list[StartPose]
    home: FloatArray
    scale: float
    notes: tuple[str, ...] = ()
    others_touch: bool = False


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
    Points are put in one order before anything is drawn from them, and the coordinates are rounded, so that neither the
    order of the rows nor a rotation of the cloud changes the numbers.

    seed_points : (k, 3) cm, on the target leaf: beside the stem no other leaf's points count
    """
    cloud = cloud.take(canonical_order(cloud.points, cloud.labels))
    looked_at = cloud.take(_some(len(cloud), N_LOOKED_AT)) if with_outliers else cloud
    clean = looked_at.take(remove_outliers(looked_at.points))
    used = cloud if with_outliers else clean
    scale = size_cm(clean.points) / _expected_size(species) if cloud.unit == "none" else 1.0
    find_starts = partial(start_poses, stem_radius=_largest_stem_radius(species), up=up)
    if seed_points is not None:
        on_target, others_touch = target_leaf_points(cloud.points / scale, seed_points / scale, find_starts)
        target = cloud.take(np.flatnonzero(on_target))
        found = prepare(target, species, n_points=n_points, up=up, with_outliers=with_outliers)
        left_out = f"{len(cloud) - len(target)} of {len(cloud)} points left out: not on the seed point's leaf"
        return replace(found, notes=(left_out, *found.notes), others_touch=others_touch)
    if cloud.labels is not None:
        _check_one_leaf(cloud.labels)
    starts = find_starts(clean.points / scale)
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


def dithered(points: FloatArray, seed: int) -> FloatArray:
    """The points (n, 3), with a little noise if they have next to none.

    Without noise the scores say nothing of how fast the likelihood falls off, and the refinement gets stuck.
    """
    some = points[:: max(1, len(points) // N_PROBED)]
    near = points[cKDTree(points).query(some, k=min(12, len(points)))[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    rough = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", offset, offset) / near.shape[1])[:, 0]
    if np.sqrt(max(0.0, float(np.median(rough)))) >= 0.5 * DITHER_CM:
        return points
    return points + np.random.default_rng(seed).normal(0.0, DITHER_CM, points.shape)


def _some(n: int, n_wanted: int) -> NDArray[np.intp]:
    """Indices of so many of n points that are in canonical order, in which the first are a sample of all."""
    return np.arange(min(n, n_wanted))


def _rigid_inverse(pose: FloatArray) -> FloatArray:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def _organ_numbers(labels: NDArray[np.int64]) -> NDArray[np.int8]:
    """Labels count 0 unknown, 1 stem, 2.. leaves; organs 0 stem, 1 leaf, -1 unknown."""
    return np.clip(labels - 1, -1, 1).astype(np.int8)


def _check_one_leaf(labels: NDArray[np.int64]) -> None:
    """NoPhytomerError if labels (n,) name a second leaf that is more than a stub beside the first."""
    counts = np.unique(labels[labels > 1], return_counts=True)[1]
    n_leaves = np.count_nonzero(counts > STUB * counts.max(initial=0))
    if n_leaves > 1:
        raise NoPhytomerError(
            f"the labels name {n_leaves} leaves, expected one leaf on its piece of stem; {ONE_LEAF_ONLY}"
        )


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
