"""How far the model's parameters are off on leaves that are not its own: what a species file's `discrepancy` rests on.

    python benchmarks/discrepancy.py [--leaves 80]

Errors of a fit have two sources: points that scatter, which the fit's covariance knows of, and a model that real leaves
do not quite follow, which no residual tells of where the whole organ is off (Kennedy and O'Hagan, J. R. Stat. Soc. B
63, 2001).  The second is learned here, on foreign leaves (foreign_leaves.py) as foreign.py's cameras see them, but on
others than foreign.py measures: numbers from 1000 on.

Each trait's error is taken to be that of its interval, plus what independent errors of a few parameters do to it: of
the diameter, angle, length and width themselves, and of the bend at the leaf's base.  Their spreads, a share of lengths
and degrees of angles, are the standard deviations of the greatest likelihood under Student's distribution with four
degrees of freedom: a few fits that are far off should not count for all.
"""

import argparse
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from common import progress
from foreign import TRAITS, cloud
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import t as student

import phytofit
from phytofit.parameters import ParameterSpace

FloatArray = NDArray[np.float64]
FIRST = 1000  # number of the first leaf
LEARNED = ("stem_diameter", "leaf_angle", "leaf_length", "leaf_width", "leaf_base_bend")
NORMAL = 1.96  # standard errors to either side of a 95 % interval
FREEDOM = 4.0
STEP = 1e-3  # of a parameter, as share or in degrees, for differences
START, LEAST = 0.02, 1e-4


class Leaf(NamedTuple):
    """Errors (t,) of the traits, standard errors (t,) on their side, and how the traits change (t, p) by one unit of
    discrepancy of each parameter that is learned."""

    error: FloatArray
    std: FloatArray
    change: FloatArray


def measured(number: int) -> Leaf | None:
    """None where the leaf was refused."""
    points, truth = cloud(number)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fit = phytofit.fit(phytofit.from_points(points, "cm"), species=_without(), threads=1)
    except phytofit.PhytofitError:
        return None
    traits = {trait.name: trait for trait in fit.traits}
    error = np.array([traits[name].value - truth[name] for name in TRAITS])
    below = np.array([traits[name].value - (traits[name].low or 0.0) for name in TRAITS])
    above = np.array([np.inf if (high := traits[name].high) is None else high - traits[name].value for name in TRAITS])
    change = np.stack([_change(fit, name) for name in LEARNED], axis=1)
    return Leaf(error, np.where(error > 0.0, below, above) / NORMAL, change)


def _without() -> phytofit.Species:
    """The species as if its model were that of all leaves."""
    species = phytofit.load_species()
    parameters = [replace(p, discrepancy=0.0) for p in species.space.parameters]
    return replace(species, space=ParameterSpace(parameters))


def _change(fit: phytofit.Fit, name: str) -> FloatArray:
    """Changes (t,) of the traits with a parameter, by a share of it or by a degree; 0 if the model has no such one."""
    space = fit.species.space
    if name not in space.names:
        return np.zeros(len(TRAITS))
    place = space.index(name)
    step = np.zeros(len(fit.x))
    step[place] = STEP * (abs(fit.x[place]) if space.units[place] == "cm" else 1.0)
    more, less = _traits_at(fit, fit.x + step), _traits_at(fit, fit.x - step)
    return (more - less) / (2.0 * STEP)


def _traits_at(fit: phytofit.Fit, x: FloatArray) -> FloatArray:
    traits = {t.name: t.value for t in phytofit.measure([organ.row(0) for organ in fit.species.model.organs(x)])}
    return np.array([traits[name] for name in TRAITS])


def learned(leaves: list[Leaf]) -> FloatArray:
    """The spreads (p,) of the parameters."""
    error, std, change = (np.array([getattr(leaf, name) for leaf in leaves]) for name in Leaf._fields)

    def surprise(logs: FloatArray) -> float:
        total = np.sqrt(std**2 + change**2 @ np.exp(2.0 * logs))
        known = np.isfinite(total)
        return -float(student.logpdf(error[known] / total[known], FREEDOM).sum() - np.log(total[known]).sum())

    start = np.log([START * (100.0 if name.endswith(("angle", "bend")) else 1.0) for name in LEARNED])
    found = minimize(surprise, start, method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-3, "fatol": 1e-3})
    of_normal = np.sqrt(FREEDOM / (FREEDOM - 2.0))  # standard deviations of Student's distribution of spread 1
    return np.maximum(of_normal * np.exp(found.x), LEAST)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--leaves", type=int, default=80)
    arguments = parser.parse_args()
    numbers = range(FIRST, FIRST + arguments.leaves)
    with ProcessPoolExecutor() as pool:
        found = [leaf for leaf in progress(pool.map(measured, numbers), len(numbers)) if leaf is not None]
    spreads = learned(found)
    print(f"\n{len(found)} of {len(numbers)} leaves; discrepancy of the parameters")
    for name, spread in zip(LEARNED, spreads.tolist(), strict=True):
        angle = name.endswith(("angle", "bend"))
        print(f"{name:20}{spread:9.3f} {'deg' if angle else 'of its value'}")
    error, std, change = (np.array([getattr(leaf, name) for leaf in found]) for name in Leaf._fields)
    total = np.sqrt(std**2 + change**2 @ spreads**2)
    print(f"\n{'':22}{'95 % holds':>12}{'with the discrepancy':>22}")
    for i, name in enumerate(TRAITS):
        held = [100.0 * np.mean(np.abs(error[:, i]) <= NORMAL * it[:, i]) for it in (std, total)]
        print(f"{name:22}{held[0]:10.1f} %{held[1]:20.1f} %")


if __name__ == "__main__":
    main()
