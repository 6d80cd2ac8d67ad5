"""Holes in a leaf's cloud: where it clearly has fewer points than elsewhere."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, convolve1d

from phytofit.engine.layout import State
from phytofit.engine.mixture import Evaluation
from phytofit.engine.posterior import Posterior
from phytofit.engine.sighting import clearly_lacking, strip_of
from phytofit.engine.visibility import N_STRIPS, Hidden
from phytofit.engine.voids import find_void
from phytofit.models import Organ, move

__all__ = ["find_holes"]

FloatArray = NDArray[np.float64]
TYPICAL = 0.75  # quantile of the densities of the leaf's pieces that counts as that where all was seen
HOLE, RIM = 0.7, 0.85  # of that: below the one a piece is a hole, below the other a cell is the rim of one
LITTLE = 0.4  # what is left of a piece with less says nothing of its width
MOST_HIDDEN = 0.98
SMOOTHING = (0.25, 0.5, 0.25)  # of the numbers of points of neighbouring cells, both ways
OFF_STEM = 3.0  # noise levels from the stem, within which a leaf has no holes
CLEARLY, FEW_ON_PIECE = 4.0, 3.0  # standard deviations of the number of points; points
EDGE_ON = 1.5  # leaf noises in a leaf's half width, below which its strips are not told apart


def find_holes(posterior: Posterior, state: State, at: Evaluation, *, with_void: bool = False) -> Hidden | None:
    """Where points of the leaf were not seen, None where all were; `at` is the state evaluated.
    The void around its base is the one that the posterior knows; `with_void`, one that is found anew, if there is."""
    on_stem, on_leaf, _ = at.responsibilities.T
    stem, leaf = move([organ.row(0) for organ in posterior.model.organs(state.x)], posterior.pose_of(state))
    void = posterior.void
    if with_void:
        void = find_void(posterior.points, on_stem > 0.5, stem, leaf, noise_cm=float(state.noise[0])) or void
    share = _lacking_share(posterior.points[on_leaf > 0.5], stem, leaf, state.noise)
    return Hidden(leaf, share, void) if void is not None or share.any() else None


def _lacking_share(points: FloatArray, stem: Organ, leaf: Organ, noise: FloatArray) -> FloatArray:
    """Share (m, 9) of the leaf's points (n, 3) that its cells lack, 0 where there is no hole.

    A hole has leaf on both sides: what is missing at the tip is another matter, and near the stem it can't be told
    whose the points are.  It may leave a part of the leaf's breadth; a strip that lacks points all along is no hole,
    but a width that is not right yet.
    """
    half = 0.5 * (leaf.half_width[1:] + leaf.half_width[:-1])
    area = 2.0 * leaf.segment_lengths * half
    m = len(area)
    number = np.bincount(leaf.nearest(points)[0] * N_STRIPS + strip_of(leaf, points, N_STRIPS), minlength=m * N_STRIPS)
    cells = _smoothed(number.reshape(m, N_STRIPS).astype(float), 0)
    wanted = np.repeat(_smoothed(area * len(points) / area.sum(), 0)[:, np.newaxis] / N_STRIPS, N_STRIPS, axis=1)
    blurred = half <= EDGE_ON * noise[1]
    density = cells.sum(axis=1) / np.maximum(wanted.sum(axis=1), 1e-9)
    typical = float(np.quantile(density, TYPICAL))
    if typical == 0.0:  # hardly a point is the leaf's
        return np.zeros((m, N_STRIPS))
    wanted *= typical
    found, expected = cells.sum(axis=1), wanted.sum(axis=1)
    ratio = found / np.maximum(expected, 1e-9)
    seen = np.flatnonzero((ratio >= 0.5) & (found >= FEW_ON_PIECE))
    across = (0.5 * (leaf.axis[1:] + leaf.axis[:-1]) - stem.axis[0]) @ stem.frame[0, :, 1:]
    apart = np.linalg.norm(across, axis=1) > stem.half_width.max() + OFF_STEM * max(noise[:2])
    looked_at = apart & (np.arange(m) < (seen[-1] if len(seen) else 0))
    hole = looked_at & (ratio < HOLE) & (expected - found > CLEARLY * np.sqrt(expected))
    wide = looked_at & ~blurred
    thirds, wanted_of_third = (numbers.reshape(m, 3, -1).sum(axis=2) for numbers in (cells, wanted))
    lacking = np.zeros(thirds.shape, bool)
    if wide.any():
        lacking[wide] = clearly_lacking(thirds[wide], wanted_of_third[wide])
    lacking &= lacking.mean(axis=0) < 0.5
    lacking |= hole[:, np.newaxis] & (thirds < HOLE * wanted_of_third)
    if not lacking.any():
        return np.zeros((m, N_STRIPS))
    lacking = np.repeat(lacking, N_STRIPS // 3, axis=1)
    missing = 1.0 - _smoothed(cells, 1) / np.maximum(wanted, 1e-9)
    rim = binary_dilation(lacking, np.ones((3, 3))) & looked_at[:, np.newaxis] & (missing > 1.0 - RIM)
    share = np.where(lacking | rim, missing, 0.0)
    little = hole & (ratio < LITTLE)
    share[little] = np.maximum(share[little], 1.0 - ratio[little, np.newaxis])
    share[blurred] = np.where(hole, 1.0 - ratio, 0.0)[blurred, np.newaxis]
    clipped: FloatArray = np.clip(share, 0.0, MOST_HIDDEN)
    return clipped


def _smoothed(numbers: FloatArray, axis: int) -> FloatArray:
    """Averaged with their neighbours; at the ends with themselves."""
    smooth: FloatArray = convolve1d(numbers, SMOOTHING, axis=axis, mode="nearest")
    return smooth
