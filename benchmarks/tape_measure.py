"""What callipers and a tape find on the points of a phytomer: circles round its stem, sections of its leaf, its length.

Unlike model_free.py, which is a whole method to compare with, these are checks by which a fit can be judged: the cloud
is given upright, with the stem's axis along z, and they are told where the leaf begins.
"""

from typing import NamedTuple

import numpy as np
from model_free import thinned
from numpy.polynomial import legendre
from scipy.optimize import least_squares
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

import phytofit
import phytofit.models

SLAB_CM = 1.5  # thickness of a section
STEM_REACH_CM = 3.5  # from the stem's axis: points further out are not of its section
OFF_STEM_CM = 0.7  # from the stem's surface: points further out are of leaves
COLLAR_BELOW_CM, COLLAR_ABOVE_CM = 2.0, 5.0  # of the leaf's base: the stem is not cut there
STEM_SCATTER_CM = 0.15  # points further than that off the circle count for less
LEAST_IN_SECTION = 20  # points
LINK_CM = 1.0  # points further apart are no neighbours
LEAST_PIECE = 0.08  # of the points off the stem: smaller pieces are stubs of other leaves
TAPE_DEGREE, TAPE_ROUNDS, TAPE_NODES = 4, 4, 100
BLADE_REACH_CM = 7.0  # from the midrib: points further out are not of its section
WITHIN = (1, 99)  # percentiles between which an extent is taken


class Ring(NamedTuple):
    """A section of the stem: its height, cm, its points (n, 2), and the circle through them."""

    height: float
    points: np.ndarray
    center: np.ndarray
    diameter: float


class Section(NamedTuple):
    """A section of the leaf at a length along the midrib, cm: its points (n, 2), across and off the blade, their extent
    along their own longest direction, cm, and the fitted width there."""

    at: float
    points: np.ndarray
    extent: float
    fitted: float


def circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (2,) and diameter of the circle nearest to the points (n, 2); those far off it count less."""

    def off(x: np.ndarray) -> np.ndarray:
        return np.hypot(*(points - x[:2]).T) - x[2]

    middle = np.median(points, axis=0)
    start = np.append(middle, np.median(np.hypot(*(points - middle).T)))
    x = least_squares(off, start, loss="cauchy", f_scale=STEM_SCATTER_CM).x
    return x[:2], 2.0 * float(x[2])


def rings_of(points: np.ndarray, base: float) -> list[Ring]:
    """Sections of an upright stem, off the leaf's collar at the height `base`."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < STEM_REACH_CM]
    rings = []
    for low in np.arange(near[:, 2].min(), near[:, 2].max() - SLAB_CM, SLAB_CM):
        slab = near[(near[:, 2] >= low) & (near[:, 2] < low + SLAB_CM), :2]
        beside_collar = low + SLAB_CM < base - COLLAR_BELOW_CM or low > base + COLLAR_ABOVE_CM
        if len(slab) >= LEAST_IN_SECTION and beside_collar:
            rings.append(Ring(low + 0.5 * SLAB_CM, slab, *circle(slab)))
    return rings


def leaf_of(points: np.ndarray, radius: float) -> np.ndarray:
    """The points off an upright stem, without stubs of other leaves."""
    off = points[np.hypot(points[:, 0], points[:, 1]) > radius + OFF_STEM_CM]
    piece = connected_components(neighbors(off), directed=False)[1]
    return off[np.bincount(piece)[piece] > LEAST_PIECE * len(off)]


def neighbors(points: np.ndarray) -> csr_array:
    """Distances between points at most `LINK_CM` apart."""
    tree = cKDTree(points)
    return csr_array(tree.sparse_distance_matrix(tree, LINK_CM))


def tape_along(leaf: np.ndarray, radius: float, degree: int = TAPE_DEGREE) -> np.ndarray:
    """Nodes (m, 3) of a tape laid along the middle of a leaf's points, from the stem's surface to the tip.

    A polynomial of the way along it, which at first is the way from the stem through the points.
    """
    few = thinned(leaf)
    graph = neighbors(few).maximum(csr_array(minimum_spanning_tree(cdist(few, few))))  # the tree bridges gaps
    rho = np.hypot(few[:, 0], few[:, 1])
    way = dijkstra(graph, directed=False, indices=np.flatnonzero(rho < rho.min() + 1.0), min_only=True)
    for _ in range(TAPE_ROUNDS):
        low, high = np.percentile(way, WITHIN)
        curve = legendre.legfit((2.0 * way - low - high) / (high - low), few, degree)
        line = legendre.legval(np.linspace(-1.0, 1.0, TAPE_NODES), curve).T
        way = along(few, line)
    length = length_of(line)
    at = np.linspace(-STEM_REACH_CM, along(leaf, line).max(), 20 * TAPE_NODES)
    out = np.maximum(at - length, 0.0)[:, np.newaxis] * direction(line[-2], line[-1])
    back = np.minimum(at, 0.0)[:, np.newaxis] * direction(line[0], line[1])
    line = points_at(line, at) + out + back
    inside = np.flatnonzero(np.hypot(line[:, 0], line[:, 1]) < radius)
    return line[inside[-1] + 1 if len(inside) else 0 :]


def along(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Length (n,) along a line (m, 3), which goes on straight at both ends, at which it is nearest to each point."""
    step = np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1)
    at = np.concatenate([[0.0], np.cumsum(length)])
    share = np.einsum("nma,ma->nm", points[:, np.newaxis] - line[:-1], step) / length**2
    low, high = np.zeros(len(step)), np.ones(len(step))
    low[0], high[-1] = -np.inf, np.inf
    share = np.clip(share, low, high)
    nearest = np.linalg.norm(points[:, np.newaxis] - line[:-1] - share[..., np.newaxis] * step, axis=2).argmin(axis=1)
    return at[nearest] + share[np.arange(len(points)), nearest] * length[nearest]


def length_of(line: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def direction(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    return (end - start) / np.linalg.norm(end - start)


def points_at(line: np.ndarray, lengths: np.ndarray | float) -> np.ndarray:
    """Points (..., 3) of a line (m, 3) at lengths (...) along it."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    return np.stack([np.interp(lengths, at, column) for column in line.T], axis=-1)


def angle_over(line: np.ndarray, axis: np.ndarray, chord: float) -> float:
    """Degrees between the unit axis (3,) and the chord over the first piece of a line."""
    return float(np.rad2deg(np.arccos(direction(line[0], points_at(line, chord)) @ axis)))


def extent(points: np.ndarray) -> float:
    """Extent of points (n, 2) along their longest direction, but for one in a hundred at each end."""
    middle = points - points.mean(axis=0)
    longest = np.linalg.svd(middle, full_matrices=False)[2][0]
    return float(np.diff(np.percentile(middle @ longest, WITHIN))[0])


def expected_beyond(leaf: np.ndarray, blade: phytofit.models.Organ) -> float:
    """Points that an even spread puts on the blade beyond the last of the leaf's points: about one, if it fits."""
    node_at = np.concatenate([[0.0], np.cumsum(blade.segment_lengths)])
    last = min(along(leaf, blade.axis).max(), node_at[-1])
    at = np.append(last, node_at[node_at > last])
    beyond = 2.0 * np.trapezoid(np.interp(at, node_at, blade.half_width), at)
    return float(len(leaf) * beyond / blade.area)


def sections_of(leaf: np.ndarray, blade: phytofit.models.Organ, start: float) -> list[Section]:
    """Sections across the fitted midrib every centimetre, from where it leaves the stem, at the length `start`."""
    node_at = np.concatenate([[0.0], np.cumsum(blade.segment_lengths)])
    sections = []
    for at in np.arange(start + 0.5, node_at[-1], 1.0):
        frame = blade.frame[np.searchsorted(node_at, at) - 1]
        local = (leaf - points_at(blade.axis, at)) @ frame
        slab = local[(np.abs(local[:, 0]) < 0.5 * SLAB_CM) & (np.hypot(local[:, 1], local[:, 2]) < BLADE_REACH_CM), 1:]
        if len(slab) >= LEAST_IN_SECTION:
            fitted = 2.0 * float(np.interp(at, node_at, blade.half_width))
            sections.append(Section(at - start, slab, extent(slab), fitted))
    return sections
