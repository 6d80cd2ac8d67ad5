"""How far the default method's numbers and intervals can be trusted; prints every number that is claimed of it.

    python benchmarks/trust.py [protocol] [correlated] [real] [maize] [seconds] [--phytomers N]

protocol   the paper's simulated phytomers: correlation with the truth, errors beside the Cramer-Rao bound, coverage of
           the 95 % intervals
correlated the same with noise that is correlated along the surface, as that of fused and stereo clouds
seconds    wall time of a fit, beside the paper's method in the same run
real       the paper's clouds in ../shared/data/sodhi2018: values, intervals, hand measures, the authors' parameters
maize      leaves of the synthetic maize plants in ../shared/data/openalea_synthetic_maize, which another program made
"""

import argparse
import csv
import json
import os
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import numpy as np
import trimesh
from accuracy import HAND
from common import DATA, clouds, progress, read, run_parts
from scipy.spatial import cKDTree

import phytofit
import phytofit.models
import phytofit.simulation
from phytofit.engine.posterior import Posterior
from phytofit.models.organs import frames_along

SPECIES = phytofit.load_species()
N_PARAMETERS = 7  # of the simulated phytomers; the others are at their neutral values
BOUND_SAMPLE = 40_000  # points by which the Cramer-Rao bound is averaged
NO_OUTLIERS = -9.0  # logit of their share
FIRST_SEED = 500_000  # not those of accuracy.py


class Job(NamedTuple):
    """One simulated phytomer: its number, the points, the noise, cm, and how far it is correlated, cm."""

    number: int
    n_points: int = 5000
    noise_cm: float = 0.5
    correlated_cm: float = 0.0


class Row(NamedTuple):
    """What became of it; `covered` is NaN where there is no interval."""

    x: np.ndarray
    fitted: np.ndarray
    covered_x: np.ndarray
    traits: np.ndarray
    measured: np.ndarray
    covered: np.ndarray
    bound: np.ndarray
    flags: tuple[str, ...]
    n_parameters: int


def fit_simulated(job: Job) -> Row:
    seed = FIRST_SEED + job.number
    noise = 0.0 if job.correlated_cm else job.noise_cm
    made = phytofit.simulate(SPECIES, n_points=job.n_points, noise_cm=noise, seed=seed)
    points = made.points
    if job.correlated_cm:
        points = phytofit.simulation.add_noise(points, job.noise_cm, np.random.default_rng(seed), job.correlated_cm)
    result = phytofit.fit(points, "cm", seed=0, threads=1)
    truth = phytofit.measure(made.organs)
    low, high = np.array(list(result.parameter_intervals.values()))[:N_PARAMETERS].T
    x = made.x[:N_PARAMETERS]
    return Row(
        x,
        result.x[:N_PARAMETERS],
        (low <= x) & (x <= high),
        np.array([t.value for t in truth]),
        np.array([t.value for t in result.traits]),
        np.array([covers(fitted, true.value) for fitted, true in zip(result.traits, truth, strict=True)]),
        cramer_rao(made, job) if not job.correlated_cm else np.full(N_PARAMETERS, np.nan),
        result.flags,
        len(result.x),
    )


def covers(trait: phytofit.Trait, value: float) -> float:
    if trait.low is None and trait.high is None:
        return np.nan
    return float((trait.low is None or trait.low <= value) and (trait.high is None or value <= trait.high))


def cramer_rao(made: phytofit.SimulatedPhytomer, job: Job) -> np.ndarray:
    """Least standard error (7,) of an unbiased estimate from so many points, pose, noise and shares unknown.

    The Fisher information is the mean of the scores' outer product over many points of the true model.
    """
    random = np.random.default_rng(0)
    points, _ = phytofit.models.SurfaceSampler(BOUND_SAMPLE, 1).draw(made.organs)
    points = points + random.normal(0.0, job.noise_cm, points.shape)
    species = SPECIES.leading(N_PARAMETERS)
    likelihood = Posterior.of(species, points)
    state = likelihood.start(made.x[:N_PARAMETERS], made.pose, job.noise_cm)
    stem, leaf = (organ.area for organ in made.organs)
    noise = np.log(job.noise_cm)
    true = state.changed(stem_noise=noise, leaf_noise=noise, stem_share=np.log(stem / leaf), outlier_share=NO_OUTLIERS)
    scores = likelihood.evaluate(true).scores
    keep = state.layout.mask(*species.space.names, "turn", "shift", "stem_noise", "leaf_noise", "stem_share")
    information = scores[:, keep].T @ scores[:, keep] * (job.n_points / BOUND_SAMPLE)
    return np.sqrt(np.diag(np.linalg.inv(information)))[:N_PARAMETERS]


def report(rows: list[Row]) -> None:
    names = SPECIES.space.names[:N_PARAMETERS]
    x, fitted, covered, bound = (np.array([getattr(r, f) for r in rows]) for f in ("x", "fitted", "covered_x", "bound"))
    flagged = np.array([bool(r.flags) for r in rows])
    print(
        f"{len(rows)} phytomers, {flagged.sum()} flagged; "
        f"the paper's model kept in {sum(r.n_parameters <= N_PARAMETERS for r in rows)}"
    )
    for flag, number in Counter(flag for r in rows for flag in r.flags).most_common():
        print(f"  {number:4} {flag}")
    print(
        f"{'':22}{'R':>8}{'RMSE':>8}{'bias':>8}{'bound':>8}{'ratio':>7}{'covered':>9}   "
        "(of all; coverage of the unflagged)"
    )
    for k, name in enumerate(names):
        line(name, x[:, k], fitted[:, k], covered[~flagged, k], np.sqrt(np.mean(bound[:, k] ** 2)))
    traits, measured, covered = (np.array([getattr(r, f) for r in rows]) for f in ("traits", "measured", "covered"))
    for k, trait in enumerate(phytofit.measure(phytofit.simulate(SPECIES).organs)):
        line(trait.name, traits[:, k], measured[:, k], covered[~flagged, k])


def line(name: str, true: np.ndarray, fitted: np.ndarray, covered: np.ndarray, bound: float = np.nan) -> None:
    error = fitted - true
    rmse = np.sqrt(np.mean(error**2))
    r = np.corrcoef(true, fitted)[0, 1]
    ratio = "" if np.isnan(bound) else f"{bound:8.3f}{rmse / bound:7.2f}"
    print(f"{name:22}{r:8.4f}{rmse:8.3f}{error.mean():8.3f}{ratio:15}{100 * np.nanmean(covered):8.1f} %")


def protocol(pool: ProcessPoolExecutor, phytomers: int) -> None:
    print("\nThe paper's protocol: 5,000 points, 0.5 cm noise", flush=True)
    report(list(progress(pool.map(fit_simulated, [Job(i) for i in range(phytomers)]), phytomers)))


def correlated(pool: ProcessPoolExecutor, phytomers: int) -> None:
    print("\nThe same with noise correlated over 2 cm", flush=True)
    jobs = [Job(i, correlated_cm=2.0) for i in range(phytomers)]
    report(list(progress(pool.map(fit_simulated, jobs), phytomers)))


def real(pool: ProcessPoolExecutor) -> None:
    paths = clouds()
    results = dict(zip(paths, pool.map(fit_real, paths), strict=True))
    with (DATA / "greenhouse" / "ground_truth.csv").open() as file:
        hand = {row["cloud"]: row for row in csv.DictReader(file)}
    print("\nGreenhouse and field clouds: fitted trait, its interval, hand measure")
    held, errors = 0, {name: [] for name in HAND}
    for path in paths:
        if "simulated" in path.parts:
            continue
        result = results[path]
        print(f"{path.stem}  {'; '.join(result.flags)}")
        for trait in result.traits:
            if trait.name not in HAND:
                continue
            measure = float(hand[path.stem][HAND[trait.name]]) if path.stem in hand else np.nan
            if path.stem in hand:
                held += bool(covers(trait, measure))
                error = trait.value - measure
                errors[trait.name].append(abs(error) if trait.unit == "deg" else 100 * abs(error) / measure)
            print(f"  {trait.name:16}{trait.value:8.2f}{interval(trait):>20}{measure:9.2f}")
    print(f"hand measures within the interval: {held} of {sum(map(len, errors.values()))}")
    for name, values in errors.items():
        print(f"  {name:16} mean absolute error {np.mean(values):5.1f} {'deg' if name == 'leaf_angle' else '%'}")
    print("\nThe authors' simulated clouds: fitted parameter (theirs); below, trait and interval (of their organs)")
    print(f"{'':18}" + "".join(f"{name:>30}" for name in HAND))
    for path in paths:
        if "simulated" in path.parts:
            theirs = dict(row.split() for row in path.with_suffix(".txt").read_text().splitlines())
            parameters = results[path].parameters
            cells = "".join(f"{parameters[n]:21.2f} ({float(theirs[n]):6.2f})" for n in HAND)
            print(f"{path.parent.name}/{path.stem:6}{cells}  {'; '.join(results[path].flags)}")
            true = {t.name: t.value for t in phytofit.measure(authors_organs(theirs))}
            fitted = {t.name: t for t in results[path].traits}
            cells = (f"{fitted[n].value:.2f} [{interval(fitted[n])}] ({true[n]:6.2f})" for n in HAND)
            print(f"{'':18}" + "".join(f"{cell:>30}" for cell in cells))


def authors_organs(theirs: dict[str, str]) -> tuple[phytofit.models.Organ, ...]:
    """Stem and leaf as the authors' generator grows them, up to where the leaf hangs down: the stem is twice its
    internode, the leaf starts at its surface, and each piece bends by 1.5 degrees more than their parameter says.  As
    the points of their clouds without noise lie, their leaf has its width up to a third of its length, is wider by a
    fifth from there on, and narrows as Eq. (2) says; its last piece has no points."""
    value = {name: float(text) for name, text in theirs.items()}
    stem = value["stem_internode_len"]
    leaf = value["leaf_angle"], value["leaf_length"], value["leaf_width"], value["leaf_rotate_angle"] + 1.5
    x = np.array([value["stem_diameter"], stem, *leaf, stem, 1.0])
    tube, strip = (organ.row(0) for organ in SPECIES.model.organs(x))
    n = SPECIES.model.n_pieces
    profile = SPECIES.model.width_profile(widest=np.array([1.0 / 3.0]))[0]
    profile[np.arange(n + 1) > n // 3] *= 1.2
    return tube, replace(strip, half_width=0.5 * value["leaf_width"] * profile).until((n - 1.0) / n)


class Leaf(NamedTuple):
    """A leaf cut from a synthetic maize plant: its name, points, and true organs."""

    name: str
    points: np.ndarray
    organs: tuple[phytofit.models.Organ, phytofit.models.Organ]


def maize_leaves(noise_cm: float = 0.3, n_points: int = 5000) -> list[Leaf]:
    """Each leaf with the stem from 15 cm below to 10 cm above its insertion, where the stem is 8 cm long or more.

    A leaf's mesh is a thin box about a midrib that lies up to the stem's radius off the polyline, which starts on the
    stem's axis; points are drawn from the mesh, so the truth is the middle of its sections.
    """
    leaves = []
    for folder in sorted((DATA.parent / "openalea_synthetic_maize").iterdir()):
        true = json.loads((folder / "synthetic_plant.json").read_text())
        mesh = trimesh.load(folder / "synthetic_plant.ply", process=False)
        parts = mesh.split(only_watertight=False)
        nodes = np.array([node for i, node in enumerate(true["stem"]) if node not in true["stem"][:i]])
        for number, polyline in enumerate(true["leaf_polylines"], start=1):
            line = np.array(polyline)
            low, high = max(0.0, line[0, 2] - 15.0), min(nodes[-1, 2], line[0, 2] + 10.0)
            if high - low < 8.0:
                continue
            part = min(parts, key=lambda part: cKDTree(part.vertices).query(line[:, :3])[0].mean())
            keep = np.concatenate([[low], nodes[(nodes[:, 2] > low) & (nodes[:, 2] < high), 2], [high]])
            axis = np.zeros((len(keep), 3))
            axis[:, 2] = keep
            radius = 0.5 * np.interp(keep, nodes[:, 2], nodes[:, 3])
            stem = phytofit.models.Organ("stem", axis, frames_along(axis, np.array([0.0, 1.0, 0.0])), radius)
            sections, tip = part.vertices[np.delete(np.arange(389), 97)].reshape(4, 97, 3), part.vertices[97]
            across = sections[0] - sections[1]
            width = np.append(np.linalg.norm(across, axis=1), 0.0)
            middle = np.concatenate([sections.mean(axis=0), [tip]])
            level = across / np.maximum(width[:-1, np.newaxis], 1e-9)
            blade = phytofit.models.Organ("leaf", middle, frames_along(middle, level), 0.5 * width)
            random = np.random.default_rng(number)
            on_stem = round(n_points * float(stem.area) / float(stem.area + part.area))
            on_leaf = trimesh.sample.sample_surface(part, n_points - on_stem, seed=number)[0]
            points = np.concatenate(
                [phytofit.models.SurfaceSampler(on_stem, number, even=False).draw([stem])[0], on_leaf]
            )
            points += random.normal(0.0, noise_cm, points.shape)
            leaves.append(Leaf(f"{folder.name[-7:]} leaf {number}", points, (stem, blade)))
    return leaves


def fit_maize(leaf: Leaf) -> phytofit.Fit:
    return phytofit.fit(leaf.points, "cm", up="z", threads=1)


def maize(pool: ProcessPoolExecutor) -> None:
    leaves = maize_leaves()
    print(f"\nSynthetic maize of another generator, {len(leaves)} leaves, 0.3 cm noise: fitted trait, interval, truth")
    errors, held = {name: [] for name in HAND}, []
    for leaf, result in zip(leaves, progress(pool.map(fit_maize, leaves), len(leaves)), strict=True):
        print(f"{leaf.name}  {'; '.join(result.flags)}")
        truth = {t.name: t for t in phytofit.measure(leaf.organs)}
        for trait in result.traits:
            if trait.name not in HAND:
                continue
            true = truth[trait.name].value
            error = trait.value - true
            errors[trait.name].append(abs(error) if trait.unit == "deg" else 100 * abs(error) / true)
            held.append(covers(trait, true))
            print(f"  {trait.name:16}{trait.value:8.2f}{interval(trait):>20}{true:9.2f}")
    print(f"truths within the interval: {np.nansum(held):.0f} of {np.isfinite(held).sum()}")
    for name, values in errors.items():
        unit = "deg" if name == "leaf_angle" else "%"
        print(f"  {name:16} absolute error: median {np.median(values):5.1f}, mean {np.mean(values):5.1f} {unit}")


def interval(trait: phytofit.Trait) -> str:
    return " - ".join("" if end is None else f"{end:.2f}" for end in (trait.low, trait.high))


def fit_real(path: Path) -> phytofit.Fit:
    return phytofit.fit(read(path), threads=1)


def seconds(pool: ProcessPoolExecutor, phytomers: int = 15) -> None:
    """Not in the pool: each fit has all cores."""
    taken: dict[str, list[float]] = {"likelihood": [], "paper": []}
    phytofit.fit(phytofit.simulate(SPECIES, n_points=1000).points, "cm")  # compiles
    for number in range(phytomers):
        points = phytofit.simulate(SPECIES, seed=FIRST_SEED + number).points
        for method, times in taken.items():
            if method == "paper" and number % 5:
                continue
            start = time.perf_counter()
            phytofit.fit(points, "cm", method=method)
            times.append(time.perf_counter() - start)
    ours, paper = (float(np.median(times)) for times in taken.values())
    print(f"\nA fit of 5,000 points on {os.cpu_count()} cores, kernels compiled, median: {ours:.2f} s")
    print(f"the paper's method at its settings, in turn: {paper:.2f} s, {paper / ours:.1f} times as long")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="some of the parts above; all by default")
    parser.add_argument("--phytomers", type=int, help="1000 in protocol, 300 in correlated, by default")
    arguments = parser.parse_args()
    parts = {
        "protocol": lambda pool: protocol(pool, arguments.phytomers or 1000),
        "correlated": lambda pool: correlated(pool, arguments.phytomers or 300),
        "real": real,
        "maize": maize,
        "seconds": seconds,
    }
    run_parts(parts, arguments.parts)


if __name__ == "__main__":
    main()
