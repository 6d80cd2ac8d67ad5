"""A baseline without a model of the plant: traits of a phytomer read off its points and their neighbourhood graph.

In the manner of the paper's refs. [4] and [5]: the stem is a region, the rest is the leaf; the leaf's length is that of
a geodesic from the stem, its width that of a cross-section, its angle that of a tangent.  It is handed the stem's axis
by phytofit, which is more than those have; pieces of the leaf are joined over gaps.  Its constants were chosen on
simulated phytomers with 0.05 and 0.5 cm of noise, whole and with holes, other than those that it is measured on.
"""

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

import phytofit
import phytofit.start
from phytofit.traits import CHORD_CM

N_POINTS = 5000
VOXEL_CM = 0.25
NEIGHBORS = 16
STEM_MARGIN, STEM_SCATTER = 1.3, 4.0  # of the stem's radius, and of its points' scatter, within which points are its
SECTION_CM = 1.5  # of geodesic distance: one section of the leaf
LEAST_IN_SECTION = 4  # points
BRIDGE_CM = 7.0  # the widest gap over which pieces are joined, somewhat more than the paper's spheres
SMOOTHING = (0.25, 0.5, 0.25)  # of the midrib's nodes
WIDTH_QUANTILES = (0.05, 0.95)  # of a section's points across: nine tenths of its width
WIDEST = 0.8  # quantile of the sections' widths, which noise widens


def measure(points: np.ndarray, seed_point: np.ndarray | None = None) -> dict[str, float]:
    """Leaf length, angle and width and stem diameter of a cloud (n, 3), cm; NaN where the method finds none.

    seed_point : (3,) on the leaf that is meant, see :func:`phytofit.fit`

    Raises NoPhytomerError where no stem is found.
    """
    cloud, seeds = phytofit.from_points(points, "cm"), None if seed_point is None else np.atleast_2d(seed_point)
    found = phytofit.start.prepare(cloud, phytofit.load_species(), n_points=N_POINTS, seed_points=seeds)
    start = found.starts[0]
    upright = (found.points - start.pose[:3, 3]) @ start.pose[:3, :3]
    rho = np.hypot(upright[:, 0], upright[:, 1])
    along_stem = (upright[:, 2] > start.foot - 2.0) & (upright[:, 2] < start.top + 2.0)
    near = along_stem & (rho < 2.0 * start.radius)
    below = near & (upright[:, 2] < -2.0 * start.radius)  # away from the leaf's base
    around = rho[below if below.sum() > 20 else near]
    radius = float(np.median(around))
    scatter = 1.4826 * float(np.median(np.abs(around - radius)))
    stem = along_stem & (rho < max(STEM_MARGIN * radius, radius + STEM_SCATTER * scatter))
    traits = dict.fromkeys(("leaf_length", "leaf_angle", "leaf_width"), np.nan) | {"stem_diameter": 2.0 * radius}
    leaf = thinned(upright[~stem])
    if len(leaf) <= NEIGHBORS:
        return traits
    distance = from_stem(leaf, radius)
    midrib, width = sections(leaf, distance)
    if len(midrib) < 3:
        return traits
    line = smoothed(midrib)
    rest = np.hypot(line[:2, 0], line[:2, 1]) - radius  # the leaf is followed straight on to the stem's surface
    back = rest[0] / max(rest[1] - rest[0], 0.3 * SECTION_CM)
    line = np.concatenate([[line[0] - min(back, 3.0) * (line[1] - line[0])], line])
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    chord = min(CHORD_CM, at[-1] / 5.0)
    end = np.array([np.interp(chord, at, column) for column in line.T]) - line[0]
    traits["leaf_length"] = float(at[-1] + 0.5 * SECTION_CM)  # the last node is the middle of a section
    traits["leaf_angle"] = float(np.rad2deg(np.arctan2(np.hypot(end[0], end[1]), end[2])))
    traits["leaf_width"] = float(np.quantile(width[1:], WIDEST))
    return traits


def thinned(points: np.ndarray) -> np.ndarray:
    """Mean of the points in each voxel, which also halves the noise."""
    number = np.unique(np.floor(points / VOXEL_CM).astype(int), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(number)
    return np.stack([np.bincount(number, column) for column in points.T], axis=1) / count[:, np.newaxis]


def from_stem(leaf: np.ndarray, radius: float) -> np.ndarray:
    """Geodesic distance (n,) from the stem's surface in the graph of neighbours; infinite where it is not connected."""
    n = len(leaf)
    gap, near = cKDTree(leaf).query(leaf, k=NEIGHBORS + 1)
    rows = np.repeat(np.arange(n), NEIGHBORS)
    graph = bridged(leaf, coo_array((gap[:, 1:].ravel(), (rows, near[:, 1:].ravel())), shape=(n, n)).tocsr())
    piece = connected_components(graph, directed=False)[1]
    rest = np.hypot(leaf[:, 0], leaf[:, 1]) - radius
    largest = piece == np.argmax(np.bincount(piece))
    first = np.flatnonzero(largest)[np.argsort(rest[largest])[:NEIGHBORS]]
    return dijkstra(graph, directed=False, indices=first, min_only=True) + max(0.0, float(rest[first].min()))


def bridged(leaf: np.ndarray, graph: csr_array) -> csr_array:
    """The graph with its pieces joined, each to the largest by the shortest way, as far as `BRIDGE_CM` reaches."""
    while True:
        count, piece = connected_components(graph, directed=False)
        size = np.bincount(piece)
        largest = np.flatnonzero(piece == np.argmax(size))
        others = np.flatnonzero((piece != np.argmax(size)) & (size[piece] > NEIGHBORS))
        if count == 1 or len(others) == 0:
            return graph
        gap, near = cKDTree(leaf[largest]).query(leaf[others])
        best = int(np.argmin(gap))
        if gap[best] > BRIDGE_CM:
            return graph
        graph = graph + coo_array(([gap[best]], ([others[best]], [largest[near[best]]])), shape=graph.shape).tocsr()


def sections(leaf: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre (m, 3) and width (m,) of the leaf's sections of equal geodesic distance."""
    number = np.full(len(leaf), -1)
    number[np.isfinite(distance)] = (distance[np.isfinite(distance)] / SECTION_CM).astype(int)
    centers, widths = [], []
    for i in range(number.max() + 1):
        those = leaf[number == i]
        if len(those) < LEAST_IN_SECTION:
            continue
        centers.append(those.mean(axis=0))
        level = np.linalg.svd(those - centers[-1], full_matrices=False)[2][0]
        widths.append(np.diff(np.quantile((those - centers[-1]) @ level, WIDTH_QUANTILES))[0] / 0.9)
    return np.array(centers).reshape(-1, 3), np.array(widths)


def smoothed(line: np.ndarray) -> np.ndarray:
    inner = np.stack([np.convolve(column, SMOOTHING, "valid") for column in line.T], axis=1)
    return np.concatenate([line[:1], inner, line[-1:]])
