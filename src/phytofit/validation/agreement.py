"""How well results agree with hand measures: bias, errors, correlation, concordance, coverage, outliers."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

__all__ = ["Agreement", "agreement", "concordance"]

FloatArray = NDArray[np.float64]
LIMITS = 1.96  # standard deviations of the differences to either side of their mean (Bland and Altman, 1986)
FAR_OFF, LEAST_FOR_OUTLIERS = 3.5, 5  # of the modified z-score (Iglewicz and Hoaglin, 1993); pairs


class Agreement(NamedTuple):
    """How well the results of a trait agree with the hand: differences are result minus measure, in ``unit``.

    ``bias`` their mean, ``rmse``, ``mae``; ``r`` Pearson's correlation and ``ccc`` Lin's concordance (NaN with fewer
    than three pairs); ``lower``, ``upper``: Bland and Altman's 95 % limits of agreement; ``coverage``: share of the
    measures within the results' intervals, of the ``n_intervals`` that there are; how many results are ``good``,
    ``check`` and ``poor`` (of older tables that is not known); ``outliers``: clouds whose difference is far from all
    the others'.
    """

    trait: str
    unit: str
    n: int
    bias: float
    rmse: float
    mae: float
    r: float
    ccc: float
    lower: float
    upper: float
    coverage: float
    n_intervals: int
    good: int
    check: int
    poor: int
    outliers: tuple[str, ...]


def agreement(pairs: pd.DataFrame) -> list[Agreement]:
    """The statistics of each trait of a comparison's pairs, in the order in which the traits come."""
    return [_agreement(trait, group) for trait, group in pairs.groupby("trait", sort=False)]


def _agreement(trait: object, group: pd.DataFrame) -> Agreement:
    measured, value = group["measured"].to_numpy(float), group["value"].to_numpy(float)
    low, high = group["low"].to_numpy(float), group["high"].to_numpy(float)
    given = np.isfinite(low) | np.isfinite(high)
    held = (np.nan_to_num(low, nan=-np.inf) <= measured) & (measured <= np.nan_to_num(high, nan=np.inf))
    difference = value - measured
    n, bias = len(difference), float(difference.mean())
    spread = float(difference.std(ddof=1)) if n > 1 else np.nan
    return Agreement(
        trait=str(trait),
        unit=str(group["unit"].iloc[0]),
        n=n,
        bias=bias,
        rmse=float(np.sqrt(np.mean(difference**2))),
        mae=float(np.mean(np.abs(difference))),
        r=_correlation(measured, value),
        ccc=concordance(measured, value),
        lower=bias - LIMITS * spread,
        upper=bias + LIMITS * spread,
        coverage=float(held[given].mean()) if given.any() else np.nan,
        n_intervals=int(given.sum()),
        good=int((group["quality"] == "good").sum()),
        check=int((group["quality"] == "check").sum()),
        poor=int((group["quality"] == "poor").sum()),
        outliers=tuple(group["cloud"].to_numpy()[_far_off(difference)]),
    )


def concordance(x: FloatArray, y: FloatArray) -> float:
    """Lin's concordance correlation coefficient (Biometrics 45, 1989) of x (n,) and y (n,); NaN of fewer than three."""
    if len(x) < 3:
        return np.nan
    both = float(np.mean((x - x.mean()) * (y - y.mean())))
    apart = float(np.var(x) + np.var(y) + (x.mean() - y.mean()) ** 2)
    return 2.0 * both / apart if apart > 0.0 else np.nan


def _correlation(x: FloatArray, y: FloatArray) -> float:
    if len(x) < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return np.nan
    return float(np.corrcoef(x, y)[0, 1])


def _far_off(difference: FloatArray) -> NDArray[np.bool_]:
    """Which (n,) differ from the median by much more than the others do, by the modified z-score."""
    off = np.abs(difference - np.median(difference))
    typical = float(np.median(off))
    if len(off) < LEAST_FOR_OUTLIERS or typical == 0.0:
        return np.zeros(len(off), bool)
    far: NDArray[np.bool_] = 0.6745 * off / typical > FAR_OFF
    return far
