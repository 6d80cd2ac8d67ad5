"""A plant's surface as a graph: nodes spread evenly over it, joined to their neighbours, pieces bridged."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from phytofit.cloud import remove_outliers, thin
from phytofit.errors import NoStemError

__all__ = ["PlantGraph", "coarse", "geodesics", "path_to_root", "plant_graph", "tips_of"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
N_NEIGHBORS = 10  # of each node
REACH = 3.5  # typical distances of neighbours, beyond which nodes are not joined
CREASE = 3.0  # an edge between normals at right angles counts this many times longer, and once more
BRIDGE = 0.12  # of the plant's size; pieces farther from all others are not the plant's
LEAST_NODES = 50
LEAST_PIECE = 0.002  # share of the nodes; smaller pieces are left to be unknown
N_ENDS = 48  # nodes of a piece that may carry its bridge
FINE = 1 / 600  # of the cloud's size: denser clouds are thinned to voxels of this edge before anything else


@dataclass(frozen=True)
class PlantGraph:
    """Nodes on a plant and how they are joined.

    ``nodes`` (m,) are indices into the points, ``points`` (m, 3) their places, cm, ``normals`` (m, 3) up to sign;
    ``weights`` is the symmetric (m, m) matrix of edge lengths, longer across creases; ``spacing`` the typical distance
    of neighbours, cm; ``n_bridges`` how many pieces had to be joined over a gap.
    """

    nodes: IntArray
    points: FloatArray
    normals: FloatArray
    weights: csr_array
    spacing: float
    n_bridges: int


def coarse(points: FloatArray) -> tuple[IntArray, IntArray]:
    """A point a voxel of 1/600 of the cloud's size: its index, and of each point (n,) which of them stands for it."""
    edge = float(np.ptp(points, axis=0).max()) * FINE
    if edge == 0.0:
        return np.arange(1), np.zeros(len(points), np.intp)
    x, y, z = ((points - points.min(axis=0)) / edge).astype(np.int64).T
    _, first, stands_for = np.unique((x << 42) | (y << 21) | z, return_index=True, return_inverse=True)
    return first, stands_for


def plant_graph(points: FloatArray, n_nodes: int, *, bridged: bool = True) -> PlantGraph:
    """The graph of points (n, 3), cm: thinned to about `n_nodes`, cleaned, joined; small far pieces left out.

    Where it is not `bridged`, all pieces but the smallest stay, each by itself.
    """
    kept = thin(points, n_nodes)
    kept = kept[remove_outliers(points[kept])]
    chosen = points[kept]
    if len(chosen) < LEAST_NODES:
        raise NoStemError(
            f"found {len(chosen)} places on the plant, at least {LEAST_NODES} are needed; is the cloud one plant?"
        )
    tree = cKDTree(chosen)
    k = min(N_NEIGHBORS, len(chosen) - 1)
    distance, neighbor = tree.query(chosen, k=k + 1)
    spacing = float(np.median(distance[:, min(4, k)]))
    normals, directions = _shapes(chosen, neighbor)
    rows = np.repeat(np.arange(len(chosen)), k)
    columns, length = neighbor[:, 1:].ravel(), distance[:, 1:].ravel()
    near = length <= REACH * spacing
    rows, columns, length = rows[near], columns[near], length[near]
    graph = _symmetric(rows, columns, length, len(chosen))
    n_pieces, piece = connected_components(graph, directed=False)
    size = np.bincount(piece, minlength=n_pieces)
    large = size >= max(6, LEAST_PIECE * len(chosen))
    large[np.argmax(size)] = True
    none = np.empty(0, np.intp)
    extra = _bridges(chosen, directions, piece, np.flatnonzero(large)) if bridged else (none, none)
    rows, columns = np.concatenate([rows, extra[0]]), np.concatenate([columns, extra[1]])
    length = np.linalg.norm(chosen[rows] - chosen[columns], axis=1)
    bent = 1.0 - np.abs(np.sum(normals[rows] * normals[columns], axis=1))
    bent[len(rows) - len(extra[0]) :] = 0.0
    graph = _symmetric(rows, columns, length * (1.0 + CREASE * bent), len(chosen))
    joined = connected_components(graph, directed=False)[1]
    inside = np.flatnonzero(joined == np.bincount(joined).argmax() if bridged else large[piece])
    graph = csr_array(graph[inside][:, inside])
    return PlantGraph(kept[inside], chosen[inside], normals[inside], graph, spacing, len(extra[0]))


def _symmetric(rows: IntArray, columns: IntArray, weight: FloatArray, n: int) -> csr_array:
    one_way = csr_array(coo_array((np.maximum(weight, 1e-9), (rows, columns)), shape=(n, n)))
    one_way.sum_duplicates()
    return csr_array(one_way.maximum(one_way.T))


def _shapes(points: FloatArray, neighbor: IntArray) -> tuple[FloatArray, FloatArray]:
    """Normal and longest direction (n, 3) of each point's neighbourhood."""
    around = points[neighbor] - points[neighbor].mean(axis=1, keepdims=True)
    vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1]
    return vectors[:, :, 0], vectors[:, :, 2]


def _bridges(points: FloatArray, directions: FloatArray, piece: IntArray, large: IntArray) -> tuple[IntArray, IntArray]:
    """Edges that join large pieces: of each two the shortest, and rather where one continues the other."""
    if len(large) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    limit = BRIDGE * 2.0 * float(np.linalg.norm(points - np.median(points, axis=0), axis=1).max())
    members = {int(p): np.flatnonzero(piece == p) for p in large}
    trees = {p: cKDTree(points[index]) for p, index in members.items()}
    found: list[tuple[float, int, int, int, int]] = []
    names = list(members)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            small, other = (a, b) if len(members[a]) <= len(members[b]) else (b, a)
            gap, nearest = trees[other].query(points[members[small]], distance_upper_bound=limit)
            order = np.argsort(gap, kind="stable")[:N_ENDS]
            order = order[np.isfinite(gap[order])]
            if len(order) == 0:
                continue
            u, v = members[small][order], members[other][nearest[order]]
            across = (points[v] - points[u]) / np.maximum(gap[order], 1e-12)[:, np.newaxis]
            along = np.abs(np.sum(across * directions[u], axis=1)) + np.abs(np.sum(across * directions[v], axis=1))
            cost = gap[order] * (2.0 - 0.5 * along)
            best = int(np.argmin(cost))
            found.append((float(cost[best]), i, names.index(b), int(u[best]), int(v[best])))
    if not found:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    costs, ends = np.array([f[0] for f in found]), np.array([f[1:3] for f in found]).T
    tree = coo_array(minimum_spanning_tree(csr_array((costs + 1e-9, ends), shape=(len(names), len(names)))))
    kept = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    edges = [(u, v) for _, a, b, u, v in found if (a, b) in kept]
    return np.array([u for u, _ in edges], np.intp), np.array([v for _, v in edges], np.intp)


def geodesics(graph: PlantGraph, root: int) -> tuple[FloatArray, IntArray]:
    """Distance (m,) of each node from the root over the surface, and the node (m,) before it; -1 at the root."""
    distance, before = dijkstra(graph.weights, directed=False, indices=root, return_predecessors=True)
    return distance, np.where(before < 0, -1, before).astype(np.intp)


def path_to_root(before: IntArray, node: int) -> list[int]:
    """Nodes from `node` down to the root, both included."""
    path = [node]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path


def tips_of(graph: PlantGraph, distance: FloatArray, least: float) -> list[int]:
    """Local maxima of the distance, farthest first, that stand out by at least `least` over the way to a higher one."""
    edges = coo_array(graph.weights)
    level = np.minimum(distance[edges.row], distance[edges.col])
    top = float(distance.max()) + 1.0
    tree = coo_array(minimum_spanning_tree(csr_array((top - level, (edges.row, edges.col)), shape=edges.shape)))
    order = np.argsort(tree.data, kind="stable")
    parent, highest = list(range(len(distance))), list(range(len(distance)))
    tips = [int(np.argmax(distance))]

    def find(a: int) -> int:
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        return a

    for e in order:
        a, b = find(int(tree.row[e])), find(int(tree.col[e]))
        if distance[highest[a]] < distance[highest[b]]:
            a, b = b, a
        if distance[highest[b]] - (top - tree.data[e]) >= least:
            tips.append(highest[b])
        parent[b] = a
    return sorted(set(tips), key=lambda tip: -distance[tip])
