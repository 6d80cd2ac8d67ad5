"""How well plants are taken apart: leaf counts, instances and stems against labels; time and memory.

Default settings for all clouds, in the frame they are stored in, with up not stated.  No tuning to a file: there are
30 labelled clouds of 8 plants, and 24 of them are days of 3 plants, so shares are of clouds that are not independent.
"""

import argparse
import json
import resource
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import trimesh
from common import DATA
from cut_leaves import Plant, labelled_plants
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

import phytofit

HIT = 0.5  # intersection over union from which a leaf is found
SIZES = (50_000, 300_000, 3_000_000)
JITTER = 0.002  # of the plant's size, added to points that are repeated
SYNTHETIC_POINTS = 60_000
# Leaves of tobacco, tomato and sorghum: precision and recall at IoU 0.5, and mean coverage, of PSegNet, a network
# trained on such plants (Li, Li, Xiang and Pan, Plant Phenomics 2022, 9787643)
PUBLISHED = f"{'PSegNet, published':46}{88:9} % {79:7} % {'-':>8} {0.83:10.2f}"
HEAD = "set                  clouds   exact  within 1  precision   recall  stem IoU  leaves IoU  slowest"


class Score(NamedTuple):
    """Of one cloud: leaves that are labelled, found, and found with IoU over 0.5; IoU of stem and leaves."""

    true: int
    found: int
    hits: int
    stem: float
    leaves: float
    seconds: float


def score(labels: np.ndarray, truth: np.ndarray, seconds: float) -> Score:
    """Labels (n,) against the true ones (n,): 0 nothing, 1 stem, 2.. leaves."""
    counted = np.zeros((int(truth.max()) + 1, int(labels.max()) + 1))
    np.add.at(counted, (truth, labels), 1.0)
    union = counted.sum(axis=1, keepdims=True) + counted.sum(axis=0, keepdims=True) - counted
    iou = counted / np.maximum(union, 1.0)
    real = np.flatnonzero(counted.sum(axis=1) > 0)
    real = real[real > 1]
    of_leaves = iou[real][:, 2:]
    i, j = linear_sum_assignment(-of_leaves)
    matched = of_leaves[i, j]
    found = int(np.sum(counted.sum(axis=0)[2:] > 0))
    return Score(
        len(real), found, int((matched > HIT).sum()), float(iou[1, 1]), float(matched.sum() / len(real)), seconds
    )


def plant_cloud(plant: Plant) -> phytofit.PointCloud:
    return phytofit.from_points(
        plant.points, "mm", name=f"{plant.plant} {plant.name}".strip(), plausible_cm=(1.0, 1000.0)
    )


def scores(plants: Iterator[Plant]) -> Iterator[tuple[Plant, Score]]:
    for plant in plants:
        start = time.perf_counter()
        try:
            labels = phytofit.segment(plant_cloud(plant)).labels
        except phytofit.NoStemError:
            labels = np.zeros(len(plant.points), np.int64)
        yield plant, score(labels, plant.labels, time.perf_counter() - start)


def summary(name: str, found: list[Score]) -> str:
    table = np.array(found, float)
    off = np.abs(table[:, 0] - table[:, 1])
    true, segments, hits = table[:, :3].sum(axis=0)
    return (
        f"{name:20} {len(table):6} {100 * (off == 0).mean():7.0f} % {100 * (off <= 1).mean():8.0f} % "
        f"{100 * hits / max(segments, 1):9.0f} % {100 * hits / true:7.0f} % {table[:, 3].mean():8.2f} "
        f"{table[:, 4].mean():10.2f} {table[:, 5].max():8.1f} s"
    )


def accuracy(each: bool) -> None:
    print(HEAD)
    sets: dict[str, list[Score]] = {}
    for plant, made in scores(labelled_plants()):
        sets.setdefault(plant.data_set, []).append(made)
        if each:
            print(
                f"  {plant.plant} {plant.name}: {made.found} of {made.true} leaves, {made.hits} over IoU {HIT}, "
                f"stem {made.stem:.2f}, leaves {made.leaves:.2f}"
            )
    for name, found in sets.items():
        print(summary(name, found))
    print(summary("labelled by hand", [s for name, found in sets.items() if name != "mccormick" for s in found]))
    print(PUBLISHED)


def turned() -> None:
    """The same clouds, without what is no organ, each turned at random."""
    found = []
    for number, plant in enumerate(labelled_plants()):
        if plant.data_set != "mccormick":
            organ = plant.labels > 0
            points = Rotation.random(rng=number).apply(plant.points[organ])
            found += [made for _, made in scores(iter([plant._replace(points=points, labels=plant.labels[organ])]))]
    print(HEAD)
    print(summary("turned at random", found))


def unlabelled() -> None:
    """Plants whose organs are not labelled, but whose leaves can be counted."""
    path = DATA.parent / "prbonn_maize_seedling" / "03-13.ply"
    made = phytofit.segment(phytofit.read_cloud(path, "mm", plausible_cm=(1.0, 500.0)))
    print(f"prbonn_maize_seedling: {len(made.leaves)} leaves (3 can be seen)")
    for path in sorted((DATA.parent / "openalea_synthetic_maize").rglob("*.ply")):
        mesh = trimesh.load(path, process=False)
        points = np.asarray(trimesh.sample.sample_surface(mesh, SYNTHETIC_POINTS, seed=0)[0])
        true = len(json.loads(path.with_suffix(".json").read_text())["leaf_polylines"])
        found = phytofit.segment(phytofit.from_points(points, "cm", plausible_cm=(1.0, 1000.0)))
        print(f"{path.parent.name}: {len(found.leaves)} of {true} leaves, stem {found.stem_length:.0f} cm")


def speed() -> None:
    plant = max(labelled_plants(), key=lambda plant: len(np.unique(plant.labels)))
    size = np.ptp(plant.points, axis=0).max()
    print("points       time    most memory of the process so far")
    for n in SIZES:
        random = np.random.default_rng(0)
        points = plant.points[random.integers(len(plant.points), size=n)] + random.normal(0.0, JITTER * size, (n, 3))
        cloud = phytofit.from_points(points, "mm", plausible_cm=(1.0, 1000.0))
        start = time.perf_counter()
        found = phytofit.segment(cloud)
        seconds = time.perf_counter() - start
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{n:9,} {seconds:6.1f} s {memory:8.0f} MiB   ({plant.plant}: {len(found.leaves)} leaves)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--each", action="store_true", help="print every cloud")
    parser.add_argument("--part", choices=["accuracy", "turned", "unlabelled", "speed"], help="only this part")
    chosen = parser.parse_args()
    if chosen.part in (None, "accuracy"):
        accuracy(chosen.each)
    if chosen.part in (None, "turned"):
        turned()
    if chosen.part in (None, "unlabelled"):
        unlabelled()
    if chosen.part in (None, "speed"):
        speed()


if __name__ == "__main__":
    main()
