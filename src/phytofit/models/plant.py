"""A whole grass: the organs of what the grammar writes, all leaves on one stem."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.models.grammar import Plant, Symbol
from phytofit.models.organs import STEM, Organ, frames_along, move
from phytofit.models.phytomer import Phytomer

__all__ = ["PlantOrgan", "plant_organs"]

FloatArray = NDArray[np.float64]
STEP_CM = 1.0  # of the stem's axis, at most
SHEATH_CM = 0.1  # thick, each
SHEATH_EDGE_CM = 0.3  # over which a sheath ends
BENT_THIRTIETHS = 27.0  # of a leaf, that bend: the last fifth of thirty does by half (section IV-B)
TOP_SHARE = 0.6  # of the stem's diameter at its last collar, that it has where its tassel or whorl begins
ROLLED_ANGLE, ROLLED_BEND = 4.0, 0.3  # deg of a rolled leaf, from the stem, and by thirtieth of its length
BRANCH_CM, SPIKE_SHARE = 0.3, 1.3  # diameter of a tassel's branch; length of its middle one, of the others
BRANCH_ANGLES = (12.0, 40.0)  # deg from the stem, of the highest and the lowest branch
PEDUNCLE = 0.6  # of a branch's length, from the last collar to the tassel
N_BRANCH = 8  # pieces of a branch


@dataclass(frozen=True)
class PlantOrgan:
    """An organ of a plant: ``kind`` is "stem" (with the sheaths around it), "blade", "whorl" (a leaf that is still
    rolled up) or "tassel" (one of its branches); ``rank`` that of a leaf, from the ground up, from 1; else 0."""

    kind: str
    rank: int
    organ: Organ


def plant_organs(
    plant: Plant,
    model: Phytomer,
    shapes: Mapping[int, ArrayLike] | None = None,
    *,
    lean: tuple[float, float] = (0.0, 0.0),
) -> list[PlantOrgan]:
    """Stem, blades, rolled leaves and tassel, cm; the foot of the stem at the origin, upwards +z.

    Parameters
    ----------
    model : of a leaf on its stem; its blade is that of each leaf
    shapes : by rank, the model's parameters after the seventh, as `Phytomer.PARAMETERS` names them: what the leaf does
        beyond the paper's model; none of a leaf that is not there
    lean : deg, by which the stem's direction turns from foot to top, towards +x and towards +y
    """
    internodes, sheaths, blades = plant.of("internode"), plant.of("sheath"), plant.of("blade")
    node = np.cumsum([it.values["length"] for it in internodes])
    collar = np.maximum.accumulate(node + np.array([it.values["length"] for it in sheaths]))
    stem = _stem(plant, node, collar, lean)
    nodes = np.append(0.0, np.cumsum(stem.segment_lengths))
    found = [PlantOrgan("stem", 0, stem)]
    for height, symbol in zip(collar.tolist(), blades, strict=True):
        radius = float(np.interp(height, nodes, stem.half_width))
        shape = np.asarray((shapes or {}).get(symbol.rank, ()), float)
        found.append(
            PlantOrgan("blade", symbol.rank, _blade(symbol, shape, model, _pose_at(stem, height, symbol), radius))
        )
    top = float(nodes[-1])
    for symbol in plant.of("whorl"):
        x = np.array([0.0, 0.0, ROLLED_ANGLE, symbol.values["length"], symbol.values["width"], ROLLED_BEND])
        leaf = model.organs(x)[1].row(0)
        found.append(PlantOrgan("whorl", symbol.rank, move([leaf], _pose_at(stem, top, symbol))[0]))
    found += [PlantOrgan("tassel", 0, it) for symbol in plant.of("tassel") for it in _tassel(symbol, stem, top)]
    return found


def _stem(plant: Plant, node: FloatArray, collar: FloatArray, lean: tuple[float, float]) -> Organ:
    """The stem up to its last collar and what rises from there, with its sheaths around it."""
    tassel = plant.of("tassel")
    top = float(collar[-1] + (PEDUNCLE * tassel[0].values["length"] if tassel else 0.0))
    edges = np.concatenate([node, node - SHEATH_EDGE_CM, collar, collar + SHEATH_EDGE_CM])
    even = np.linspace(0.0, top, max(2, int(np.ceil(top / STEP_CM)) + 1))
    z = np.unique(np.concatenate([even, edges[(edges > 0.0) & (edges < top)]]))
    diameter = np.array([it.values["diameter"] for it in plant.of("internode")])
    middle = node - 0.5 * np.diff(np.append(0.0, node))
    radius = 0.5 * np.interp(
        z, np.append(middle, max(top, middle[-1] + STEP_CM)), np.append(diameter, TOP_SHARE * diameter[-1])
    )
    for low, high in zip(node, collar, strict=True):
        radius = radius + SHEATH_CM * np.interp(
            z, [low - SHEATH_EDGE_CM, low, high, high + SHEATH_EDGE_CM], [0.0, 1.0, 1.0, 0.0]
        )
    turn = np.deg2rad(np.outer(0.5 * (z[1:] + z[:-1]) / top, lean))
    direction = np.column_stack([np.sin(turn), np.ones(len(turn))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    axis = np.concatenate([np.zeros((1, 3)), np.cumsum(direction * np.diff(z)[:, np.newaxis], axis=0)])
    return Organ(STEM, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), radius)


def _pose_at(stem: Organ, height: float, symbol: Symbol) -> FloatArray:
    """Pose (4, 4) of a phytomer's frame whose stem is the plant's at a length along it, and whose leaf has the symbol's
    azimuth: counter-clockwise, seen from above, from +x."""
    nodes = np.append(0.0, np.cumsum(stem.segment_lengths))
    piece = int(np.clip(np.searchsorted(nodes, height, side="right") - 1, 0, len(stem.frame) - 1))
    up = stem.frame[piece, :, 0]
    azimuth = np.deg2rad(symbol.values["azimuth"])
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([ahead, np.cross(up, ahead), up])
    pose[:3, 3] = stem.axis[piece] + (height - nodes[piece]) * up
    return pose


def _blade(symbol: Symbol, shape: FloatArray, model: Phytomer, pose: FloatArray, radius: float) -> Organ:
    values = symbol.values
    bend = values["bend"] / BENT_THIRTIETHS
    x = np.concatenate([[2.0 * radius, 0.0, values["angle"], values["length"], values["width"], bend, 0.0], shape])
    names = model.PARAMETERS
    if len(x) <= names.index("collar_offset"):
        x = np.append(x, 1.0)
    x[names.index("collar_offset")] = 1.0  # a leaf begins at the sheath's surface
    if len(x) > names.index("stem_diameter_above"):
        x[names.index("stem_diameter_above")] = 1.0
    return move([model.organs(x)[1].row(0)], pose)[0]


def _tassel(symbol: Symbol, stem: Organ, top: float) -> list[Organ]:
    """A spike that goes on as the stem does, and branches around it, the lower ones wider."""
    n, length = int(symbol.values["branches"]), symbol.values["length"]
    branches = []
    for i in range(n + 1):
        share = i / max(1, n)
        angle = np.deg2rad(0.0 if i == n else BRANCH_ANGLES[1] + share * (BRANCH_ANGLES[0] - BRANCH_ANGLES[1]))
        around = {"azimuth": 137.508 * i}  # the golden angle
        height = top - (0.0 if i == n else (1.0 - share) * 0.3 * length)
        pose = _pose_at(stem, max(height, 0.0), Symbol("tassel", 0, around))
        direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
        long = length * (SPIKE_SHARE if i == n else 1.0)
        axis = np.outer(np.linspace(0.0, long, N_BRANCH + 1), direction)
        half = 0.5 * BRANCH_CM * np.linspace(1.0, 0.5, N_BRANCH + 1)
        tube = Organ(STEM, axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), half)
        branches.append(move([tube], pose)[0])
    return branches
