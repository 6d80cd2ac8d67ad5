"""Files become clouds: every reader turns bytes into a :class:`Table` of named columns, :func:`read_cloud` makes the
cloud of it.

What a file declares about itself is checked against its size before anything is allocated.  A reader is imported when
the first of its files is read.
"""

import os
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phytofit.cloud.cloud import PointCloud, from_points
from phytofit.cloud.encoding import content_fault, in_utf8
from phytofit.cloud.faces import sampled
from phytofit.cloud.table import COLOR, NORMAL, XYZ, Columns, FileError, Table, key_of, listed, quoted
from phytofit.errors import CloudError, SettingError
from phytofit.silence import silenced
from phytofit.text import one_line

__all__ = ["READERS", "as_cloud", "read_cloud"]

READERS = {
    **{".ply": "ply", ".pcd": "pcd", ".las": "las", ".laz": "las", ".e57": "e57", ".obj": "obj"},
    **dict.fromkeys((".xyz", ".txt", ".csv", ".pts", ".asc"), "columns"),
}
"""By suffix the module whose ``read`` makes a Table of bytes and of the keys of the columns wanted."""
OTHER_UNIT = "the file says that its unit is {}, but it was read in {}"


def read_cloud(
    path: str | os.PathLike[str],
    units: str | None = None,
    *,
    label_property: str | None = "label",
    sample_faces: int | None = None,
    plausible_cm: tuple[float, float] = (10.0, 250.0),
) -> PointCloud:
    """Read a point cloud; the file's suffix says the format (see :data:`READERS`).

    Parameters
    ----------
    path
        The file.
    units
        Unit of its coordinates: ``mm``, ``cm``, ``m``, or ``none`` for relative lengths.  Where it is None, the file's
        own counts: LAS, LAZ and E57 are in metres, and columns of text may say theirs (``X [mm]``); without any, the
        error shows the size in each unit.
    label_property
        Name of the property or column that holds the labels; only ``label`` may be missing.  ``scalar_label``, as
        CloudCompare writes it, counts as ``label``.  A column without a name is called by its number from 1, and
        never used unless it is asked for so.  None: labels are not read.
    sample_faces
        Take so many points, drawn uniformly from the area of the faces (PLY, OBJ), instead of the vertices; the
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
    called, data = one_line(path.name), _file_bytes(path)
    try:
        table = _table(data, path.suffix.lower(), label_property)
        columns, labels_from = _columns(table, label_property)
        n_faces = len(table.polygons)
        if sample_faces is not None:
            with np.errstate(all="ignore"):
                columns = sampled(columns, table.polygons, sample_faces)
    except FileError as error:
        raise CloudError(f"{called}: {error}") from error
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # the libraries raise anything, and a panic in lazrs is not even an Exception
        said = one_line(str(error).strip().partition("\n")[0])[:150] or type(error).__name__
        raise CloudError(f"{called}: can't be read as {path.suffix} ({said}); damaged or misnamed?") from error
    triples = {names: [columns[name] for name in names] for names in (XYZ, NORMAL, COLOR) if columns.keys() >= {*names}}
    stacked = {names: np.stack(arrays, axis=1) for names, arrays in triples.items()}
    cloud = from_points(
        stacked[XYZ],
        units or table.unit,
        labels=columns.get("label"),
        labels_from=labels_from,
        normals=stacked.get(NORMAL),
        colors=stacked.get(COLOR),
        name=path.stem,
        source=path,
        plausible_cm=plausible_cm,
    )
    for note in table.notes:
        cloud = cloud.with_note(note)
    if n_faces and sample_faces is None:
        cloud = cloud.with_note(f"a mesh of {n_faces} faces: its vertices are the points")
    return cloud if table.unit in (None, cloud.unit) else cloud.with_note(OTHER_UNIT.format(table.unit, cloud.unit))


def as_cloud(
    given: PointCloud | ArrayLike | str | os.PathLike[str],
    units: str | None = None,
    **how: Any,
) -> PointCloud:
    """A cloud as it is, or read from a file, or made of points (n, 3) in `units`; `how` as for :func:`read_cloud`.

    Raises SettingError where a cloud was read in another unit.
    """
    if isinstance(given, (str, os.PathLike)):
        return read_cloud(Path(given), units, **how)
    if not isinstance(given, PointCloud):
        return from_points(given, units, **how)
    if units not in (None, given.unit):
        raise SettingError(f"units: {given.name} was read in {given.unit}, got {units!r}; leave units out")
    return given


def _table(data: bytes, suffix: str, label_property: str | None) -> Table:
    if suffix not in READERS:
        raise FileError(f"unknown suffix '{one_line(suffix)}', expected one of {', '.join(READERS)}")
    if not data:
        raise FileError("the file is empty; was the export interrupted?")
    data = in_utf8(data)
    if fault := content_fault(data, suffix):
        raise FileError(fault)
    wanted = {*XYZ, *NORMAL, *COLOR} | ({label_property, key_of(label_property)} if label_property else set())
    with silenced(), np.errstate(all="ignore"):  # a wrong number is a finding, not a warning
        table: Table = import_module(f"phytofit.cloud.{READERS[suffix]}").read(data, wanted)
    return table


def _columns(table: Table, label_property: str | None) -> tuple[Columns, str | None]:
    """The columns of a cloud by their own names, and what the file calls its labels."""
    found = {name: table.column(name) for name in (*XYZ, *NORMAL, *COLOR)}
    labels = table.column(label_property) if label_property else None
    missing = [name for name in XYZ if found[name] is None]
    if missing:
        raise FileError(f"no property {', '.join(missing)}, found {listed(table.names)}; name them so")
    if label_property not in (None, "label") and labels is None:
        raise FileError(
            f"no property {quoted(label_property)} with labels, found {listed(table.names)}; choose one of these"
        )
    columns = {name: pair[1] for name, pair in (found | {"label": labels}).items() if pair is not None}
    return columns, labels[0] if labels else None


def _file_bytes(path: Path) -> bytes:
    shown = one_line(path)
    try:
        if path.is_file():
            return path.read_bytes()
        found = "is a folder" if path.is_dir() else "is a device or a pipe" if path.exists() else "no such file"
    except (OSError, ValueError, MemoryError) as error:
        raise CloudError(f"{shown}: can't be read ({one_line(error)}); check its permissions and its size") from error
    raise CloudError(f"{shown}: {found}, expected a file of points; check the path")
