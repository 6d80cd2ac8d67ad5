"""The noun of the pipeline's first stage: a point cloud in centimetres."""

import math
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.cloud.copies import is_single, places_of, unrounded
from phytofit.cloud.thinning import size_cm
from phytofit.cloud.units import SCALE_CM, checked_unit
from phytofit.errors import CloudError
from phytofit.text import one_line

__all__ = ["MIN_POINTS", "PointCloud", "from_points"]

MIN_POINTS = 100  # fewer can't carry a stem and a leaf
FAR_CM = 1e6  # coordinates beyond 10 km are map coordinates: their offset is subtracted
TOO_COARSE = 0.1  # of the cloud's size, in steps of which coordinates show no shape
FAR_STEPS = 2**22  # steps from the origin, beyond which single precision has no finer ones


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points and what is known of each; the arrays are read-only copies, CloudError if a shape is wrong."""

    points: NDArray[np.float64]  # (n, 3) cm
    labels: NDArray[np.int64] | None = None  # (n,) 0 unknown, 1 stem, 2.. leaves
    normals: NDArray[np.float64] | None = None  # (n, 3) components that are not known are 0
    colors: NDArray[np.uint8] | None = None  # (n, 3) red green blue
    name: str = "cloud"  # the file's stem
    source: Path | None = None
    unit: str = "cm"  # of the input: mm, cm, m or none
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))  # (3,) cm, was subtracted
    notes: tuple[str, ...] = ()  # plain-words remarks collected while reading
    labels_from: str | None = None  # the property or column that the labels were
    step: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))  # (3,) cm, of the coarse grid; 0: none

    def __post_init__(self) -> None:
        n = len(self.points)
        for key, dtype, shape in (
            ("points", np.float64, (n, 3)),
            ("labels", np.int64, (n,)),
            ("normals", np.float64, (n, 3)),
            ("colors", np.uint8, (n, 3)),
            ("offset", np.float64, (3,)),
            ("step", np.float64, (3,)),
        ):
            if getattr(self, key) is None:
                continue
            array = np.array(getattr(self, key), dtype=dtype)
            if array.shape != shape:
                raise CloudError(f"{self.name}: expected {key} of shape {shape}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: NDArray[np.bool_] | NDArray[np.integer]) -> "PointCloud":
        """Return the cloud of the points that `index` (boolean mask or integers) picks, in its order."""
        arrays: dict[str, Any] = {key: getattr(self, key) for key in ("points", "labels", "normals", "colors")}
        arrays |= {key: array[index] for key, array in arrays.items() if array is not None}
        return replace(self, **arrays)

    def to_input_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (m, 3), cm, in the unit and the frame that this cloud was read in."""
        shifted: NDArray[np.float64] = (points + self.offset) / SCALE_CM[self.unit]
        return shifted

    def from_input_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (m, 3) in the unit and the frame that this cloud was read in, as cm in its own."""
        shifted: NDArray[np.float64] = points * SCALE_CM[self.unit] - self.offset
        return shifted

    def unrounded(self) -> "PointCloud":
        """Return the cloud with its points off the coarse grid on which few digits put them, if they did."""
        return replace(self, points=unrounded(self.points, self.step)) if self.step.any() else self

    def with_note(self, text: str) -> "PointCloud":
        """Return the same cloud with one more remark."""
        return replace(self, notes=(*self.notes, text))


def from_points(
    points: ArrayLike,
    units: str | None,
    *,
    labels: ArrayLike | None = None,
    labels_from: str | None = None,
    normals: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    name: str = "cloud",
    source: Path | None = None,
    plausible_cm: tuple[float, float] = (10.0, 250.0),
) -> PointCloud:
    """Make a cloud from arrays: check them, drop what is no measured point, convert to centimetres.

    Parameters
    ----------
    points
        (n, 3), in `units`.  Dropped, with a note, are rows that are not finite, exact copies of others, and stacks of
        points at one place, where a sensor saw nothing; but for copies, one warning says so too.
    units
        ``mm``, ``cm``, ``m``, or ``none`` for relative lengths (no conversion and no check of the size).
    labels, labels_from
        (n,) whole numbers (0 unknown, 1 stem, 2.. leaves), NaN: unknown; and what they are called, for the notes.
    normals, colors
        (n, 3), what is not finite becomes 0; (n, 3) 0 to 255, fractions of 1, or 16 bit.
    name, source
        The cloud's name and the file it came from; messages call it by its file if there is one.
    plausible_cm
        The least and the greatest size (see :func:`size_cm`) that is believed, cm.

    Raises
    ------
    CloudError
        If the arrays don't fit each other, hold fewer than 100 finite points, or no extent.
    UnitError
        If the unit is missing, unknown, or gives a size outside `plausible_cm`.
    """
    called = one_line(source.name if source else name)
    xyz, finite, notes = _finite(called, points)
    places = places_of(xyz)
    notes += places.stacks
    if places.n_copies:
        notes += (f"{places.n_copies} exact cop{'ies' if places.n_copies > 1 else 'y'} of points dropped",)
    xyz, kept = xyz[places.kept], finite.copy()
    kept[finite] = places.kept
    if len(xyz) < MIN_POINTS:
        why = f" ({'; '.join(notes)})" if notes else ""
        raise CloudError(
            f"{called}: found {len(xyz)} points{why}, at least {MIN_POINTS} are needed to fit; is this the whole cloud?"
        )
    unit = checked_unit(called, units, size_cm(xyz), plausible_cm)
    if places.step.any():
        notes += (_few_digits(called, xyz, places.step, unit),)
    if lost := [note for note in notes if "exact cop" not in note]:
        warnings.warn(f"{called}: {'; '.join(lost)}", UserWarning, stacklevel=2)
    if labels is not None:
        labels, about = _whole_labels(called, _matching(called, "labels", labels, kept), labels_from)
        notes += (about,)
    xyz *= SCALE_CM[unit]
    offset = np.floor(xyz.min(axis=0)) if np.abs(xyz).max() > FAR_CM else np.zeros(3)
    return PointCloud(
        points=xyz - offset,
        labels=labels,
        normals=None if normals is None else _known(_matching(called, "normals", normals, kept)),
        colors=None if colors is None else _uint8(_matching(called, "colors", colors, kept)),
        name=name,
        source=source,
        unit=unit,
        offset=offset,
        notes=notes,
        labels_from=None if labels is None else labels_from,
        step=places.step * SCALE_CM[unit],
    )


def _finite(called: str, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_], tuple[str, ...]]:
    """The finite points (m, 3), which of those given they are (n,), and a note if some are not."""
    try:
        with np.errstate(invalid="ignore"):  # signalling NaNs
            xyz = np.array(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        said = one_line(error)[:200]
        raise CloudError(f"{called}: expected points of shape (n, 3), got something else: {said}") from error
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        hint = "; is this a 2-D export?" if xyz.shape[1:] == (2,) else ""
        raise CloudError(f"{called}: expected points of shape (n, 3), got {xyz.shape}{hint}")
    finite = np.asarray(np.isfinite(xyz).all(axis=1))
    n_dropped = len(xyz) - int(finite.sum())
    if n_dropped == len(xyz) > 0:
        raise CloudError(f"{called}: none of its {len(xyz)} points is finite; was the scan empty?")
    xyz = xyz[finite]
    if len(xyz) >= MIN_POINTS and (xyz == xyz[0]).all():
        raise CloudError(f"{called}: all {len(xyz)} points are equal; was it exported with too few digits?")
    if not math.isfinite(size_cm(xyz)):
        reach = f"{np.abs(xyz).max():.3g}"
        raise CloudError(f"{called}: coordinates reach {reach}, expected a plant's size; is the file damaged?")
    notes = (f"{n_dropped} non-finite point{'s' if n_dropped > 1 else ''} dropped",) if n_dropped else ()
    return xyz, finite, notes


def _few_digits(called: str, xyz: NDArray[np.float64], step: NDArray[np.float64], unit: str) -> str:
    """A note on coordinates in coarse steps; CloudError if they leave too few places."""
    n_places = len(np.unique(xyz, axis=0))
    is_map = is_single(xyz) and np.abs(xyz).max() > FAR_STEPS * step.max()
    steps = f"coordinates are in steps of {step.max():.3g} {'' if unit == 'none' else unit}".strip()
    cause = " (map coordinates in single precision)" if is_map else ""
    advice = "subtract an offset before the export, or write doubles" if is_map else "export it with more digits"
    if n_places < MIN_POINTS or step.max() > TOO_COARSE * size_cm(xyz):
        raise CloudError(f"{called}: {steps}{cause}, so that {len(xyz)} points share {n_places} positions; {advice}")
    return f"{steps}{cause}: digits are missing; {advice}"


def _matching(called: str, what: str, array: ArrayLike, finite: NDArray[np.bool_]) -> NDArray[np.float64]:
    try:
        with np.errstate(invalid="ignore"):
            rows = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CloudError(f"{called}: expected numbers as {what}, got something else: {error}") from error
    if rows.shape[:1] != finite.shape:
        raise CloudError(f"{called}: expected {what} for {len(finite)} points, got shape {rows.shape}")
    return rows[finite]


def _whole_labels(called: str, labels: NDArray[np.float64], name: str | None) -> tuple[NDArray[np.int64], str]:
    """Labels as whole numbers, 0 where there is none, and a note on them."""
    missing = np.isnan(labels)
    labels = np.where(missing, 0.0, labels)
    bad = labels[~((labels == np.rint(labels)) & (np.abs(labels) < 2**31))]
    of_property = f" of property '{one_line(name)}'" if name else ""
    if len(bad):
        expected = "whole numbers (0 unknown, 1 stem, 2.. leaves)"
        raise CloudError(f"{called}: found the label {bad[0]:g}{of_property}, expected {expected}")
    n_known = int(np.count_nonzero(labels))
    note = f"labels{of_property or ' given'} (1 stem, 2.. leaves): {n_known} of {len(labels)} points"
    return labels.astype(np.int64), note


def _known(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(normals), normals, 0.0)


def _uint8(colors: NDArray[np.float64]) -> NDArray[np.uint8]:
    colors = np.nan_to_num(colors, nan=0.0)
    top = colors.max()
    if top <= 1 and (colors != np.rint(colors)).any():  # fractions
        colors = colors * 255
    elif top > 255:  # 16 bit
        colors = colors / 257
    return np.asarray(np.rint(colors.clip(0, 255)), dtype=np.uint8)
