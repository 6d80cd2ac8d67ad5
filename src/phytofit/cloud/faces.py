"""Points drawn from the faces of a mesh."""

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phytofit.cloud.table import XYZ, Columns, FileError

__all__ = ["sampled"]


def sampled(columns: Columns, polygons: Collection[NDArray[Any]], n_points: int) -> Columns:
    groups: dict[int, list[NDArray[Any]]] = {}
    for polygon in polygons:
        groups.setdefault(len(polygon), []).append(polygon)
    fans = [np.empty((0, 3), dtype=np.int64)]
    for n_corners, group in groups.items():
        fans += [np.array(group)[:, [0, i, i + 1]].astype(np.int64) for i in range(1, n_corners - 1)]
    triangles = np.concatenate(fans)
    corners = np.stack([columns[name] for name in XYZ], axis=1).astype(np.float64)[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    areas[~np.isfinite(areas)] = 0
    if not 0 < areas.sum() < np.inf:
        raise FileError("no faces with an area to sample; leave sample_faces out to read its vertices")
    random = np.random.default_rng(0)
    chosen = random.choice(len(triangles), n_points, p=areas / areas.sum())
    root, part = np.sqrt(random.random(n_points)), random.random(n_points)
    weights = np.stack([1 - root, root * (1 - part), root * part], axis=1)
    nearest = triangles[chosen, weights.argmax(axis=1)]
    x, y, z = np.einsum("nk,nkd->dn", weights, corners[chosen])
    return {name: column[nearest] for name, column in columns.items()} | {"x": x, "y": y, "z": z}
