"""What is told of a segmented plant: midribs, collars, ranks, azimuths, lengths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phytofit.segmentation.graph import PlantGraph
from phytofit.segmentation.organs import SLICE, Organs, along_path, centerline

__all__ = ["SegmentedLeaf", "azimuth_frame", "derive_leaves"]

FloatArray = NDArray[np.float64]
BASE_BAND = 4.0  # typical distances of neighbours: of a leaf, next to the stem
N_ALONG = 40  # sections of a midrib at most
CLOSE_COLLARS = 2.0  # stem radii: leaves whose collars are nearer may be in the wrong order
FEW_NODES = 25  # of a leaf


@dataclass(frozen=True)
class SegmentedLeaf:
    """One leaf of a segmented plant.

    ``rank`` counts from the base of the stem, from 1; its points are labelled ``rank + 1``.  ``azimuth`` is the
    direction in which it leaves the stem, deg, counter-clockwise seen from above from the x axis (from y, where x is
    upright); ``collar`` (3,) the place on the stem's axis, cm, ``collar_distance`` how far it is along the stem from
    its base and ``collar_height`` how high above it, cm; ``tip`` (3,); ``midrib`` (k, 3) from the collar to the tip,
    ``length`` along it from the stem's surface, cm; ``n_points`` of the cloud.  ``flags`` are codes of remarks.
    """

    rank: int
    azimuth: float
    collar: FloatArray
    collar_distance: float
    collar_height: float
    tip: FloatArray
    midrib: FloatArray
    length: float
    n_points: int
    flags: tuple[str, ...]


def azimuth_frame(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Horizontal unit vectors of azimuth 0 and 90 degrees."""
    first = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    zero = first - (first @ up) * up
    zero = zero / np.linalg.norm(zero)
    return zero, np.cross(up, zero)


def derive_leaves(
    graph: PlantGraph, distance: FloatArray, organs: Organs, up: FloatArray
) -> tuple[list[SegmentedLeaf], list[int]]:
    """The leaves by rank, and of each the label that its nodes have in `organs`; ``n_points`` are still 0."""
    found = []
    for i, (tip, level) in enumerate(zip(organs.tips, organs.levels, strict=True)):
        nodes = np.flatnonzero(organs.labels == i + 2)
        if len(nodes):
            found.append((_leaf(graph, distance, organs, up, nodes, tip, level), i + 2))
    found.sort(key=lambda pair: (pair[0].collar_distance, pair[0].tip @ up, pair[1]))
    leaves = []
    for rank, (leaf, _) in enumerate(found, start=1):
        beside = [other for other, _ in found[max(rank - 2, 0) : rank + 1] if other is not leaf]
        flags = list(leaf.flags)
        if any(abs(o.collar_distance - leaf.collar_distance) < CLOSE_COLLARS * organs.radius for o in beside):
            flags.append("rank_uncertain")
        leaves.append(SegmentedLeaf(**{**leaf.__dict__, "rank": rank, "flags": tuple(flags)}))
    return leaves, [label for _, label in found]


def _leaf(
    graph: PlantGraph,
    distance: FloatArray,
    organs: Organs,
    up: FloatArray,
    nodes: NDArray[np.intp],
    tip: int,
    level: float,
) -> SegmentedLeaf:
    d = distance[nodes]
    start = max(level, float(d.min()))
    upper = nodes[d >= start] if (d >= start).sum() >= 3 else nodes
    base = upper[distance[upper] <= distance[upper].min() + BASE_BAND * graph.spacing]
    root = graph.points[base].mean(axis=0)
    _, along, place = along_path(root[np.newaxis], organs.path)
    collar = place[0]
    thickness = max(SLICE * graph.spacing, float(np.ptp(distance[upper])) / N_ALONG)
    line = centerline(graph.points[upper], distance[upper], thickness)
    midrib = np.concatenate([collar[np.newaxis], line, graph.points[tip][np.newaxis]])
    whole = float(np.linalg.norm(np.diff(midrib, axis=0), axis=1).sum())
    zero, ninety = azimuth_frame(up)
    side = midrib[: max(3, len(midrib) // 2)].mean(axis=0) - collar
    azimuth = float(np.degrees(np.arctan2(side @ ninety, side @ zero)) % 360.0)
    flags = ["leaf_doubtful"] if len(nodes) < FEW_NODES else []
    return SegmentedLeaf(
        rank=0,
        azimuth=azimuth,
        collar=collar,
        collar_distance=float(along[0]),
        collar_height=float((collar - organs.path[0]) @ up),
        tip=graph.points[tip],
        midrib=midrib,
        length=max(whole - organs.radius, 0.0),
        n_points=0,
        flags=tuple(flags),
    )
