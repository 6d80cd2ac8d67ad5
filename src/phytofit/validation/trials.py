"""How good would it be with my sensor: simulated phytomers, scanned as it would scan them, fitted, beside the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from phytofit.errors import CloudError, NoPhytomerError, SettingError
from phytofit.fitting import fit
from phytofit.simulation import simulate
from phytofit.species import Species, load_species
from phytofit.traits import measure
from phytofit.validation.agreement import agreement
from phytofit.validation.matching import PAIR_COLUMNS, Comparison

__all__ = ["ENOUGH", "Trial", "needed", "share_within", "trial", "trial_table", "vary"]

MAIN_TRAITS = ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter")
N_POINTS = (300, 1000, 2500, 5000)
N_VIEWS = (1, 2, 3, 6)
ENOUGH = 0.9  # of the results have to be as near the truth as was asked for


@dataclass(frozen=True)
class Trial:
    """Results of simulated phytomers beside their truth: ``comparison.pairs`` has the truth as ``measured``, and
    ``comparison.unmatched`` says which clouds were refused, and why; ``n`` phytomers; ``sensor`` made the clouds:
    settings of :func:`phytofit.simulate`."""

    comparison: Comparison
    n: int
    sensor: Mapping[str, Any]


def trial(
    sensor: Mapping[str, Any],
    species: Species | None = None,
    *,
    number: int = 30,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[], None] | None = None,
) -> Trial:
    """Draw `number` phytomers from the species' ranges, scan them with the `sensor` (settings of
    :func:`phytofit.simulate`), and fit each.  The same `seed` draws the same phytomers for every sensor.

    progress : called before each phytomer
    """
    species = load_species() if species is None else species
    pairs, refused = [], []
    for i in range(number):
        name = f"phytomer_{i + 1:04d}"
        if progress is not None:
            progress()
        try:
            made = simulate(species, seed=seed + i, **sensor)
            result = fit(made.points, "cm", species=species, threads=threads)
        except (SettingError, CloudError, NoPhytomerError) as error:  # spheres may remove all points of one phytomer
            refused.append(f"{name}: {error}")
            continue
        for truth, found in zip(measure(made.organs), result.traits, strict=True):
            said = found.quality, ";".join(found.flags)
            pairs.append((name, found.name, found.unit, truth.value, found.value, found.low, found.high, *said, 1))
    table = pd.DataFrame(pairs, columns=PAIR_COLUMNS).astype(
        {**dict.fromkeys(PAIR_COLUMNS[3:7], float), "n_measured": int}
    )
    return Trial(Comparison(table, tuple(refused)), number, dict(sensor))


def vary(
    base: Trial,
    setting: str,
    values: Sequence[int],
    species: Species | None = None,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[], None] | None = None,
) -> dict[int, Trial]:
    """Trials with one setting of the base's sensor at each of the values, and all else as it is; the base's own where
    it has that value."""
    made = {}
    for value in values:
        if base.sensor.get(setting) == value:
            made[value] = base
            continue
        made[value] = trial(
            {**base.sensor, setting: value}, species, number=base.n, seed=seed, threads=threads, progress=progress
        )
    return made


def share_within(made: Trial, percent: float, degrees: float) -> dict[str, float]:
    """Share of the phytomers of which a trait came out within so many per cent, or degrees, of the truth; clouds that
    were refused count as not."""
    pairs = made.comparison.pairs
    off = (pairs["value"] - pairs["measured"]).abs()
    allowed = (pairs["measured"].abs() * percent / 100.0).where(pairs["unit"] != "deg", degrees)
    near = (off <= allowed).groupby(pairs["trait"]).sum()
    return {trait: float(near.get(trait, 0.0)) / made.n for trait in MAIN_TRAITS}


def needed(trials: Mapping[int, Trial], percent: float, degrees: float) -> dict[str, tuple[int | None, float]]:
    """For each main trait the least of the values from which on `ENOUGH` of the results are within so many per cent, or
    degrees, of the truth, None if there is no such; and the largest share at any value."""
    shares = {value: share_within(made, percent, degrees) for value, made in sorted(trials.items())}
    found: dict[str, tuple[int | None, float]] = {}
    for trait in MAIN_TRAITS:
        least = None
        for value in reversed(shares):
            if shares[value][trait] < ENOUGH:
                break
            least = value
        found[trait] = least, max(share[trait] for share in shares.values())
    return found


def trial_table(setting: str, trials: Mapping[int, Trial], percent: float, degrees: float) -> pd.DataFrame:
    """One row for each value of the setting and main trait: errors, share within, coverage, good, refused."""
    rows = []
    for value, made in sorted(trials.items()):
        share = share_within(made, percent, degrees)
        found = {a.trait: a for a in agreement(made.comparison.pairs)}
        for trait in MAIN_TRAITS:
            unit = "deg" if "angle" in trait else "cm"
            if trait not in found:
                rows.append((setting, value, trait, unit, 0, np.nan, np.nan, 0.0, np.nan, 0, made.n))
                continue
            a = found[trait]
            errors = (a.bias, a.rmse, share[trait], a.coverage)
            rows.append((setting, value, trait, unit, a.n, *errors, a.good, made.n - a.n))
    columns = ["setting", "value", "trait", "unit", "n", "bias", "rmse", "within", "coverage", "good", "refused"]
    return pd.DataFrame(rows, columns=columns)
