"""Files become clouds: every reader turns bytes into a :class:`Table` of named columns, :func:`read_cloud` makes the
cloud of it.

What a file declares about itself is checked against its size before anything is allocated.  A reader is imported when
the first of its files is read.
"""

from importlib import import_module
from pathlib import Path

import numpy as np

from phytofit.cloud.cloud import PointCloud, from_points
from phytofit.cloud.faces import sampled
from phytofit.cloud.table import COLOR, NORMAL, XYZ, FileError, Table, key_of
from phytofit.errors import CloudError

__all__ = ["READERS", "read_cloud"]

READERS = {
    **{".ply": "ply", ".pcd": "pcd", ".las": "las", ".laz": "las"},
    **dict.fromkeys((".xyz", ".txt", ".csv", ".pts", ".asc"), "columns"),
}
"""By suffix the module whose ``read`` makes a Table of bytes and of the keys of the columns wanted."""


def read_cloud(
    path: str | Path,
    units: str | None = None,
    *,
    label_property: str = "label",
    sample_faces: int | None = None,
    plausible_cm: tuple[float, float] = (10.0, 250.0),
) -> PointCloud:
    """Read a point cloud; the file's suffix says the format (see :data:`READERS`).

    Parameters
    ----------
    path
        The file.
    units
        Unit of its coordinates: ``mm``, ``cm``, ``m``, or ``none`` for relative lengths.  LAS and LAZ are in
        ``m`` unless told otherwise; for the others None raises the error that shows the size in each unit.
    label_property
        Name of the property or column that holds the labels; only ``label`` may be missing.
    sample_faces
        Take so many points, drawn uniformly from the area of the faces (PLY), instead of the vertices; the
        draw is always the same.  Label, colour and normal are those of the nearest corner.
    plausible_cm
        The least and the greatest size that is believed, cm.

    Raises
    ------
    CloudError
        If the file can't be read, isn't what its suffix says, is damaged, or holds too few points.
    UnitError
        If the unit is missing or doesn't fit the cloud's size.
    """
    path = Path(path)
    data = _file_bytes(path)
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise CloudError(f"{path.name}: unknown suffix {suffix!r}, expected one of {', '.join(READERS)}")
    if not data:
        raise CloudError(f"{path.name}: the file is empty; was the export interrupted?")
    label_key = key_of(label_property)
    try:
        with np.errstate(all="ignore"):  # a wrong number is a finding, not a warning
            table: Table = import_module(f"phytofit.cloud.{READERS[suffix]}").read(
                data, {*XYZ, *NORMAL, *COLOR, label_key}
            )
            columns = {key_of(name): column for name, column in table.columns.items()}
            needed = XYZ if label_property == "label" else (*XYZ, label_property)
            if missing := [name for name in needed if key_of(name) not in columns]:
                raise FileError(f"no property {', '.join(missing)}, found {table.names}; name them so")
            if sample_faces is not None:
                columns = sampled(columns, table.polygons, sample_faces)
            triples = [names for names in (XYZ, NORMAL, COLOR) if columns.keys() >= {*names}]
            stacked = {names: np.stack([columns[name] for name in names], axis=1) for names in triples}
    except FileError as error:
        raise CloudError(f"{path.name}: {error}") from error
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # the libraries raise anything, and a panic in lazrs is not even an Exception
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise CloudError(f"{path.name}: can't be read as {suffix} ({said}); damaged or misnamed?") from error
    return from_points(
        stacked[XYZ],
        "m" if units is None and suffix in (".las", ".laz") else units,
        labels=columns.get(label_key),
        normals=stacked.get(NORMAL),
        colors=stacked.get(COLOR),
        name=path.stem,
        source=path,
        plausible_cm=plausible_cm,
    )


def _file_bytes(path: Path) -> bytes:
    try:
        if path.is_file():
            return path.read_bytes()
        found = "is a folder" if path.is_dir() else "no such file"
    except (OSError, ValueError, MemoryError) as error:
        raise CloudError(f"{path}: can't be read ({error}); check its permissions and its size") from error
    raise CloudError(f"{path}: {found}, expected a file of points; check the path")
