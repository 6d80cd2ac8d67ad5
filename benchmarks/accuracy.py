"""How accurate the paper's method is, `--method paper`; the default is measured by trust.py.

    python benchmarks/accuracy.py [protocol] [real] [rotations] [--seeds 10] [--phytomers 50]

protocol   the paper's simulated protocol (section V, Table II): correlation with the true parameters and traits
real       the paper's clouds in ../shared/data/sodhi2018, beside hand measures and the authors' parameters
rotations  the same clouds from 20 random orientations each
"""

import argparse
import csv
import dataclasses
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import numpy as np

import phytofit

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "sodhi2018"
MM = {"0015_occl1"}
HAND = {
    "stem_diameter": "stem_diameter_cm",
    "leaf_angle": "leaf_angle_deg",
    "leaf_length": "leaf_length_cm",
    "leaf_width": "leaf_width_cm",
}


def simulated_fit(job: tuple[int, int, bool]) -> tuple[np.ndarray, ...]:
    """True and fitted parameters (7,), true and fitted traits, flags of one phytomer under one seed."""
    seed, number, stem_above = job
    fixed = None if stem_above else {"stem_length_above": 0.0}
    made = phytofit.simulate(fixed=fixed, seed=100_000 + number)  # 5,000 points, 0.5 cm noise, random orientation
    result = phytofit.fit(made.points, "cm", seed=seed, stem_above=stem_above, method="paper", threads=1)
    x = np.zeros(7)
    x[: len(result.x)] = result.x
    true = [t.value for t in phytofit.measure(made.organs)]
    return made.x[:7], x, np.array(true), np.array([t.value for t in result.traits]), np.array(len(result.flags))


def protocol(pool: ProcessPoolExecutor, seeds: int, phytomers: int) -> None:
    parameters = phytofit.Phytomer.PARAMETERS[:6]
    for stem_above, model in (
        (False, "the paper's: six parameters, no stem above the leaf"),
        (True, "the default: stem above the leaf, 5 to 15 cm"),
    ):
        print(
            f"\nSimulated protocol, {phytomers} phytomers, {seeds} seeds, priors of sorghum.toml; {model}", flush=True
        )
        jobs = [(seed, number, stem_above) for seed in range(seeds) for number in range(phytomers)]
        rows = list(progress(pool.map(simulated_fit, jobs, chunksize=1), len(jobs)))
        x, fitted, traits, estimates, flags = (np.array(column) for column in zip(*rows, strict=True))
        names = [t.name for t in phytofit.measure(phytofit.simulate(seed=0).organs)]
        table(parameters, x.reshape(seeds, phytomers, 7), fitted.reshape(seeds, phytomers, 7))
        shape = (seeds, phytomers, len(names))
        print("traits, measured on the true and on the fitted organs:")
        table(names, traits.reshape(shape), estimates.reshape(shape))
        print(f"flagged: {int((flags > 0).sum())} of {len(rows)}")


def table(names: list[str] | tuple[str, ...], true: np.ndarray, fitted: np.ndarray) -> None:
    print(f"{'':22}{'mean R':>8}{'least':>8}{'RMSE':>8}{'bias':>8}")
    for k, name in enumerate(names):
        r = [np.corrcoef(a, b)[0, 1] for a, b in zip(true[:, :, k], fitted[:, :, k], strict=True)]
        error = fitted[:, :, k] - true[:, :, k]
        print(f"{name:22}{np.mean(r):8.3f}{np.min(r):8.3f}{np.sqrt(np.mean(error**2)):8.2f}{error.mean():8.2f}")


def clouds() -> list[Path]:
    if not DATA.is_dir():
        sys.exit(f"{DATA} is absent: the paper's clouds can't be measured")
    return [path for folder in ("greenhouse", "field", "simulated") for path in sorted((DATA / folder).rglob("*.ply"))]


def real_fit(job: tuple[Path, int]) -> tuple[dict[str, float], dict[str, float], float, tuple[str, ...], np.ndarray]:
    """Traits, parameters, error, flags and the model's points in the given pose, of a cloud in one orientation."""
    path, rotation = job
    cloud = phytofit.read_cloud(path, "mm" if path.stem in MM else "cm")
    pose = np.eye(4)
    if rotation:
        pose = random_pose(rotation)
        cloud = dataclasses.replace(cloud, points=cloud.points @ pose[:3, :3].T + pose[:3, 3])
    result = phytofit.fit(cloud, method="paper", threads=1)
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
    results = dict(zip(paths, pool.map(real_fit, [(path, 0) for path in paths]), strict=True))
    with (DATA / "greenhouse" / "ground_truth.csv").open() as file:
        hand = {row["cloud"]: row for row in csv.DictReader(file)}
    print("\nGreenhouse clouds, fitted trait (hand measure)")
    print(f"{'cloud':14}" + "".join(f"{name:>20}" for name in HAND) + f"{'error, cm':>12}")
    for path in paths:
        if path.parent.name == "greenhouse":
            traits, _, error, flags, _ = results[path]
            row = hand[path.stem]
            cells = "".join(f"{traits[n]:11.2f} ({float(row[c]):6.2f})" for n, c in HAND.items())
            print(f"{path.stem:14}{cells}{error:12.2f}  {'; '.join(flags)}")
    print("\nField clouds, fitted trait")
    for path in paths:
        if path.parent.name == "field":
            traits, _, error, flags, _ = results[path]
            cells = "".join(f"{traits[n]:20.2f}" for n in HAND)
            print(f"{path.stem[:13]:14}{cells}{error:12.2f}  {'; '.join(flags)}")
    names = ("stem_diameter", "leaf_angle", "leaf_length", "leaf_width")
    print("\nThe authors' simulated clouds, fitted parameter (theirs; their model is not quite Eq. (1) and (2))")
    print(f"{'cloud':18}" + "".join(f"{name:>20}" for name in names) + f"{'error, cm':>12}")
    for path in paths:
        if "simulated" in path.parts:
            _, parameters, error, flags, _ = results[path]
            theirs = dict(line.split() for line in path.with_suffix(".txt").read_text().splitlines())
            cells = "".join(f"{parameters[n]:11.2f} ({float(theirs[n]):6.2f})" for n in names)
            print(f"{path.parent.name}/{path.stem:6}{cells}{error:12.2f}  {'; '.join(flags)}")


def rotations(pool: ProcessPoolExecutor, number: int = 20) -> None:
    paths = clouds()
    jobs = [(path, rotation) for path in paths for rotation in range(number + 1)]
    rows = list(progress(pool.map(real_fit, jobs, chunksize=1), len(jobs)))
    print(f"\nThe same cloud in {number} random orientations: largest difference from the given pose")
    print(f"{'cloud':26}{'pose, cm':>10}" + "".join(f"{name:>16}" for name in HAND))
    for i, path in enumerate(paths):
        mine = rows[i * (number + 1) : (i + 1) * (number + 1)]
        moved = max(np.linalg.norm(other[4] - mine[0][4], axis=1).max() for other in mine[1:])
        spread = [max(abs(other[0][name] - mine[0][0][name]) for other in mine[1:]) for name in HAND]
        print(f"{path.parent.name[:12]}/{path.stem[:12]:13}{moved:10.3f}" + "".join(f"{s:16.3f}" for s in spread))


def progress(results, total: int):  # type: ignore[no-untyped-def]
    for done, result in enumerate(results, start=1):
        if sys.stderr.isatty() or done % 50 == 0:
            print(f"\r{done}/{total}", end="" if sys.stderr.isatty() else "\n", file=sys.stderr, flush=True)
        yield result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="protocol, real, rotations; all by default")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--phytomers", type=int, default=50)
    arguments = parser.parse_args()
    parts = arguments.parts or ["protocol", "real", "rotations"]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        if "real" in parts:
            real(pool)
        if "rotations" in parts:
            rotations(pool)
        if "protocol" in parts:
            protocol(pool, arguments.seeds, arguments.phytomers)


if __name__ == "__main__":
    main()
