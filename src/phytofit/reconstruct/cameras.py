"""Pinhole cameras: intrinsics by name or from a TOML file, pixels to rays and back."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from phytofit.cloud import SCALE_CM
from phytofit.errors import InputError, SettingError
from phytofit.small_files import read_toml, shortened

__all__ = ["CAMERAS", "Camera", "load_camera"]

FloatArray = NDArray[np.float64]
UNITS = ("mm", "cm", "m")
FARTHEST_CM = 1000.0  # that a depth is believed, where the camera does not say how far it sees
MOST = 1e9  # of any number in a camera file; larger ones are slips
MOST_PIXELS = 30_000  # along a side
UNDISTORT_ROUNDS = 30  # of the fixed-point iteration; the lenses of depth cameras need about ten


@dataclass(frozen=True)
class Camera:
    """A depth camera: x to the right, y down, z forward; depth is along z, not along the ray.

    ``fx fy cx cy`` are pixels, the first pixel's centre being (0, 0); ``width height`` pixels; one step of a stored
    depth is ``depth_scale`` ``unit``; ``distortion`` is k1, k2, p1, p2, k3 as OpenCV counts them.  Depths nearer than
    ``near`` or farther than ``far``, in ``unit``, are no measurements; by default those beyond 10 m are none.

    Raises
    ------
    SettingError
        If a number is not finite or not possible, or the unit is unknown.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    depth_scale: float = 1.0
    unit: str = "mm"
    distortion: tuple[float, ...] = ()
    name: str = "camera"
    near: float = 0.0
    far: float | None = None

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, self.depth_scale, *self.distortion)
        if not all(math.isfinite(number) for number in numbers):
            raise SettingError(f"camera {self.name}: expected finite numbers, got {numbers}")
        if min(self.fx, self.fy, self.depth_scale) <= 0 or min(self.width, self.height) < 1:
            raise SettingError(
                f"camera {self.name}: expected fx, fy, depth_scale, width and height above 0, got "
                f"{self.fx:g}, {self.fy:g}, {self.depth_scale:g}, {self.width} and {self.height}"
            )
        if not (0 <= self.cx < self.width and 0 <= self.cy < self.height):
            raise SettingError(
                f"camera {self.name}: expected cx, cy inside an image of {self.width} x {self.height} pixels, "
                f"got {self.cx:g}, {self.cy:g}; are the intrinsics those of another resolution?"
            )
        low, high = self.range_cm
        if not 0.0 <= low < high < math.inf:
            raise SettingError(f"camera {self.name}: expected 0 <= near < far, got {self.near:g} and {self.far}")
        if self.unit not in UNITS:
            raise SettingError(f"camera {self.name}: expected unit mm, cm or m, got {shortened(repr(self.unit))}")
        if len(self.distortion) > 5:
            raise SettingError(
                f"camera {self.name}: expected distortion = [k1, k2, p1, p2, k3], got {len(self.distortion)} numbers"
            )

    @property
    def step_cm(self) -> float:
        """What a stored depth of 1 is, cm."""
        return self.depth_scale * SCALE_CM[self.unit]

    @property
    def range_cm(self) -> tuple[float, float]:
        """The nearest and the farthest depth that is a measurement, cm."""
        to_cm = SCALE_CM.get(self.unit, 1.0)
        return self.near * to_cm, FARTHEST_CM if self.far is None else self.far * to_cm

    def pitch(self, depth: float) -> float:
        """Distance of neighbouring pixels on a surface that faces the camera at this depth, in the depth's unit."""
        return depth / math.sqrt(self.fx * self.fy)

    def rays(self) -> FloatArray:
        """(height, width, 2): x and y of what each pixel sees at depth 1."""
        v, u = np.mgrid[: self.height, : self.width].astype(float)
        seen = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        if not any(self.distortion):
            return seen
        straight = seen.copy()
        for _ in range(UNDISTORT_ROUNDS):
            straight += seen - self._distort(straight)
        return straight

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns and rows (n,) of points (n, 3) in the camera's frame; not a number for points behind it."""
        ahead = points[:, 2] > 0
        xy = np.full((len(points), 2), np.nan)
        xy[ahead] = points[ahead, :2] / points[ahead, 2:]
        xy = self._distort(xy)
        return self.fx * xy[:, 0] + self.cx, self.fy * xy[:, 1] + self.cy

    def _distort(self, xy: FloatArray) -> FloatArray:
        if not any(self.distortion):
            return xy
        k1, k2, p1, p2, k3 = (*self.distortion, *(0.0,) * (5 - len(self.distortion)))
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        moved = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
        return np.stack(moved, axis=-1)


PRESETS = {  # fx fy cx cy width height; typical units, without distortion: a calibration of your own camera is better
    "kinect-v1": (575.8, 575.8, 319.5, 239.5, 640, 480),
    "kinect-v2": (365.0, 365.0, 255.5, 211.5, 512, 424),
    "realsense-d4xx": (424.0, 424.0, 423.5, 239.5, 848, 480),  # D435 and D455 at 848 x 480
    "azure-kinect": (504.0, 504.0, 320.0, 333.0, 640, 576),  # narrow field of view, unbinned
}
RANGES_MM = {  # nearest and farthest depth that the sensor gives
    "kinect-v1": (400.0, 8000.0),  # Kinect for Windows SDK 1.8: from 0.4 m in near mode; up to 8 m, beyond 4 m coarsely
    "kinect-v2": (500.0, 8000.0),  # Kinect for Windows SDK 2.0: from 0.5 m; up to 8 m, beyond 4.5 m unreliably
    "realsense-d4xx": (195.0, 10_000.0),  # Intel's data sheet of the D400 series: least depth at 848 x 480; about 10 m
    "azure-kinect": (500.0, 3860.0),  # Microsoft's hardware specification, of that mode
}
CAMERAS = {
    name: Camera(*numbers, near=RANGES_MM[name][0], far=RANGES_MM[name][1], name=name)
    for name, numbers in PRESETS.items()
}
EXPECTED = (
    "a camera: fx fy cx cy width height, in pixels, and maybe depth_scale unit near far distortion, in lines like "
    "'fx = 365.0'"
)
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MOST, le=MOST)]  # no text, no true or false
Whole = Annotated[int, Field(strict=True, ge=1, le=MOST_PIXELS)]


class _File(BaseModel):
    """What a camera's TOML file may hold."""

    model_config = ConfigDict(extra="forbid")
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    width: Whole
    height: Whole
    depth_scale: Number = 1.0
    unit: Annotated[str, Field(strict=True)] = "mm"
    near: Number | None = None
    far: Number | None = None
    distortion: Annotated[list[Number], Field(max_length=5)] = []


def load_camera(name: str) -> Camera:
    """A camera of `CAMERAS` by its name, or from a TOML file: fx fy cx cy width height, and maybe depth_scale, unit,
    near and far in that unit, and distortion.

    Raises
    ------
    InputError
        If there is no such preset and no such file, or the file is not TOML.
    SettingError
        If a key is missing or unknown, or a value is impossible.
    """
    if name in CAMERAS:
        return CAMERAS[name]
    path = Path(name)
    if path.suffix.lower() != ".toml":
        known = ", ".join(CAMERAS)
        raise InputError(
            f"{shortened(name)}: no camera known by that name; expected {known}, or a TOML file of {EXPECTED}"
        )
    given = read_toml(path, EXPECTED)
    try:
        read = _File.model_validate(given).model_dump(exclude_none=True)
    except (ValidationError, OverflowError) as error:
        raise SettingError(f"{path}: {_first(error)}; expected {EXPECTED}") from None
    try:
        return Camera(**{**read, "distortion": tuple(read["distortion"])}, name=path.stem)
    except SettingError as error:
        raise SettingError(f"{path}: {error}") from None


def _first(error: ValidationError | OverflowError) -> str:
    """The first thing that is wrong, in words."""
    if isinstance(error, OverflowError):
        return "a number is too large"
    first = error.errors(include_url=False)[0]
    key = shortened(".".join(str(part) for part in first["loc"]))
    if first["type"] in ("missing", "extra_forbidden"):
        return f"{key} is {'missing' if first['type'] == 'missing' else 'unknown'}"
    what = first["msg"][0].lower() + first["msg"][1:]
    return f"{key} = {shortened(repr(first['input']))}: {what}"
