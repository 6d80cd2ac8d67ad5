"""Depth images of a plant, on a turntable or from known viewpoints, to one cloud: read, register, fuse, judge."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from phytofit.cloud import MIN_POINTS, SCALE_CM, PointCloud
from phytofit.display import Shown, Summary
from phytofit.errors import InputError, SettingError
from phytofit.reconstruct.cameras import MOST, Camera, load_camera
from phytofit.reconstruct.depth_files import DepthView, depth_files, read_views
from phytofit.reconstruct.fusion import fuse
from phytofit.reconstruct.placing import Placed, Rejected, Views, place_by_poses, place_on_turntable
from phytofit.reconstruct.registration import Pair, move_points
from phytofit.reconstruct.turntable import Turn
from phytofit.reconstruct.views import drop_flying_pixels, surface_normals, view_points
from phytofit.small_files import read_json, shortened

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["Reconstruction", "read_poses", "reconstruct"]

FloatArray = NDArray[np.float64]
POSES = '{"unit": "cm", "views": [{"file": "a.png", "pose": 4x4}, ...]}'
LEAST_RETURNS = 0.01  # share of an image's pixels; below, the image is empty
DOUBTFUL, REFUSED = 0.15, 0.4  # shares of points that other views see through; right poses leave some per cent


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction(Shown):
    """A plant's cloud from several depth images, and how far to trust it.

    ``cloud`` in cm, z up, with normals; on a turntable z is its axis, x points to the first view's camera, and z = 0
    is the pot's rim, or the lowest point if no pot was found.  ``view`` (n,) is the number of
    the view (in ``files``) that each point came from, ``n_views`` (n,) how many saw it.
    ``files`` and ``poses`` (k, 4, 4), camera to world, are those of the views used.  ``turn`` and ``step_deg`` are None
    where poses were given; ``loop`` is what is left of a turn after all pairwise registrations, degrees and cm, None
    where it does not close.  ``contradicted`` is the share of all points that was dropped, since other views see
    through them: flying pixels, leaves that moved, views that stand wrong.
    """

    cloud: PointCloud
    view: NDArray[np.int64]
    n_views: NDArray[np.int64]
    camera: Camera
    files: tuple[str, ...]
    poses: FloatArray
    pairs: tuple[Pair, ...]
    turn: Turn | None
    step_deg: float | None
    loop: tuple[float, float] | None
    contradicted: float
    rejected: tuple[Rejected, ...]
    flags: tuple[str, ...]
    settings: dict[str, Any]

    def summary(self) -> Summary:
        """The views, and the flags."""
        rows = [(file, "" if np.isnan(angle) else f"{angle:.1f}") for file, angle in self._angles()]
        remarks = [f"left out: {view.file}: {view.reason}" for view in self.rejected]
        title = f"Reconstruction of {self.cloud.name}: {len(self.cloud)} points of {len(self.files)} views"
        return Summary(title, ("view", "angle, deg"), rows, [*remarks, *(f"flag: {flag}" for flag in self.flags)])

    def to_frame(self) -> "pd.DataFrame":
        """The views as a table: ``file``, and ``angle_deg`` by which the plant had turned, where it turned."""
        import pandas as pd

        return pd.DataFrame(self._angles(), columns=["file", "angle_deg"])

    def _angles(self) -> list[tuple[str, float]]:
        turned = np.full(len(self.files), np.nan) if self.turn is None else np.degrees(self.turn.angles)
        return list(zip(self.files, turned.tolist(), strict=True))

    def plot(self) -> "Figure":
        """The cloud from three sides, coloured by view: ``reconstruction.png``."""
        from phytofit.plots import plot_reconstruction

        return plot_reconstruction(self, title=self.cloud.name)

    @property
    def residual_cm(self) -> float:
        """The median distance between the surfaces of views that overlap, cm; not a number for one view."""
        return float(np.nanmedian([pair.residual_cm for pair in self.pairs])) if self.pairs else float("nan")


def reconstruct(
    folder: str | Path,
    camera: Camera | str,
    *,
    step_deg: float | None = None,
    unit: str | None = None,
    poses: str | Path | None = None,
    pattern: str = "*",
    spacing_cm: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Reconstruction:
    """Reconstruct a plant's cloud from the depth images in a folder.

    Parameters
    ----------
    folder
        Depth images of one plant, in the order of the numbers in their names; `pattern` chooses among its files.
    camera
        A camera, the name of a preset, or a TOML file (:func:`phytofit.reconstruct.load_camera`).
    step_deg
        The turntable's nominal step; by default it is found from nothing.  The true one is estimated either way.
    unit
        mm, cm or m: what a stored depth of 1 is; by default the camera's.
    poses
        A file of known viewpoints (:func:`read_poses`); then nothing has to turn.
    spacing_cm
        Between points of the cloud; by default that of neighbouring pixels on the plant.
    progress
        Is called with a word on each stage as it begins.

    Raises
    ------
    InputError
        If the images can't be used: which, what was found, what was expected.
    SettingError
        If a setting is out of its range.
    """
    if poses is not None and step_deg is not None:
        raise SettingError("step_deg: it is for a turntable, and known poses were given; leave one of the two out")
    if step_deg is not None and not 1.0 <= abs(step_deg) <= 180.0:
        raise SettingError(f"step_deg: expected degrees between two views, 1 to 180, got {step_deg:g}")
    if spacing_cm is not None and not 0.01 <= spacing_cm <= 5.0:
        raise SettingError(f"spacing_cm: expected 0.01 to 5 cm, got {spacing_cm:g}")
    chosen = load_camera(camera) if isinstance(camera, str) else camera
    folder = Path(folder)
    progress("images")
    files = depth_files(folder, pattern)
    images, notes = read_views(files, chosen, unit=unit)
    given = None if poses is None else read_poses(Path(poses), [image.file for image in images])
    views = _usable(images, chosen)
    settings = {"step_deg": step_deg, "unit": unit or chosen.unit, "poses": None if poses is None else Path(poses).name,
                "pattern": pattern, "spacing_cm": spacing_cm}  # fmt: skip
    with threadpool_limits(limits=1, user_api="blas"):  # more would round sums in another order
        if given is not None:
            placed = place_by_poses(views, given, chosen, progress)
        else:
            placed = place_on_turntable(views, chosen, step_deg, progress)
        progress("fusion")
        return _fused(views, placed, chosen, spacing_cm, folder, settings, notes)


def read_poses(path: Path, files: Sequence[str]) -> dict[str, FloatArray]:
    """Poses (4, 4), camera to world, cm, of image files from JSON, as reconstruction.json has them, too.

    ``{"unit": "cm", "views": [{"file": "a.png", "pose": [[…], […], […], [0, 0, 0, 1]]}, …]}``: the camera's axes are x
    to the right, y down, z forward; the world's z is up.

    Raises
    ------
    InputError
        If the file can't be read, a view has no pose, or a pose is no rotation and translation.
    """
    found = read_json(path, POSES)
    try:
        scale = SCALE_CM[found["unit"]]
        read = {str(view["file"]): np.array(view["pose"], dtype=float) for view in found["views"]}
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: not a file of poses ({shortened(repr(error))}); expected {POSES}") from None
    for name in files:
        if name not in read:
            raise InputError(f"{path}: no pose for {name}, found {len(read)} poses; name each image file once")
        pose = read[name]
        rigid = pose.shape == (4, 4) and bool((np.abs(pose) <= MOST).all()) and np.allclose(pose[3], [0, 0, 0, 1])
        R = pose[:3, :3] if rigid else np.zeros((3, 3))
        if not (np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0):
            raise InputError(
                f"{path}: the pose of {name} is not a rotation and a translation, expected 4 x 4 with last row 0 0 0 1"
            )
    poses = {name: read[name].copy() for name in files}
    for pose in poses.values():
        pose[:3, 3] *= scale
    return poses


def _usable(images: Sequence[DepthView], camera: Camera) -> Views:
    """The views that show anything, each once, without flying pixels."""
    files = [image.file for image in images]
    views = Views(list(files), [image.depth for image in images], files)
    views.keep(
        [bool((depth > 0).mean() >= LEAST_RETURNS) for depth in views.depths],
        lambda i: f"empty: {100 * (views.depths[i] > 0).mean():.1f} % of its pixels hold a depth",
    )
    first = [next(j for j in range(i + 1) if np.array_equal(d, views.depths[j])) for i, d in enumerate(views.depths)]
    names = [views.files[j] for j in first]
    views.keep([j == i for i, j in enumerate(first)], lambda i: f"duplicate of {names[i]}")
    views.depths = [drop_flying_pixels(depth, camera) for depth in views.depths]
    return views


def _fused(
    views: Views,
    placed: Placed,
    camera: Camera,
    spacing_cm: float | None,
    folder: Path,
    settings: dict[str, Any],
    notes: tuple[str, ...],
) -> Reconstruction:
    rays = camera.rays()
    points, normals, view, distances = [], [], [], []
    for i, (depth, mask, pose) in enumerate(zip(views.depths, placed.masks, placed.poses, strict=True)):
        seen = view_points(depth, rays, mask)
        points.append(move_points(pose, seen))
        normals.append(surface_normals(seen)[0] @ pose[:3, :3].T)
        view.append(np.full(len(seen), i))
        distances.append(seen[:, 2])
    n_points = sum(map(len, points))
    if n_points < MIN_POINTS:
        raise InputError(
            f"{folder}: found {n_points} points of a plant, expected at least {MIN_POINTS}; is it in view?"
        )
    spacing = spacing_cm or float(np.clip(camera.pitch(float(np.median(np.concatenate(distances)))), 0.05, 1.0))
    fused = fuse(
        np.concatenate(points),
        np.concatenate(normals),
        np.concatenate(view),
        placed.poses,
        views.depths,
        camera,
        spacing_cm=spacing,
    )
    if fused.contradicted > DOUBTFUL:
        said = f"other views see through {100 * fused.contradicted:.0f} % of the points, expected a few"
        asked = f"is the camera ({camera.name}, f = {camera.fx:g} pixels) right, and did the leaves keep still?"
        if fused.contradicted > REFUSED:
            raise InputError(f"{folder}: the views don't fit each other: {said}; {asked}")
        views.flags.append(f"{said}; {asked}")
    poses, kept = placed.poses.copy(), fused.points
    if placed.turn is not None and placed.lowest_is_ground:
        poses[:, 2, 3] -= kept[:, 2].min()
        kept = kept - [0.0, 0.0, kept[:, 2].min()]
    return Reconstruction(
        cloud=PointCloud(kept, normals=fused.normals, name=folder.resolve().name, notes=notes),
        view=fused.view,
        n_views=fused.n_views,
        camera=camera,
        files=tuple(views.files),
        poses=poses,
        pairs=placed.pairs,
        turn=placed.turn,
        step_deg=placed.step_deg,
        loop=placed.loop,
        contradicted=fused.contradicted,
        rejected=tuple(views.rejected),
        flags=tuple(views.flags),
        settings={**settings, "spacing_cm": spacing},
    )
