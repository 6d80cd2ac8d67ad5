"""One order of a cloud's points, whatever the order in which they were stored, and however the cloud lies."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["canonical_order"]

FloatArray = NDArray[np.float64]
DECIMALS = 9  # of the cloud's own size; hides what the rounding of a rotated copy's coordinates leaves


def canonical_order(points: FloatArray, labels: NDArray[np.int64] | None = None) -> NDArray[np.intp]:
    """Indices (n,) that put points (n, 3), in any unit, in an order that depends on nothing but where they are.

    Points that are given in another order come out the same, to the last bit; those of a rotated or shifted copy too,
    up to its rounding, unless the cloud looks the same after a turn.  It is the order of their coordinates along the
    cloud's principal axes, shuffled: the first of so many, and every so-many-th, are then a fair sample of all.
    Copies of a point come in the order of their labels (n,).
    """
    marks = np.zeros(len(points), np.int64) if labels is None else labels
    stored = np.lexsort((marks, *points.T))  # sums are taken in this order
    centered = points[stored] - points[stored].mean(axis=0)
    moments = np.einsum("ni,nj->ij", centered, centered)  # BLAS may sum in another order with more threads
    axes = np.linalg.eigh(moments)[1][:, ::-1]
    for k in (0, 1):  # the sign of an eigenvector is arbitrary: the longer tail decides
        axes[:, k] *= 1.0 if np.sum(np.einsum("ni,i->n", centered, axes[:, k]) ** 3) >= 0.0 else -1.0
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    size = np.sqrt(np.trace(moments) / max(len(points), 1)) or 1.0
    place = np.round(np.einsum("ni,ik->kn", centered / size, axes), DECIMALS)
    order: NDArray[np.intp] = stored[np.lexsort((marks[stored], *place[::-1]))]
    return order[np.random.default_rng(len(order)).permutation(len(order))]
