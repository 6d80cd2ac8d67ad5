"""Which points of a crowded cloud are of the target leaf and its stem: by seed points on its leaf."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from phytofit.errors import NoPhytomerError, NoStemError, SettingError
from phytofit.segmentation.graph import coarse, geodesics, plant_graph
from phytofit.segmentation.growing import grow
from phytofit.start.pose import StartPose, near_stem, with_tube

__all__ = ["TargetLeaf", "target_leaf_points"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
LINK, LINK_NEIGHBOR, LEAST_LINK_CM = 1.5, 8, 0.3  # points within so many typical distances of a neighbour are connected
MANY = 100_000  # points; larger clouds are thinned to one point in each voxel
LEAST_PIECE = 30  # points, or voxels; fewer are no piece of anything: those near to the target leaf may be outliers
NEAREST_CM = 3.0  # within which a seed point must have a point of a leaf, and a stray point one of the target leaf
LIKELY = 0.25  # of the score of the most likely stem of all, from which that beside the seed is believed
N_AROUND = 300  # points around a seed point, from which the density of the leaf's points is taken
N_NODES = 8000  # to which the leaf and what touches it are thinned
BESIDE_CM = 2.0  # a branch with most of its points so near to the target leaf is a part of its blade
NEAR_BASE_CM = 8.0  # along the stem, from the base of the target leaf; of others so near, some points are left
FEW_TOUCH = 5  # points, fewer of which may be there by chance
NOBODY = -1  # piece


class TargetLeaf(NamedTuple):
    """Which points (n,) are on it or its stem, and whether others are so near that some of theirs may be left."""

    points: BoolArray
    others_touch: bool


def target_leaf_points(
    points: FloatArray, seed_points: FloatArray, find_starts: Callable[[FloatArray], list[StartPose]]
) -> TargetLeaf:
    """Which points (n, 3), cm, are of the stem or of a leaf on which seed points (k, 3) lie.

    The stem is looked for, with `find_starts`, among the points that are connected with a seed point, or among all if
    there it is far more likely.  Beside it, pieces that no seed point is connected with are of others.  What touches
    the leaf is told from it by the branches of the surface on which no seed point lies.

    Raises SettingError where a seed point is far from all points beside the stem, and what `find_starts` does.
    """
    if len(points) <= MANY:
        return _on_target(points, seed_points, find_starts)
    first, stands_for = coarse(points)
    target, others_touch = _on_target(points[first], seed_points, find_starts)
    return TargetLeaf(target[stands_for], others_touch)


def _on_target(
    points: FloatArray, seed_points: FloatArray, find_starts: Callable[[FloatArray], list[StartPose]]
) -> TargetLeaf:
    tree = cKDTree(points)
    _check_near(tree.query(seed_points)[0])
    link = _link(tree, tree.query(seed_points, k=min(N_AROUND, len(points)))[1].ravel())
    piece = _pieces(tree, link)
    seeded = np.isin(piece, piece[tree.query(seed_points)[1]])
    start = with_tube(points, _likely_start(points, seeded, find_starts))
    upright = (points - start.pose[:3, 3]) @ start.pose[:3, :3]
    seeds = (seed_points - start.pose[:3, 3]) @ start.pose[:3, :3]
    at_stem = near_stem(upright, start)
    beside = np.flatnonzero(~at_stem)
    tree = cKDTree(upright[beside])
    gap, nearest = tree.query(seeds)
    _check_near(gap)
    piece = np.full(len(points), NOBODY)
    piece[beside] = _pieces(tree, link)
    own = np.unique(piece[beside[nearest]])
    connected = np.flatnonzero(at_stem | np.isin(piece, own))
    other = _of_other_branches(upright[connected], seeds, start.foot)
    leaf = piece.copy()
    leaf[connected[other > 0]] = piece.max() + other[other > 0]
    leaf[at_stem] = NOBODY
    of_target = np.isin(leaf, own)
    of_others = (np.bincount(leaf + 1)[leaf + 1] >= LEAST_PIECE) & (leaf != NOBODY) & ~of_target
    far = cKDTree(upright[at_stem | of_target]).query(upright)[0] > NEAREST_CM
    return TargetLeaf(~(of_others | far), _touches(upright, at_stem, of_target, of_others))


def _touches(upright: FloatArray, at_stem: BoolArray, of_target: BoolArray, of_others: BoolArray) -> bool:
    """Whether points (n, 3) of others come near to the target leaf, or to the stem about as high as that leaf
    does; at any height, where none of its points near the stem was seen."""
    leaf, others = upright[of_target], upright[of_others]
    near_leaf = cKDTree(leaf).query(others)[0] < BESIDE_CM
    stem = cKDTree(upright[at_stem])
    base, beside = (points[stem.query(points)[0] < NEAREST_CM, 2] for points in (leaf, others))
    near_base = np.abs(beside - np.median(base)) < NEAR_BASE_CM if len(base) else np.ones(len(beside), bool)
    return bool(max(np.count_nonzero(near_leaf), np.count_nonzero(near_base)) >= FEW_TOUCH)


def _likely_start(
    points: FloatArray, seeded: BoolArray, find_starts: Callable[[FloatArray], list[StartPose]]
) -> StartPose:
    """The stem among the points that are connected with a seed point; or that among all, if theirs is far less likely:
    a leaf whose base is hidden has a piece that looks a little like one."""
    found = [starts[0] for starts in (_starts(points[seeded], find_starts), _starts(points, find_starts)) if starts]
    if not found:
        return find_starts(points)[0]  # which says why there is none
    return found[0] if found[0].score >= LIKELY * found[-1].score else found[-1]


def _starts(points: FloatArray, find_starts: Callable[[FloatArray], list[StartPose]]) -> list[StartPose]:
    try:
        return find_starts(points)
    except NoPhytomerError:
        return []


def _check_near(gap: FloatArray) -> None:
    if np.any(gap > NEAREST_CM):
        raise SettingError(
            f"seed_point: expected a point within {NEAREST_CM:g} cm of a leaf's, in the unit of the cloud; "
            f"seed point {np.argmax(gap) + 1} of {len(gap)} is {gap.max():.1f} cm from the nearest one"
        )


def _link(tree: cKDTree, about: NDArray[np.intp]) -> float:
    """Distance, cm, within which points are connected: by how dense the cloud is about some of them."""
    gap = tree.query(tree.data[about], k=min(LINK_NEIGHBOR, tree.n))[0][:, -1]
    return max(LINK * float(np.median(gap)), LEAST_LINK_CM)


def _pieces(tree: cKDTree, link: float) -> NDArray[np.int64]:
    """Which piece, from 0, each point (n,) of the tree is of: points at most a link apart are connected."""
    links = tree.query_pairs(link, output_type="ndarray")
    graph = coo_array((np.ones(len(links), bool), links.T), shape=(tree.n, tree.n))
    piece: NDArray[np.int64] = connected_components(graph, directed=False)[1].astype(np.int64)
    return piece


def _of_other_branches(upright: FloatArray, seeds: FloatArray, foot: float) -> NDArray[np.int64]:
    """Of which branch that leads to no seed point each point (n,) is, from 1; 0 of none.

    The surface is grown from its ends towards the stem's foot at height `foot`, as whole plants are: where ends meet,
    their branches unite.  What is target are the branches on which seeds (k, 3) lie, all that these lead to down the
    stem, and all that goes on beyond the outermost of them.
    """
    try:
        graph = plant_graph(upright, N_NODES)
    except NoStemError:  # too few places to tell branches
        return np.zeros(len(upright), np.int64)
    tree = cKDTree(graph.points)
    distance, _ = geodesics(graph, int(tree.query([0.0, 0.0, foot])[1]))
    regions, _ = grow(graph, distance)
    branch = np.zeros(len(distance), np.int64)
    for i, region in enumerate(regions):
        branch[region.nodes] = i
    parent = {child: i for i, region in enumerate(regions) for child in region.children}
    outermost: dict[int, float] = {}  # of the seeds on a branch and above it, their distance
    for seed in tree.query(seeds)[1].tolist():
        at: int | None = int(branch[seed])
        while at is not None:
            outermost[at] = max(outermost.get(at, 0.0), float(distance[seed]))
            at = parent.get(at)
    target = list(outermost)
    for i in target:  # grows
        reached = outermost.get(i, 0.0) - NEAREST_CM
        target += [child for child in regions[i].children if child not in outermost and regions[child].level >= reached]
    of_point = branch[tree.query(upright)[1]]
    other = ~np.isin(of_point, target)
    whole = np.bincount(of_point[other], minlength=len(regions))
    beside = cKDTree(upright[~other]).query(upright[other])[0] < BESIDE_CM
    strip = 2 * np.bincount(of_point[other][beside], minlength=len(regions)) > whole  # of the same blade
    return np.where(other & ~strip[of_point], of_point + 1, 0)
