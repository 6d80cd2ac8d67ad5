"""What of a leaf a cloud lacks, as a part of space: points that came to lie there were not seen."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from phytofit.engine.voids import PARTS, Void
from phytofit.models import Organ
from phytofit.models.surface import Patches, on_strip

__all__ = ["CELLS", "N_STRIPS", "Hidden"]

FloatArray = NDArray[np.float64]
N_STRIPS = 9  # of a leaf, along it
CELLS = Patches.of_strip(1, N_STRIPS)  # of each piece of a leaf
IN_VOID = 0.1  # share not seen, from which a cell lies in a void


@dataclass(frozen=True)
class Hidden:
    """Share of the points that was not seen, around a leaf as it lay when that was found out.

    The leaf's m pieces have nine strips each, from the right edge to the left.  ``share`` (m, 9) are the coefficients
    of a cubic B-spline over these cells: without kinks, as a likelihood should be.  Farther than a cell
    beyond them it stays as it is there.  ``void``, if there is one, lies around the leaf's base:
    of the stem nothing was seen there either.
    """

    leaf: Organ
    share: FloatArray
    void: Void | None = None

    @cached_property
    def pieces(self) -> NDArray[np.bool_]:
        """Which pieces (m,) of the leaf were not seen whole."""
        lacking: NDArray[np.bool_] = np.any(self.share > 0.0, axis=1)
        if self.void is not None:
            lacking = lacking | np.any(self.void.at(self._centers) > IN_VOID, axis=1)
        return lacking

    @cached_property
    def _middle(self) -> FloatArray:
        middle: FloatArray = 0.5 * (self.leaf.half_width[1:] + self.leaf.half_width[:-1])
        return middle

    @cached_property
    def _centers(self) -> FloatArray:
        """(m, 9, 3) of the cells."""
        return CELLS.places(self.leaf, self.leaf.segment_lengths, self.leaf.half_width)

    @cached_property
    def _lateral(self) -> FloatArray:
        """(m, 9, 3) directions across the blade in the cells."""
        return CELLS.frames(self.leaf)[..., 1]

    @cached_property
    def _long(self) -> FloatArray:
        long: FloatArray = np.maximum(self.leaf.segment_lengths, 1e-9)
        return long

    @cached_property
    def _wide(self) -> FloatArray:
        wide: FloatArray = np.maximum(2.0 * self._middle / N_STRIPS, 1e-9)
        return wide

    def around_cells(self, places: FloatArray) -> FloatArray:
        """Share (n, m, 9) not seen of points at places (n, m, 9, 3), each near the centre of its cell."""
        offset = places - self._centers
        tangent = self.leaf.frame[:, :, 0]
        along = np.einsum("nmbi,mi->nmb", offset, tangent) / self._long[:, np.newaxis]
        across = np.einsum("nmbi,mbi->nmb", offset, self._lateral) / self._wide[:, np.newaxis]
        share = self._at(along + np.arange(len(self.share))[:, np.newaxis], across + np.arange(N_STRIPS))
        if self.void is None:
            return share
        step = (self._long[:, np.newaxis] * tangent)[:, np.newaxis]
        parts = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        void = np.mean([self.void.at(places + part * step) for part in parts], axis=0)
        both: FloatArray = 1.0 - (1.0 - share) * (1.0 - void)
        return both

    def at(self, points: FloatArray) -> FloatArray:
        """Share (n,) not seen of the leaf's points where these (n, 3) lie; a void takes all points alike, those of no
        organ as well, and has no part in it."""
        by = on_strip(self.leaf, points)
        piece = by.segment
        return self._at(
            piece + by.along / self._long[piece] - 0.5, by.across / self._wide[piece] + 0.5 * (N_STRIPS - 1)
        )

    def around(self, places: FloatArray) -> FloatArray:
        """Share (n,) not seen of the leaf's points from places (n, 3) on it, by holes and void."""
        seen = 1.0 - self.at(places)
        return 1.0 - (seen if self.void is None else seen * (1.0 - self.void.at(places)))

    def without_holes(self) -> "Hidden":
        """With the void alone."""
        return replace(self, share=np.zeros_like(self.share))

    def smaller(self) -> "Hidden":
        """With holes that end a cell earlier, and a smaller void."""
        return Hidden(self.leaf, minimum_filter(self.share, 3, mode="nearest"), self.void and self.void.smaller())

    def larger(self) -> "Hidden":
        """With holes that end a cell later, and a larger void."""
        return Hidden(self.leaf, maximum_filter(self.share, 3, mode="nearest"), self.void and self.void.larger())

    def _at(self, along: FloatArray, across: FloatArray) -> FloatArray:
        at = np.stack([along, across])
        found: FloatArray = map_coordinates(self.share, at, order=3, prefilter=False, mode="nearest")
        return found
