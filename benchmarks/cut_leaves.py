"""Leaves with their piece of stem, cut from the plants of ../shared/data by their labels."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from common import DATA, clouds, read
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

import phytofit
import phytofit.start

SPECIES = phytofit.load_species()
LEAF_CM = float(SPECIES.space.mean[SPECIES.space.index("leaf_length")])  # to which leaves are scaled
BELOW_CM, ABOVE_CM = 15.0, 10.0  # of stem that is kept, at that scale
LEAST_POINTS, LEAST_ON_STEM = 150, 30  # of a leaf, of its piece of stem
MESH_POINTS, STEM_COLOR = 60_000, (0, 255, 255)
GAP = 0.05  # of a leaf's length: one whose base is further from the stem is hidden there
N_NEAR, N_ALONG = 10, 1500  # neighbours, and points, of the graph that a leaf's length is measured along


class Leaf(NamedTuple):
    """A leaf with its piece of stem: points (n, 3), at the prior's scale; organ (n,) 0 stem, 1 leaf, or None."""

    data_set: str
    plant: str
    name: str
    points: np.ndarray
    organ: np.ndarray | None
    starts: list[phytofit.start.StartPose]


class Plant(NamedTuple):
    """A cloud (n, 3) of a plant, in any unit, on one of its days; labels (n,): 1 the stem, 2.. leaves, 0 neither."""

    data_set: str
    plant: str
    name: str
    points: np.ndarray
    labels: np.ndarray


def leaves(n_points: int, most: int) -> Iterator[Leaf]:
    """All there are, at most so many of a plant, evenly over its leaves and days."""
    yield from single_leaves(n_points)
    cut: dict[str, list[Leaf]] = {}
    for plant in labelled_plants():
        those = (cut_leaf(plant, label, n_points) for label in range(2, plant.labels.max() + 1))
        cut.setdefault(plant.plant, []).extend(leaf for leaf in those if leaf is not None)
    for found in cut.values():
        for i in np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int)):
            yield found[i]


def single_leaves(n_points: int) -> Iterator[Leaf]:
    """The paper's real clouds: not labelled, a leaf on its piece of stem each, y is up."""
    for path in clouds("greenhouse", "field"):
        up = np.array([0.0, 1.0, 0.0])
        found = phytofit.start.prepare(read(path), SPECIES, n_points=n_points, up=up, with_outliers=True)
        yield Leaf(path.parent.name, path.stem, path.stem, found.points, None, found.starts)


def labelled_plants() -> Iterator[Plant]:
    for path in sorted((DATA.parent / "trackplant3d").rglob("*.txt"), key=lambda path: path.stem.split("_")[1:]):
        points, labels = rows_of(path)
        _, species, treatment, plant, day = path.stem.split("_")
        yield Plant(f"{species} seedlings", f"{species} {treatment} {plant}", day, points, labels + 1)
    for path in sorted((DATA.parent / "label3dmaize").glob("*.txt")):
        points, labels = rows_of(path)
        if path.stem.startswith("nk"):  # its highest label is the pot
            labels[labels == labels.max()] = 0
        yield Plant("label3dmaize", path.stem, "", points, labels)
    mesh, of_face = colored_mesh()
    drawn, face = trimesh.sample.sample_surface(mesh, MESH_POINTS, seed=0)
    yield Plant("mccormick", "mccormick", "", np.asarray(drawn), of_face[face])


def colored_mesh() -> tuple[trimesh.Trimesh, np.ndarray]:
    """The sorghum mesh, in mm, and the labels of its faces by their colours: 1 stem, others a leaf each."""
    mesh = trimesh.load(DATA.parent / "mccormick2016_turntable" / "segmentedMesh.ply", process=False)
    colors, number = np.unique(mesh.visual.vertex_colors[mesh.faces[:, 0], :3], axis=0, return_inverse=True)
    stem = int(np.flatnonzero((colors == STEM_COLOR).all(axis=1))[0])
    return mesh, np.where(number == stem, 1, number + 2).ravel()


def rows_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = np.loadtxt(path)
    return rows[:, :3], rows[:, 3].astype(int)


def cut_leaf(plant: Plant, label: int, n_points: int) -> Leaf | None:
    """A labelled leaf and its piece of stem, as long as the species expects it to be; None where that can't be cut."""
    leaf, stem = plant.points[plant.labels == label], plant.points[plant.labels == 1]
    if len(leaf) < LEAST_POINTS:
        return None
    gap, nearest = cKDTree(leaf).query(stem)
    close = np.argsort(gap)[:N_NEAR]
    length = midrib_length(leaf, int(nearest[close[0]]))
    if gap[close].mean() > GAP * length:
        return None
    leaf, stem = ((those - stem[close].mean(axis=0)) * LEAF_CM / length for those in (leaf, stem))
    near = stem[np.linalg.norm(stem, axis=1) < BELOW_CM]
    axis = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][0]
    if (plant.points[plant.labels > 1].mean(axis=0) - plant.points[plant.labels == 1].mean(axis=0)) @ axis < 0.0:
        axis = -axis  # leaves are at the stem's top
    height = stem @ axis
    stem, height = (those[(height > -BELOW_CM) & (height < ABOVE_CM)] for those in (stem, height))
    both = np.concatenate([stem, leaf])
    organ = np.repeat(np.array([0, 1], np.int8), [len(stem), len(leaf)])
    kept = np.sort(np.random.default_rng(0).permutation(len(both))[:n_points])
    if np.sum(organ[kept] == 0) < LEAST_ON_STEM:
        return None
    across = stem - np.outer(height, axis)
    middle = np.median(across, axis=0)
    side = leaf.mean(axis=0) - middle
    side -= side @ axis * axis
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([side, np.cross(axis, side), axis], axis=1), middle
    foot, top = np.quantile(height, [0.01, 0.99])
    radius = np.median(np.linalg.norm(across - middle, axis=1))
    start = phytofit.start.StartPose(pose, float(foot), float(top), float(radius), curl=0.0, score=0.0)
    return Leaf(plant.data_set, plant.plant, f"{plant.name} leaf {label - 1}".strip(), both[kept], organ[kept], [start])


def midrib_length(leaf: np.ndarray, base: int) -> float:
    """Of a leaf's points (n, 3), from that of them which is its base, along the graph of neighbours."""
    some = np.linspace(0, len(leaf) - 1, min(len(leaf), N_ALONG)).astype(int)
    leaf = np.concatenate([leaf[[base]], leaf[some[some != base]]])
    gap, near = cKDTree(leaf).query(leaf, k=N_NEAR + 1)
    rows = np.repeat(np.arange(len(leaf)), N_NEAR)
    graph = coo_array((gap[:, 1:].ravel(), (rows, near[:, 1:].ravel())), shape=(len(leaf), len(leaf))).tocsr()
    far = dijkstra(graph, directed=False, indices=0)
    return float(far[np.isfinite(far)].max())
