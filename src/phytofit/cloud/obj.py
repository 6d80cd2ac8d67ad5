"""OBJ: the vertices of a mesh or a cloud, their colours, and the faces."""

from collections.abc import Collection

import numpy as np

from phytofit.cloud.encoding import decoded
from phytofit.cloud.numerals import numbers
from phytofit.cloud.table import COLOR, XYZ, FileError, Table

__all__ = ["read"]

COLUMNS = {3: XYZ, 4: (*XYZ, "w"), 6: (*XYZ, *COLOR), 7: (*XYZ, *COLOR, "alpha")}  # of a vertex, by their number


def read(data: bytes, wanted: Collection[str]) -> Table:
    """The vertices, and the faces; what a line continues in the next is joined."""
    vertices, faces = list[list[bytes]](), list[list[bytes]]()
    for line in decoded(data).replace("\\\n", " ").encode().split(b"\n"):
        match line.split():
            case [b"v", *words]:
                vertices.append(words)
            case [b"f", *corners]:
                faces.append([corner.partition(b"/")[0] for corner in corners])
    if not vertices:
        raise FileError("holds no vertices, expected lines 'v x y z'; is it an OBJ file?")
    widths = {len(words) for words in vertices}
    if len(widths) > 1 or not widths <= COLUMNS.keys():
        found = " and ".join(map(str, sorted(widths)[:3]))
        raise FileError(f"its vertices have {found} numbers, expected 3 (x y z) or 6 (and a colour) on each; damaged?")
    names = COLUMNS[len(vertices[0])]
    values = numbers([word for words in vertices for word in words]).reshape(len(vertices), -1)
    polygons = []
    for corners in faces:
        places = numbers(corners)
        places[places < 0] += len(vertices) + 1  # counted from the last one
        if not ((places >= 1) & (places <= len(vertices)) & (places == np.rint(places))).all():
            raise FileError(f"a face has corners beyond its {len(vertices)} vertices; truncated? export it again")
        polygons.append(places.astype(np.int64) - 1)
    return Table(list(zip(names, values.T, strict=True)), names, polygons)
