"""LAS and LAZ."""

import io
import logging
import math
import struct
from collections.abc import Collection

import laspy
import lazrs
import numpy as np

from phytofit.cloud.table import XYZ, FileError, Table, keys_of, quoted

__all__ = ["read"]

logging.getLogger("laspy").addHandler(logging.NullHandler())  # or it prints what is raised here anyway
POINT_FORMAT, LAST_POINT_FORMAT = 0x3F, 10  # bits of its byte that number it; the others mark LAZ
VERSION_OF_LONG_COUNT = (1, 4)  # since which the number of points has a field of 64 bits beside that of 32


def read(data: bytes, wanted: Collection[str]) -> Table:
    """The coordinates, in metres, and the dimensions wanted."""
    if not data.startswith(b"LASF"):
        raise FileError(f"not a LAS file: it starts with {quoted(data[:16].decode('latin-1'))}, expected 'LASF'")
    _check_header(data.ljust(375, b"\0"), len(data))
    with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as file:
        if not _holds_points(data, file.header):
            raise FileError(f"truncated: it declares {file.header.point_count} points; copy it again")
        las = file.read()
    names = [*XYZ, *(name for name in las.point_format.dimension_names if name not in ("X", "Y", "Z"))]
    return Table([(name, np.asarray(las[name])) for name in names if keys_of(name) & {*wanted}], names, unit="m")


def _check_header(header: bytes, n_bytes: int) -> None:
    """Raise FileError for a header that contradicts itself or the file's size, before anything is read by it."""
    version, is_new = f"{header[24]}.{header[25]}", (header[24], header[25]) >= VERSION_OF_LONG_COUNT
    start, n_vlrs, length, old_count, n_evlrs, long_count = (
        struct.unpack_from(kind, header, at)[0]
        for kind, at in (("<I", 96), ("<I", 100), ("<H", 105), ("<I", 107), ("<I", 243), ("<Q", 247))
    )
    if not "1.0" <= version <= "1.4" or header[104] & POINT_FORMAT > LAST_POINT_FORMAT:
        found = f"version {version} and point format {header[104] & POINT_FORMAT}"
        raise FileError(f"its LAS header has {found}, expected 1.0 to 1.4 and 0 to 10; export it again as LAS 1.2")
    if 54 * n_vlrs + (60 * n_evlrs if is_new else 0) > n_bytes:
        raise FileError(f"damaged: its LAS header declares {n_vlrs} more headers; copy it again")
    count = long_count if is_new else old_count
    if count == 0 and ((is_new and old_count) or start + length < n_bytes):
        elsewhere = f", and {old_count} in the field for versions before 1.4" if is_new and old_count else ""
        raise FileError(
            f"its LAS {version} header declares 0 points{elsewhere}, yet {n_bytes - start} bytes of them follow: "
            "the header is wrong; export the file again, or as LAS 1.2"
        )
    if is_new and 0 < old_count != count:
        raise FileError(
            f"its LAS {version} header declares {count} points, and {old_count} in the field for versions before 1.4; "
            "export it again"
        )
    scales = struct.unpack_from("<6d", header, 131)
    if not all(map(math.isfinite, scales)) or not all(scales[:3]):
        shown = ", ".join(f"{scale:g}" for scale in scales)
        raise FileError(f"its LAS header has the scales and offsets {shown}, expected finite numbers; export it again")


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
