"""From grown regions to organs: which of what leaves share is the stem, its axis, and the leaves that part from it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from phytofit.segmentation.graph import PlantGraph
from phytofit.segmentation.growing import Region

__all__ = ["Organs", "along_path", "centerline", "find_organs", "roundness"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
LOBE = 0.35  # of a leaf's length: a shorter end that parts from it away from the stem is a lobe of it
SMALL_LOBE = 0.1  # of the length beyond what two ends share: so short an end is a lobe, whatever they share
THIN = 0.3  # of the sections of what leaves share, the share that is the stem's alone for sure
WHORL = 1.25  # times thicker than those, it is no longer the stem alone
FLAT = 0.4  # thin over wide of the sections: what leaves share with less is a blade, not a stem
STICKS_OUT = 1.8  # stem radii from the axis, and beyond: a leaf's base
BASE = 7.5  # typical distances of neighbours, of a leaf where it comes out of the whorl, from which it goes on
END = 3.0  # typical distances of neighbours, of a whorl next to the stem, where all its leaves begin
SLICE = 2.5  # typical distances of neighbours, thickness of a section


@dataclass(frozen=True)
class Organs:
    """The nodes' labels (m,), 1 stem, 2.. leaves in no order; the stem's axis (k, 3) from its base; its radius, cm.

    ``tips`` are the leaves' tip nodes and ``levels`` the distances at which they parted from the stem, in the order of
    the labels.
    """

    labels: NDArray[np.int64]
    path: FloatArray
    radius: float
    tips: tuple[int, ...]
    levels: tuple[float, ...]


def find_organs(graph: PlantGraph, distance: FloatArray, regions: list[Region], root: int) -> Organs | None:
    """Stem and leaves of grown regions; None where no two ends were found, so that nothing could be a stem."""
    if not regions[root].children:
        return None
    spine, groups = _spine(graph, distance, regions, root)
    stem = np.array(sorted((node for s in spine for node in regions[s].nodes), key=lambda node: distance[node]), int)
    if len(stem) < 6:
        return None
    labels = np.zeros(len(distance), np.int64)
    labels[stem] = 1
    tips, levels = [], []
    for nodes, tip, level in groups:
        tips.append(tip)
        levels.append(level)
        labels[nodes] = len(tips) + 1
    path, radius, top = _axis(graph, distance, stem)
    gap, _, _ = along_path(graph.points, path)
    grown = labels.copy()
    out = (labels == 1) & ((gap > STICKS_OUT * radius + 0.5 * graph.spacing) | (distance > top))
    _give_away(graph, labels, out)
    whorl = np.flatnonzero(out & (distance > top) & (labels > 1))
    parted = {n: np.flatnonzero(grown == n) for n in range(2, len(tips) + 2)}
    above = {n: own for n, own in parted.items() if len(own) and distance[own].min() >= top}
    _share_whorl(graph, distance, labels, whorl, above, path[-1])
    return Organs(labels, path, radius, tuple(tips), tuple(levels))


def _tips_below(regions: list[Region], number: int) -> list[int]:
    """Regions without children in the tree below one."""
    if not regions[number].children:
        return [number]
    return [leaf for child in regions[number].children for leaf in _tips_below(regions, child)]


def _all_below(regions: list[Region], number: int) -> list[int]:
    return [number, *(n for child in regions[number].children for n in _all_below(regions, child))]


def _spine(
    graph: PlantGraph, distance: FloatArray, regions: list[Region], root: int
) -> tuple[list[int], list[tuple[list[int], int, float]]]:
    """Regions that are the stem, and of each leaf its nodes, its tip and the distance at which it left the stem."""
    spine: list[int] = []
    groups: list[tuple[list[int], int, float]] = []
    current = root
    while True:
        spine.append(current)
        shared = [c for c in regions[current].children if regions[c].children]
        following = max(shared, key=lambda c: (len(_tips_below(regions, c)), len(regions[c].nodes)), default=-1)
        if following >= 0 and not _is_stem(graph, distance, regions, following):
            following = -1
        for child in regions[current].children:
            if child != following:
                groups += _leaves_of(distance, regions, child)
        if following < 0:
            return spine, groups
        current = following


def _is_stem(graph: PlantGraph, distance: FloatArray, regions: list[Region], number: int) -> bool:
    """Whether a shared region continues the stem; one with more than two leaves does in any case."""
    if len(_tips_below(regions, number)) > 2:
        return True
    nodes = np.array(regions[number].nodes, int)
    lobes = _lobes(distance, regions, number)
    return not lobes or (
        roundness(graph, distance, nodes) >= FLAT and not _lobes(distance, regions, number, SMALL_LOBE)
    )


def _lobes(distance: FloatArray, regions: list[Region], number: int, share: float = LOBE) -> list[int]:
    """Of the ends beyond a region those that are too short, beside the longest, to be leaves of their own."""
    ends = _tips_below(regions, number)
    longest = max(ends, key=lambda e: distance[regions[e].tip])
    whole = distance[regions[longest].tip] - regions[number].level
    return [e for e in ends if e != longest and distance[regions[e].tip] - regions[e].level < share * whole]


def _leaves_of(distance: FloatArray, regions: list[Region], number: int) -> list[tuple[list[int], int, float]]:
    """The leaf that a region, beside the stem, is; or several that touch, the longest with what they share."""
    ends = _tips_below(regions, number)
    longest = max(ends, key=lambda e: distance[regions[e].tip])
    apart = [e for e in ends if e != longest and e not in _lobes(distance, regions, number)]
    main = [node for n in _all_below(regions, number) if n not in apart for node in regions[n].nodes]
    return [(main, regions[longest].tip, regions[number].level)] + [
        (regions[e].nodes, regions[e].tip, regions[e].level) for e in apart
    ]


def roundness(graph: PlantGraph, distance: FloatArray, nodes: IntArray) -> float:
    """Median over sections of a region's nodes of their thin over wide extent, 0 flat to 1 round."""
    if len(nodes) < 8:
        return 1.0
    band = ((distance[nodes] - distance[nodes].min()) / (SLICE * graph.spacing)).astype(int)
    line = [graph.points[nodes[band == b]].mean(axis=0) for b in np.unique(band)]
    values = []
    for i, b in enumerate(np.unique(band)):
        inside = graph.points[nodes[band == b]]
        if len(inside) < 5 or len(line) < 2:
            continue
        ahead = line[min(i + 2, len(line) - 1)] - line[max(i - 2, 0)]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
        across = inside - inside.mean(axis=0)
        across = across - (across @ ahead)[:, np.newaxis] * ahead
        eigen = np.linalg.eigvalsh(across.T @ across)
        values.append(float(np.sqrt(max(eigen[1], 0.0) / max(eigen[2], 1e-12))))
    return float(np.median(values)) if values else 1.0


def centerline(points: FloatArray, distance: FloatArray, thickness: float) -> FloatArray:
    """Centres (k, 3) of the sections of points by distance, in its order, smoothed over three."""
    band = ((distance - distance.min()) / thickness).astype(int)
    centers = np.array([points[band == b].mean(axis=0) for b in np.unique(band)])
    if len(centers) < 4:
        return centers
    smooth = centers.copy()
    smooth[1:-1] = (centers[:-2] + centers[1:-1] + centers[2:]) / 3.0
    return smooth


def _axis(graph: PlantGraph, distance: FloatArray, stem: IntArray) -> tuple[FloatArray, float, float]:
    """The stem's axis and radius without the bases of leaves, and the distance beyond which it is a whorl of leaves.

    A stem is about as thick all along; where several leaves share what is thicker, they are rolled around each other.
    Where it was last nearer, as a ratio, to its own thickness than to that of the whorl where the leaves part, and it
    gets no thinner downwards, or is as thin as it is elsewhere, the stem ends.
    """
    thickness = max(SLICE * graph.spacing, 0.012 * float(distance.max()))
    path = centerline(graph.points[stem], distance[stem], thickness)
    gap, _, _ = along_path(graph.points[stem], path)
    low, top = float(distance[stem].min()), float(distance[stem].max())
    steps = low + thickness * (np.arange(max(1, np.ceil((top - low) / thickness))) + 0.5)
    sections = [gap[np.abs(distance[stem] - step) <= thickness] for step in steps]
    steps = steps[[len(section) > 0 for section in sections]]
    spread = np.array([np.median(section) for section in sections if len(section)])
    radius = max(float(np.quantile(spread, THIN)), 0.5 * graph.spacing)
    end = int(np.flatnonzero(spread <= max(WHORL * radius, np.sqrt(radius * spread[-1])))[-1])
    if end + 1 < len(steps):
        while end > 0 and spread[end - 1] < spread[end] and spread[end] > WHORL * radius:
            end -= 1
        top = float(np.interp(max(WHORL * radius, spread[end]), spread[end : end + 2], steps[end : end + 2]))
    for _ in range(2):
        below = stem[distance[stem] <= top]
        gap, _, _ = along_path(graph.points[below], path)
        inside = below[gap < STICKS_OUT * radius + 0.5 * graph.spacing]
        if len(inside) < 6:
            break
        path = centerline(graph.points[inside], distance[inside], max(thickness, 0.7 * radius))
    if len(path) < 2:
        path = graph.points[stem[[0, -1]]]
    gap, _, _ = along_path(graph.points[stem], path)
    on_it = gap < STICKS_OUT * radius + 0.5 * graph.spacing
    radius = max(float(np.median(gap[on_it & (distance[stem] <= top)])), 1e-6) if on_it.any() else radius
    return path, radius, top


def along_path(points: FloatArray, path: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of points (n, 3) the gap (n,) to a polyline (k, 3), how far (n,) along it the nearest place is, and it (n, 3)."""
    if len(path) == 1:
        return np.linalg.norm(points - path[0], axis=1), np.zeros(len(points)), np.tile(path[0], (len(points), 1))
    piece = np.diff(path, axis=0)
    length = np.maximum(np.linalg.norm(piece, axis=1), 1e-12)
    start = np.concatenate([[0.0], np.cumsum(length)])
    best = np.full(len(points), np.inf)
    along, place = np.zeros(len(points)), np.zeros_like(points)
    for i in range(len(piece)):
        t = np.clip((points - path[i]) @ piece[i] / length[i] ** 2, 0.0, 1.0)
        foot = path[i] + t[:, np.newaxis] * piece[i]
        gap = np.linalg.norm(points - foot, axis=1)
        nearer = gap < best
        best[nearer], along[nearer], place[nearer] = gap[nearer], (start[i] + t * length[i])[nearer], foot[nearer]
    return best, along, place


def _give_away(graph: PlantGraph, labels: NDArray[np.int64], out: NDArray[np.bool_]) -> None:
    """Give what is not the stem's to the leaf that it is connected with outside the stem."""
    part = np.flatnonzero(out | (labels > 1))
    sources = np.flatnonzero(labels[part] > 1)
    if not out.any() or len(sources) == 0:
        return
    inside = csr_array(graph.weights[part][:, part])
    gap, _, source = dijkstra(inside, directed=False, indices=sources, min_only=True, return_predecessors=True)
    reached = np.isfinite(gap) & out[part]
    labels[part[reached]] = labels[part[source[reached]]]


def _share_whorl(
    graph: PlantGraph,
    distance: FloatArray,
    labels: NDArray[np.int64],
    whorl: IntArray,
    leaves: dict[int, IntArray],
    end: FloatArray,
) -> None:
    """Share the nodes of a whorl out among its leaves, of which `leaves` has the nodes beyond it, by label.

    Rolled around each other they touch all over, so which is next over the surface says little.  A leaf goes straight
    to the stem's end (3,), from all over its visible base, and all leaves reach it: ways over the surface are compared
    by how much longer they are than those to the stem.
    """
    nodes = whorl[np.isin(labels[whorl], list(leaves))]
    if len(leaves) < 2 or len(nodes) == 0:
        return
    at_end = distance[nodes] <= distance[nodes].min() + END * graph.spacing
    cost = np.empty((len(leaves), len(nodes)))
    for row, own in enumerate(leaves.values()):
        base = graph.points[own[distance[own] <= distance[own].min() + BASE * graph.spacing]]
        gap = np.min([along_path(graph.points[nodes], np.array([place, end]))[0] for place in base], axis=0)
        part = np.concatenate([nodes, own])
        inside = csr_array(graph.weights[part][:, part])
        way = dijkstra(inside, directed=False, indices=np.arange(len(nodes), len(part)), min_only=True)[: len(nodes)]
        to_end = way[at_end & np.isfinite(way)]
        cost[row] = gap + way - (np.median(to_end) if len(to_end) else 0.0)
    reached = np.isfinite(cost).any(axis=0)
    labels[nodes[reached]] = np.array(list(leaves))[np.argmin(cost[:, reached], axis=0)]
