"""Depth images of a known plant in a pot on a tilted turntable, rendered with a z-buffer: for the tests."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from phytofit.models import LEAF, STEM, Organ, SurfaceSampler
from phytofit.models.organs import frames_along
from phytofit.reconstruct import Camera

CAMERA = Camera(228.0, 228.0, 159.5, 131.5, 320, 264, name="test")
STEP_DEG = -31.3
TILT_DEG, ROLL_DEG = 20.0, 2.0
AXIS_POINT = np.array([-3.0, 6.0, 96.0])  # cm, in the camera's frame: where the axis leaves the pot
POT_RADIUS, POT_HEIGHT = 7.0, 13.0


def plant(seed=3):
    """A leaning stem with seven leaves, z up, the soil at z = 0, cm."""
    random = np.random.default_rng(seed)
    height = np.linspace(-1.0, 42.0, 30)
    stem = np.stack([1.0 + 0.03 * height, -0.5 + 0.0 * height, height], axis=1)
    organs = [Organ(STEM, stem, frames_along(stem, np.array([1.0, 0.0, 0.0])), np.full(30, 0.9))]
    for i in range(7):
        length, azimuth = random.uniform(25.0, 42.0), np.pi * i + random.uniform(-0.5, 0.5)
        along = np.linspace(0.0, 1.0, 25)
        turned = np.radians(random.uniform(25.0, 40.0) + random.uniform(70.0, 110.0) * along)
        r = np.concatenate([[0.0], np.cumsum(np.sin(turned[1:]))]) * length / 24
        z = np.concatenate([[0.0], np.cumsum(np.cos(turned[1:]))]) * length / 24
        base = stem[np.argmin(np.abs(height - (10.0 + 4.5 * i)))]
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axis = base + r[:, None] * out + z[:, None] * [0.0, 0.0, 1.0] + (2.0 * along**2)[:, None] * side
        width = 2.3 * np.sqrt(np.clip(1.0 - along**3, 0.0, 1.0)) + 0.05
        organs.append(Organ(LEAF, axis, frames_along(axis, side), width))
    return organs


def plant_points(n=350_000):
    return SurfaceSampler(n, seed=1).draw(plant())[0]


def pot_points(radius=POT_RADIUS, density=150.0):
    """The wall of a pot, its soil and a table below, rotationally symmetric about z."""
    random = np.random.default_rng(7)

    def disc(r, z):
        n = int(density * np.pi * r * r)
        rho, a = r * np.sqrt(random.random(n)), 2 * np.pi * random.random(n)
        return np.stack([rho * np.cos(a), rho * np.sin(a), np.full(n, z)], axis=1)

    n = int(density * 2 * np.pi * radius * POT_HEIGHT)
    a, z = 2 * np.pi * random.random(n), -POT_HEIGHT * random.random(n)
    wall = np.stack([radius * np.cos(a), radius * np.sin(a), z], axis=1)
    return np.concatenate([disc(radius, -1.0), wall, disc(2.5 * radius, -POT_HEIGHT)])


def camera_from_turntable():
    """The pose (4, 4) of the plant's frame at angle 0 in the camera's."""
    tilt = Rotation.from_euler("zx", [ROLL_DEG, TILT_DEG], degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = tilt @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pose[:3, 3] = AXIS_POINT
    return pose


def turned(points, angle):
    return points @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().T


def z_buffer(points, camera=CAMERA, far=np.inf):
    """The depth (height, width) of the nearest of points (n, 3) in the camera's frame, `far` where there is none.

    On a grid three times as fine as the image, of which each third is taken: the nearest within a whole pixel would
    bring slanted surfaces nearer.
    """
    u, v = camera.project(points)
    column, row = np.rint(3.0 * u + 1.0), np.rint(3.0 * v + 1.0)
    inside = (column >= 0) & (column < 3 * camera.width) & (row >= 0) & (row < 3 * camera.height)
    depth = np.full((3 * camera.height, 3 * camera.width), far)
    np.minimum.at(depth, (row[inside].astype(int), column[inside].astype(int)), points[inside, 2])
    return depth[1::3, 1::3]


def spoiled(depth, seed, noise_cm=0.12, flying_share=0.3):
    """Noise, no returns, and flying pixels where the depth jumps; whole millimetres as a sensor stores them."""
    random = np.random.default_rng(seed)
    made = depth + noise_cm * (depth / 95.0) ** 2 * random.standard_normal(depth.shape)
    neighbour = np.roll(depth, 1, axis=1)
    jump = (np.abs(neighbour - depth) > 5.0) & (random.random(depth.shape) < flying_share)
    mixed = random.random(depth.shape)
    made = np.where(jump, mixed * depth + (1 - mixed) * neighbour, made)
    made = np.where(random.random(depth.shape) < 0.01, 0.0, made)
    return np.rint(10.0 * made).clip(0, 65535).astype(np.uint16)


@dataclass
class Scan:
    """Images (n, height, width) uint16 mm, and their angles (n,), rad."""

    images: list
    angles: np.ndarray


def scan(angles_deg, points=None, pot=None, wall_cm=230.0):
    """Views of the plant in its pot before a wall."""
    points = plant_points() if points is None else points
    still = pot_points() if pot is None else pot
    pose = camera_from_turntable()
    images = []
    for k, angle in enumerate(np.radians(angles_deg)):
        world = np.concatenate([turned(points, angle), still])
        images.append(spoiled(z_buffer(world @ pose[:3, :3].T + pose[:3, 3], far=wall_cm), seed=k))
    return Scan(images, np.radians(angles_deg))
