"""What a scan does to the points of true organs: noise, sides that no camera sees, holes, outliers, any pose."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phytofit.errors import SettingError
from phytofit.models import Organ, SurfaceSampler
from phytofit.parsing import checked_number, checked_whole

__all__ = [
    "MOST_CM",
    "add_noise",
    "add_outliers",
    "anywhere",
    "check_scan",
    "occlude",
    "random_pose",
    "seen_from",
    "visible",
]

FloatArray = NDArray[np.float64]
MOST_CM = 10_000.0  # of any length; a plant is no longer than 100 m
CAMERA_ABOVE_DEG = 20.0  # the cameras of `n_views` are so much above the horizon
SPARE = 8  # times as many points are drawn as cameras are to see
SCREEN_POINTS, PIXEL_CM = 250_000, 0.1  # of the depth buffer; some five points a pixel
BEHIND_CM = 0.4  # so far behind the nearest point of its pixel a point is still of the same surface, seen at a slant
AT_ONCE = 1000  # points, whose neighbours are listed
OUTLIER_MARGIN = 0.25  # outliers fill the cloud's box, grown by this share of its size


def check_scan(
    n_points: int, noise_cm: float, noise_reach_cm: float, n_views: int | None, outlier_share: float, seed: int
) -> None:
    """SettingError for numbers that no scan can have."""
    checked_whole("points", n_points, 1)
    checked_whole("views", 1 if n_views is None else n_views, 1)
    checked_whole("seed", seed, 0, math.inf)
    for name, length in (("noise", noise_cm), ("noise reach", noise_reach_cm)):
        checked_number(name, length, most=MOST_CM)
    if not checked_number("outliers", outlier_share) < 1:
        raise SettingError(f"outliers: expected a share from 0 to below 1, got {outlier_share:g}")


def seen_from(
    organs: Sequence[Organ], n_points: int, n_views: int | None, random: np.random.Generator
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Points (n, 3) drawn uniformly from the organs, and the index (n,) of each point's organ.  With `n_views`, only
    points that some camera sees; the cameras stand evenly around the plant, `CAMERA_ABOVE_DEG` above the horizon."""
    n_drawn = n_points if n_views is None else SPARE * n_points
    points, organ = SurfaceSampler(n_drawn, int(random.integers(2**31)), even=False).draw(organs)
    shuffle = random.permutation(n_drawn)  # a sensor's points come in no order of the model's
    points, which = points[shuffle], organ.astype(np.int64)[shuffle]
    if n_views is None:
        return points, which
    turns = 2.0 * np.pi * (random.random() + np.arange(n_views) / n_views)
    above = np.deg2rad(CAMERA_ABOVE_DEG)
    cameras = np.stack([np.cos(above) * np.cos(turns), np.cos(above) * np.sin(turns), 0 * turns + np.sin(above)], 1)
    surface, _ = SurfaceSampler(SCREEN_POINTS, 0).draw(organs)
    seen = np.flatnonzero(np.any([visible(points, surface, toward) for toward in cameras], axis=0))[:n_points]
    return points[seen], which[seen]


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


def anywhere(
    points: FloatArray, labels: NDArray[np.int64], outlier_share: float, random: np.random.Generator, *, turned: bool
) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
    """Points and labels with outliers, labelled 0, and their pose (4, 4): random if `turned`, else where they are."""
    outliers = add_outliers(points, outlier_share, random)
    labels = np.concatenate([labels, np.zeros(len(outliers), np.int64)])
    pose = random_pose(random) if turned else np.eye(4)
    return np.concatenate([points, outliers]) @ pose[:3, :3].T + pose[:3, 3], labels, pose


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
