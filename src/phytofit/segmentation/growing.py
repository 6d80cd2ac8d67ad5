"""Organs grown from their tips towards the base of the stem.

The nodes are taken in the order of their distance from the base, the farthest first.  A leaf's tip is a node with no
neighbour taken before it; a leaf grows by what is next to it.  Where two leaves that stand out meet and stay in
contact, they have come to what they share: the stem.  Where they soon part again, they only touched.
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
    level: float = 0.0  # distance at which it was given up to its parent


def grow(graph: PlantGraph, distance: FloatArray) -> tuple[list[Region], int]:
    """Regions of the plant, and the number of the one at the base of the stem, the root of their tree.

    distance : (m,) of each node from the base of the stem over the surface, cm
    """
    growth = _Growth(distance, graph.spacing**2)
    weights = graph.weights
    first, other, weight = weights.indptr.tolist(), weights.indices.tolist(), weights.data.tolist()
    for node in np.argsort(-distance, kind="stable").tolist():
        edges = slice(first[node], first[node + 1])
        growth.take(node, other[edges], weight[edges])
    return growth.regions, growth.finish(int(np.argmin(distance)))


class _Growth:
    """Regions while they grow."""

    def __init__(self, distance: FloatArray, cell: float) -> None:
        far = float(distance.max())
        self.least, self.contact = LEAST_LENGTH * far, CONTACT * far
        self.cell = cell  # area of a node, cm2
        self.distance: list[float] = distance.tolist()
        self.regions: list[Region] = []
        self.into: list[int] = []  # of each region, the one that it has become part of
        self.owner = [-1] * len(self.distance)
        self.met: dict[tuple[int, int], tuple[float, float]] = {}  # first and last distance of a contact

    def find(self, a: int) -> int:
        while self.into[a] != a:
            self.into[a] = self.into[self.into[a]]
            a = self.into[a]
        return a

    def take(self, node: int, others: list[int], weights: list[float]) -> None:
        """Give a node to the region of its nearest neighbour that stands out; or begin a region with it."""
        level = self.distance[node]
        near: dict[int, float] = {}
        for other, weight in zip(others, weights, strict=True):
            if self.owner[other] >= 0:
                a = self.find(self.owner[other])
                near[a] = min(near.get(a, np.inf), weight)
        if not near:
            self.owner[node] = self._begin(Region(tip=node, nodes=[node]))
            return
        owners = sorted(near, key=lambda a: (near[a], a))
        strong = [a for a in owners if self._stands_out(a, level)]
        keep = strong[0] if strong else max(owners, key=lambda a: (self.distance[self.regions[a].tip], -a))
        for a in owners:
            if a != keep and a not in strong:
                self._absorb(a, keep)
        self.owner[node] = keep
        self.regions[keep].nodes.append(node)
        for a in strong:
            if a != self.find(keep) and self.find(a) == a:
                keep = self._touch(a, self.find(keep), level)

    def finish(self, base: int) -> int:
        """Settle the contacts that have not lasted, as one of the two went no further; the region at the base."""
        while True:
            pending = [(first, a, b) for (a, b), (first, _) in self.met.items() if self.find(a) != self.find(b)]
            if not pending:
                return self.find(self.owner[base])
            first, a, b = max(pending)
            if self._lowest(self.find(a)) < self._lowest(self.find(b)):
                a, b = b, a
            self._insert(self.find(a), b, first)

    def _lowest(self, a: int) -> float:
        return min((self.distance[node] for node in self.regions[a].nodes), default=0.0)

    def _insert(self, a: int, other: int, level: float) -> None:
        """Unite a region that ended with the one that it had met, which may have become part of others since."""
        whole = self.into[other] == other
        lower, parents = self.regions[other].level, [r for r in self.regions if other in r.children]
        into = self.into[other]
        self._unite(a, other, level)
        number = len(self.regions) - 1
        if whole:
            return
        self.regions[number].level = lower
        for parent in parents:
            parent.children = (*(child for child in parent.children if child != other), number)
        self.into[number] = into

    def _begin(self, region: Region) -> int:
        self.regions.append(region)
        self.into.append(len(self.into))
        return len(self.into) - 1

    def _stands_out(self, a: int, level: float) -> bool:
        region = self.regions[a]
        length = self.distance[region.tip] - level
        slender = length * length >= LEAST_ELONGATION * len(region.nodes) * self.cell
        return bool(region.children) or (length >= self.least and slender)

    def _absorb(self, small: int, large: int) -> None:
        self.regions[large].nodes += self.regions[small].nodes
        self.regions[small].nodes = []
        self.into[small] = large

    def _touch(self, a: int, b: int, level: float) -> int:
        """Note a contact of two regions; if it has lasted, they are united.  The region that b belongs to then."""
        key = (min(a, b), max(a, b))
        first, last = self.met.get(key, (level, level))
        if last - level > 0.5 * self.contact:  # they had parted
            first = level
        self.met[key] = (first, level)
        if first - level >= self.contact:
            self._unite(*key, first)
        return self.find(b)

    def _unite(self, a: int, b: int, level: float) -> None:
        """A region for what two share: what was taken since they met, and all that follows."""
        tip = max(self.regions[a].tip, self.regions[b].tip, key=lambda node: self.distance[node])
        number = self._begin(Region(tip=tip, children=(a, b)))
        for child in (a, b):
            region = self.regions[child]
            self.regions[number].nodes += [node for node in region.nodes if self.distance[node] < level]
            region.nodes = [node for node in region.nodes if self.distance[node] >= level]
            region.level = level
            self.into[child] = number
