"""Where each view was taken from: on a turntable, found from the data; or given, and made to fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import InputError
from phytofit.reconstruct.cameras import Camera
from phytofit.reconstruct.plant import CORE_CM, cylinder, find_support, largest_body
from phytofit.reconstruct.registration import Pair, Surface, exp_pose, log_pose, move_points, pair_quality, register
from phytofit.reconstruct.turntable import Turn, find_turn, moving_pixels, scene_without_plant, turn_model, turn_poses
from phytofit.reconstruct.views import surface_normals, view_points

__all__ = ["Placed", "Rejected", "Views", "place_by_poses", "place_on_turntable"]

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]
LEAST_PIXELS = 200  # of a plant in a view; fewer say nothing about where it stands
FULL_FRAME = 0.5  # share of an image's pixels that a plant may take
NEIGHBOUR_DEG = 70.0  # views that differ by less are matched
LEAST_OVERLAP = 0.3  # of a view with its neighbours, or it is suspect; for all views: the registration is
MOST_RESIDUAL_CM = 0.6  # median of a registration that is believed
FLAT = 0.1  # least flatness of a point whose normal is used to register
DRIFT_CM, DRIFT_RAD = 0.3, 0.005  # how far views may stray from the turntable or the poses given: a leaf sways
NOISE_CM, ALIKE = 0.2, 20.0  # of matched points; and how many neighbours count as one, as their errors are alike


@dataclass(frozen=True)
class Rejected:
    """A view that was left out, and why."""

    file: str
    reason: str


@dataclass
class Views:
    """The views still in use while they are worked on."""

    files: list[str]
    depths: list[FloatArray]
    order: list[str]  # all files, those rejected too
    rejected: list[Rejected] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)

    def keep(self, good: Sequence[bool], reason: Callable[[int], str]) -> None:
        """Reject the views that are not good."""
        self.rejected += [Rejected(self.files[i], reason(i)) for i in range(len(good)) if not good[i]]
        self.files = [file for file, yes in zip(self.files, good, strict=True) if yes]
        self.depths = [depth for depth, yes in zip(self.depths, good, strict=True) if yes]


@dataclass(frozen=True, eq=False)
class Placed:
    """Views in the world: poses (k, 4, 4), the pixels of the plant, and what is known of the registration."""

    poses: FloatArray
    masks: list[Mask]
    pairs: tuple[Pair, ...]
    turn: Turn | None = None
    step_deg: float | None = None
    loop: tuple[float, float] | None = None
    lowest_is_ground: bool = False  # no pot was found: the plant's lowest point becomes z = 0


def place_on_turntable(views: Views, camera: Camera, step_deg: float | None, progress: Callable[[str], None]) -> Placed:
    if len(views.files) < 3:
        left_out = "".join(f"; {r.file}: {r.reason}" for r in views.rejected)
        raise InputError(f"found {len(views.files)} usable views, expected at least 3 of a turntable{left_out}")
    progress("what turns")
    rays = camera.rays()
    scene = scene_without_plant(np.stack(views.depths))
    masks = _bodies([moving_pixels(depth, scene) for depth in views.depths], views.depths, rays)
    masks = _showing_plant(views, masks, "nothing turns in front of what stands still")
    if len(views.files) < 3:
        raise InputError(
            f"no plant in view: in {len(views.files)} of {len(views.files) + len(views.rejected)} views something "
            "turns in front of a still background, expected at least 3; does the camera stand still?"
        )
    _judge_frame(views, masks)
    clouds = [view_points(d, rays, m) for d, m in zip(views.depths, masks, strict=True)]
    turn = find_turn(clouds, step_deg=step_deg, progress=progress)
    progress("registration")
    turn, poses, pairs, good = _relaxed_turn(clouds, turn)
    if not all(good):
        masks = [m for m, yes in zip(masks, good, strict=True) if yes]
        quality = _overlaps(pairs, len(good))
        views.keep(good, lambda i: f"does not fit the others: overlap {100 * quality[i]:.0f} % with its neighbours")
        clouds = [c for c, yes in zip(clouds, good, strict=True) if yes]
        turn, poses, pairs, _ = _relaxed_turn(clouds, Turn(turn.up, turn.point, turn.angles[np.array(good)]))
    _believe(pairs, camera)
    step = _step(turn, views)
    loop = _loop_error(_surfaces(clouds), poses, turn)
    upright = _upright(turn)
    poses = upright @ poses
    still = view_points(np.where(np.isfinite(scene), scene, 0.0), rays, np.isfinite(scene))
    turning = np.concatenate([move_points(p, c) for p, c in zip(poses, clouds, strict=True)])
    support = find_support(move_points(upright, still), facing=0.0)
    r, _, z = cylinder(turning)
    ground = support.top if support else float(np.quantile(z, 0.001))
    full = []
    for depth, mask, pose in zip(views.depths, masks, poses, strict=True):
        seen = depth > 0
        points = move_points(pose, view_points(depth, rays, seen))
        r, _, z = cylinder(points)
        middle = (r < CORE_CM) & (z > ground) & (z < turning[:, 2].max())  # a stem on the axis stands still
        plant = mask[seen] | middle
        if support:
            plant &= ~support.covers(points)
        whole = np.zeros_like(mask)
        whole[seen] = plant
        full.append(whole)
    if support:
        crumbs = support.crumbs(np.concatenate([
            move_points(p, view_points(d, rays, m)) for p, d, m in zip(poses, views.depths, full, strict=True)
        ]))  # fmt: skip
        for mask, part in zip(full, np.split(crumbs, np.cumsum([m.sum() for m in full])[:-1]), strict=True):
            mask[mask] = ~part
    else:
        views.flags.append("no pot was found; if there is one, it is still in the cloud")
    drop = np.eye(4)
    drop[2, 3] = -ground
    return Placed(drop @ poses, full, pairs, turn, step, loop, lowest_is_ground=support is None)


def _bodies(
    masks: Sequence[Mask], depths: Sequence[FloatArray], rays: FloatArray, poses: FloatArray | None = None
) -> list[Mask]:
    """Of the pixels of each mask those of the largest body over all views."""
    clouds = [view_points(d, rays, m) for d, m in zip(depths, masks, strict=True)]
    if poses is not None:
        clouds = [move_points(p, c) for p, c in zip(poses, clouds, strict=True)]
    parts = largest_body(clouds)
    made = []
    for mask, part in zip(masks, parts, strict=True):
        whole = np.zeros_like(mask)
        whole[mask] = part
        made.append(whole)
    return made


def _showing_plant(views: Views, masks: list[Mask], reason: str) -> list[Mask]:
    n = np.array([mask.sum() for mask in masks])
    good = n >= max(LEAST_PIXELS, 0.1 * float(np.median(n)))
    views.keep(good.tolist(), lambda i: f"no plant in view: {reason} ({n[i]} pixels)")
    return [mask for mask, yes in zip(masks, good, strict=True) if yes]


def _judge_frame(views: Views, masks: Sequence[Mask]) -> None:
    """Flag views whose plant is cut by the image's edge; InputError if it fills the frame."""
    shares = [float(mask.mean()) for mask in masks]
    if np.median(shares) > FULL_FRAME:
        raise InputError(
            f"{views.files[0]} and the others: the plant fills the frame ({100 * float(np.median(shares)):.0f} % of "
            f"the pixels), expected less than {100 * FULL_FRAME:.0f} %; move the camera back"
        )
    edges = [int(sum(e.sum() for e in (m[:2].any(0), m[-2:].any(0), m[:, :2].any(1), m[:, -2:].any(1)))) for m in masks]
    cut = [file for file, n in zip(views.files, edges, strict=True) if n >= 3]
    if cut:
        views.flags.append(f"the plant is cut by the image's edge in {_names(cut)}; move the camera back")


def _names(files: Sequence[str]) -> str:
    return ", ".join(files[:3]) + (f" and {len(files) - 3} more" if len(files) > 3 else "")


def _surfaces(clouds: Sequence[FloatArray]) -> list[Surface]:
    made = []
    for cloud in clouds:
        normals, flat = surface_normals(cloud)
        keep = flat >= min(FLAT, float(np.quantile(flat, 0.5)))
        made.append(Surface(cloud[keep], normals[keep]))
    return made


def _relaxed_turn(clouds: Sequence[FloatArray], turn: Turn) -> tuple[Turn, FloatArray, tuple[Pair, ...], list[bool]]:
    """The turntable that fits best, then views that may stray a little from it; and which views fit the others."""
    surfaces = _surfaces(clouds)
    near = _near_in_angle(turn.angles)
    moved, n_parameters = turn_model(turn)
    x = register(surfaces, turn_poses(turn), near, lambda y: turn_poses(moved(y)), n_parameters)
    turn = moved(x)
    poses = _relaxed(surfaces, turn_poses(turn), near)
    pairs = tuple(pair_quality(surfaces, poses, i, j) for i, j in near)
    return turn, poses, pairs, _fitting(_overlaps(pairs, len(clouds)))


def place_by_poses(
    views: Views, given: dict[str, FloatArray], camera: Camera, progress: Callable[[str], None]
) -> Placed:
    """Views at known poses (camera to world, cm, z up), relaxed a little so that they fit each other.

    The plant is what is near the place that the cameras look at, without what stands round about it below.
    """
    if not views.files:
        raise InputError("no usable view: " + "; ".join(f"{r.file}: {r.reason}" for r in views.rejected))
    progress("finding the plant")
    rays = camera.rays()
    poses = np.stack([given[file] for file in views.files])
    focus, reach = _focus(poses, views.depths, rays)
    masks = []
    for depth, pose in zip(views.depths, poses, strict=True):
        masks.append(_within(depth, rays, pose, focus, reach))
    middle = np.eye(4)
    middle[:2, 3] = -focus[:2]
    everything = np.concatenate([move_points(middle @ p, view_points(d, rays, m))
                                 for p, d, m in zip(poses, views.depths, masks, strict=True)])  # fmt: skip
    support = find_support(everything, most_radius_cm=reach) if len(everything) else None
    if support:
        for mask, depth, pose in zip(masks, views.depths, poses, strict=True):
            mask[mask] = ~support.covers(move_points(middle @ pose, view_points(depth, rays, mask)))
    else:
        views.flags.append("no pot or ground was found; if there is one, it is still in the cloud")
    masks = _showing_plant(views, _bodies(masks, views.depths, rays, poses), "nothing stands where the cameras look")
    if not views.files:
        raise InputError("no plant in view: nothing stands where the cameras look; are poses, unit and camera right?")
    poses = np.stack([given[file] for file in views.files])
    _judge_frame(views, masks)
    progress("registration")
    clouds = [view_points(d, rays, m) for d, m in zip(views.depths, masks, strict=True)]
    surfaces = _surfaces(clouds)
    pairs: tuple[Pair, ...] = ()
    if len(views.files) > 1:
        near = _near_in_direction(poses)
        poses = _relaxed(surfaces, poses, near)
        pairs = tuple(pair_quality(surfaces, poses, i, j) for i, j in near)
        good = _fitting(_overlaps(pairs, len(poses)))
        if not all(good):
            quality = _overlaps(pairs, len(good))
            views.keep(good, lambda i: f"does not fit the others: overlap {100 * quality[i]:.0f} % with its neighbours")
            masks, poses = [m for m, yes in zip(masks, good, strict=True) if yes], poses[np.array(good)]
            new = {old: k for k, old in enumerate(np.flatnonzero(good).tolist())}
            pairs = tuple(
                Pair(new[p.first], new[p.second], p.overlap, p.residual_cm)
                for p in pairs if p.first in new and p.second in new
            )  # fmt: skip
        _believe(pairs, camera)
    return Placed(poses, masks, pairs)


def _focus(poses: FloatArray, depths: Sequence[FloatArray], rays: FloatArray) -> tuple[FloatArray, float]:
    """The place nearest to all optical axes, and how far around it the plant may reach, cm: to half way to the
    nearest camera.  One camera, or several that look the same way, look at the median depth of their middle."""
    centres, ahead = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    A = across.sum(axis=0)
    if np.linalg.eigvalsh(A)[0] > 0.05 * len(poses):
        place = np.linalg.solve(A, np.einsum("nij,nj->i", across, centres))
    else:
        h, w = depths[0].shape
        inner = np.stack([d[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3] for d in depths])
        middle = np.median(inner[inner > 0]) if (inner > 0).any() else 100.0
        place = (centres + ahead * middle).mean(axis=0)
    return place, 0.6 * float(np.linalg.norm(centres - place, axis=1).min())


def _within(depth: FloatArray, rays: FloatArray, pose: FloatArray, focus: FloatArray, reach: float) -> Mask:
    mask = depth > 0
    mask[mask] = np.linalg.norm(move_points(pose, view_points(depth, rays, mask)) - focus, axis=1) <= reach
    return mask


def _near_in_angle(angles: FloatArray) -> list[tuple[int, int]]:
    """Pairs of views that see the same sides of the plant."""
    n = len(angles)
    apart = np.abs((angles[:, None] - angles[None] + np.pi) % (2 * np.pi) - np.pi)
    most = max(np.radians(NEIGHBOUR_DEG), float(np.abs(np.diff(angles)).min(initial=np.pi)) * 1.1)
    return [(i, j) for i in range(n) for j in range(i + 1, n) if apart[i, j] <= most or j == i + 1]


def _near_in_direction(poses: FloatArray) -> list[tuple[int, int]]:
    """Pairs of views whose cameras look the same way within `NEIGHBOUR_DEG`; the nearest where none does."""
    n = len(poses)
    alike = poses[:, :3, 2] @ poses[:, :3, 2].T - 2 * np.eye(n)
    found = {(i, j) for i in range(n) for j in range(i + 1, n) if alike[i, j] >= np.cos(np.radians(NEIGHBOUR_DEG))}
    found |= {(min(i, j), max(i, j)) for i, j in enumerate(alike.argmax(axis=1).tolist())}
    return sorted(found)


def _relaxed(surfaces: Sequence[Surface], poses: FloatArray, near: Sequence[tuple[int, int]]) -> FloatArray:
    """Poses from which each view but the first may stray by about `DRIFT_CM` and `DRIFT_RAD`."""
    middles = [move_points(p, s.points.mean(axis=0)[None])[0] for p, s in zip(poses, surfaces, strict=True)]

    def strayed(x: FloatArray) -> FloatArray:
        made = poses.copy()
        for i, twist in enumerate(x.reshape(-1, 6), start=1):
            change = exp_pose(twist)
            change[:3, 3] += middles[i] - change[:3, :3] @ middles[i]  # turns about the plant
            made[i] = change @ poses[i]
        return made

    stiff = ALIKE * np.repeat([(NOISE_CM / DRIFT_RAD) ** 2, (NOISE_CM / DRIFT_CM) ** 2], 3)
    stiffness = np.tile(stiff, len(poses) - 1)
    return strayed(register(surfaces, poses, near, strayed, len(stiffness), stiffness=stiffness, reaches_cm=(1.0,)))


def _overlaps(pairs: Sequence[Pair], n: int) -> FloatArray:
    """The greatest overlap (n,) of each view with another."""
    best = np.zeros(n)
    for pair in pairs:
        for i in (pair.first, pair.second):
            best[i] = max(best[i], pair.overlap)
    return best


def _fitting(overlaps: FloatArray) -> list[bool]:
    return [bool(yes) for yes in (overlaps >= LEAST_OVERLAP) | (overlaps >= 0.5 * np.median(overlaps))]


def _believe(pairs: Sequence[Pair], camera: Camera) -> None:
    """InputError if the views don't fit each other at all."""
    if not pairs:
        return
    overlap = float(np.median([pair.overlap for pair in pairs if pair.second == pair.first + 1] or [0.0]))
    residual = float(np.nanmedian([pair.residual_cm for pair in pairs]))
    if overlap < LEAST_OVERLAP or residual > MOST_RESIDUAL_CM:
        raise InputError(
            f"the views don't fit each other: neighbours overlap by {100 * overlap:.0f} % with {residual:.2f} cm "
            f"between them, expected at least {100 * LEAST_OVERLAP:.0f} % and at most {MOST_RESIDUAL_CM:g} cm; is "
            f"the camera ({camera.name}, f = {camera.fx:g} pixels) right, are views in order, and steps at most 60°?"
        )


def _step(turn: Turn, views: Views) -> float:
    """The median step, degrees; views that were missed or doubled are flagged."""
    steps = np.degrees(np.diff(turn.angles))
    step = float(np.median(steps))
    for i, turned in enumerate(steps):
        a, b = views.files[i : i + 2]
        if abs(turned) < 0.4 * abs(step):
            views.flags.append(f"{b}: turned {abs(turned):.1f}° from {a}, the step is {abs(step):.1f}°; taken twice?")
        elif abs(turned) > 1.6 * abs(step) and views.order.index(b) == views.order.index(a) + 1:
            views.flags.append(
                f"{b}: turned {abs(turned):.1f}° from {a}, the step is {abs(step):.1f}°; is a view missing?"
            )
    covered = float(np.ptp(np.degrees(turn.angles)))
    if covered + 2.0 * abs(step) < 360.0:
        views.flags.append(f"the views cover {covered:.0f}° of the turn; the far side was not seen")
    return step


def _loop_error(surfaces: Sequence[Surface], poses: FloatArray, turn: Turn) -> tuple[float, float] | None:
    """Rotation, degrees, and shift of the plant's middle, cm, that are left when all pairs of neighbours are registered
    one by one and their motions are chained once around; None where the last view is too far from the first."""
    ring = list(range(len(surfaces)))
    order = sorted(ring, key=lambda i: (float(turn.angles[i] * np.sign(turn.angles[-1] or 1.0)) % (2 * np.pi), i))
    angles = np.mod(turn.angles[order] * np.sign(turn.angles[-1] or 1.0), 2 * np.pi)
    if np.max(np.diff(angles, append=angles[0] + 2 * np.pi)) > np.radians(NEIGHBOUR_DEG):
        return None
    chained = np.eye(4)
    start = turn_poses(turn)
    for a, b in zip(order, [*order[1:], order[0]], strict=True):
        two = np.stack([np.linalg.inv(start[a]) @ start[b], np.eye(4)])[::-1]  # b in the frame of a

        def free(x: FloatArray, two: FloatArray = two) -> FloatArray:
            return np.stack([two[0], two[1] @ exp_pose(x)])

        x = register([surfaces[a], surfaces[b]], two, [(0, 1)], free, 6, reaches_cm=(1.5, 1.0))
        chained = chained @ free(x)[1]
    middle = surfaces[order[0]].points.mean(axis=0)
    turned = float(np.degrees(np.linalg.norm(log_pose(chained)[:3])))
    return turned, float(np.linalg.norm(move_points(chained, middle[None])[0] - middle))


def _upright(turn: Turn) -> FloatArray:
    """The pose (4, 4) of the first camera's frame with the axis along z, and x towards the camera."""
    towards = -turn.point + (turn.point @ turn.up) * turn.up
    x = towards / np.linalg.norm(towards)
    R = np.stack([x, np.cross(turn.up, x), turn.up])
    upright = np.eye(4)
    upright[:3, :3], upright[:3, 3] = R, -R @ turn.point
    return upright
