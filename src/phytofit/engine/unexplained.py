"""Whether the points that no organ explains are outliers, or lie on something else."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import gamma

__all__ = ["on_something_else"]

FloatArray = NDArray[np.float64]
N_NEAR = 8  # neighbours by which it is seen how crowded a place is; fewer tell little, more look farther
BY_CHANCE = 0.01  # of outliers that are spread evenly, the share that counts as crowded


def on_something_else(points: FloatArray, density: float) -> NDArray[np.bool_]:
    """Which of the points (n, 3) that no organ explains are too crowded for outliers, which lie anywhere.

    Were they spread evenly, with so many a volume as they are in all, the number expected within the distance of a
    point's eighth neighbour would follow a gamma distribution.  It is far less where points lie on a surface.

    density : of a single outlier, 1 / volume of the cloud
    """
    if len(points) <= N_NEAR:
        return np.zeros(len(points), bool)
    reach = cKDTree(points).query(points, k=N_NEAR + 1)[0][:, -1]
    expected = len(points) * density * 4.0 / 3.0 * np.pi * reach**3
    crowded: NDArray[np.bool_] = expected < gamma.ppf(BY_CHANCE, N_NEAR)
    return crowded
