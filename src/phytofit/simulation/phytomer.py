"""Simulated phytomers: true organs to a cloud, with noise, removed spheres, outliers and a random pose."""

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import SettingError
from phytofit.models import Organ, move
from phytofit.parsing import checked_number, checked_whole
from phytofit.simulation.scan import MOST_CM, add_noise, anywhere, check_scan, occlude, seen_from
from phytofit.species import Species, load_species

__all__ = ["SimulatedPhytomer", "simulate"]

FloatArray = NDArray[np.float64]
ABOVE = "stem_length_above"


@dataclass(frozen=True)
class SimulatedPhytomer:
    """A cloud with its truth: ``points`` (n, 3) cm, ``labels`` (n,) 1 stem, 2 leaf, 0 outlier; ``x`` (k,); ``organs``
    in the cloud's frame; ``pose`` (4, 4) from the model's frame to the cloud's."""

    points: FloatArray
    labels: NDArray[np.int64]
    x: FloatArray
    organs: tuple[Organ, ...]
    pose: FloatArray


def simulate(
    species: Species | None = None,
    *,
    fixed: Mapping[str, float] | None = None,
    stem_above: str = "free",
    n_points: int = 5000,
    noise_cm: float = 0.5,
    noise_reach_cm: float = 0.0,
    n_views: int | None = None,
    n_spheres: int = 0,
    sphere_diameter_cm: float = 6.0,
    outlier_share: float = 0.0,
    random_orientation: bool = True,
    seed: int = 0,
) -> SimulatedPhytomer:
    """Draw a phytomer from the species' ranges and scan it.

    Defaults are the paper's simulated protocol (section V); `n_spheres` of `sphere_diameter_cm` are its occlusions
    (Fig. 7).  `fixed` gives parameters by name that are not to be drawn.  The stem above the leaf is drawn
    too ("free"), as long as that below ("equal"), or "none".  `n_points` are drawn before spheres are
    removed; `outlier_share` of the points that are left is added.  Noise is shared by neighbours as far as
    `noise_reach_cm`, as in fused and stereo clouds, or independent.  `n_views` cameras see the points, evenly
    spaced around the stem and looking down on it by `CAMERA_ABOVE_DEG`; None: from everywhere.
    """
    species = load_species() if species is None else species
    check_scan(n_points, noise_cm, noise_reach_cm, n_views, outlier_share, seed)
    checked_whole("spheres", n_spheres, 0)
    if not checked_number("sphere diameter", sphere_diameter_cm, most=MOST_CM) > 0:
        raise SettingError(f"sphere diameter: expected a positive number of cm, got {sphere_diameter_cm:g}")
    random = np.random.default_rng(seed)
    space = species.space
    low, high = species.ranges.T
    x = low.copy()
    x[low < high] = random.uniform(low[low < high], high[low < high])
    fixed = {} if fixed is None else fixed
    for name, value in fixed.items():
        i = space.index(name)
        low_end, high_end = float(space.lower[i]), min(float(space.upper[i]), MOST_CM)
        if isinstance(value, bool) or not isinstance(value, Real) or not low_end <= float(value) <= high_end:
            raise SettingError(
                f"{name}: expected a number within the species' bounds [{low_end:g}, {high_end:g}], got {value!r}"
            )
        x[i] = value
    model = species.with_stem_above(stem_above).model
    if stem_above != "free" and ABOVE in space.names:
        if ABOVE in fixed:
            raise SettingError(f"{ABOVE}: expected no value where stem_above is {stem_above!r}, got {fixed[ABOVE]:g}")
        x[space.index(ABOVE)] = model.stem_above * x[space.index("stem_length")]
    organs: tuple[Organ, ...] = tuple(o.row(0) for o in model.organs(x))
    points, organ = seen_from(organs, n_points, n_views, random)
    labels = organ + 1
    points = add_noise(points, noise_cm, random, noise_reach_cm)
    for _ in range(n_spheres):
        keep = occlude(points, sphere_diameter_cm, random)
        points, labels = points[keep], labels[keep]
        if len(points) == 0:
            raise SettingError(
                f"spheres: expected to leave some of the {n_points} points, but "
                f"{n_spheres} of {sphere_diameter_cm:g} cm remove all"
            )
    points, labels, pose = anywhere(points, labels, outlier_share, random, turned=random_orientation)
    return SimulatedPhytomer(points, labels, x, move(organs, pose), pose)
