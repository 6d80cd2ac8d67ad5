"""Where the plant's stem begins: of all ends of the cloud the one from which it looks most like a plant.

From the base, what the leaves share is round and straight, the leaves part from it forwards, and droop.  From the tip
of a leaf, the way to the other leaves begins flat, bends, and turns back at the collar; and from the top, leaves rise.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from phytofit.segmentation.graph import PlantGraph, geodesics, path_to_root, tips_of
from phytofit.segmentation.growing import grow
from phytofit.segmentation.organs import Organs, along_path, find_organs, roundness

__all__ = ["Standing", "ends_of", "find_root", "stands_on"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
LEAST_TIP = 0.015  # of the greatest distance over the plant: what sticks out less is not an end
APART = 0.02  # of that distance: nearer ends are one
AROUND = 0.06  # of that distance: neighbourhood of an end, all of which lies before it
ONE_SIDED = 0.08  # of its radius: how far its centre lies beside an end along it
LEAST_BEFORE = 0.05  # of that neighbourhood's radius: how far its centre lies before an end at least
LEAST_FORWARD = 0.2  # cosine: leaves part forwards from the way along a stem
FOOT = 0.1  # of that distance: of the stem, that must be round in any case
LEAST_FOOT = 8  # nodes of it
LEAST_MIDRIB = 4  # nodes of it, to see whether a leaf droops
PROBE = 0.05  # of that distance: from where to where a direction is measured
STRAIGHT_WEIGHT = 0.5  # against the others
HEIGHT_WEIGHT = 3.0  # of how low an end is, where up is known
LEAST_END = 0.1  # of that distance: what parts from the stem and is shorter is no leaf to count on
DIRECTIONS = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])


@dataclass(frozen=True)
class Standing:
    """How a plant stands on one of its ends: how much it looks like a plant there (``alike``), the axis (k, 3) that its
    stem then has, the stem's radius, cm, how round it is, and its foot (0 flat to 1), the greatest distance over the
    plant, cm, and how many ends of it are free."""

    alike: float
    path: FloatArray
    radius: float
    roundness: float
    foot_roundness: float
    reach: float
    n_free: int

    @property
    def rise(self) -> FloatArray:
        """The direction (3,) from the stem's base to its end."""
        rise = self.path[-1] - self.path[0]
        unit: FloatArray = rise / max(float(np.linalg.norm(rise)), 1e-12)
        return unit


def find_root(graph: PlantGraph, up: FloatArray | None) -> int | None:
    """The node at the base of the stem; None where from no end two others can be told apart.

    up : (3,) where it is known; what is high above the lowest nodes is then hardly the base
    """
    return next(iter(ends_of(graph, up)), None)


def ends_of(graph: PlantGraph, up: FloatArray | None) -> list[int]:
    """The nodes on which the plant may stand, the likeliest first."""
    low, span = 0.0, 1.0
    height = np.zeros(len(graph.points))
    if up is not None:
        height = graph.points @ up
        low, span = float(height.min()), max(float(np.ptp(height)), 1e-9)
    standing = {end: stands_on(graph, end) for end in _ends(graph)}
    for path in [it.path for it in standing.values() if it is not None]:
        beyond = int(np.argmax(graph.points @ (path[0] - path[-1])))  # where a leaf hides the very end
        if beyond not in standing:
            standing[beyond] = stands_on(graph, beyond)
    score = {
        end: it.alike - HEIGHT_WEIGHT * (height[end] - low) / span for end, it in standing.items() if it is not None
    }
    return sorted(score, key=lambda end: -score[end])


def _ends(graph: PlantGraph) -> list[int]:
    """Nodes where the cloud may end: geodesic maxima, and the farthest in all directions of space."""
    start = int(np.argmax(np.linalg.norm(graph.points - graph.points.mean(axis=0), axis=1)))
    start = int(np.argmax(geodesics(graph, start)[0]))
    distance, _ = geodesics(graph, start)
    far = float(distance.max())
    ends = [start, *tips_of(graph, distance, LEAST_TIP * far)]
    for direction in DIRECTIONS:
        end = int(np.argmax(graph.points @ direction))
        offset = graph.points - graph.points[end]
        around = offset[np.linalg.norm(offset, axis=1) < AROUND * far]
        longest = np.linalg.svd(around - around.mean(axis=0), full_matrices=False)[2][0]
        beside = abs(float(around.mean(axis=0) @ longest)) > ONE_SIDED * AROUND * far  # not in the middle of an organ
        if beside and np.linalg.norm(offset[ends], axis=1).min() > APART * far:
            ends.append(end)
    return list(dict.fromkeys(ends))


def stands_on(graph: PlantGraph, root: int, touches: NDArray[np.bool_] | None = None) -> Standing | None:
    """How the plant would stand on this node; None if it can't.

    touches : (m,) the nodes that touch another plant; organs that have any are not free, nor are short ones
    """
    distance, before = geodesics(graph, root)
    organs = find_organs(graph, distance, *grow(graph, distance))
    if organs is None or len(organs.path) < 2:
        return None
    stem = np.flatnonzero(organs.labels == 1)
    foot = stem[distance[stem] < FOOT * float(distance.max())]
    if len(foot) < LEAST_FOOT:  # what the way begins with is so wide that it is a leaf
        return None
    length = float(np.linalg.norm(np.diff(organs.path, axis=0), axis=1).sum())
    straight = float(np.linalg.norm(organs.path[-1] - organs.path[0])) / max(length, 1e-12)
    round_foot, round_stem = roundness(graph, distance, foot), roundness(graph, distance, stem)
    near = distance < AROUND * float(distance.max())
    _, along, place = along_path(graph.points[near], organs.path)
    ahead = place[np.argmax(along)] - organs.path[0]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
    before_it = float(((graph.points[near] - graph.points[root]) @ ahead).mean()) / (AROUND * float(distance.max()))
    forward = _forward(graph, distance, before, organs)
    if before_it < LEAST_BEFORE or forward < LEAST_FORWARD:
        return None
    at_end = min(4.0 * before_it, 1.0)  # 1 at the end of a stem, 0 in its middle
    droop = _droop(graph, distance, before, organs)
    alike = round_foot + round_stem + at_end + forward + droop + STRAIGHT_WEIGHT * straight
    reach = float(distance.max())
    bound = np.zeros(len(organs.tips) + 2, np.bool_)
    if touches is not None:
        bound[organs.labels[touches]] = True
    long = distance[list(organs.tips)] - np.array(organs.levels) >= LEAST_END * reach
    return Standing(alike, organs.path, organs.radius, round_stem, round_foot, reach, int((long & ~bound[2:]).sum()))


def _forward(graph: PlantGraph, distance: FloatArray, before: IntArray, organs: Organs) -> float:
    """Mean cosine of the turn that the ways to the leaves' tips make where they leave the stem."""
    reach = PROBE * float(distance.max())
    cosines = []
    for tip, level in zip(organs.tips, organs.levels, strict=True):
        path = path_to_root(before, tip)[::-1]
        below, fork, above = np.searchsorted(distance[path], [level - reach, level, level + reach])
        place = graph.points[[path[min(int(i), len(path) - 1)] for i in (below, fork, above)]]
        a, b = place[1] - place[0], place[2] - place[1]
        norm = float(np.linalg.norm(a) * np.linalg.norm(b))
        cosines.append(float(a @ b) / norm if norm > 0 else 0.0)
    return float(np.mean(cosines))


def _droop(graph: PlantGraph, distance: FloatArray, before: IntArray, organs: Organs) -> float:
    """By how much the leaves' outer halves point less along the stem than their inner halves, as cosines; a mean in
    which longer leaves count more."""
    stem = organs.path[-1] - organs.path[0]
    stem = stem / max(float(np.linalg.norm(stem)), 1e-12)
    bends, lengths = [0.0], [1e-12]
    for tip, level in zip(organs.tips, organs.levels, strict=True):
        path = path_to_root(before, tip)[::-1]
        midrib = graph.points[path[int(np.searchsorted(distance[path], level)) :]]
        if len(midrib) < LEAST_MIDRIB:
            continue
        middle = midrib[len(midrib) // 2]
        inner, outer = middle - midrib[0], midrib[-1] - middle
        inner, outer = (half / max(float(np.linalg.norm(half)), 1e-12) for half in (inner, outer))
        bends.append(float((inner - outer) @ stem))
        lengths.append(float(distance[tip] - level))
    return float(np.average(bends, weights=lengths))
