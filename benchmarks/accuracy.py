"""How accurate the paper's method is, `--method paper`; the default is measured by trust.py.

    python benchmarks/accuracy.py [protocol] [real] [rotations] [--seeds 2] [--phytomers 50]

protocol   the paper's simulated protocol (section V, Table II): correlation with the true parameters and traits; the
           stem above the leaf drawn, and fitted, as long as below it (the default), not there, and freely
real       the paper's clouds in ../shared/data/sodhi2018, beside hand measures and the authors' parameters
rotations  the same clouds from 20 random orientations each

A fit takes some six seconds of one core: the protocol with all its choices, 900 fits, an hour and a half.
"""

import argparse
import csv
import dataclasses
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import numpy as np
from common import DATA, clouds, progress, read, run_parts

import phytofit
import phytofit.models
from phytofit.species import STEM_ABOVE

PARAMETERS = phytofit.models.Phytomer.PARAMETERS[:6]  # of Eq. (1)
HAND = {
    "stem_diameter": "stem_diameter_cm",
    "leaf_angle": "leaf_angle_deg",
    "leaf_length": "leaf_length_cm",
    "leaf_width": "leaf_width_cm",
}


class Job(NamedTuple):
    """A fit of the paper's protocol: how the stem above the leaf is drawn and fitted; phytomer, seed, candidates."""

    drawn: str
    fitted: str
    number: int
    seed: int
    n_samples: int | None


class Fitted(NamedTuple):
    """True and fitted parameters (6,), true and fitted traits, and whether the stem was said to end elsewhere."""

    x: np.ndarray
    fitted: np.ndarray
    traits: np.ndarray
    estimates: np.ndarray
    elsewhere: bool


def simulated_fit(job: Job) -> Fitted:
    made = phytofit.simulate(stem_above=job.drawn, seed=100_000 + job.number)  # 5,000 points, 0.5 cm noise
    settings = {} if job.n_samples is None else {"n_samples": job.n_samples}
    result = phytofit.fit(
        made.points, "cm", seed=job.seed, stem_above=job.fitted, method="paper", threads=1, **settings
    )
    return Fitted(
        made.x[: len(PARAMETERS)],
        result.x[: len(PARAMETERS)],
        np.array([t.value for t in phytofit.measure(made.organs)]),
        np.array([t.value for t in result.traits]),
        "stem_ends_elsewhere" in result.flags,
    )


def protocol(pool: ProcessPoolExecutor, seeds: int, phytomers: int, n_samples: int | None) -> None:
    names = [t.name for t in phytofit.measure(phytofit.simulate(seed=0).organs)]
    for drawn in STEM_ABOVE:
        for fitted in STEM_ABOVE:
            print(
                f"\nSimulated protocol, {phytomers} phytomers, {seeds} seeds; stem above the leaf: drawn {drawn}, "
                f"fitted {fitted}{' (the default)' if fitted == 'equal' else ''}",
                flush=True,
            )
            jobs = [Job(drawn, fitted, n, seed, n_samples) for seed in range(seeds) for n in range(phytomers)]
            rows = list(progress(pool.map(simulated_fit, jobs, chunksize=1), len(jobs)))
            x, found, traits, estimates, elsewhere = (np.array(column) for column in zip(*rows, strict=True))
            of_seed = (seeds, phytomers, -1)
            table(PARAMETERS, x.reshape(of_seed), found.reshape(of_seed))
            print("traits, measured on the true and on the fitted organs:")
            table(names, traits.reshape(of_seed), estimates.reshape(of_seed))
            print(f"flagged, that the stem ends elsewhere: {elsewhere.sum()} of {len(rows)}")


def table(names: list[str] | tuple[str, ...], true: np.ndarray, fitted: np.ndarray) -> None:
    print(f"{'':22}{'mean R':>8}{'least':>8}{'RMSE':>8}{'bias':>8}")
    for k, name in enumerate(names):
        r = [np.corrcoef(a, b)[0, 1] for a, b in zip(true[:, :, k], fitted[:, :, k], strict=True)]
        error = fitted[:, :, k] - true[:, :, k]
        print(f"{name:22}{np.mean(r):8.3f}{np.min(r):8.3f}{np.sqrt(np.mean(error**2)):8.2f}{error.mean():8.2f}")


def real_fit(
    job: tuple[Path, int, str],
) -> tuple[dict[str, float], dict[str, float], float, tuple[str, ...], np.ndarray]:
    """Traits, parameters, error, flags and the model's points in the given pose, of a cloud in one orientation."""
    path, rotation, stem_above = job
    cloud = read(path)
    pose = np.eye(4)
    if rotation:
        pose = random_pose(rotation)
        cloud = dataclasses.replace(cloud, points=cloud.points @ pose[:3, :3].T + pose[:3, 3])
    result = phytofit.fit(cloud, method="paper", stem_above=stem_above, threads=1)
    axes = np.concatenate([organ.axis[:: max(1, len(organ.axis) // 10)] for organ in result.organs])
    back = (axes - pose[:3, 3]) @ pose[:3, :3]
    return {t.name: t.value for t in result.traits}, result.parameters, result.error, result.flags, back


def random_pose(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    q, r = np.linalg.qr(random.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    pose = np.eye(4)
    pose[:3, :3] = q * np.sign(np.linalg.det(q))
    pose[:3, 3] = random.uniform(-100, 100, 3)
    return pose


def real(pool: ProcessPoolExecutor) -> None:
    paths = clouds()
    jobs = [(path, 0, how) for path in paths for how in STEM_ABOVE]
    results = dict(zip(jobs, progress(pool.map(real_fit, jobs, chunksize=1), len(jobs)), strict=True))
    with (DATA / "greenhouse" / "ground_truth.csv").open() as file:
        hand = {row["cloud"]: row for row in csv.DictReader(file)}
    parts = {
        "greenhouse": "Greenhouse clouds, fitted trait (hand measure)",
        "field": "Field clouds, fitted trait",
        "simulated": "The authors' simulated clouds, fitted parameter (theirs; their model is not quite the paper's)",
    }
    for part, title in parts.items():
        print(f"\n{title}\n{'cloud':18}{'stem above':>11}" + "".join(f"{name:>20}" for name in HAND) + "   error, cm")
        for path, rotation, how in jobs:
            if part not in path.parts:
                continue
            traits, parameters, error, flags, _ = results[path, rotation, how]
            known, values = dict.fromkeys(HAND, ""), traits
            if part == "greenhouse":
                known = {name: hand[path.stem][column] for name, column in HAND.items()}
            if part == "simulated":
                known, values = (
                    dict(line.split() for line in path.with_suffix(".txt").read_text().splitlines()),
                    parameters,
                )
            cells = "".join(
                f"{values[n]:11.2f}" + (f" ({float(known[n]):6.2f})" if known[n] else 9 * " ") for n in HAND
            )
            name = f"{path.parent.name}/{path.stem}" if part == "simulated" else path.stem[:14]
            print(f"{name:18}{how:>11}{cells}{error:12.2f}  {'; '.join(flags)}")


def rotations(pool: ProcessPoolExecutor, number: int = 20) -> None:
    paths = clouds()
    jobs = [(path, rotation, "equal") for path in paths for rotation in range(number + 1)]
    rows = list(progress(pool.map(real_fit, jobs, chunksize=1), len(jobs)))
    print(f"\nThe same cloud in {number} random orientations: largest difference from the given pose")
    print(f"{'cloud':26}{'pose, cm':>10}" + "".join(f"{name:>16}" for name in HAND))
    for i, path in enumerate(paths):
        mine = rows[i * (number + 1) : (i + 1) * (number + 1)]
        moved = max(np.linalg.norm(other[4] - mine[0][4], axis=1).max() for other in mine[1:])
        spread = [max(abs(other[0][name] - mine[0][0][name]) for other in mine[1:]) for name in HAND]
        print(f"{path.parent.name[:12]}/{path.stem[:12]:13}{moved:10.3f}" + "".join(f"{s:16.3f}" for s in spread))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="protocol, real, rotations; all by default")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--phytomers", type=int, default=50)
    parser.add_argument("--samples", type=int, help="candidates a generation; the method's own by default")
    arguments = parser.parse_args()
    run_parts(
        {
            "real": real,
            "rotations": rotations,
            "protocol": partial(
                protocol, seeds=arguments.seeds, phytomers=arguments.phytomers, n_samples=arguments.samples
            ),
        },
        arguments.parts,
    )


if __name__ == "__main__":
    main()
