"""Text in columns: XYZ, TXT, CSV, PTS, ASC."""

import io
import re
from collections.abc import Collection

import numpy as np
import pandas as pd

from phytofit.cloud.table import COLOR, NORMAL, XYZ, FileError, Table, key_of

__all__ = ["read"]


def read(data: bytes, wanted: Collection[str]) -> Table:
    if b"\0" in data:
        raise FileError("holds binary data, expected text with x y z on each line; is the suffix right?")
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    row = re.compile(rb"^[ \t]*(?!#|//)(?=\S).*", re.MULTILINE)
    first, n_points = row.search(data), None
    if first and re.fullmatch(rb"\s*\d{1,18}\s*", first[0]) and (second := row.search(data, first.end())):
        first, n_points = second, int(first[0])  # PTS
    if first is None:
        raise FileError("holds no rows, expected x y z on each line; was the export interrupted?")
    separator = next((mark for mark in ";," if mark.encode() in first[0]), None)
    words = [word.strip(" \t\"'") for word in first[0].decode("latin-1").split(separator)]
    if len(words) < 3:
        raise FileError(f"expected at least 3 columns (x y z), found {len(words)}; is this a 2-D export?")
    if len(words) > 1000:
        raise FileError(f"expected columns x y z and a few more, found {len(words)}; is it a table of points?")
    names, start = words, first.end()
    if all(re.fullmatch(r"(?i)[-+.\de]+|[-+]?(nan|inf)", word) for word in words):
        names, start = [], first.start()
    frame = pd.read_csv(
        io.BytesIO(re.sub(rb"^[ \t]*(#|//).*", b"", data[start:], flags=re.MULTILINE)),
        sep=separator or r"\s+",
        header=None,
        dtype={i: np.float64 if not names or key_of(names[i]) in wanted else str for i in range(len(words))},
        encoding="latin-1",
        skipinitialspace=True,
    )
    names = names or _guessed_names(frame, n_points is not None)
    if len(names) != frame.shape[1]:
        raise FileError(f"found {len(names)} column names over {frame.shape[1]} columns; name each column")
    if n_points not in (None, len(frame)):
        raise FileError(f"truncated: its first line declares {n_points} points, found {len(frame)}")
    return Table({name: frame[i].to_numpy() for i, name in enumerate(names) if key_of(name) in wanted}, names)


def _guessed_names(frame: pd.DataFrame, is_pts: bool) -> list[str]:
    values = frame.iloc[:, 3:].to_numpy()
    values = values[np.isfinite(values)]
    is_whole = (values == np.rint(values)).all()
    is_color = is_whole and ((values >= 0) & (values <= 255)).all()
    more = {3: (), 4: ("label",) if is_whole else ("intensity",), 6: COLOR if is_color else NORMAL}
    if is_pts:
        more |= {4: ("intensity",), 7: ("intensity", *COLOR)}
    if (n := frame.shape[1]) not in more:
        expected = "3 (x y z), 4 (and label) or 6 (and red green blue, or nx ny nz)"
        raise FileError(f"found {n} columns without names, expected {expected}; name them in the first line")
    return [*XYZ, *more[n]]
