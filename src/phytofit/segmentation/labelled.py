"""Organs of a plant whose points are labelled already, by a person or another program."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.cloud import PointCloud
from phytofit.errors import CloudError
from phytofit.segmentation.graph import PlantGraph, geodesics, plant_graph
from phytofit.segmentation.organs import SLICE, Organs, along_path, centerline

__all__ = ["labelled_organs", "leaf_names"]

FloatArray = NDArray[np.float64]
LEAST_POINTS = 10  # of the stem, and of a leaf
FORWARD = 0.3  # of a leaf's length from its collar: where its direction against the stem's is measured


def labelled_organs(
    cloud: PointCloud, first: NDArray[np.intp], up: FloatArray | None, n_nodes: int
) -> tuple[PlantGraph, FloatArray, Organs, FloatArray | None]:
    """Graph, distances from the stem's base, organs and up of a labelled cloud; the points `first` are looked at.

    Raises CloudError where no stem or no leaf is labelled.
    """
    if cloud.labels is None or not (cloud.labels == 1).sum() >= LEAST_POINTS or not len(leaf_names(cloud)):
        found = "none" if cloud.labels is None else f"the labels {np.unique(cloud.labels).tolist()[:12]}"
        raise CloudError(
            f"{cloud.name}: expected a point property with labels, 1 stem and 2.. leaves (at least {LEAST_POINTS} "
            f"points each), found {found}"
        )
    names = leaf_names(cloud)
    used = np.flatnonzero((cloud.labels == 1) | np.isin(cloud.labels, names))
    kept = np.intersect1d(first, used)
    missing = [name for name in [1, *names] if not (cloud.labels[kept] == name).any()]
    kept = np.union1d(kept, [int(np.flatnonzero(cloud.labels == name)[0]) for name in missing]).astype(np.intp)
    points = cloud.points[kept]
    graph = plant_graph(points, n_nodes)
    given = cloud.labels[kept][graph.nodes]
    stem = np.flatnonzero(given == 1)
    if len(stem) < 4:
        raise CloudError(f"{cloud.name}: the stem's {int((cloud.labels == 1).sum())} points are no connected piece")
    base = _base(graph, given, stem, up)
    distance, _ = geodesics(graph, base)
    thickness = max(SLICE * graph.spacing, 0.02 * float(np.ptp(distance[stem])))
    path = centerline(graph.points[stem], distance[stem], thickness)
    if len(path) < 2:
        path = graph.points[[base, int(stem[np.argmax(distance[stem])])]]
    radius = max(float(np.median(along_path(graph.points[stem], path)[0])), 1e-6)
    labels = np.where(given == 1, 1, 0).astype(np.int64)
    tips, levels = [], []
    tree = cKDTree(graph.points)
    for i, name in enumerate(names):
        nodes = np.flatnonzero(given == name)
        if len(nodes) == 0:  # too small, or too far away, to be on the graph: its nearest node stands for it
            nodes = np.array([int(tree.query(cloud.points[cloud.labels == name].mean(axis=0))[1])])
        labels[nodes] = i + 2
        tips.append(int(nodes[np.argmax(distance[nodes])]))
        levels.append(float(distance[nodes].min()))
    return graph, distance, Organs(labels, path, radius, tuple(tips), tuple(levels)), up


def leaf_names(cloud: PointCloud) -> NDArray[np.int64]:
    """The labels (m,) of leaves; fewer than `LEAST_POINTS` points of a label are a slip of the hand, and no leaf."""
    assert cloud.labels is not None
    names, count = np.unique(cloud.labels[cloud.labels > 1], return_counts=True)
    return names[count >= LEAST_POINTS]


def _base(graph: PlantGraph, given: NDArray[np.int64], stem: NDArray[np.intp], up: FloatArray | None) -> int:
    """Of the stem's two ends the lower one; where up is not known, the one from which the leaves part forwards."""
    center = graph.points[stem].mean(axis=0)
    axis = np.linalg.svd(graph.points[stem] - center, full_matrices=False)[2][0]
    along = (graph.points[stem] - center) @ axis
    ends = [int(stem[np.argmin(along)]), int(stem[np.argmax(along)])]
    if up is not None:
        return min(ends, key=lambda end: float(graph.points[end] @ up))
    forward = 0.0
    for name in np.unique(given[given > 1]):
        blade = graph.points[given == name]
        gap = cKDTree(graph.points[stem]).query(blade)[0]
        near = gap <= np.quantile(gap, FORWARD)
        middle = blade[near].mean(axis=0) - blade[gap <= np.quantile(gap, 0.05)].mean(axis=0)
        forward += float(middle @ axis) / max(float(np.linalg.norm(middle)), 1e-12)
    return ends[0] if forward >= 0 else ends[1]
