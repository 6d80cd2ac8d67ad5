"""Organs grown from their tips towards the base of the stem.

The nodes are taken in the order of their distance from the base, the farthest first.  A leaf's tip is a node with no
neighbour taken before it; a leaf grows by what is next to it.  Where two leaves that stand out meet and stay in contact,
they have come to what they share: the stem.  Where they soon part again, they only touched.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from phytofit.segmentation.graph import PlantGraph

__all__ = ["Region", "grow"]

FloatArray = NDArray[np.float64]
LEAST_LENGTH = 0.025  # of the greatest distance: what sticks out less is no leaf
LEAST_ELONGATION = 0.9  # length over mean width of what sticks out: corners and lobes of a blade have less
CONTACT = 0.03  # of the greatest distance: in contact for longer, two leaves have met for good


@dataclass
class Region:
    """A leaf, or what several share: its nodes from the tip downwards, and the regions that met to form it."""

    tip: int
    nodes: list[int] = field(default_factory=list)
    children: tuple[int, ...] = ()
    parent: int = -1
    level: float = 0.0  # distance at which it was given up to its parent


def grow(graph: PlantGraph, distance: FloatArray) -> tuple[list[Region], int]:
    """Regions of the plant, and the number of the one at the base of the stem, the root of their tree.

    distance : (m,) of each node from the base of the stem over the surface, cm
    """
    far = float(distance.max())
    least, contact_length = LEAST_LENGTH * far, CONTACT * far
    cell = graph.spacing**2
    weights = graph.weights
    indptr, indices, data = weights.indptr.tolist(), weights.indices.tolist(), weights.data.tolist()
    d = distance.tolist()
    regions: list[Region] = []
    owner = [-1] * len(d)
    into: list[int] = []  # of each region, the one it was merged into
    met: dict[tuple[int, int], tuple[float, float]] = {}  # first and last distance of a contact

    def find(a: int) -> int:
        while into[a] != a:
            into[a] = into[into[a]]
            a = into[a]
        return a

    def stands_out(a: int, level: float) -> bool:
        region = regions[a]
        if region.children:
            return True
        length = d[region.tip] - level
        if length < least:
            return False
        return length * length >= LEAST_ELONGATION * len(region.nodes) * cell

    def absorb(small: int, large: int) -> None:
        regions[large].nodes.extend(regions[small].nodes)
        regions[large].nodes.sort(key=lambda node: -d[node])
        regions[small].nodes = []
        into[small] = large

    def unite(a: int, b: int, level: float) -> None:
        joined = Region(tip=regions[a].tip if d[regions[a].tip] >= d[regions[b].tip] else regions[b].tip)
        joined.children, joined.level = (a, b), 0.0
        number = len(regions)
        for child in (a, b):
            region = regions[child]
            below = [node for node in region.nodes if d[node] < level]
            region.nodes = [node for node in region.nodes if d[node] >= level]
            joined.nodes += below
            region.parent, region.level = number, level
            into[child] = number
        joined.nodes.sort(key=lambda node: -d[node])
        regions.append(joined)
        into.append(number)

    for node in np.argsort(-distance, kind="stable").tolist():
        level = d[node]
        best: dict[int, float] = {}
        for e in range(indptr[node], indptr[node + 1]):
            other = indices[e]
            if owner[other] >= 0:
                a = find(owner[other])
                best[a] = min(best.get(a, np.inf), data[e])
        if not best:
            owner[node] = len(regions)
            into.append(len(regions))
            regions.append(Region(tip=node, nodes=[node]))
            continue
        owners = sorted(best, key=lambda a: (best[a], a))
        strong = [a for a in owners if stands_out(a, level)]
        keep = strong[0] if strong else max(owners, key=lambda a: (d[regions[a].tip], -a))
        for a in owners:
            if a != keep and a not in strong:
                absorb(a, keep)
        owner[node] = keep
        regions[keep].nodes.append(node)
        for a in strong:
            if a == keep or find(a) != a or find(keep) != keep:
                continue
            key = (min(a, keep), max(a, keep))
            first, last = met.get(key, (level, level))
            if last - level > 0.5 * contact_length:  # they had parted
                first = level
            met[key] = (first, level)
            if first - level >= contact_length:
                unite(*key, first)
                keep = find(keep)
    while alive := [(first, a, b) for (a, b), (first, _) in met.items() if find(a) != find(b)]:
        first, a, b = max(alive)  # at the base of the stem whatever is in contact has met
        unite(find(a), find(b), first)
    return regions, find(owner[int(np.argmin(distance))])
