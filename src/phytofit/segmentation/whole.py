"""A plant's cloud taken apart: the one function that calls all the others, and what it returns."""

import os
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from phytofit.cloud import PointCloud, as_cloud
from phytofit.display import Shown, Summary
from phytofit.errors import CloudError, NoStemError, SettingError
from phytofit.ordering import canonical_order
from phytofit.parsing import parse_up
from phytofit.segmentation.derive import SegmentedLeaf, derive_leaves
from phytofit.segmentation.graph import PlantGraph, coarse, geodesics, plant_graph
from phytofit.segmentation.ground import find_ground
from phytofit.segmentation.growing import grow
from phytofit.segmentation.labelled import labelled_organs, leaf_names
from phytofit.segmentation.organs import Organs, along_path, find_organs
from phytofit.segmentation.root import find_root

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["PLANT_CM", "Segmentation", "segment"]

PLANT_CM = (3.0, 500.0)  # sizes that are believed of a whole plant, from the seedling on
FloatArray = NDArray[np.float64]
MIN_POINTS = 100  # of a cloud that can be told apart
LEAST_SETTING = 500  # nodes
N_ROOT_NODES = 3000  # enough to see by where the stem begins
FAR = 4.0  # typical distances of nodes, beyond which a point is nobody's
DOUBTFUL = 4.0  # stem radii about a collar: there the fit is to say what is stem and what is leaf
PIECE = 5.0  # stem radii, at least, of stem above a phytomer's collar
HUGS = 10.0  # stem radii, at least, of stem below; so far a leaf may lie against its stem before it is seen to part
BESIDE = 0.5  # cosine of the angle about the stem's axis within which a point is on a leaf's side


@dataclass(frozen=True, repr=False)
class Segmentation(Shown):
    """A plant's points by organ, and what follows.

    ``cloud`` is what was segmented, ``labels`` (n,) of its points: 0 unknown, ground or pot, 1 stem, 2.. leaves
    counted from the base.  ``stem_path`` (k, 3) is the stem's axis from its base to the innermost leaf,
    ``stem_radius`` its typical radius, cm; ``up`` (3,) the direction that was stated or found; ``leaves`` by rank.
    ``notes`` say what was done; ``settings`` repeat the run.
    """

    cloud: PointCloud
    labels: NDArray[np.int64]
    stem_path: FloatArray
    stem_radius: float
    up: FloatArray
    leaves: tuple[SegmentedLeaf, ...]
    notes: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)

    def summary(self) -> Summary:
        """The leaves from the base, and their flags."""
        unit = "rel" if self.cloud.unit == "none" else "cm"
        columns = ("leaf", f"collar along the stem, {unit}", f"length, {unit}", "azimuth, deg", "points")
        rows = [
            (
                str(leaf.rank),
                f"{leaf.collar_distance:.1f}",
                f"{leaf.length:.1f}",
                f"{leaf.azimuth:.0f}",
                str(leaf.n_points),
            )
            for leaf in self.leaves
        ]
        flags = [f"flag: leaf {leaf.rank}: {flag}" for leaf in self.leaves for flag in leaf.flags]
        return Summary(f"Segmentation of {self.cloud.name}: {len(self.leaves)} leaves", columns, rows, flags)

    def to_frame(self) -> "pd.DataFrame":
        """The leaves as a table, with the columns of ``leaves.csv``."""
        from phytofit.io import leaf_table

        return leaf_table(self.cloud.name, self)

    def plot(self) -> "Figure":
        """The plant with its leaves coloured and numbered: ``segmentation.png``."""
        from phytofit.plots import plot_segmentation

        return plot_segmentation(self, title=self.cloud.name)

    @property
    def plant(self) -> PointCloud:
        """The whole cloud with the labels; written to a file and edited, it can be given back."""
        return replace(self.cloud, labels=self.labels)

    @property
    def stem_length(self) -> float:
        """Along the axis, cm."""
        return float(np.linalg.norm(np.diff(self.stem_path, axis=0), axis=1).sum())

    def phytomers(self) -> list[PointCloud]:
        """Each leaf with the piece of stem around its collar, ready for the fit: labelled 1 stem, 2 leaf, and 0 about
        the collar, and up to 10 stem radii below it on the leaf's side, where a leaf may hug the stem.

        The piece reaches half way to the collars below and above, and at least 10 stem radii down and 5 up.
        """
        points, radius = self.cloud.points, self.stem_radius
        on_stem = np.flatnonzero(self.labels == 1)
        _, along, place = along_path(points[on_stem], self.stem_path)
        collars = np.array([leaf.collar_distance for leaf in self.leaves])
        ends = np.concatenate([[-np.inf], 0.5 * (collars[1:] + collars[:-1]), [np.inf]])
        clouds = []
        for i, leaf in enumerate(self.leaves):
            low = min(ends[i], collars[i] - HUGS * radius)
            high = max(ends[i + 1], collars[i] + PIECE * radius)
            piece = (along >= low) & (along <= high)
            below = (along < collars[i]) & (along > collars[i] - HUGS * radius)
            below &= _beside(points[on_stem] - place, leaf, self.stem_path)
            labels = np.where(self.labels == leaf.rank + 1, 2, 0)
            labels[on_stem[piece]] = 1
            index = np.flatnonzero(labels)
            labels[on_stem[below]] = 0
            labels[np.linalg.norm(points - leaf.collar, axis=1) < DOUBTFUL * radius] = 0
            name = f"{self.cloud.name}_leaf_{leaf.rank:02d}"
            piece_cloud = self.cloud.take(index)
            clouds.append(replace(piece_cloud, labels=labels[index], labels_from=None, name=name, notes=()))
        return clouds


def segment(
    cloud: PointCloud | ArrayLike | str | os.PathLike[str],
    units: str | None = None,
    *,
    up: str | ArrayLike | None = None,
    n_nodes: int = 8000,
    labelled: bool = False,
) -> Segmentation:
    """Take a plant's cloud apart: stem, leaves by rank, phytomers.

    Distances are measured over the surface from the base of the stem; leaves are grown from their tips downwards until
    they meet in the stem (region growing, as in section III-A of the paper, ordered by that distance).

    Parameters
    ----------
    cloud
        One plant with stem and leaves, in any orientation; ground and pot may be below it.  A PointCloud, or a file or
        points (n, 3) in `units`.
    units
        "cm", "mm", "m", or "none" for relative lengths; needed for files without a unit and for points.
    up
        The upward direction where it is known, as for :func:`phytofit.fit`; else it is told by the plant: the stem's
        base is the end that is round, and from which the leaves part forwards and droop.
    n_nodes
        Places that the cloud is thinned to; labels are carried back to all points.
    labelled
        Take stem (1) and leaves (2..) from the cloud's labels, for example after correcting them; only ranks, collars,
        azimuths and lengths are then worked out.  Points labelled 0 stay unknown; ranks follow the collars.

    Raises
    ------
    CloudError
        If there are fewer than 100 points; or with `labelled`, no labels of a stem and a leaf.
    NoStemError
        If no two leaves part from anything that could be a stem.
    SettingError
        If `up` or `n_nodes` can't be used.
    """
    direction = parse_up(up)
    cloud = as_cloud(cloud, units, plausible_cm=PLANT_CM)
    if n_nodes < LEAST_SETTING:
        raise SettingError(f"segment: expected n_nodes >= {LEAST_SETTING}, got {n_nodes}")
    if len(cloud) < MIN_POINTS:
        raise CloudError(f"{cloud.name}: found {len(cloud)} points, at least {MIN_POINTS} are needed to see a plant")
    order = canonical_order(cloud.points, cloud.labels)
    found = _segmented(cloud.take(order), direction, n_nodes, labelled=labelled)
    labels = np.empty_like(found.labels)
    labels[order] = found.labels
    return replace(found, cloud=cloud, labels=labels)


def _segmented(cloud: PointCloud, direction: FloatArray | None, n_nodes: int, *, labelled: bool) -> Segmentation:
    """What :func:`segment` returns, of a cloud whose points are in canonical order."""
    stated = direction
    first, stands_for = coarse(cloud.points)
    points = cloud.points[first]
    notes: list[str] = []
    if labelled:
        graph, distance, organs, direction = labelled_organs(cloud, first, direction, n_nodes)
        by_node = organs.labels
    else:
        ground, direction = find_ground(points, direction)
        if ground.any():
            share = 100.0 * np.bincount(stands_for[ground[stands_for]]).sum() / len(cloud)
            notes.append(f"{share:.0f} % of the points are ground or pot")
        above = np.flatnonzero(~ground)
        try:
            graph, distance, organs = _found(points[above], direction, n_nodes)
        except NoStemError as error:
            raise NoStemError(f"{cloud.name}: {error}") from None
        if graph.n_bridges:
            notes.append(f"{graph.n_bridges} gaps were bridged: the plant is in pieces")
        by_node = organs.labels
    upward = _upward(organs.path, direction)
    leaves, numbers = derive_leaves(graph, distance, organs, upward)
    ranked = np.zeros(len(organs.tips) + 2, np.int64)
    ranked[1] = 1
    ranked[numbers] = np.arange(2, len(numbers) + 2)
    if labelled:
        assert cloud.labels is not None
        given = leaf_names(cloud)
        strays = np.count_nonzero((cloud.labels > 1) & ~np.isin(cloud.labels, given))
        if strays:
            notes.append(f"{strays} points left out: too few share their label")
        table = dict(zip(given.tolist(), ranked[2:].tolist(), strict=True)) | {1: 1}
        labels = np.array([table.get(v, 0) for v in np.unique(cloud.labels).tolist()], np.int64)[
            np.unique(cloud.labels, return_inverse=True)[1]
        ]
    else:
        of_node = ranked[by_node]
        gap, nearest = cKDTree(graph.points).query(points, distance_upper_bound=FAR * graph.spacing)
        of_first = np.where(np.isfinite(gap), of_node[np.minimum(nearest, len(of_node) - 1)], 0)
        of_first[ground] = 0
        labels = of_first[stands_for]
    count = np.bincount(labels, minlength=len(leaves) + 2)
    leaves = [replace(leaf, n_points=int(count[leaf.rank + 1])) for leaf in leaves]
    n_unknown = int(count[0])
    if n_unknown:
        notes.append(f"{n_unknown} of {len(cloud)} points belong to no organ")
    settings = {"up": None if stated is None else stated.tolist(), "n_nodes": n_nodes, "labelled": labelled}
    return Segmentation(cloud, labels, organs.path, organs.radius, upward, tuple(leaves), tuple(notes), settings)


def _beside(out: FloatArray, leaf: SegmentedLeaf, path: FloatArray) -> NDArray[np.bool_]:
    """Which of the ways out (n, 3) from the stem's axis to points lead to the side of the leaf."""
    inner = leaf.midrib[: max(3, len(leaf.midrib) // 2)]
    side = (inner - along_path(inner, path)[2]).mean(axis=0)
    stem = path[-1] - path[0]
    stem = stem / max(float(np.linalg.norm(stem)), 1e-12)
    side = side - (side @ stem) * stem  # the innermost leaves go on above the stem's end
    beside: NDArray[np.bool_] = out @ side > BESIDE * np.linalg.norm(out, axis=1) * np.linalg.norm(side)
    return beside


def _found(points: FloatArray, up: FloatArray | None, n_nodes: int) -> tuple[PlantGraph, FloatArray, Organs]:
    """Graph, distances from the base and organs of a plant's points."""
    rough = plant_graph(points, min(N_ROOT_NODES, n_nodes))
    root = find_root(rough, up)
    if root is not None:
        graph = plant_graph(points, n_nodes)
        distance, _ = geodesics(graph, int(cKDTree(graph.points).query(rough.points[root])[1]))
        organs = find_organs(graph, distance, *grow(graph, distance))
        if organs is not None and len(organs.path) > 1:
            return graph, distance, organs
    raise NoStemError(
        "no stem was found: expected at least two ends, leaves or a leaf and the stem's top, that part from a stem; "
        "is it a whole plant, and not cut off above the stem?"
    )


def _upward(path: FloatArray, up: FloatArray | None) -> FloatArray:
    """The stated direction; else the axis of the frame that the stem hardly leans from; else the stem's own."""
    if up is not None:
        return up
    rise = path[-1] - path[0]
    rise = rise / max(float(np.linalg.norm(rise)), 1e-12)
    axis = np.zeros(3)
    axis[int(np.argmax(np.abs(rise)))] = np.sign(rise[int(np.argmax(np.abs(rise)))])
    return axis if rise @ axis > np.cos(np.deg2rad(30.0)) else rise
