"""Several plants in one cloud: each that stands on a stem of its own, and what belongs to it.

A piece of a plant is not another plant: a leaf beyond a gap has no round stem, and what a gap cuts off from the top of
a plant stands above the rest of its stem.  Where plants touch, the nearer stem over the surface decides.
"""

import os
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from phytofit.cloud import PointCloud, as_cloud
from phytofit.errors import NoStemError
from phytofit.parsing import parse_up
from phytofit.segmentation.graph import PlantGraph, coarse, plant_graph
from phytofit.segmentation.ground import find_grounds
from phytofit.segmentation.organs import FLAT, along_path
from phytofit.segmentation.root import Standing, ends_of, stands_on
from phytofit.segmentation.whole import PLANT_CM

__all__ = ["numbering", "separate_plants"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
N_NODES = 4000  # over all plants, to see which touch
N_OF_PIECE = 3000  # of each of those, to see what it stands on
LEAST_NODES = 50  # of a plant: of fewer it can't be said what is a stem
SMALLEST = 0.1  # of the tallest plant's: the greatest distance over a plant
LEAST_ENDS = 2  # leaves, or a leaf and the stem's top, that touch no other plant
CLUMP = 6.0  # stem radii: shoots whose bases or stems are nearer to each other are one plant's
UPRIGHT = 0.5  # cosine: stems of plants in one cloud point the same way
HIGHEST_BASE = 0.5  # of the tallest plant's height above its base: bases of others may stand higher, in higher pots
BELOW = 0.87  # cosine of the angle around straight down, in which nothing carries a plant
CARRIES = 0.01  # of a plant's nodes, below its base: it is the upper part of another


@dataclass(frozen=True)
class _Plant:
    """Nodes that are a plant, the one at its base, and how it stands on it."""

    nodes: IntArray
    base: int
    standing: Standing


def separate_plants(
    cloud: PointCloud | ArrayLike | str | os.PathLike[str],
    units: str | None = None,
    *,
    up: str | ArrayLike | None = None,
) -> tuple[PointCloud, ...]:
    """The plants of a cloud, each as a cloud of its own; the cloud itself where it holds one.

    A plant has a stem on which it stands, from which at least two ends part.  Plants are numbered along the axis of the
    frame along which their bases lie farthest apart.  Pots, ground and stray points go with the nearest plant.

    Parameters
    ----------
    cloud
        Plants in any orientation, all growing the same way; or a file or points (n, 3) of them in `units`.
    units
        As for :func:`segment`.
    up
        The upward direction where it is known, as for :func:`segment`.
    """
    cloud = as_cloud(cloud, units, plausible_cm=PLANT_CM)
    first, stands_for = coarse(cloud.points)
    points = cloud.points[first]
    ground, direction = find_grounds(points, parse_up(up))
    try:
        graphs = _pieces(points[~ground])
    except NoStemError:
        return (cloud,)
    nodes = np.concatenate([graph.points for graph in graphs])
    start = np.cumsum([0, *(len(graph.points) for graph in graphs)])
    found = [
        replace(plant, nodes=plant.nodes + start[i], base=plant.base + int(start[i]))
        for i, graph in enumerate(graphs)
        for plant in _of_piece(graph, direction)
    ]
    plants = _standing(nodes, found, direction)
    if len(plants) < 2:
        return (cloud,)
    bases = nodes[[plant.base for plant in plants]]
    axis = _axis_of(bases)
    plants = [plants[i] for i in np.argsort(bases[:, axis], kind="stable")]
    of_node = _share_out(nodes, np.repeat(np.arange(len(graphs)), np.diff(start)), plants)
    of_first = of_node[cKDTree(nodes).query(points)[1]]
    upward = direction if direction is not None else _largest(plants).standing.rise
    bases = nodes[[plant.base for plant in plants]]
    flat, flat_bases = (those - np.outer(those @ upward, upward) for those in (points[ground], bases))
    of_first[ground] = cKDTree(flat_bases).query(flat)[1]
    number = of_first[stands_for]
    notes = (*cloud.notes, numbering(bases))
    return tuple(replace(cloud.take(np.flatnonzero(number == i)), notes=notes) for i in range(len(plants)))


def numbering(bases: FloatArray) -> str:
    """How the plants with these bases (n, 3) are numbered, in words."""
    return f"{len(bases)} plants were found, numbered along {'xyz'[_axis_of(bases)]}"


def _axis_of(bases: FloatArray) -> int:
    """The axis of the frame along which the bases lie farthest apart."""
    return int(np.argmax(np.ptp(bases, axis=0)))


def _pieces(points: FloatArray) -> list[PlantGraph]:
    """The connected pieces of the points (n, 3), the largest first, each as fine as a plant by itself."""
    rough = plant_graph(points, N_NODES, bridged=False)
    piece = connected_components(rough.weights, directed=False)[1]
    of_point = piece[cKDTree(rough.points).query(points)[1]]
    found = []
    for number in np.argsort(-np.bincount(piece), kind="stable"):
        mine = np.flatnonzero(piece == number)
        if len(mine) >= LEAST_NODES:
            found.append(plant_graph(points[of_point == number], N_OF_PIECE))
        else:
            found.append(_part(rough, mine))
    return found


def _of_piece(graph: PlantGraph, up: FloatArray | None) -> list[_Plant]:
    """The plants of a piece: on the end on which it looks most like one; and on others from which, with what is nearer
    to them, it looks like one too."""
    if len(graph.points) < LEAST_NODES:
        return []
    ends = ends_of(graph, up)
    alone = next((plant for plant in (_on(graph, [end], 0) for end in ends) if plant is not None), None)
    if alone is None:
        return []
    roots = [alone.base]
    for end in ends:
        if _may_be_beside(graph, alone, end, roots):
            beside = _on(graph, [*roots, end], len(roots))
            if beside is not None and not _share_a_stem(alone, beside):
                roots.append(end)
    if len(roots) == 1:
        return [alone]
    return [plant for plant in (_on(graph, roots, number) for number in range(len(roots))) if plant is not None]


def _may_be_beside(graph: PlantGraph, plant: _Plant, end: int, roots: list[int]) -> bool:
    """Whether an end is low enough, and far enough from the roots, to be the base of a plant beside this one."""
    rise = plant.standing.rise
    height = graph.points @ rise
    if height[end] - height[plant.base] > HIGHEST_BASE * (height[plant.nodes].max() - height[plant.base]):
        return False
    beside = graph.points[end] - graph.points[roots]
    beside = beside - np.outer(beside @ rise, rise)
    return bool(np.linalg.norm(beside, axis=1).min() > CLUMP * plant.standing.radius)


def _share_a_stem(one: _Plant, other: _Plant) -> bool:
    """Whether the stem of one comes so near to the other's that it is the same: reached over a leaf, from its tip."""
    gap = along_path(other.standing.path, one.standing.path)[0]
    return bool(gap.min() <= CLUMP * max(one.standing.radius, other.standing.radius))


def _on(graph: PlantGraph, roots: list[int], number: int) -> _Plant | None:
    """The plant on one of several roots, of what is nearest to it over the surface; None if that is no plant."""
    source = dijkstra(graph.weights, directed=False, indices=roots, min_only=True, return_predecessors=True)[2]
    mine = np.flatnonzero(source == roots[number])
    if len(mine) < LEAST_NODES:
        return None
    others = np.setdiff1d(np.arange(len(graph.points)), mine)
    touches = np.diff(csr_array(graph.weights[mine][:, others]).indptr) > 0
    standing = stands_on(_part(graph, mine), int(np.searchsorted(mine, roots[number])), touches)
    if standing is None or standing.n_free < LEAST_ENDS:
        return None
    is_round = 0.5 * (standing.foot_roundness + standing.roundness) >= FLAT
    return _Plant(mine, roots[number], standing) if is_round else None


def _standing(nodes: FloatArray, found: list[_Plant], up: FloatArray | None) -> list[_Plant]:
    """Those of the candidates that are plants beside the largest: they grow the same way, from about as low, and
    nothing carries them."""
    if not found:
        return []
    largest = _largest(found)
    upward = largest.standing.rise if up is None else up
    height = nodes @ upward
    low = height[largest.base]
    tall = max(float(height[largest.nodes].max()) - low, 1e-9)
    return [
        plant
        for plant in found
        if plant.standing.reach >= SMALLEST * largest.standing.reach
        and plant.standing.rise @ upward >= UPRIGHT
        and height[plant.base] - low <= HIGHEST_BASE * tall
        and not _carried(nodes, plant)
    ]


def _largest(plants: list[_Plant]) -> _Plant:
    return max(plants, key=lambda plant: plant.standing.reach)


def _carried(nodes: FloatArray, plant: _Plant) -> bool:
    """Whether there is more of the cloud straight below the base: the lower part of the same stem."""
    others = np.setdiff1d(np.arange(len(nodes)), plant.nodes)
    down = nodes[others] - nodes[plant.base]
    below = down @ -plant.standing.rise > BELOW * np.linalg.norm(down, axis=1)
    return int(below.sum()) > CARRIES * len(plant.nodes)


def _share_out(nodes: FloatArray, piece: IntArray, plants: list[_Plant]) -> IntArray:
    """The number (m,) of the plant of each node; what is of none goes with the nearest, piece by piece."""
    number = np.full(len(nodes), -1, np.intp)
    for i, plant in enumerate(plants):
        number[plant.nodes] = i
    gap, nearest = cKDTree(nodes[number >= 0]).query(nodes)
    of_nearest = number[number >= 0][nearest]
    for p in np.unique(piece[number < 0]):
        rest = np.flatnonzero((piece == p) & (number < 0))
        number[rest] = of_nearest[rest[np.argmin(gap[rest])]]
    return number


def _part(graph: PlantGraph, inside: IntArray) -> PlantGraph:
    """The graph of some of its nodes (k,)."""
    return PlantGraph(
        graph.nodes[inside],
        graph.points[inside],
        graph.normals[inside],
        csr_array(graph.weights[inside][:, inside]),
        graph.spacing,
        0,
    )
