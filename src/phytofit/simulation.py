"""Simulated phytomers: true organs to a cloud, with noise, removed spheres, outliers and a random pose."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.errors import SettingError
from phytofit.models import Organ, SurfaceSampler, move
from phytofit.parsing import checked_number, checked_whole
from phytofit.species import Species, load_species

__all__ = ["SimulatedPhytomer", "add_noise", "add_outliers", "occlude", "random_pose", "simulate", "visible"]

FloatArray = NDArray[np.float64]
CAMERA_ABOVE_DEG = 20.0  # the cameras of `n_views` are so much above the horizon
SPARE = 8  # times as many points are drawn as cameras are to see
SCREEN_POINTS, PIXEL_CM = 250_000, 0.1  # of the depth buffer; some five points a pixel
BEHIND_CM = 0.4  # so far behind the nearest point of its pixel a point is still of the same surface, seen at a slant
MOST_CM = 10_000.0  # of any length of a phytomer; a plant is no longer than 100 m
AT_ONCE = 1000  # points, whose neighbours are listed
ABOVE = "stem_length_above"
OUTLIER_MARGIN = 0.25  # outliers fill the cloud's box, grown by this share of its size


@dataclass(frozen=True)
class SimulatedPhytomer:
    """A cloud with its truth: ``points`` (n, 3) cm, ``labels`` (n,) 1 stem, 2 leaf, 0 outlier; ``x`` (k,); ``organs``
    in the cloud's frame; ``pose`` (4, 4) from the model's frame to the cloud's."""

    points: FloatArray
    labels: NDArray[np.int64]
    x: FloatArray
    organs: tuple[Organ, ...]
    pose: FloatArray


def simulate(
    species: Species | None = None,
    *,
    fixed: Mapping[str, float] | None = None,
    stem_above: str = "free",
    n_points: int = 5000,
    noise_cm: float = 0.5,
    noise_reach_cm: float = 0.0,
    n_views: int | None = None,
    n_spheres: int = 0,
    sphere_diameter_cm: float = 6.0,
    outlier_share: float = 0.0,
    random_orientation: bool = True,
    seed: int = 0,
) -> SimulatedPhytomer:
    """Draw a phytomer from the species' ranges and scan it.

    Defaults are the paper's simulated protocol (section V); `n_spheres` of `sphere_diameter_cm` are its occlusions
    (Fig. 7).  `fixed` gives parameters by name that are not to be drawn.  The stem above the leaf is drawn
    too ("free"), as long as that below ("equal"), or "none".  `n_points` are drawn before spheres are
    removed; `outlier_share` of the points that are left is added.  Noise is shared by neighbours as far as
    `noise_reach_cm`, as in fused and stereo clouds, or independent.  `n_views` cameras see the points, evenly
    spaced around the stem and looking down on it by `CAMERA_ABOVE_DEG`; None: from everywhere.
    """
    species = load_species() if species is None else species
    for name, count, least in (
        ("points", n_points, 1),
        ("views", 1 if n_views is None else n_views, 1),
        ("spheres", n_spheres, 0),
    ):
        checked_whole(name, count, least)
    checked_whole("seed", seed, 0, math.inf)
    for name, length in (("noise", noise_cm), ("noise reach", noise_reach_cm), ("sphere diameter", sphere_diameter_cm)):
        checked_number(name, length, most=MOST_CM)
    if not sphere_diameter_cm > 0:
        raise SettingError(f"sphere diameter: expected a positive number of cm, got {sphere_diameter_cm:g}")
    if not checked_number("outliers", outlier_share) < 1:
        raise SettingError(f"outliers: expected a share from 0 to below 1, got {outlier_share:g}")
    random = np.random.default_rng(seed)
    space = species.space
    low, high = species.ranges.T
    x = low.copy()
    x[low < high] = random.uniform(low[low < high], high[low < high])
    fixed = {} if fixed is None else fixed
    for name, value in fixed.items():
        i = space.index(name)
        low_end, high_end = float(space.lower[i]), min(float(space.upper[i]), MOST_CM)
        if isinstance(value, bool) or not isinstance(value, Real) or not low_end <= float(value) <= high_end:
            raise SettingError(
                f"{name}: expected a number within the species' bounds [{low_end:g}, {high_end:g}], got {value!r}"
            )
        x[i] = value
    model = species.with_stem_above(stem_above).model
    if stem_above != "free" and ABOVE in space.names:
        if ABOVE in fixed:
            raise SettingError(f"{ABOVE}: expected no value where stem_above is {stem_above!r}, got {fixed[ABOVE]:g}")
        x[space.index(ABOVE)] = model.stem_above * x[space.index("stem_length")]
    organs: tuple[Organ, ...] = tuple(o.row(0) for o in model.organs(x))
    n_drawn = n_points if n_views is None else SPARE * n_points
    points, organ = SurfaceSampler(n_drawn, int(random.integers(2**31)), even=False).draw(organs)
    labels = organ.astype(np.int64) + 1
    shuffle = random.permutation(n_drawn)  # a sensor's points come in no order of the model's
    points, labels = points[shuffle], labels[shuffle]
    if n_views is not None:
        turns = 2.0 * np.pi * (random.random() + np.arange(n_views) / n_views)
        above = np.deg2rad(CAMERA_ABOVE_DEG)
        cameras = np.stack([np.cos(above) * np.cos(turns), np.cos(above) * np.sin(turns), 0 * turns + np.sin(above)], 1)
        surface, _ = SurfaceSampler(SCREEN_POINTS, 0).draw(organs)
        seen = np.flatnonzero(np.any([visible(points, surface, toward) for toward in cameras], axis=0))[:n_points]
        points, labels = points[seen], labels[seen]
    points = add_noise(points, noise_cm, random, noise_reach_cm)
    for _ in range(n_spheres):
        keep = occlude(points, sphere_diameter_cm, random)
        points, labels = points[keep], labels[keep]
        if len(points) == 0:
            raise SettingError(
                f"spheres: expected to leave some of the {n_points} points, but "
                f"{n_spheres} of {sphere_diameter_cm:g} cm remove all"
            )
    outliers = add_outliers(points, outlier_share, random)
    points = np.concatenate([points, outliers])
    labels = np.concatenate([labels, np.zeros(len(outliers), np.int64)])
    pose = random_pose(random) if random_orientation else np.eye(4)
    points = points @ pose[:3, :3].T + pose[:3, 3]
    return SimulatedPhytomer(points, labels, x, move(organs, pose), pose)


def add_noise(points: FloatArray, std_cm: float, random: np.random.Generator, reach_cm: float = 0.0) -> FloatArray:
    """Points (n, 3) with Gaussian noise of zero mean on each coordinate, independent, or shared by neighbours: white
    noise summed over those within `reach_cm` of each point, scaled to the same standard deviation."""
    if reach_cm == 0.0:
        return points + random.normal(0.0, std_cm, points.shape)
    white, tree = random.standard_normal(points.shape), cKDTree(points)
    noisy = points.copy()
    for first in range(0, len(points), AT_ONCE):
        block = slice(first, first + AT_ONCE)
        near = tree.query_ball_point(points[block], reach_cm)
        noisy[block] += std_cm * np.array([white[those].sum(axis=0) / np.sqrt(len(those)) for those in near])
    return noisy


def visible(points: FloatArray, surface: FloatArray, toward: FloatArray) -> NDArray[np.bool_]:
    """Mask (n,) of the points (n, 3) that a distant camera sees, which is in the direction `toward` (3,): those with
    nothing before them of the `surface`, points (m, 3) all over it (a depth buffer, Catmull 1974)."""
    view = np.linalg.svd(toward[np.newaxis])[2]
    view[0] = toward / np.linalg.norm(toward)
    both = np.concatenate([surface, points]) @ view.T
    cell = np.floor(both[:, 1:] / PIXEL_CM).astype(np.int64)
    cell -= cell.min(axis=0)
    pixel = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    nearest = np.full(pixel.max() + 1, -np.inf)
    np.maximum.at(nearest, pixel, both[:, 0])
    seen: NDArray[np.bool_] = both[len(surface) :, 0] >= nearest[pixel[len(surface) :]] - BEHIND_CM
    return seen


def occlude(points: FloatArray, diameter_cm: float, random: np.random.Generator) -> NDArray[np.bool_]:
    """Mask (n,) of the points that stay when a sphere around a random point of the cloud is removed (Fig. 7)."""
    center = points[random.integers(len(points))]
    stay: NDArray[np.bool_] = np.linalg.norm(points - center, axis=1) > 0.5 * diameter_cm
    return stay


def add_outliers(points: FloatArray, share: float, random: np.random.Generator) -> FloatArray:
    """`share` times as many points (m, 3) as there are, uniform in the cloud's box and somewhat around it."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = OUTLIER_MARGIN * (high - low)
    return random.uniform(low - margin, high + margin, (round(share * len(points)), 3))


def random_pose(random: np.random.Generator, reach_cm: float = 50.0) -> FloatArray:
    """Rigid pose (4, 4): a uniform rotation (Shoemake 1992) and a translation within `reach_cm` a coordinate."""
    q = random.standard_normal(4)
    w, a, b, c = q / np.linalg.norm(q)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
        [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
        [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
    ]
    pose[:3, 3] = random.uniform(-reach_cm, reach_cm, 3)
    return pose
