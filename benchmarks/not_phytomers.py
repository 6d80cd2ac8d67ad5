"""Whether what is no phytomer is refused or marked poor, and what is one never is.

    python benchmarks/not_phytomers.py [others] [phytomers] [cut] [--phytomers 200] [--each]

others     leaves alone, stems alone, two leaves, whole plants, two phytomers, pots, walls and other bodies, real ones
           from ../shared/data and simulated ones: how many of each kind are refused or marked poor (goal: 95 %)
phytomers  the paper's clouds, real and simulated, and phytomers of the project's own simulator with various noise,
           holes, views, outliers and without a tip: none of them should be
cut        leaves with their piece of stem, cut from the labelled plants: seedlings and maize, unlike what is expected
"""

import argparse
import os
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import cut_leaves
import numpy as np
import trimesh
from common import DATA, clouds, progress, read, run_parts
from robustness import HOLES, NOISE, OUTLIERS, POINTS, SWEEPS, TIPS, VIEWS
from scipy.spatial.transform import Rotation

import phytofit
import phytofit.simulation
from phytofit.cloud import size_cm
from phytofit.simulation import random_pose

SPECIES = phytofit.load_species()
FIRST_SEED = 700_000  # not those of robustness.py and trust.py
VARIANTS = 6  # of each body and of each simulated kind
MOST = 4000  # points of a cloud; more are left out at random
REAL_EACH = 8  # parts of real plants of each kind
LEAST_LEAF, LEAST_STEM = 300, 200  # points


class Cloud(NamedTuple):
    """Points (n, 3) cm of something of a kind."""

    kind: str
    name: str
    points: np.ndarray


def others() -> Iterator[Cloud]:
    plants = list(real_plants())
    yield from (Cloud("whole plant", plant.name, plant.points) for plant in plants)
    yield from two_plants(plants)
    yield from real_parts([plant for plant in plants if plant.labels is not None])
    yield from simulated_parts()
    yield from bodies()


class Plant(NamedTuple):
    """Points (n, 3) cm of a plant; labels (n,), 1 stem, 2.. leaves, or None."""

    name: str
    points: np.ndarray
    labels: np.ndarray | None


def real_plants() -> Iterator[Plant]:
    for plant in cut_leaves.labelled_plants():
        name = f"{plant.data_set} {plant.plant} {plant.name}"
        points = plant.points / 10.0
        if "nk-" in name:  # of no known scale: made as tall as a plant of that age
            points = points * 150.0 / np.ptp(points, axis=0).max()
        yield thinned(Plant(name, points, plant.labels))
    for folder, units in (("corn_leaf_area", "m"), ("field_maize", "m"), ("prbonn_maize_seedling", "mm")):
        for path in sorted((DATA.parent / folder).glob("*.ply")):
            cloud = phytofit.read_cloud(path, units, plausible_cm=(1.0, 1000.0))
            yield thinned(Plant(f"{folder} {path.stem}", cloud.points, cloud.labels))
    for folder in sorted((DATA.parent / "openalea_synthetic_maize").iterdir()):
        mesh = trimesh.load(folder / "synthetic_plant.ply", process=False)
        points = np.asarray(trimesh.sample.sample_surface(mesh, MOST, seed=0)[0])
        yield Plant(folder.name, phytofit.simulation.add_noise(points, 0.3, np.random.default_rng(0)), None)


def thinned(plant: Plant) -> Plant:
    kept = np.random.default_rng(0).permutation(len(plant.points))[:MOST]
    return Plant(plant.name, plant.points[kept], None if plant.labels is None else plant.labels[kept])


def two_plants(plants: list[Plant]) -> Iterator[Cloud]:
    for i, (one, other) in enumerate(zip(plants[::5], plants[2::5], strict=False)):
        apart = 0.5 * (np.ptp(one.points[:, 0]) + np.ptp(other.points[:, 0]))
        beside = other.points - other.points.mean(axis=0) + one.points.mean(axis=0) + [apart, 0.0, 0.0]
        yield Cloud("two plants", f"{one.name}, {other.name} {i}", np.concatenate([one.points, beside]))
    for path in sorted((DATA.parent / "awkward" / "60_two_plants").iterdir()):
        yield Cloud("two plants", f"{path.parent.name} {path.stem}", phytofit.read_cloud(path, "mm").points)


def real_parts(plants: list[Plant]) -> Iterator[Cloud]:
    """Leaves alone, stems alone, and pairs of leaves, with and without the stem, of labelled plants."""
    found: dict[str, list[Cloud]] = defaultdict(list)
    for plant in plants:
        size = np.bincount(np.maximum(plant.labels, 0))
        leaves = [label for label in np.argsort(-size) if label > 1 and size[label] >= LEAST_LEAF]
        for label in leaves[:2]:
            found["leaf alone"].append(
                Cloud("leaf alone", f"{plant.name} {label}", plant.points[plant.labels == label])
            )
        stem = plant.points[plant.labels == 1]
        if len(stem) >= LEAST_STEM:
            found["stem alone"].append(Cloud("stem alone", plant.name, stem))
        if len(leaves) > 1:
            pair = np.isin(plant.labels, leaves[:2])
            found["two leaves"].append(Cloud("two leaves", plant.name, plant.points[pair]))
            with_stem = plant.points[pair | (plant.labels == 1)]
            found["two leaves on a stem"].append(Cloud("two leaves on a stem", plant.name, with_stem))
    for clouds_of_kind in found.values():
        big = [cloud for cloud in clouds_of_kind if size_cm(cloud.points) > 10.0]
        for i in np.unique(np.linspace(0, len(big) - 1, min(REAL_EACH, len(big))).round().astype(int)):
            yield big[i]


def simulated_parts() -> Iterator[Cloud]:
    for number in range(VARIANTS):
        random = np.random.default_rng(FIRST_SEED + number)
        noise = float(random.choice([0.1, 0.2, 0.3, 0.5]))
        made, other = (
            phytofit.simulate(SPECIES, n_points=n, noise_cm=noise, random_orientation=False, seed=FIRST_SEED + i)
            for n, i in ((4000, 2 * number), (4000, 2 * number + 1))
        )
        leaf, another = made.points[made.labels == 2], other.points[other.labels == 2]
        turn = Rotation.from_euler("z", random.uniform(90.0, 270.0), degrees=True)
        another = turn.apply(another) + np.array([0.0, 0.0, made.x[1] - other.x[1] + random.uniform(-10.0, 10.0)])
        beside = other.points + random.uniform([20.0, -30.0, -10.0], [60.0, 30.0, 10.0])
        yield turned("leaf alone", f"simulated {number}", leaf, random)
        yield turned("stem alone", f"simulated {number}", made.points[made.labels == 1], random)
        yield turned("two leaves", f"simulated {number}", np.concatenate([leaf, another]), random)
        yield turned("two leaves on a stem", f"simulated {number}", np.concatenate([made.points, another]), random)
        yield turned("two phytomers", f"simulated {number}", np.concatenate([made.points, beside]), random)


def turned(kind: str, name: str, points: np.ndarray, random: np.random.Generator) -> Cloud:
    return Cloud(kind, name, points @ random_pose(random)[:3, :3].T)


def bodies() -> Iterator[Cloud]:
    """Shapes, each in some sizes, with noise."""
    for number in range(VARIANTS):
        random = np.random.default_rng(FIRST_SEED + 100 + number)
        for kind, points in shapes(random, 4000):
            noise = float(random.choice([0.0, 0.05, 0.2, 0.5]))
            yield turned(kind, f"{number}", points + random.normal(0.0, max(noise, 1e-3), points.shape), random)


def shapes(random: np.random.Generator, n: int) -> Iterator[tuple[str, np.ndarray]]:
    size = random.uniform(15.0, 60.0)
    unit = random.uniform(-1.0, 1.0, (n, 3))
    angle, height = np.pi * unit[:, 0], 0.5 * (unit[:, 1] + 1.0)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radius, taper = random.uniform(5.0, 12.0), random.uniform(0.6, 1.0)
    wide = radius * (taper + (1.0 - taper) * height)
    side = np.column_stack([circle * wide[:, np.newaxis], height * random.uniform(8.0, 25.0)])
    soil = np.column_stack([circle * (radius * taper * np.sqrt(height))[:, np.newaxis], np.zeros(n)])
    yield "pot", np.concatenate([side[: 3 * n // 4], soil[3 * n // 4 :]])
    yield "wall", unit * [size, random.uniform(10.0, 40.0), 0.1]
    normal = random.standard_normal((n, 3))
    yield "sphere", normal * (0.4 * size / np.linalg.norm(normal, axis=1, keepdims=True))
    yield "box", on_box(random, n, np.array([size, random.uniform(5.0, 40.0), random.uniform(5.0, 40.0)]))
    yield "blob", unit * size * 0.5 if random.random() < 0.5 else normal * size * 0.25
    yield "line", unit * [size, 0.0, 0.0]
    count = round(n ** (1.0 / 3.0))
    grid = np.stack(np.meshgrid(*[np.arange(count)] * 3), axis=-1).reshape(-1, 3)
    yield "lattice", grid * random.uniform(0.5, 3.0)
    yield "disc", np.column_stack([circle * (0.5 * size * np.sqrt(height))[:, np.newaxis], np.zeros(n)])


def on_box(random: np.random.Generator, n: int, sides: np.ndarray) -> np.ndarray:
    points = random.uniform(-0.5, 0.5, (n, 3))
    area = np.prod(sides) / sides
    face = random.choice(3, n, p=area / area.sum())
    points[np.arange(n), face] = random.choice([-0.5, 0.5], n)
    return points * sides


def papers() -> Iterator[Cloud]:
    for path in clouds():
        kind, name = f"sodhi2018 {path.relative_to(DATA).parts[0]}", f"{path.parent.name} {path.stem}"
        yield Cloud(kind, name, read(path).points)


def simulated(number: int) -> Cloud:
    """A phytomer, made worse in one of the ways and by one of the steps at which the method is said to work."""
    works = {
        "noise": NOISE[:5],
        "leaf removed": HOLES[1:4],
        "tip cut off": TIPS[1:],
        "outliers": OUTLIERS[1:],
        "views": VIEWS,
        "points": POINTS,
    }
    random = np.random.default_rng(FIRST_SEED + 1000 + number)
    way = list(works)[number % len(works)]
    sweep, step = SWEEPS[way], works[way][number // len(works) % len(works[way])]
    noise = 0.0 if way == "noise" else float(random.choice([0.1, 0.3, 0.5]))
    made = phytofit.simulate(SPECIES, n_points=5000, noise_cm=noise, seed=FIRST_SEED + 1000 + number)
    return Cloud(f"simulated: {way}", f"{step:g}, number {number}", sweep.cloud(made, step, random))


def cut() -> Iterator[Cloud]:
    for leaf in cut_leaves.leaves(5000, 4):
        if leaf.organ is not None:
            yield Cloud(f"cut from {leaf.data_set}", f"{leaf.plant} {leaf.name}", leaf.points)


def refused(cloud: Cloud) -> str:
    """The sentence by which a cloud is refused or marked poor; empty where it is measured."""
    try:
        result = phytofit.fit(phytofit.from_points(cloud.points, "cm", plausible_cm=(1.0, 1000.0)), threads=1)
    except phytofit.PhytofitError as error:
        return str(error)
    return next((str(one) for one in result.remarks if one.code == "other_surfaces"), "")


def report(pool: ProcessPoolExecutor, those: list[Cloud], each: bool, *, wanted: bool) -> None:
    """Prints how many of each kind are refused; with `each`, of all of them why, else of those that should not be."""
    of_kind: dict[str, list[bool]] = defaultdict(list)
    for cloud, why in zip(those, progress(pool.map(refused, those), len(those)), strict=True):
        of_kind[cloud.kind].append(bool(why))
        if each or bool(why) != wanted:
            print(f"  {cloud.kind}: {cloud.name}: {why or 'measured'}", flush=True)
    for kind, found in of_kind.items():
        print(f"{kind:28} {sum(found):4} of {len(found):4} refused or marked poor")
    every = [it for found in of_kind.values() for it in found]
    print(f"{'in all':28} {sum(every):4} of {len(every):4}: {100.0 * np.mean(every):.1f} %", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="others, phytomers, cut; all by default")
    parser.add_argument("--phytomers", type=int, default=200, help="simulated ones")
    parser.add_argument("--each", action="store_true", help="what is said of each cloud")
    arguments = parser.parse_args()
    wanted = {
        "others": lambda: (list(others()), True),
        "phytomers": lambda: ([*papers(), *map(simulated, range(arguments.phytomers))], False),
        "cut": lambda: (list(cut()), False),
    }

    def part(name: str, pool: ProcessPoolExecutor) -> None:
        print(f"\n{name}")
        those, refuse = wanted[name]()
        report(pool, those, arguments.each, wanted=refuse)

    run_parts({name: partial(part, name) for name in wanted}, arguments.parts)


if __name__ == "__main__":
    main()
