"""Table I: seconds per generation over samples and points, beside the paper's and other libraries'."""

import os
import platform
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd

import phytofit
import phytofit.fitting
import phytofit.models
import phytofit.paper
import phytofit.start
from benchmarks import peers
from evaluation.jobs import run_all
from evaluation.settings import PAPERS, Budget
from evaluation.tables import write_markdown, write_table

PAPER = {  # seconds, 8 threads of an Intel i7 at 2.9 GHz: (samples, points)
    (100, 1000): 0.67, (100, 5000): 3.61, (100, 10000): 7.98,
    (500, 1000): 3.31, (500, 5000): 18.8, (500, 10000): 40.3,
    (1000, 1000): 6.80, (1000, 5000): 37.1, (1000, 10000): 80.4,
}  # fmt: skip
ROUNDS = 50  # of a peer's ICP
CORES = os.cpu_count() or 1


def make(budget: Budget, out: Path) -> None:
    rows = run_all(
        seconds, [(*cell, budget.generations, budget.candidates) for cell in budget.cells], "Table I", one_by_one=True
    )
    table = pd.DataFrame(rows)
    write_table(table, "table1", out)
    head = [
        "samples",
        "points",
        "the paper",
        f"phytofit, {CORES} threads",
        "phytofit, 1 thread",
        *list(table.columns[5:]),
    ]
    cells = [
        [f"{row[0]:.0f}", f"{row[1]:,.0f}", *("" if np.isnan(s) else f"{s:.3g}" for s in row[2:])]
        for row in table.to_numpy(float)
    ]
    write_markdown(cells, head, "table1", out)
    (out / "machine.md").write_text(f"{CORES} cores, {processor()}\n", encoding="utf-8")


def seconds(n_samples: int, n_points: int, n_generations: int, n_candidates: int) -> dict[str, float]:
    """Seconds of a generation: ours, mean of a search's, with all threads and with one; a peer's, one thread, from so
    many candidates, each with 50 rounds of ICP and the Hausdorff distance."""
    species = PAPERS
    cloud = phytofit.from_points(phytofit.simulate(n_points=n_points, seed=1).points, "cm")
    found = phytofit.start.prepare(cloud, species, n_points=n_points)
    starts = [start.pose for start in found.starts]
    mean = phytofit.fitting.mean_at(found.starts[0], species)
    row: dict[str, float] = {
        "samples": n_samples,
        "points": n_points,
        "paper": PAPER.get((n_samples, n_points), np.nan),
    }
    for threads in (CORES, 1):
        with ThreadPoolExecutor(threads) as executor:
            search = phytofit.paper.CrossEntropy(
                species.space, n_samples=n_samples, n_generations=n_generations, mean=mean
            )
            objective = phytofit.paper.PaperObjective(
                species.model,
                phytofit.paper.Reference.of(found.points),
                starts=starts,
                n_points=n_points,
                executor=executor,
            )
            phytofit.paper.minimise(
                phytofit.paper.CrossEntropy(species.space, n_samples=20, n_generations=1, mean=mean), objective
            )  # kernels compiled
            began = time.perf_counter()
            phytofit.paper.minimise(search, objective)
            row["all threads" if threads == CORES and "all threads" not in row else "one thread"] = (
                time.perf_counter() - began
            ) / n_generations
    row.setdefault("one thread", row["all threads"])
    organs = species.model.organs(search.ask()[:n_candidates])
    population = phytofit.models.SurfaceSampler(n_points, seed=0).population(organs)
    for make_peer in (peers.small_gicp_peer, peers.open3d_peer, peers.scipy_peer):
        try:
            peer = make_peer(found.points)
        except (ImportError, OSError):
            continue  # an extra, and without a wheel for some versions of Python
        began = time.perf_counter()
        for i in range(min(n_candidates, n_samples)):
            points = population.draw(i)[0].T.astype(float)
            pose, _ = peer.align(points, peers.placed(organs[1].axis[i, 0], starts[0]), ROUNDS)
            peer.distance(points, pose)
        row[peer.name] = (time.perf_counter() - began) * n_samples / min(n_candidates, n_samples)
    return row


def processor() -> str:
    """What the machine says it is."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
