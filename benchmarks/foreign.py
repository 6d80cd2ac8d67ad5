"""Whether the intervals hold on leaves that no model of the project drew.

    python benchmarks/foreign.py [random] [grid] [--leaves 300] [--from 0] [--each]

random  clouds of which points are left out at random
grid    the same leaves, thinned to one point in each voxel, as many programs do it

The phytomers are those of foreign_leaves.py: spline midribs with torsion, V-folded and wavy blades whose bases clasp an
elliptical, bent, tapering stem with a sheath and a node.  They are seen by 1 to 12 depth cameras through a z-buffer,
with noise that grows with depth and is shared by neighbouring pixels, points that fly off edges, surfaces too steep to
be seen, and views that are registered to a millimetre or so.
"""

import argparse
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from common import progress, run_parts
from foreign_leaves import Surface, Truth, phytomer
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation

import phytofit

FloatArray = NDArray[np.float64]
FIRST_SEED = 40_000
VIEWS = (1, 2, 3, 4, 6, 12)
JUMP_CM = 1.0  # between neighbouring pixels, at which points fly
BACKGROUND_CM = 4.0  # to which a point flies at most where nothing is behind it
TRAITS = {  # and whether the error is counted as a share of the truth, or in degrees
    "leaf_length": True,
    "leaf_angle": False,
    "leaf_insertion_angle": False,
    "leaf_width": True,
    "leaf_area": True,
    "stem_diameter": True,
}


class Camera(NamedTuple):
    """What is common to the views of one cloud; cm unless it says otherwise."""

    distance: float
    pixel: float  # at that distance
    noise: float  # standard deviation at that distance; it grows as the square of depth
    shared: float  # share of the noise's variance that neighbouring pixels share
    shared_px: float  # over so many pixels
    flying: float  # share of the pixels at edges
    steepest: float  # cosine of the incidence beyond which nothing returns
    registration: float  # standard error of a view's place
    registration_deg: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Camera":
        distance = rng.uniform(50.0, 140.0)
        return cls(
            distance=distance,
            pixel=rng.uniform(0.12, 0.25),
            noise=float(np.exp(rng.uniform(np.log(0.03), np.log(0.4)))),
            shared=rng.uniform(0.0, 0.7),
            shared_px=rng.uniform(1.5, 4.0),
            flying=rng.uniform(0.0, 0.4),
            steepest=rng.uniform(0.08, 0.25),
            registration=rng.uniform(0.0, 0.15),
            registration_deg=rng.uniform(0.0, 0.3),
        )


def scanned(surface: Surface, rng: np.random.Generator) -> FloatArray:
    """A cloud (n, 3) cm of the surface, as some depth cameras around it see it."""
    camera = Camera.drawn(rng)
    return seen_by(camera, int(rng.choice(VIEWS)), surface, rng)


def seen_by(camera: Camera, n_views: int, surface: Surface, rng: np.random.Generator) -> FloatArray:
    """The points (n, 3) cm that so many views return, registered as well as the camera says."""
    first = rng.uniform(0.0, 2.0 * np.pi)
    around = first + 2.0 * np.pi * np.arange(n_views) / n_views + rng.normal(0.0, 0.15, n_views)
    middle = np.average(surface.points, axis=0, weights=surface.areas)
    views = []
    for azimuth, elevation in zip(around, np.deg2rad(rng.uniform(-10.0, 55.0, n_views)), strict=True):
        seen = _view(surface, middle, azimuth, elevation, camera, rng)
        turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, camera.registration_deg, 3))).as_matrix()
        views.append((seen - middle) @ turn.T + middle + rng.normal(0.0, camera.registration, 3))
    return np.vstack(views)


def _view(
    surface: Surface, middle: FloatArray, azimuth: float, elevation: float, camera: Camera, rng: np.random.Generator
) -> FloatArray:
    """The points (n, 3) that one camera returns."""
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), -back])  # rows: x right, y up, z forward
    place = middle + camera.distance * back
    ray = surface.points - place
    facing = -np.einsum("ij,ij->i", surface.normals, ray) / np.linalg.norm(ray, axis=1)
    front = (surface.half_thickness > 0.0) | (facing > 0.0)
    toward = np.sign(facing)[:, np.newaxis] * surface.normals  # the face of a blade that the camera sees
    local = (ray + surface.half_thickness[:, np.newaxis] * toward)[front] @ axes.T
    focal = camera.distance / camera.pixel
    uv = np.rint(focal * local[:, :2] / local[:, 2:]).astype(int)
    low = uv.min(0) - 2
    shape = tuple(uv.max(0) - low + 3)
    at = np.ravel_multi_index(tuple((uv - low).T), shape)
    order = np.lexsort((local[:, 2], at))
    first = order[np.unique(at[order], return_index=True)[1]]  # nearest of each pixel
    depth, incidence = np.full(shape, np.inf), np.zeros(shape)
    depth.flat[at[first]] = local[first, 2]
    incidence.flat[at[first]] = np.abs(facing[front][first])
    hit = np.isfinite(depth)
    behind = maximum_filter(depth, 3)
    jump = np.where(np.isfinite(behind), behind, depth + rng.uniform(JUMP_CM, BACKGROUND_CM, shape))
    jump = np.subtract(jump, depth, where=hit, out=np.zeros(shape))
    flies = hit & (jump > JUMP_CM) & (rng.random(shape) < camera.flying)
    smooth = gaussian_filter(rng.normal(size=shape), camera.shared_px)
    smooth /= smooth.std()
    error = np.sqrt(1.0 - camera.shared) * rng.normal(size=shape) + np.sqrt(camera.shared) * smooth
    flown = np.where(flies, rng.random(shape) * jump, 0.0)
    returned = hit & (incidence > camera.steepest)
    where = returned.flat[at[first]]  # the surface's own place within its pixel, so that edges lie where they do
    z = local[first, 2][where]
    noisy = z + camera.noise * (z / camera.distance) ** 2 * error.flat[at[first]][where] + flown.flat[at[first]][where]
    xyz = local[first][where] * (noisy / z)[:, np.newaxis]
    return xyz @ axes + place


def thinned(points: FloatArray, on_grid: bool, rng: np.random.Generator) -> FloatArray:
    """Fewer points: the mean of those in each voxel, or some at random."""
    if not on_grid:
        n = min(len(points), int(rng.integers(2500, 12_000)))
        return points[np.sort(rng.choice(len(points), n, replace=False))]
    voxel = np.floor(points / rng.uniform(0.2, 0.4)).astype(int)
    _, inverse, count = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), 3))
    np.add.at(sums, inverse.ravel(), points)
    return sums / count[:, np.newaxis]


def cloud(number: int, on_grid: bool = False) -> tuple[FloatArray, Truth]:
    """The number-th cloud (n, 3) cm and its truth; leant by some degrees, turned and moved."""
    rng = np.random.default_rng(FIRST_SEED + number)
    surface, truth = phytomer(rng)
    points = thinned(scanned(surface, rng), on_grid, rng)
    turn = Rotation.from_euler("zxy", [*rng.uniform(0.0, 360.0, 1), *rng.normal(0.0, 5.0, 2)], degrees=True)
    return turn.apply(points) + rng.uniform(-50.0, 50.0, 3), truth


class Row(NamedTuple):
    """What became of a leaf: why it was refused, or its flags; and the traits by name with truth, ends and quality."""

    number: int
    said: str
    traits: dict[str, tuple[float, float, float, float]]  # value, low, high, true; not a number where there is none
    quality: dict[str, str]


def measured(number: int, on_grid: bool) -> Row:
    points, truth = cloud(number, on_grid)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            result = phytofit.fit(phytofit.from_points(points, "cm"), threads=1)
    except phytofit.PhytofitError as error:
        return Row(number, f"refused: {error}", {}, {})
    ends = {
        t.name: (t.value, -np.inf if t.low is None else t.low, np.inf if t.high is None else t.high, truth[t.name])
        for t in result.traits
        if t.name in TRAITS
    }
    quality = {t.name: t.quality for t in result.traits}
    return Row(number, ";".join(result.flags), ends, quality)


def part(leaves: range, on_grid: bool, each: bool, pool: ProcessPoolExecutor) -> None:
    print(f"\n{len(leaves)} foreign leaves, thinned {'on a grid' if on_grid else 'at random'}", flush=True)
    rows = list(progress(pool.map(partial(measured, on_grid=on_grid), leaves), len(leaves)))
    fitted = [row for row in rows if row.traits]
    if each:
        for row in rows:
            cells = "  ".join(
                f"{name} {v:.1f} [{a:.1f}, {b:.1f}] ({t:.1f}){'' if a <= t <= b else ' *'}"
                for name, (v, a, b, t) in row.traits.items()
            )
            print(f"{row.number}  {cells}  {row.said}")
    print(f"measured {len(fitted)}, refused {len(rows) - len(fitted)}; usable traits are those that are not poor")
    print(f"{'':22}{'median error':>14}{'bias':>9}{'half interval':>15}{'95 % holds':>12}{'of usable':>11}{'good':>8}")
    for name, relative in TRAITS.items():
        value, low, high, true = np.array([row.traits[name] for row in fitted]).T
        held = (low <= true) & (true <= high)
        quality = np.array([row.quality[name] for row in fitted])
        usable = quality != "poor"
        scale = 100.0 / true if relative else np.ones(len(true))
        error, half = (value - true) * scale, 0.5 * (high - low) * scale
        unit = "%  " if relative else "deg"
        print(
            f"{name:22}{np.median(np.abs(error)):10.2f} {unit}{np.median(error):9.2f}{np.median(half):15.2f}"
            f"{100.0 * held.mean():10.1f} %{100.0 * held[usable].mean() if usable.any() else np.nan:9.1f} %"
            f"{100.0 * np.mean(quality == 'good'):6.1f} %",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="random, grid; both by default")
    parser.add_argument("--leaves", type=int, default=300)
    parser.add_argument("--from", dest="first", type=int, default=0, help="number of the first leaf")
    parser.add_argument("--each", action="store_true", help="also a line for each leaf")
    arguments = parser.parse_args()
    leaves = range(arguments.first, arguments.first + arguments.leaves)
    run_parts(
        {
            "random": partial(part, leaves, False, arguments.each),
            "grid": partial(part, leaves, True, arguments.each),
        },
        arguments.parts,
    )


if __name__ == "__main__":
    main()
