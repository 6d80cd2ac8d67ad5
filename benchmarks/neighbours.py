"""Several plants in one cloud: how many are found, and how many points go with their own plant.

First every single plant of ../shared/data, each of which must stay one; then the same plants, upright, in rows of
two and three, so far apart that their leaves are clear of each other, just touch, or reach into each other.
"""

import argparse
from collections.abc import Iterator
from itertools import groupby

import numpy as np
import trimesh
from common import DATA
from cut_leaves import labelled_plants
from scipy.spatial.transform import Rotation

import phytofit

N_POINTS = 30_000  # of each plant in a row
CLOSER = (-0.1, 0.0, 0.15)  # of the neighbours' mean width: how far they reach into each other
FIELD = ("field_maize", "corn_leaf_area")  # in metres


def single_plants() -> Iterator[tuple[str, str, np.ndarray]]:
    """Data set, name, and points (n, 3), cm, z roughly up."""
    for plant in labelled_plants():
        yield plant.data_set, f"{plant.plant} {plant.name}".strip(), plant.points / 10.0
    for data_set in FIELD:
        for path in sorted((DATA.parent / data_set).glob("*.ply")):
            yield data_set, path.stem, phytofit.read_cloud(path, "m", plausible_cm=(1.0, 1000.0)).points
    for path in sorted((DATA.parent / "openalea_synthetic_maize").rglob("*.ply")):
        mesh = trimesh.load(path, process=False)
        yield "openalea", path.parent.name, np.asarray(trimesh.sample.sample_surface(mesh, N_POINTS, seed=0)[0])
    path = DATA.parent / "prbonn_maize_seedling" / "03-13.ply"
    yield "prbonn", path.stem, phytofit.read_cloud(path, "mm", plausible_cm=(1.0, 500.0)).points


def found_in(points: np.ndarray, up: str | None) -> tuple[phytofit.PointCloud, ...]:
    return phytofit.separate_plants(phytofit.from_points(points, "cm", plausible_cm=(1.0, 1000.0)), up=up)


def singles() -> None:
    print("single plants that stay one, of all: without and with up stated")
    for data_set, plants in groupby(single_plants(), key=lambda it: it[0]):
        those = list(plants)
        n = [[len(found_in(points, up)) for _, _, points in those] for up in (None, "z")]
        split = [name for row in n for (_, name, _), k in zip(those, row, strict=True) if k != 1]
        print(f"{data_set:20} {np.sum(np.array(n[0]) == 1)} and {np.sum(np.array(n[1]) == 1)} of {len(those)}", *split)


def rows() -> None:
    """Rows of plants of one set, each turned about its vertical, cut to a number of points, and moved along x."""
    for closer in CLOSER:
        right, shares, n = 0, [], 0
        for _, plants in groupby(single_plants(), key=lambda it: it[0]):
            those = [points for _, _, points in plants][::4]
            for size in (2, 3):
                for i in range(0, len(those) - size + 1, size):
                    row, owner = in_a_row(those[i : i + size], closer, np.random.default_rng(i))
                    found = found_in(row, "z")
                    n += 1
                    right += len(found) == size
                    shares.append(agreement(row, owner, found))
        print(
            f"{-100 * closer:+4.0f} % of a width between them: {right} of {n} rows have the right number of plants; "
            f"points with their own plant: mean {100 * np.mean(shares):.1f} %, least {100 * np.min(shares):.1f} %"
        )


def in_a_row(plants: list[np.ndarray], closer: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3), and of which plant each is (n,)."""
    made, edge = [], 0.0
    for points in plants:
        kept = upright(points[random.permutation(len(points))[:N_POINTS]])
        turn = random.uniform(0.0, 2.0 * np.pi)
        turned = kept @ np.array(
            [[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
        )
        turned = turned - [turned[:, 0].min(), np.median(turned[:, 1]), turned[:, 2].min()]
        width = float(turned[:, 0].max())
        edge -= closer * width if made else 0.0
        made.append(turned + np.array([edge, 0.0, 0.0]))
        edge += width
    return np.concatenate(made), np.repeat(np.arange(len(made)), [len(points) for points in made])


def upright(points: np.ndarray) -> np.ndarray:
    """The plant (n, 3) with its stem along z; its clouds are stored in any orientation."""
    path = phytofit.segment(phytofit.from_points(points, "cm", plausible_cm=(1.0, 1000.0))).stem_path
    return np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], [path[-1] - path[0]])[0].apply(points))


def agreement(row: np.ndarray, owner: np.ndarray, found: tuple[phytofit.PointCloud, ...]) -> float:
    """Share of the points that are with the plant that has most of their own's; plants come in the order of x."""
    given = {tuple(point): i for i, cloud in enumerate(found) for point in cloud.points.tolist()}
    number = np.array([given.get(tuple(point), -1) for point in row.tolist()])
    same = [np.bincount(number[owner == i] + 1, minlength=len(found) + 1)[1:] for i in range(owner.max() + 1)]
    return float(sum(counts[i] if i < len(counts) else 0 for i, counts in enumerate(same)) / len(row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help="singles, rows; both by default")
    parts = {"singles": singles, "rows": rows}
    for name in parser.parse_args().parts or parts:
        parts[name]()


if __name__ == "__main__":
    main()
