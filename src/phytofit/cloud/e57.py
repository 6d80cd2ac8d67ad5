"""E57: all scans of the file, each moved to where it was taken from."""

import tempfile
from collections.abc import Collection
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phytofit.cloud.table import COLOR, XYZ, Columns, FileError, Table

__all__ = ["read"]

try:
    import pye57
except ImportError:
    pye57 = None

CARTESIAN = dict(zip(XYZ, ("cartesianX", "cartesianY", "cartesianZ"), strict=True))
COLORS = dict(zip(COLOR, ("colorRed", "colorGreen", "colorBlue"), strict=True))


def read(data: bytes, wanted: Collection[str]) -> Table:
    """The points of all scans in one frame, in metres, and their colours if all scans have them."""
    if pye57 is None:
        raise FileError("E57 files need the package pye57: pip install 'phytofit[e57]'")
    with tempfile.TemporaryDirectory() as folder:  # the library takes a name, and not every one
        path = Path(folder) / "cloud.e57"
        path.write_bytes(data)
        with closing(pye57.E57(str(path))) as file:
            scans = [  # no real point takes less than a bit
                _scan(file, i, most_points=8 * len(data)) for i in range(file.scan_count)
            ]
    if not scans:
        raise FileError("holds no scans, expected at least one; are there only images in it?")
    names = [name for name in (*XYZ, *COLOR) if all(name in scan for scan in scans)]
    columns = [(name, np.concatenate([scan[name] for scan in scans])) for name in names]
    notes = (f"{len(scans)} scans, read as one cloud",) if len(scans) > 1 else ()
    return Table(columns, names, unit="m", notes=notes)


def _scan(file: Any, index: int, most_points: int) -> Columns:
    """The points that the sensor saw in one scan, as the whole file has them."""
    n_points = file.get_header(index).point_count
    if n_points > most_points:
        raise FileError(f"damaged: it declares {n_points} points, more than it can hold; copy it again")
    if n_points == 0:
        return {name: np.empty(0) for name in XYZ}
    found: dict[str, NDArray[Any]] = file.read_scan(index, colors=True, ignore_missing_fields=True)
    return {name: found[field] for name, field in (CARTESIAN | COLORS).items() if field in found}
