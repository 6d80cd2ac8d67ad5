"""Distances from a generated cloud to the reference: the paper's Hausdorff distance and what may take its place.

A new distance is a function of a :class:`Reference` that returns the function to be called for every candidate; add it
to `DISTANCES` under its name, and ``fit(..., distance=name)`` knows it (the command too, if it is added here).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import CloudError
from phytofit.kernels.distance import hausdorff_within
from phytofit.kernels.nearest import Bins, NearestGrid, bin_points, make_bins, nearest_distances, nearest_grid

__all__ = [
    "DISTANCES",
    "Distance",
    "Reference",
    "chamfer",
    "hausdorff",
    "labelled_hausdorff",
    "quantile_hausdorff",
]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
OrganArray = NDArray[np.int8]

Distance = Callable[[Float32Array, OrganArray, float], float]
"""``distance(points (3, n), organ (n,), limit)``, cm: exact where it is at most `limit`, else anything above it."""


@dataclass(frozen=True)
class Reference:
    """The cloud P_ref in the start pose, with its search structures, built once a fit.

    ``points`` (m, 3) cm; ``organ`` (m,) number of the organ each point lies on, -1 unknown, or None.
    """

    points: FloatArray
    grid: NearestGrid
    bins: Bins
    organ: OrganArray | None = None

    @classmethod
    def of(cls, points: FloatArray, organ: OrganArray | None = None) -> "Reference":
        """From points (m, 3), m >= 1."""
        return cls(points, nearest_grid(points), make_bins(points), organ)

    @property
    def columns(self) -> Float32Array:
        """The points as (3, m) float32."""
        return np.ascontiguousarray(self.points.T, np.float32)


def hausdorff(reference: Reference) -> Distance:
    """The paper's: the largest distance from any point of either cloud to the other cloud, Eq. (3) and (4)."""
    grid, bins = reference.grid, reference.bins

    def distance(points: Float32Array, organ: OrganArray, limit: float) -> float:
        return float(hausdorff_within(points, grid, bins, limit))

    return distance


def quantile_hausdorff(reference: Reference, quantile: float = 0.95) -> Distance:
    """Hausdorff distance with a quantile in place of each maximum, so that a few stray points do not decide it.

    Source: Huttenlocher, Klanderman and Rucklidge, IEEE TPAMI 15 (1993).
    """

    def distance(points: Float32Array, organ: OrganArray, limit: float) -> float:
        forward, backward = _both_ways(points, reference)
        return float(max(np.quantile(forward, quantile), np.quantile(backward, quantile)))

    return distance


def chamfer(reference: Reference) -> Distance:
    """Mean of the two mean distances from each cloud's points to the other cloud."""

    def distance(points: Float32Array, organ: OrganArray, limit: float) -> float:
        forward, backward = _both_ways(points, reference)
        return float(0.5 * (forward.mean() + backward.mean()))

    return distance


def labelled_hausdorff(reference: Reference, mismatch_cm: float = 2.0) -> Distance:
    """Hausdorff distance in which a point counts as `mismatch_cm` further from points of another organ (section VI).

    Points of unknown organ match any.  Raises CloudError where the reference has no labels.
    """
    if reference.organ is None or not np.any(reference.organ >= 0):
        raise CloudError(
            "distance labels: the cloud has no labels; expected a property that tells stem (1) from leaf (2..), "
            "or another distance"
        )
    labels = reference.organ
    all_of = reference.columns
    bins_of = {}
    for organ in np.unique(labels[labels >= 0]):
        bins_of[int(organ)] = make_bins(reference.points[(labels == organ) | (labels < 0)])

    def distance(points: Float32Array, organ: OrganArray, limit: float) -> float:
        # min over q of d(p, q) + cost [labels differ] = min(nearest of the same label, nearest of any + cost)
        forward, backward = _both_ways(points, reference)
        forward, backward = forward + mismatch_cm, backward + mismatch_cm
        backward[labels < 0] -= mismatch_cm
        for number in np.unique(organ):
            mine = organ == number
            if int(number) in bins_of:
                columns = np.ascontiguousarray(points[:, mine])
                forward[mine] = np.minimum(forward[mine], nearest_distances(bins_of[int(number)], *columns)[0])
            same = labels == number
            if same.any():
                own = make_bins(points[:, mine].T)
                columns = np.ascontiguousarray(all_of[:, same])
                backward[same] = np.minimum(backward[same], nearest_distances(own, *columns)[0])
        return float(max(forward.max(), backward.max()))

    return distance


DISTANCES: dict[str, Callable[[Reference], Distance]] = {
    "hausdorff": hausdorff,
    "quantile": quantile_hausdorff,
    "chamfer": chamfer,
    "labels": labelled_hausdorff,
}


def _both_ways(points: Float32Array, reference: Reference) -> tuple[FloatArray, FloatArray]:
    """Distance of every generated point to the reference (n,), and of every reference point to them (m,)."""
    forward, _ = nearest_distances(reference.bins, points[0], points[1], points[2])
    own = Bins(*bin_points(points[0], points[1], points[2], reference.bins.edge))
    backward, _ = nearest_distances(own, *reference.columns)
    return forward, backward
