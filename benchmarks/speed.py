"""How fast the fits are, beside the paper and beside other libraries, and that speed has cost no accuracy.

    python benchmarks/speed.py [table1] [peers] [search] [agreement] [--quick]

table1     seconds per generation, Table I's grid of samples and points, beside the paper's
peers      CPU time of a candidate at equal work, 50 rounds of ICP and the Hausdorff distance: ours beside
           small_gicp with SciPy's k-d tree, Open3D, and NumPy and SciPy alone; one thread, interleaved
search     CPU time of a candidate over a whole search beside small_gicp's; the floor; seconds of a whole fit
agreement  errors of one batch of candidates beside those of ICP from several starts to rest; the same elite by the
           short cuts of a search, and for rotated copies of the cloud

--quick tries the script: small numbers, none of which means anything.
"""

import argparse
import inspect
import multiprocessing
import os
import platform
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")  # peers are measured on one thread

import numba
import numpy as np
from peers import Peer, open3d_peer, placed, scipy_peer, small_gicp_peer, yardstick

import phytofit
import phytofit.models
import phytofit.paper
import phytofit.start
from phytofit.fitting import mean_at
from phytofit.kernels.distance import hausdorff
from phytofit.kernels.icp import icp, transform
from phytofit.kernels.nearest import NearestGrid
from phytofit.paper import distances
from phytofit.paper import objective as objectives
from phytofit.simulation import random_pose

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "sodhi2018"
SPECIES = phytofit.load_species().leading(7)
CORES = os.cpu_count() or 1
PAPER = {  # Table I: samples, points -> seconds per generation; 8 threads, Intel i7 2.9 GHz
    (100, 1000): 0.67, (100, 5000): 3.61, (100, 10000): 7.98,
    (500, 1000): 3.31, (500, 5000): 18.8, (500, 10000): 40.3,
    (1000, 1000): 6.80, (1000, 5000): 37.1, (1000, 10000): 80.4,
}  # fmt: skip
ROUNDS = 50  # of ICP, where the work is to be equal
GOAL_EQUAL, GOAL_SEARCH = 25.0, 60.0  # times less CPU per candidate than small_gicp and cKDTree
GOAL_EXCESS_CM, GOAL_SHARE = 0.05, 0.95
BYTES_A_LOOK_UP = 12 + 4 + 16  # the source point, the cell's index, the padded target point


class Task(NamedTuple):
    """A cloud as :func:`phytofit.fit` searches on it: upright and thinned, with its start poses and first mean."""

    reference: phytofit.paper.Reference
    starts: list[np.ndarray]
    mean: np.ndarray

    def objective(self, n_points: int, executor: Executor | None = None) -> phytofit.paper.PaperObjective:
        return phytofit.paper.PaperObjective(
            SPECIES.model, self.reference, starts=self.starts, n_points=n_points, executor=executor
        )

    def search(self, n_samples: int, n_generations: int = 10) -> phytofit.paper.CrossEntropy:
        return phytofit.paper.CrossEntropy(
            SPECIES.space, n_samples=n_samples, n_generations=n_generations, mean=self.mean
        )


def task_of(points: np.ndarray, n_points: int) -> Task:
    """What `phytofit.fit` does to a cloud (n, 3), cm, before it searches."""
    found = phytofit.start.prepare(phytofit.from_points(points, "cm"), SPECIES, n_points=n_points)
    return Task(
        phytofit.paper.Reference.of(found.points),
        [start.pose for start in found.starts],
        mean_at(found.starts[0], SPECIES),
    )


def simulated(n_points: int) -> np.ndarray:
    """Points (n, 3), cm, of the phytomer that everything here is measured on; 0.5 cm noise, as in section V."""
    return phytofit.simulate(n_points=n_points, seed=1).points


def mid_search(task: Task, n_samples: int, n_points: int, n_generations: int = 6) -> np.ndarray:
    """The candidates (n_samples, k) that a search draws after so many of ten generations."""
    search = task.search(n_samples)
    with ThreadPoolExecutor(CORES) as executor:
        objective = task.objective(n_points, executor)
        for _ in range(n_generations):
            xs = search.ask()
            search.tell(xs, objective(xs, search.n_elite))
    return search.ask()


def drawn(xs: np.ndarray, n_points: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points (n, 3) on each candidate as the objective draws them, and the junction (3,) of its leaf and stem."""
    organs = SPECIES.model.organs(xs)
    population = phytofit.models.SurfaceSampler(n_points, seed=0).population(organs)
    return [(population.draw(i)[0].T.astype(float), organs[1].axis[i, 0]) for i in range(len(xs))]


# Table I


def table1(samples: tuple[int, ...] = (100, 500, 1000), sizes: tuple[int, ...] = (1000, 5000, 10000)) -> None:
    heading("Table I: seconds per generation, mean of a search's ten; as many points on the model as in the cloud")
    print(
        f"{'samples':>8}{'points':>8}{'paper, 8 threads':>18}{f'{CORES} threads':>12}{'1 thread':>12}{'paper/ours':>12}"
    )
    for n_points in sizes:
        task = task_of(simulated(n_points), n_points)
        for n_samples in samples:
            ours = []
            for threads in (CORES, 1):
                with ThreadPoolExecutor(threads) as executor:
                    search, objective = task.search(n_samples), task.objective(n_points, executor)
                    start = time.perf_counter()
                    phytofit.paper.minimise(search, objective)
                    ours.append((time.perf_counter() - start) / search.n_generations)
            paper = PAPER.get((n_samples, n_points), np.nan)
            print(
                f"{n_samples:8}{n_points:8}{paper:18.2f}{ours[0]:12.3f}{ours[1]:12.3f}{paper / ours[0]:12.0f}",
                flush=True,
            )


# Equal work


def our_kernels(reference: phytofit.paper.Reference) -> Peer:
    """Our kernels as a peer: plain ICP on the grid, and the Hausdorff distance."""

    def align(points: np.ndarray, pose: np.ndarray, iterations: int) -> tuple[np.ndarray, int]:
        mean = points.mean(axis=0)
        source = np.ascontiguousarray((points - mean).T, np.float32)
        rotation = np.ascontiguousarray(pose[:3, :3])
        r, t, _, made, _ = icp(source, reference.grid, rotation, rotation @ mean + pose[:3, 3], iterations, 0.0, 0)
        aligned = np.eye(4)
        aligned[:3, :3], aligned[:3, 3] = r, t - r @ mean
        return aligned, made

    def distance(points: np.ndarray, pose: np.ndarray) -> float:
        source = np.ascontiguousarray(points.T, np.float32)
        moved = np.empty_like(source)
        transform(source, np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3]), moved)
        return float(hausdorff(moved, reference.grid, reference.bins))

    return Peer("phytofit", align, distance)


class Cost(NamedTuple):
    """CPU ms of one candidate by one peer, scaled to `ROUNDS` of ICP if it stopped sooner."""

    ms: float
    rounds: int
    error: float


def cost(peer: Peer, points: np.ndarray, pose: np.ndarray) -> Cost:
    start = time.process_time()
    end, rounds = peer.align(points, pose, ROUNDS)
    aligned = time.process_time()
    error = peer.distance(points, end)
    done = time.process_time()
    return Cost(1e3 * ((aligned - start) * ROUNDS / rounds + (done - aligned)), rounds, error)


def available_peers() -> list[Callable[[np.ndarray], Peer]]:
    try:
        open3d_peer(np.zeros((1, 3)))
    except (ImportError, OSError) as error:
        print(f"Open3D is left out ({error}): pip install 'phytofit[peers]'")
        return [small_gicp_peer, scipy_peer]
    return [small_gicp_peer, open3d_peer, scipy_peer]


def peers(sizes: tuple[int, ...] = (1000, 5000, 10000), n_candidates: int = 20) -> None:
    heading(
        f"Equal work: CPU ms of a candidate, {ROUNDS} rounds of ICP and the Hausdorff distance, one thread\n"
        f"(median of {n_candidates} candidates of a search's seventh generation; each peer's in turn with ours)"
    )
    makers = available_peers()
    titles = ("peer's ms", "ours, ms", "ratio", "stopped sooner", "|difference| of errors, cm")
    print(f"{'points':>8}  {'peer':22}" + "".join(f"{title:>{len(title) + 3}}" for title in titles))
    for n_points in sizes:
        task = task_of(simulated(n_points), n_points)
        ours = our_kernels(task.reference)
        candidates = drawn(mid_search(task, max(2 * n_candidates, 100), n_points)[:n_candidates], n_points)
        for make in makers:
            peer = make(task.reference.points)
            theirs, mine = in_turn(peer, ours, candidates, task.starts[0])
            ratio = median_ms(theirs) / median_ms(mine)
            sooner = sum(each.rounds < ROUNDS for each in theirs)
            apart = np.mean([abs(a.error - b.error) for a, b in zip(theirs, mine, strict=True)])
            cells = (f"{median_ms(theirs):.2f}", f"{median_ms(mine):.3f}", f"{ratio:.1f}", f"{sooner}", f"{apart:.3f}")
            row = "".join(f"{cell:>{len(title) + 3}}" for cell, title in zip(cells, titles, strict=True))
            goal = verdict(ratio, GOAL_EQUAL) if peer.name.startswith("small_gicp") else ""
            print(f"{n_points:8}  {peer.name:22}{row}{goal}", flush=True)
    print(
        "Who stopped sooner had come to rest: its ICP is scaled to 50 rounds.  Our matches are those of a grid cell's\n"
        "centre, theirs exact, so that ICP takes slightly different ways; the distance at the end is exact for all."
    )


def in_turn(
    peer: Peer, ours: Peer, candidates: list[tuple[np.ndarray, np.ndarray]], start: np.ndarray
) -> tuple[list[Cost], list[Cost]]:
    """Costs of the candidates: peer, ours, peer, ours ..; the first is done once before, untimed."""
    theirs, mine = [], []
    for warm, (points, junction) in enumerate([candidates[0], *candidates]):
        pose = placed(junction, start)
        pair = cost(peer, points, pose), cost(ours, points, pose)
        if warm:
            theirs.append(pair[0])
            mine.append(pair[1])
    return theirs, mine


def median_ms(costs: Iterable[Cost]) -> float:
    return statistics.median(each.ms for each in costs)


# A whole search


def search(
    n_samples: int = 500, n_points: int = 5000, n_generations: int = 10, repeats: int = 3, n_clouds: int = 3
) -> None:
    heading(
        f"A whole search: {n_samples} samples, {n_points} points, {n_generations} generations "
        f"(the paper's settings are 500, 5000, 10)"
    )
    cloud = simulated(n_points)
    task = task_of(cloud, n_points)
    settings = {"n_samples": n_samples, "n_points": n_points, "n_generations": n_generations}
    candidates = drawn(mid_search(task, max(n_samples, 100), n_points)[:10], n_points)
    peer, ours = small_gicp_peer(task.reference.points), our_kernels(task.reference)
    theirs, equal, amortised = [], [], []
    for _ in range(repeats):
        more = in_turn(peer, ours, candidates, task.starts[0])
        theirs += more[0]
        equal += more[1]
        start = time.process_time()
        phytofit.fit(cloud, "cm", method="paper", threads=1, **settings)
        amortised.append(1e3 * (time.process_time() - start) / (n_samples * n_generations))
    ratio = median_ms(theirs) / statistics.median(amortised)
    print(f"{peer.name}, {ROUNDS} rounds: {median_ms(theirs):.2f} ms CPU a candidate")
    print(f"phytofit.fit, threads=1, all it does: {statistics.median(amortised):.3f} ms CPU a candidate")
    print(f"ratio {ratio:.1f}{verdict(ratio, GOAL_SEARCH)}")

    floor(task, settings, statistics.median(amortised), median_ms(equal), candidates)

    print(f"\nSeconds of a whole fit (wall), {CORES} threads, kernels compiled, median of {repeats}")
    for name, points in clouds(n_points)[:n_clouds]:
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            result = phytofit.fit(points, "cm", method="paper", **settings)
            seconds.append(time.perf_counter() - start)
        print(f"{name:20}{statistics.median(seconds):8.2f} s   error {result.error:.2f} cm  {'; '.join(result.flags)}")


def clouds(n_points: int) -> list[tuple[str, np.ndarray]]:
    """The simulated phytomer, and one greenhouse and one field cloud of the paper's where they are at hand."""
    found = [("simulated", simulated(n_points))]
    for name, path in (
        ("greenhouse/0006", DATA / "greenhouse" / "0006.ply"),
        ("field/02", DATA / "field" / "02_3260_frame0016.ply"),
    ):
        if path.is_file():
            found.append((name, phytofit.read_cloud(path, "cm").points))
        else:
            print(f"{name} is left out: {path} is absent")
    return found


def floor(
    task: Task,
    settings: dict[str, int],
    search_ms: float,
    equal_ms: float,
    candidates: list[tuple[np.ndarray, np.ndarray]],
) -> None:
    """The time of the look-ups alone, and how far the measured times (CPU ms a candidate) are from it."""
    ns = ns_per_look_up(task, candidates)
    grid = task.reference.grid
    megabytes = (grid.nearest.nbytes + grid.points.nbytes) / 1e6
    n, m = settings["n_points"], len(task.reference.points)
    print(
        f"\nFloor: {ns:.2f} ns a look-up (index of the cell, then its point, and nothing else; cells known beforehand; "
        f"{megabytes:.1f} MB of tables)"
    )
    most = look_ups_at_most(task, n)
    made = look_ups_made(task, settings)
    print(f"{'look-ups a candidate':24}" + "".join(f"{name:>12}" for name in (*most, "all")))
    for title, counts in (("at most, by settings", most), ("made in this search", made)):
        print(f"{title:24}" + "".join(f"{count:12,.0f}" for count in (*counts.values(), sum(counts.values()))))
    rows = (
        ("equal work", ROUNDS * n + n + m, equal_ms),
        ("whole search", sum(made.values()), search_ms),
    )
    print(f"{'':14}{'look-ups':>12}{'MB read':>10}{'floor, ms':>12}{'ours, ms':>12}{'ours/floor':>12}")
    for name, count, ms in rows:
        least = 1e-6 * ns * count
        print(f"{name:14}{count:12,.0f}{1e-6 * BYTES_A_LOOK_UP * count:10.2f}{least:12.3f}{ms:12.3f}{ms / least:12.1f}")


@numba.njit(nogil=True, fastmath=True)
def touch(cells: np.ndarray, nearest: np.ndarray, points: np.ndarray, sums: np.ndarray) -> None:
    """Look all cells up, once for every element of sums; what is summed is only there to be used."""
    for s in range(len(sums)):
        total = np.float32(s)
        for i in range(len(cells)):
            k = nearest[cells[i]]
            total += points[k, 0] + points[k, 1] + points[k, 2]
        sums[s] = total


def ns_per_look_up(task: Task, candidates: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """CPU ns of one access to the grid, in the order in which aligned candidates ask; median of the candidates."""
    grid = task.reference.grid
    sums = np.empty(ROUNDS, np.float32)
    ours = our_kernels(task.reference)
    times = []
    for points, junction in candidates:
        pose, _ = ours.align(points, placed(junction, task.starts[0]), ROUNDS)
        cells = cells_of(grid, points @ pose[:3, :3].T + pose[:3, 3])
        touch(cells, grid.nearest, grid.points, sums)
        start = time.process_time()
        touch(cells, grid.nearest, grid.points, sums)
        times.append(1e9 * (time.process_time() - start) / (len(sums) * len(cells)))
    return statistics.median(times)


def cells_of(grid: NearestGrid, points: np.ndarray) -> np.ndarray:
    at = np.clip(((points - grid.origin) * grid.inverse_cell).astype(np.int64), 0, grid.dims - 1)
    return ((at[:, 0] * grid.dims[1] + at[:, 1]) * grid.dims[2] + at[:, 2]).astype(np.int32)


def look_ups_at_most(task: Task, n: int) -> dict[str, float]:
    """Look-ups per candidate by the objective's defaults, if no round of ICP ends early and no distance is given up.

    A Hausdorff distance counts as one look-up for each point of both clouds.
    """
    settings = {name: p.default for name, p in inspect.signature(phytofit.paper.PaperObjective).parameters.items()}
    elite_fraction = inspect.signature(phytofit.paper.CrossEntropy).parameters["elite_fraction"].default
    short = min(objectives.SHORTLIST * elite_fraction, 1.0)
    tilts = len(settings["tilts_deg"])
    scout = len(task.starts) * -(-n // settings["scout_stride"]) * settings["scout_iterations"]
    coarse = -(-n // settings["coarse_stride"]) * settings["coarse_iterations"]
    both = n + len(task.reference.points)
    return {
        "scout": scout if len(task.starts) > 1 else 0,
        "coarse": coarse * (1 + short * tilts),
        "fine": short * (1 + tilts) * n * settings["iterations"],
        "Hausdorff": both * (1 + short * (1 + tilts)),
    }


def look_ups_made(task: Task, settings: dict[str, int]) -> dict[str, float]:
    """The same, counted in a search."""
    n = settings["n_points"]
    search = task.search(settings["n_samples"], settings["n_generations"])
    with counted() as counts:
        phytofit.paper.minimise(search, task.objective(n))
    candidates = settings["n_samples"] * settings["n_generations"]
    by_size = sorted(size for size in counts if size != "Hausdorff")
    names = dict(zip(by_size, ("scout", "coarse", "fine")[-len(by_size) :], strict=True))
    made = dict.fromkeys(("scout", "coarse", "fine"), 0.0) | {names[s]: counts[s] / candidates for s in by_size}
    return made | {"Hausdorff": counts["Hausdorff"] / candidates}


@contextmanager
def counted() -> Iterator[Counter]:
    """Counts what the objective looks up: by the number of points that ICP was given, and by the distance."""
    counts: Counter = Counter()

    def icp_and_count(source, *arguments):  # type: ignore[no-untyped-def]
        result = icp(source, *arguments)
        counts[source.shape[1]] += source.shape[1] * result[3]
        return result

    real_hausdorff = distances.hausdorff_within

    def hausdorff_and_count(points, target, *arguments):  # type: ignore[no-untyped-def]
        counts["Hausdorff"] += points.shape[1] + len(target.points)
        return real_hausdorff(points, target, *arguments)

    with (
        mock.patch.object(objectives, "icp", icp_and_count),
        mock.patch.object(distances, "hausdorff_within", hausdorff_and_count),
    ):
        yield counts


# Agreement

JUDGED = f"yardstick's elite, ours at most {GOAL_EXCESS_CM} cm above"
SHORTLISTED = "our elite as searched, in the elite of the full evaluation"
ROTATED = "our elite, the same for a rotated copy, mean"


def agreement(
    n_samples: int = 500,
    n_points: int = 5000,
    n_generations: int = 6,
    n_judged: int = 120,
    n_control: int = 30,
    n_starts: int = 5,
    n_rotations: int = 3,
    n_clouds: int = 3,
) -> None:
    n_elite = n_samples // 10
    heading(
        f"Agreement: the {n_samples} candidates that a search draws after {n_generations} generations, elite of "
        f"{n_elite}\nYardstick: plain ICP with SciPy's k-d tree to rest (at most 500 rounds, 1e-4 cm) from {n_starts} "
        f"starts, error where\nthe RMSE is least; for the {n_judged} candidates that are best by our full evaluation, "
        f"and {n_control} drawn from the rest"
    )
    context = multiprocessing.get_context("spawn")
    rows = {}
    with ProcessPoolExecutor(CORES, mp_context=context) as pool, ThreadPoolExecutor(CORES) as threads:
        for name, points in clouds(n_points)[:n_clouds]:
            task = task_of(points, n_points)
            xs = mid_search(task, n_samples, n_points, n_generations)
            full = task.objective(n_points, threads)(xs)
            ours = task.objective(n_points, threads)(xs, n_elite)
            by_error = np.argsort(full, kind="stable")
            judged = by_error[:n_judged]
            control = np.random.default_rng(0).permutation(by_error[n_judged:])[:n_control]
            judge = partial(judge_by_yardstick, pool, task, xs, n_points, n_starts)
            rotated = [
                best(rotated_errors(points, xs, n_points, n_elite, seed, threads), n_elite)
                for seed in range(n_rotations)
            ]
            rows[name] = compare(
                full, ours, judged, judge(judged, name), judge(control, f"{name}, control"), rotated, n_elite
            )
            print(f"{name}: done", file=sys.stderr, flush=True)
    print(f"{'':60}" + "".join(f"{name:>18}" for name in (*rows, "pooled")))
    for key in next(iter(rows.values())):
        values = [row[key] for row in rows.values()]
        pooled = float({"largest": np.max, "least": np.min}.get(key.rsplit(" ", 1)[-1], np.mean)(values))
        goal = verdict(pooled, GOAL_SHARE) if key in (JUDGED, SHORTLISTED, ROTATED) else ""
        print(f"{key:60}" + "".join(f"{value:18.3f}" for value in (*values, pooled)) + goal)


def judge_by_yardstick(
    pool: Executor, task: Task, xs: np.ndarray, n_points: int, n_starts: int, which: np.ndarray, label: str
) -> np.ndarray:
    """Errors (len(which), 2) of candidates by the yardstick: where the RMSE is least, and the least of all starts."""
    jobs = [
        (points, junction, task.reference.points, task.starts, n_starts, int(i))
        for i, (points, junction) in zip(which, drawn(xs[which], n_points), strict=True)
    ]
    return np.array(list(progress(pool.map(yardstick, jobs), len(jobs), label))).reshape(-1, 2)


def rotated_errors(
    points: np.ndarray, xs: np.ndarray, n_points: int, n_elite: int, seed: int, executor: Executor
) -> np.ndarray:
    """Our errors, as a search takes them, on a rotated copy of the cloud, from its own start poses."""
    pose = random_pose(np.random.default_rng(seed))
    task = task_of(points @ pose[:3, :3].T + pose[:3, 3], n_points)
    return task.objective(n_points, executor)(xs, n_elite)


def best(errors: np.ndarray, n: int) -> set[int]:
    """The n smallest, as :class:`phytofit.CrossEntropy` takes them."""
    return set(np.argsort(errors, kind="stable")[:n].tolist())


def compare(
    full: np.ndarray,
    ours: np.ndarray,
    judged: np.ndarray,
    by_yardstick: np.ndarray,
    control: np.ndarray,
    rotated: list[set[int]],
    n_elite: int,
) -> dict[str, float]:
    """Shares, by what they are called in the table; `control` are the yardstick's errors of some not judged."""
    error, least = by_yardstick.T
    excess = full[judged] - error
    elite = np.argsort(error, kind="stable")[:n_elite]
    elite_by_least = np.argsort(least, kind="stable")[:n_elite]
    our_elite, full_elite = best(ours, n_elite), best(full, n_elite)
    is_ours = np.isin(judged, list(our_elite))
    return {
        JUDGED: np.mean(excess[elite] <= GOAL_EXCESS_CM),
        "  our elite, the same": np.mean(excess[is_ours] <= GOAL_EXCESS_CM),
        "  yardstick's elite by least error of all starts, the same": np.mean(
            (full[judged] - least)[elite_by_least] <= GOAL_EXCESS_CM
        ),
        "  ours less yardstick's over its elite, cm, mean": np.mean(excess[elite]),
        "  ours less yardstick's over its elite, cm, largest": np.max(excess[elite]),
        "  yardstick's elite that is ours too": np.mean(np.isin(judged[elite], list(our_elite))),
        "  control, share that would be the yardstick's elite": np.mean(control[:, 0] < error[elite[-1]]),
        SHORTLISTED: len(our_elite & full_elite) / n_elite,
        ROTATED: np.mean([len(our_elite & r) / n_elite for r in rotated]),
        "our elite, the same for a rotated copy, least": min(len(our_elite & r) / n_elite for r in rotated),
    }


# Printing


def heading(text: str) -> None:
    print(f"\n{text}", flush=True)


def verdict(ratio: float, goal: float) -> str:
    return f"   goal >= {goal:g}: {'met' if ratio >= goal else 'MISSED'}"


def progress(results: Iterable, total: int, label: str) -> Iterator:
    for done, result in enumerate(results, start=1):
        if sys.stderr.isatty() or done % 50 == 0:
            print(f"\r{label}: {done}/{total}", end="" if sys.stderr.isatty() else "\n", file=sys.stderr, flush=True)
        yield result


def machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        model = next((x.split(":")[1].strip() for x in info.read_text().splitlines() if x.startswith("model n")), model)
    load = os.getloadavg()[0]
    busy = "  THE MACHINE IS BUSY: these times mean little" if load > 0.5 else ""
    return (
        f"{model}, {CORES} cores, load {load:.1f}; Python {platform.python_version()}, NumPy {np.__version__}, "
        f"Numba {numba.__version__}{busy}"
    )


PARTS: dict[str, Callable[..., None]] = {"table1": table1, "peers": peers, "search": search, "agreement": agreement}
QUICK = {
    "table1": {"samples": (30,), "sizes": (1000,)},
    "peers": {"sizes": (1000,), "n_candidates": 3},
    "search": {"n_samples": 40, "n_points": 1000, "n_generations": 2, "repeats": 1, "n_clouds": 1},
    "agreement": {
        "n_samples": 40, "n_points": 1000, "n_generations": 2, "n_judged": 10, "n_control": 4, "n_starts": 2,
        "n_rotations": 1, "n_clouds": 1,
    },
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{', '.join(PARTS)}; all by default")
    parser.add_argument("--quick", action="store_true", help="small numbers, to try the script")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.parts) - set(PARTS))
    if unknown:
        parser.error(f"{', '.join(unknown)}: expected {', '.join(PARTS)}")
    print(machine())
    start = time.perf_counter()
    phytofit.fit(simulated(1000), "cm", method="paper", n_samples=20, n_generations=1, n_points=1000)
    print(f"kernels compiled or read in {time.perf_counter() - start:.1f} s")
    if arguments.quick:
        print("--quick: small numbers; neither times nor shares nor goals mean anything")
    for name in arguments.parts or PARTS:
        start = time.perf_counter()
        PARTS[name](**(QUICK[name] if arguments.quick else {}))
        print(f"({name}: {time.perf_counter() - start:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
