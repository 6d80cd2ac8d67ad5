"""Organs: tubes and strips swept along an axis; no species.

A stem is a tube, a leaf a strip.  Arrays may carry leading dimensions: one organ, or that organ for a whole
population of plants at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.stats import qmc

from phytofit.kernels.neighbors import nearest_pieces
from phytofit.kernels.sampling import sample_surfaces

__all__ = ["LEAF", "STEM", "Organ", "SurfaceSampler", "frames_along", "mesh", "move"]

FloatArray = NDArray[np.float64]
STEM = "stem"
LEAF = "leaf"
ROUNDING = 1e-9  # of an organ's length: a part that ends so near a node ends there
COLORS = {STEM: (146, 100, 53, 255), LEAF: (52, 140, 60, 255)}


@dataclass(frozen=True)
class Organ:
    """A stem (a tube around its axis) or a leaf (a strip across its midrib).

    ``kind`` is `STEM` or `LEAF`; ``axis`` (..., m, 3) are the nodes from base to tip, cm; ``frame``
    (..., m - 1, 3, 3) has for each segment the columns tangent, lateral, normal; ``half_width`` (..., m) at the
    nodes, cm: a stem's radius, half a leaf's width.  ``fold`` (...) says by how many degrees each half of a leaf is
    raised along its midrib, to a V; 0 is flat.
    """

    kind: str
    axis: FloatArray
    frame: FloatArray
    half_width: FloatArray
    fold: FloatArray | float = 0.0

    def row(self, i: int) -> "Organ":
        """The organ of plant i of a population."""
        fold = self.fold[i] if isinstance(self.fold, np.ndarray) else self.fold
        return Organ(self.kind, self.axis[i], self.frame[i], self.half_width[i], fold)

    @property
    def as_population(self) -> "Organ":
        """One organ, as that of a population of one plant."""
        arrays = self.axis[np.newaxis], self.frame[np.newaxis], self.half_width[np.newaxis]
        return Organ(self.kind, *arrays, np.array([self.fold]))

    @property
    def segment_lengths(self) -> FloatArray:
        """(..., m - 1), cm."""
        lengths: FloatArray = np.linalg.norm(np.diff(self.axis, axis=-2), axis=-1)
        return lengths

    def nearest(self, points: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """The segment (n,) of one organ's axis that is nearest to each of points (n, 3), and how far (n,) along it."""
        piece, along = np.empty(len(points), np.intp), np.empty(len(points))
        tangent = np.ascontiguousarray(self.frame[:, :, 0])
        nearest_pieces(np.ascontiguousarray(points), self.axis[:-1], tangent, self.segment_lengths, piece, along)
        return piece, along

    def until(self, share: float) -> "Organ":
        """One organ from its base up to a share, more than 0, of its axis; straight on where that is more than 1."""
        before = np.append(0.0, np.cumsum(self.segment_lengths))
        end = share * before[-1]
        m = min(max(1, int(np.searchsorted(before, (1.0 - ROUNDING) * end))), len(self.frame))  # nodes that stay
        tip = self.axis[m - 1] + (end - before[m - 1]) * self.frame[m - 1, :, 0]
        half_width = np.append(self.half_width[:m], np.interp(end, before, self.half_width))
        return Organ(self.kind, np.vstack([self.axis[:m], tip]), self.frame[:m], half_width, self.fold)

    @property
    def area(self) -> FloatArray:
        """Area (...) of the surface, cm²: one side of a leaf, the lateral surface of a stem."""
        width = self.half_width[..., 1:] + self.half_width[..., :-1]
        if self.kind == LEAF:
            return np.asarray(np.sum(width * self.segment_lengths, axis=-1))
        slant = np.hypot(self.segment_lengths, np.diff(self.half_width, axis=-1))
        return np.asarray(np.pi * np.sum(width * slant, axis=-1))


def frames_along(axis: FloatArray, lateral: FloatArray) -> FloatArray:
    """Frames (..., m - 1, 3, 3), columns tangent, lateral, normal, of an axis (..., m, 3).

    lateral : (3,) or (..., m - 1, 3), not parallel to the axis; made orthogonal to the tangents.
    """
    tangent = np.diff(axis, axis=-2)
    length = np.linalg.norm(tangent, axis=-1, keepdims=True)
    tangent = tangent / np.where(length > 0, length, 1.0)
    side = lateral - np.sum(lateral * tangent, axis=-1, keepdims=True) * tangent
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    return np.stack([tangent, side, np.cross(tangent, side)], axis=-1)


def move(organs: Sequence[Organ], pose: FloatArray) -> tuple[Organ, ...]:
    """The organs moved by a rigid pose (4, 4)."""
    r, t = pose[:3, :3], pose[:3, 3]
    return tuple(replace(o, axis=o.axis @ r.T + t, frame=r @ o.frame) for o in organs)


class SurfaceSampler:
    """Draws points uniformly by area from the surfaces of plants, with common random numbers (Fig. 5d).

    The same `seed` gives every plant the same numbers (a scrambled Halton sequence: uniform, and more even than
    independent draws), so equal organs give equal points and a small change of the organs moves each point a little.
    With ``even=False`` the draws are independent, as those of a sensor.
    """

    def __init__(self, n_points: int, seed: int, *, even: bool = True) -> None:
        random = np.random.default_rng(seed)
        halton = qmc.Halton(d=2, scramble=True, rng=random)
        numbers = halton.random(n_points) if even else random.random((n_points, 2))
        numbers = numbers[np.lexsort((numbers[:, 1], numbers[:, 0]))]
        self.n_points = n_points
        self._along = np.ascontiguousarray(numbers[:, 0])
        self._across = 2.0 * numbers[:, 1] - 1.0
        self._cosine = np.cos(2.0 * np.pi * numbers[:, 1])
        self._sine = np.sin(2.0 * np.pi * numbers[:, 1])

    def population(self, organs: Sequence[Organ]) -> "PopulationSurfaces":
        """Prepare a population of plants (organs with one leading dimension n) for sampling one by one."""
        return PopulationSurfaces(self, organs)

    def draw(self, organs: Sequence[Organ]) -> tuple[FloatArray, NDArray[np.int8]]:
        """Points (n_points, 3), cm, on one plant, and the number (n_points,) of the organ that each lies on."""
        batched = [organ.as_population for organ in organs]
        points, label = self.population(batched).draw(0)
        return points.T.astype(float), label


class PopulationSurfaces:
    """The surfaces of a population, laid out for the sampling kernel."""

    def __init__(self, sampler: SurfaceSampler, organs: Sequence[Organ]) -> None:
        self._sampler = sampler
        self._axis = np.concatenate([o.axis for o in organs], axis=1)
        frames = [np.concatenate([o.frame, o.frame[:, -1:]], axis=1) for o in organs]  # one a node, for the kernel
        self._frame = np.ascontiguousarray(np.concatenate(frames, axis=1))
        self._half_width = np.concatenate([o.half_width for o in organs], axis=1)
        self._first = np.cumsum([0, *(o.axis.shape[1] for o in organs)])
        self._tube = np.array([o.kind == STEM for o in organs])
        n = len(self._axis)
        self._fold = np.deg2rad(np.stack([np.broadcast_to(o.fold, n) for o in organs], axis=1))

    def draw(self, i: int) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Points (3, n_points) float32 on plant i, and the number (n_points,) of the organ that each lies on."""
        s = self._sampler
        points = np.empty((3, s.n_points), np.float32)
        label = np.empty(s.n_points, np.int8)
        sample_surfaces(
            self._axis[i], self._frame[i], self._half_width[i], self._first, self._tube, self._fold[i],
            s._along, s._across, s._cosine, s._sine, points, label,
        )  # fmt: skip
        return points, label


def mesh(organs: Sequence[Organ], n_around: int = 24) -> trimesh.Trimesh:
    """Triangle mesh of the organs, cm, coloured by kind; a tube has `n_around` sides and open ends.

    Write it with ``mesh(organs).export("model.ply")``; .obj and .glb work as well.
    """
    parts = []
    for organ in organs:
        m = len(organ.axis)
        frame = np.concatenate([organ.frame, organ.frame[-1:]])
        lateral = frame[:, :, 1]
        if organ.kind == LEAF:
            angle = np.deg2rad(organ.fold)
            side = organ.half_width[:, np.newaxis] * np.cos(angle) * lateral
            up = organ.half_width[:, np.newaxis] * np.sin(angle) * frame[:, :, 2]
            rings = np.stack([organ.axis - side + up, organ.axis, organ.axis + side + up], axis=1)
            closed = False
        else:
            angle = np.linspace(0, 2 * np.pi, n_around, endpoint=False)[:, np.newaxis]
            unit = np.cos(angle) * lateral[:, np.newaxis] + np.sin(angle) * frame[:, np.newaxis, :, 2]
            rings = organ.axis[:, np.newaxis] + organ.half_width[:, np.newaxis, np.newaxis] * unit
            closed = True
        k = rings.shape[1]
        node, around = np.meshgrid(np.arange(m - 1), np.arange(k if closed else k - 1), indexing="ij")
        a, b = node * k + around, node * k + (around + 1) % k
        faces = np.concatenate(
            [np.stack([a, b, b + k], -1).reshape(-1, 3), np.stack([a, b + k, a + k], -1).reshape(-1, 3)]
        )
        colors = np.tile(COLORS[organ.kind], (m * k, 1))
        part = trimesh.Trimesh(rings.reshape(-1, 3), faces, vertex_colors=colors, process=False)
        parts.append(part)
    joined: trimesh.Trimesh = trimesh.util.concatenate(parts)  # type: ignore[assignment]
    return joined
