"""The fitted model as a mesh for other programs: OBJ and GLB, each organ a part with a name."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from phytofit.cloud import PointCloud
from phytofit.errors import SettingError
from phytofit.io.replacing import whole_file
from phytofit.models import Organ, mesh
from phytofit.text import one_line

__all__ = ["MESHES", "check_meshes", "write_mesh"]

MESHES = ("ply", "obj", "glb")


def check_meshes(kinds: str | Sequence[str]) -> tuple[str, ...]:
    """The kinds, or the one, each once; SettingError if one is not among `MESHES`."""
    kinds = [kinds] if isinstance(kinds, str) else kinds
    for kind in kinds:
        if kind not in MESHES:
            raise SettingError(f"mesh: expected one of {', '.join(MESHES)}, got {one_line(kind)!r}")
    return tuple(dict.fromkeys(kinds))


def write_mesh(path: str | Path, organs: Sequence[Organ], cloud: PointCloud) -> None:
    """Write the organs as a mesh, in the unit and frame in which the cloud was read.

    The ending says the format, one of `MESHES`.  OBJ and GLB hold each organ as a part with its name: ``stem``,
    ``leaf``, or where there are more of a kind ``leaf_1`` and on.  PLY has no names, but colours.

    Raises SettingError for another ending, OutputError if the file can't be written.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    check_meshes([kind])
    if kind == "ply":
        content: Any = _placed(mesh(organs), cloud).export(file_type=kind)
    else:
        scene = trimesh.Scene()
        for name, organ in zip(_names(organs), organs, strict=True):
            scene.add_geometry(_placed(mesh([organ]), cloud), node_name=name, geom_name=name)
        content = scene.export(file_type=kind)
    if kind == "obj":  # as an object for some programs, as a group for others
        content = re.sub(r"(?m)^o (.+)$", r"o \1\ng \1", content)
    with whole_file(path) as hidden:
        hidden.write_bytes(content.encode() if isinstance(content, str) else content)


def _placed(part: trimesh.Trimesh, cloud: PointCloud) -> trimesh.Trimesh:
    part.vertices = cloud.to_input_frame(np.asarray(part.vertices))
    return part


def _names(organs: Sequence[Organ]) -> list[str]:
    kinds = [organ.kind for organ in organs]
    return [kind if kinds.count(kind) == 1 else f"{kind}_{kinds[: i + 1].count(kind)}" for i, kind in enumerate(kinds)]
