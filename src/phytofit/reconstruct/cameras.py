"""Pinhole cameras: intrinsics by name or from a TOML file, pixels to rays and back."""

import math
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phytofit.cloud import SCALE_CM
from phytofit.errors import InputError, SettingError

__all__ = ["CAMERAS", "Camera", "load_camera"]

FloatArray = NDArray[np.float64]
UNITS = ("mm", "cm", "m")
UNDISTORT_ROUNDS = 30  # of the fixed-point iteration; the lenses of depth cameras need about ten


@dataclass(frozen=True)
class Camera:
    """A depth camera: x to the right, y down, z forward; depth is along z, not along the ray.

    ``fx fy cx cy`` are pixels, the first pixel's centre being (0, 0); ``width height`` pixels; one step of a stored
    depth is ``depth_scale`` ``unit``; ``distortion`` is k1, k2, p1, p2, k3 as OpenCV counts them.

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
        if self.unit not in UNITS:
            raise SettingError(f"camera {self.name}: expected unit mm, cm or m, got {self.unit!r}")
        if len(self.distortion) > 5:
            raise SettingError(
                f"camera {self.name}: expected distortion = [k1, k2, p1, p2, k3], got {len(self.distortion)} numbers"
            )

    @property
    def step_cm(self) -> float:
        """What a stored depth of 1 is, cm."""
        return self.depth_scale * SCALE_CM[self.unit]

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
CAMERAS = {name: Camera(*numbers, name=name) for name, numbers in PRESETS.items()}
NEEDED = ("fx", "fy", "cx", "cy", "width", "height")


def load_camera(name: str) -> Camera:
    """A camera of `CAMERAS` by its name, or from a TOML file: fx fy cx cy width height, depth_scale, unit, distortion.

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
        raise InputError(f"--camera {name}: expected {', '.join(CAMERAS)}, or a TOML file with {' '.join(NEEDED)}")
    try:
        given: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror}); expected a TOML file of a camera") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a TOML file ({error}); expected lines like 'fx = 365.0'") from None
    known = {field.name for field in fields(Camera)} - {"name"}
    missing, unknown = [key for key in NEEDED if key not in given], sorted(set(given) - known)
    if missing or unknown:
        wrong = [f"{key} is missing" for key in missing] + [f"{key} is unknown" for key in unknown]
        expected = f"{' '.join(NEEDED)}, and maybe depth_scale unit distortion"
        raise SettingError(f"{path}: {', '.join(wrong)}; expected {expected}")
    try:
        fx, fy, cx, cy = (float(given[key]) for key in NEEDED[:4])
        return Camera(
            fx,
            fy,
            cx,
            cy,
            int(given["width"]),
            int(given["height"]),
            depth_scale=float(given.get("depth_scale", 1.0)),
            unit=str(given.get("unit", "mm")),
            distortion=tuple(float(k) for k in given.get("distortion", ())),
            name=path.stem,
        )
    except (TypeError, ValueError) as error:
        if isinstance(error, SettingError):
            raise
        raise SettingError(f"{path}: expected numbers ({error})") from None
