"""Clouds become files."""

from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import numpy as np
import pandas as pd

from phytofit.cloud.cloud import PointCloud
from phytofit.cloud.table import COLOR, NORMAL, XYZ, Columns
from phytofit.errors import OutputError

__all__ = ["write_cloud"]


def write_cloud(path: str | Path, cloud: PointCloud, extra: Columns | None = None) -> None:
    """Write a cloud, in the unit and the frame it was read in: all of it, or nothing.

    The suffix says the format: ``.ply`` (binary, little endian) or ``.xyz`` (text under a line of names).  `extra` are
    more columns (n,), by name: 32-bit integers or doubles.

    Raises
    ------
    OutputError
        If the suffix is another one, or the file can't be written there.
    """
    path = Path(path)
    columns: Columns = dict(zip(XYZ, cloud.to_input_frame(cloud.points).T, strict=True))
    if cloud.labels is not None:
        columns["label"] = cloud.labels.astype(np.int32)
    if cloud.normals is not None:
        columns |= zip(NORMAL, cloud.normals.T, strict=True)
    if cloud.colors is not None:
        columns |= zip(COLOR, cloud.colors.T, strict=True)
    columns |= extra or {}
    frame = pd.DataFrame(columns)
    if path.suffix.lower() == ".ply":
        rows = frame.to_records(index=False)
        kinds = {"f": "double", "i": "int", "u": "uchar"}
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        lines += [f"property {kinds[column.dtype.kind]} {name}" for name, column in columns.items()]
        content = "\n".join([*lines, "end_header", ""]).encode() + rows.astype(rows.dtype.newbyteorder("<")).tobytes()
    elif path.suffix.lower() == ".xyz":
        content = frame.to_csv(sep=" ", index=False, lineterminator="\n").encode()
    else:
        raise OutputError(f"{path.name}: can't write {path.suffix!r} files, expected .ply or .xyz")
    temporary = path.with_name(f".{uuid4().hex}{path.suffix}")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: can't be written ({error}); choose a folder you can write to") from error
    finally:
        with suppress(OSError, ValueError):
            temporary.unlink()
