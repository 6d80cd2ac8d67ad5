"""LAS and LAZ."""

import io
import logging
import struct
from collections.abc import Collection

import laspy
import lazrs
import numpy as np

from phytofit.cloud.table import XYZ, FileError, Table, key_of

__all__ = ["read"]

logging.getLogger("laspy").addHandler(logging.NullHandler())  # or it prints what is raised here anyway


def read(data: bytes, wanted: Collection[str]) -> Table:
    if not data.startswith(b"LASF"):
        raise FileError(f"not a LAS file: it starts with {data[:16]!r}, expected 'LASF'")
    n_vlrs, n_evlrs = (struct.unpack_from("<I", data.ljust(375, b"\0"), at)[0] for at in (100, 243))
    if 54 * n_vlrs + (60 * n_evlrs if data[25] >= 4 else 0) > len(data):
        raise FileError(f"damaged: its LAS header declares {n_vlrs} more headers; copy it again")
    with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as file:
        if not _holds_points(data, file.header):
            raise FileError(f"truncated: it declares {file.header.point_count} points; copy it again")
        las = file.read()
    names = [*XYZ, *(name for name in las.point_format.dimension_names if name not in ("X", "Y", "Z"))]
    return Table({name: np.asarray(las[name]) for name in names if key_of(name) in wanted}, names)


def _holds_points(data: bytes, header: laspy.LasHeader) -> bool:
    """Say whether the declared points can be there: lazrs allocates them unseen, and aborts Python if that fails."""
    at, n_points, n_bytes = header.offset_to_point_data, header.point_count, header.point_format.size
    if not header.are_points_compressed:
        return bool(at + n_points * n_bytes <= len(data))
    table_at = struct.unpack_from("<q", data, at)[0]
    table_at = struct.unpack_from("<q", data, len(data) - 8)[0] if table_at == -1 else table_at
    n_chunks = struct.unpack_from("<I", data, table_at + 4)[0]
    if n_chunks * n_bytes > len(data) or n_points > 8 * len(data):  # no real point takes less than a bit
        return False
    vlr = header.vlrs.get("LasZipVlr")[0].record_data
    source = io.BytesIO(data)
    source.seek(at)
    chunks = lazrs.read_chunk_table(source, lazrs.LazVlr(vlr))
    items = struct.iter_unpack("<3H", vlr[34:])
    n_layers = sum({10: 9, 11: 1, 12: 2, 13: 1, 14: size}.get(kind, 0) for kind, size, _ in items)
    at += 8
    for _ in chunks if n_layers else ():  # a point, the number of points, the sizes of the layers, the layers
        at += n_bytes + 4
        at += 4 * n_layers + sum(struct.unpack_from(f"<{n_layers}I", data, at))
    return bool(at <= len(data) and sum(n for n, _ in chunks) >= n_points)
