"""Phytomers that share no code, and no shape, with the models that are fitted: for `foreign.py`.

A stem that is elliptical, bent and tapers, with a node; a sheath around it up to the collar; a blade along a spline
with torsion, V-folded, with waves along its edges, whose base clasps the stem.  Truth is taken from the surface by the
definitions of the traits, not from any parameter: lengths and areas are sums over a fine mesh.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

__all__ = ["Surface", "Truth", "phytomer"]

FloatArray = NDArray[np.float64]
N_ALONG, N_ACROSS = 1200, 81  # nodes of the blade's mesh
N_UP, N_AROUND = 240, 96  # of the stem's
CHORD_CM = 8.0  # of leaf_angle; shorter leaves: a fifth of their length
STEM, BLADE = 1, 2


@dataclass(frozen=True)
class Surface:
    """A mesh: points (n, 3) cm, outward or adaxial unit normals (n, 3), what area each stands for (n,) cm², half the
    thickness there (n,) cm, 0 for a closed body, and which organ it belongs to (n,)."""

    points: FloatArray
    normals: FloatArray
    areas: FloatArray
    half_thickness: FloatArray
    organ: NDArray[np.intp]


Truth = dict[str, float]  # by the names of the traits; cm, degrees, cm²


def phytomer(rng: np.random.Generator) -> tuple[Surface, Truth]:
    """A phytomer drawn at random, z up, its foot near the origin, and its true traits."""
    stem = _Stem.drawn(rng)
    stem_points, stem_normals, stem_areas = stem.mesh()
    up, collar, outward = stem.frame_at(stem.collar_z)
    blade = _Blade.drawn(rng, stem)
    midrib, tangent, lateral, adaxial, s = blade.midrib(collar, up, outward)
    points, normals, areas, widths = blade.mesh(midrib, tangent, lateral, adaxial, s)
    chord = min(CHORD_CM, blade.length / 5.0)
    end = np.array([np.interp(chord, s, midrib[:, axis]) for axis in range(3)])
    truth = {
        "leaf_length": float(np.linalg.norm(np.diff(midrib, axis=0), axis=1).sum()),
        "leaf_angle": _degrees(end - midrib[0], up),
        "leaf_insertion_angle": _degrees(tangent[0], up),
        "leaf_width": float(widths.max()),
        "leaf_area": float(areas.sum()),
        "leaf_curvature": _turning(tangent) / blade.length,
        "stem_diameter": stem.mean_diameter_below(),
    }
    n_stem, n_blade = len(stem_points), len(points)
    surface = Surface(
        np.vstack([stem_points, points]),
        np.vstack([stem_normals, normals]),
        np.concatenate([stem_areas, areas]),
        np.concatenate([np.zeros(n_stem), np.full(n_blade, 0.5 * blade.thickness)]),
        np.repeat([STEM, BLADE], [n_stem, n_blade]),
    )
    return surface, truth


@dataclass(frozen=True)
class _Stem:
    """An elliptical, bent, tapering stem with a sheath up to the collar and a node below or within it; cm."""

    diameter: float  # outer, mean of both axes, at the collar without the sheath
    ratio: float  # of the longer axis to the shorter
    turned: float  # rad, of the longer axis from the leaf's side
    below: float
    above: float
    bend: float  # cm^-1, curvature of the axis
    bend_towards: float  # rad
    taper: float  # cm of diameter lost with each cm
    sheath: float  # thickness
    node_z: float
    node_swelling: float  # share of the diameter
    collar_z: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "_Stem":
        below, above = rng.uniform(5.0, 18.0), rng.uniform(3.0, 15.0)
        return cls(
            diameter=rng.uniform(0.8, 2.6),
            ratio=rng.uniform(1.0, 1.3),
            turned=rng.uniform(0.0, np.pi),
            below=below,
            above=above,
            bend=rng.uniform(0.0, 0.006),
            bend_towards=rng.uniform(0.0, 2.0 * np.pi),
            taper=rng.uniform(0.0, 0.02),
            sheath=rng.uniform(0.03, 0.15),
            node_z=rng.uniform(0.0, 0.5) * below,
            node_swelling=rng.uniform(0.0, 0.15),
            collar_z=below,
        )

    def axis(self, z: FloatArray) -> FloatArray:
        aside = 0.5 * self.bend * (z - self.below) ** 2
        return np.stack([aside * np.cos(self.bend_towards), aside * np.sin(self.bend_towards), z], axis=-1)

    def mean_diameter(self, z: FloatArray) -> FloatArray:
        """Of both axes of the section, sheath included where there is one, (n,) cm."""
        swelling = 1.0 + self.node_swelling * np.exp(-(((z - self.node_z) / 0.5) ** 2))
        sheath = 2.0 * self.sheath / (1.0 + np.exp((z - self.collar_z) / 0.1))  # ends over some millimetres
        return (self.diameter - self.taper * (z - self.collar_z)) * swelling + sheath

    def mean_diameter_below(self) -> float:
        return float(self.mean_diameter(np.linspace(0.0, self.collar_z, 2000)).mean())

    def radius(self, z: FloatArray, angle: FloatArray) -> FloatArray:
        """From the axis to the surface, in the direction of the angle (rad) from the leaf's side."""
        longer = self.mean_diameter(z) * self.ratio / (1.0 + self.ratio)
        shorter = longer / self.ratio
        a = angle - self.turned
        return longer * shorter / np.hypot(shorter * np.cos(a), longer * np.sin(a))

    def frame_at(self, z: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The axis' direction, the point of the surface on the leaf's side, and the horizontal direction to it."""
        step = self.axis(np.array([z - 0.01, z + 0.01]))
        up = _unit(step[1] - step[0])
        outward = _unit(np.array([1.0, 0.0, 0.0]) - up[0] * up)
        return up, self.axis(np.array([z]))[0] + self.radius(np.array([z]), np.zeros(1))[0] * outward, outward

    def mesh(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        z, angle = np.linspace(0.0, self.below + self.above, N_UP), np.linspace(0.0, 2.0 * np.pi, N_AROUND + 1)
        zz, aa = np.meshgrid(z, angle, indexing="ij")
        r = self.radius(zz, aa)
        grid = self.axis(zz)
        grid[..., 0] += r * np.cos(aa)
        grid[..., 1] += r * np.sin(aa)
        return _cells(grid)


@dataclass(frozen=True)
class _Blade:
    """A blade: coordinates s along the midrib and v across, both cm along the surface."""

    length: float
    width: float
    pitch: FloatArray  # rad from the stem's axis, at even shares of the midrib
    yaw: FloatArray  # rad to the side
    torsion: FloatArray  # rad about the midrib
    widths: FloatArray  # share of the widest, at `WIDTH_AT`
    widest_at: float
    fold: FloatArray  # rad by which either half rises, at base, middle, tip
    fold_round_cm: float  # over which the fold is rounded
    clasp: float  # cm^-1, curvature of the base's section: 1 / radius of the stem, or flatter
    clasp_cm: float  # over which the section opens
    wave_cm: float  # amplitude at the edges
    wave_length: float
    wave_phase: FloatArray  # (2,) rad, of either edge
    thickness: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, stem: _Stem) -> "_Blade":
        length = rng.uniform(22.0, 90.0)
        insertion = np.deg2rad(rng.uniform(10.0, 65.0))
        turning = np.deg2rad(rng.uniform(10.0, 130.0))
        shares = np.array([0.0, 0.2, 0.45, 0.7, 1.0])
        steepness = rng.uniform(0.7, 2.2)  # more than 1: the bend lies towards the tip
        pitch = insertion + turning * shares**steepness + np.deg2rad(rng.normal(0.0, 4.0, 5)) * (shares > 0.0)
        fold = np.deg2rad(rng.uniform(0.0, 35.0)) * np.array([1.0, rng.uniform(0.3, 1.0), rng.uniform(0.0, 0.6)])
        radius = 0.5 * float(stem.mean_diameter(np.array([stem.collar_z]))[0])
        return cls(
            length=length,
            width=float(np.clip(length * rng.uniform(0.07, 0.15), 2.5, 11.0)),
            pitch=pitch,
            yaw=np.deg2rad(np.cumsum(np.append(0.0, rng.normal(0.0, 6.0, 4)))),
            torsion=np.deg2rad(np.cumsum(np.append(0.0, rng.normal(0.0, 12.0, 4)))),
            widths=np.array([rng.uniform(0.45, 0.95), 1.0, rng.uniform(0.5, 0.75), 0.0]),
            widest_at=rng.uniform(0.25, 0.55),
            fold=fold,
            fold_round_cm=rng.uniform(0.1, 0.6),
            clasp=rng.uniform(0.3, 1.0) / radius,
            clasp_cm=rng.uniform(0.5, 3.0),
            wave_cm=rng.uniform(0.0, 0.5) * (rng.random() < 0.6),
            wave_length=rng.uniform(4.0, 12.0),
            wave_phase=rng.uniform(0.0, 2.0 * np.pi, 2),
            thickness=rng.uniform(0.02, 0.06),
        )

    def midrib(
        self, collar: FloatArray, up: FloatArray, outward: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Points, tangents, laterals and adaxial normals (n, 3) at s (n,) cm from the collar."""
        share = np.linspace(0.0, 1.0, len(self.pitch))
        s = np.linspace(0.0, self.length, N_ALONG)
        at = s / self.length
        pitch, yaw, torsion = (CubicSpline(share, it)(at) for it in (self.pitch, self.yaw, self.torsion))
        aside = np.cross(up, outward)
        level = np.cos(yaw)[:, np.newaxis] * outward + np.sin(yaw)[:, np.newaxis] * aside
        tangent = np.cos(pitch)[:, np.newaxis] * up + np.sin(pitch)[:, np.newaxis] * level
        mean = 0.5 * (tangent[1:] + tangent[:-1])
        mean *= (self.length / (N_ALONG - 1)) / np.linalg.norm(mean, axis=1, keepdims=True)
        midrib = collar + np.vstack([np.zeros(3), np.cumsum(mean, axis=0)])
        flat = np.cos(yaw)[:, np.newaxis] * aside - np.sin(yaw)[:, np.newaxis] * outward
        normal = np.cross(tangent, flat)  # towards the stem: adaxial
        lateral = np.cos(torsion)[:, np.newaxis] * flat + np.sin(torsion)[:, np.newaxis] * normal
        return midrib, tangent, lateral, np.cross(tangent, lateral), s

    def mesh(
        self, midrib: FloatArray, tangent: FloatArray, lateral: FloatArray, adaxial: FloatArray, s: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Cells of the blade: centres, normals, areas; and the width along the surface at each s."""
        at = s / self.length
        profile = PchipInterpolator([0.0, self.widest_at, 0.5 * (1.0 + self.widest_at), 1.0], self.widths)
        half = 0.5 * self.width * profile(at)
        u = np.linspace(-1.0, 1.0, N_ACROSS)
        v = half[:, np.newaxis] * u
        fold = np.interp(at, [0.0, 0.5, 1.0], self.fold)[:, np.newaxis]
        clasp = self.clasp * np.exp(-s / self.clasp_cm)[:, np.newaxis]
        slope = fold * (1.0 - np.exp(-np.abs(v) / self.fold_round_cm)) + np.clip(clasp * np.abs(v), 0.0, np.pi)
        step = np.abs(np.diff(v, axis=1))
        middle = 0.5 * (slope[:, 1:] + slope[:, :-1])
        sign = np.sign(0.5 * (u[1:] + u[:-1]))
        x = _from_middle(step * np.cos(middle))
        y = _from_middle(sign * step * np.sin(middle))
        starts = 1.0 - np.exp(-s / 3.0)  # waves grow from the base
        swing = np.sin(2.0 * np.pi * s[:, np.newaxis] / self.wave_length + self.wave_phase[(u > 0.0).astype(int)])
        y += self.wave_cm * (half / half.max() * starts)[:, np.newaxis] * u**2 * swing
        grid = (
            midrib[:, np.newaxis]
            + x[..., np.newaxis] * lateral[:, np.newaxis]
            + y[..., np.newaxis] * adaxial[:, np.newaxis]
        )
        widths = np.linalg.norm(np.diff(grid, axis=1), axis=2).sum(1)
        points, normals, areas = _cells(grid)
        towards = np.repeat(adaxial[:-1], N_ACROSS - 1, axis=0)
        normals *= np.where(np.einsum("ij,ij->i", normals, towards) < 0.0, -1.0, 1.0)[:, np.newaxis]
        return points, normals, areas, widths


def _from_middle(steps: FloatArray) -> FloatArray:
    """Running sums (n, m + 1) of steps (n, m), 0 at the middle node."""
    sums = np.hstack([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)])
    return sums - sums[:, [steps.shape[1] // 2]]


def _cells(grid: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres, unit normals and areas of the cells of a grid (n, m, 3)."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    cross = 0.5 * np.cross(c - a, d - b)
    area = np.linalg.norm(cross, axis=-1)
    normal = cross / np.maximum(area, 1e-12)[..., np.newaxis]
    centre = 0.25 * (a + b + c + d)
    return centre.reshape(-1, 3), -normal.reshape(-1, 3), area.ravel()


def _unit(vector: FloatArray) -> FloatArray:
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def _degrees(a: FloatArray, b: FloatArray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(_unit(a) @ _unit(b), -1.0, 1.0))))


def _turning(tangent: FloatArray) -> float:
    cosine = np.einsum("ij,ij->i", tangent[1:], tangent[:-1])
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))).sum())
