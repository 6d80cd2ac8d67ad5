"""Where the default method stops working, and whether its flags say so first.

    python benchmarks/robustness.py [field] [sweeps] [--phytomers 100] [--untouched 330] [--peers 3] [--only SWEEP ...]

field    the paper's two data sets (Fig. 7): a field phytomer with 0.5 cm noise added, or without the points in a
         sphere of 6 cm; and among pieces of another phytomer and a background, with seed points on the leaf that is
         meant; 50 copies each, from random starting means: leaf length beside that of the untouched cloud
sweeps   simulated phytomers made worse step by step, others at each step: noise, holes, a missing tip, outliers, few
         viewpoints, few points, leaves of others; errors, coverage of the 95 % intervals and flags, and the errors of
         the paper's method and of model_free.py on some of the clouds; plotted in docs/images/robustness.png
"""

import argparse
import os
import sys
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # each process works with one thread

import model_free
import numpy as np
from common import DATA, progress, run_parts
from matplotlib.figure import Figure
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trust import covers

import phytofit
import phytofit.simulation

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "robustness.png"
SPECIES = phytofit.load_species()
TRAITS = ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter")
FIRST_SEED, SEEDS = 900_000, 10_000  # of the untouched phytomers; how many a step has for its own
HOLED = "leaf removed"
COPIES = 50  # of the field phytomer, each way
SEEDED = (6, 12, 18, 24)  # nodes of its midrib that are seed points
N_PIECES, PIECE_CM = 6, 6.0  # of another phytomer; their radius


class Sweep(NamedTuple):
    """One way of making a cloud worse: its unit, its steps, those of them at which the method is said to work, and
    points (n, 3) of a phytomer at a step.  At step 0 it is untouched."""

    unit: str
    steps: tuple[float, ...]
    works: tuple[float, ...]
    cloud: Callable[[phytofit.SimulatedPhytomer, float, np.random.Generator], np.ndarray]
    noise_cm: float = 0.5
    n_points: int = 5000
    seeded: bool = False  # told by a seed point which leaf is meant


class Outcome(NamedTuple):
    """Errors and coverage (4,) of `TRAITS`, NaN where there is none; flags; False if no phytomer was found; errors of
    leaf length of the paper's method and of the baseline without a model."""

    error: np.ndarray
    covered: np.ndarray
    flags: tuple[str, ...]
    found: bool
    peers: tuple[float, float]


def along_leaf(made: phytofit.SimulatedPhytomer) -> np.ndarray:
    """Share of the midrib at which each point lies; negative on the stem."""
    leaf = made.organs[1]
    offset = made.points[:, np.newaxis] - leaf.axis[:-1]
    along = np.clip(np.einsum("nmi,mi->nm", offset, leaf.frame[:, :, 0]), 0.0, leaf.segment_lengths)
    gap = offset - along[..., np.newaxis] * leaf.frame[:, :, 0]
    j = np.argmin(np.einsum("nmi,nmi->nm", gap, gap), axis=1)
    share = (j + along[np.arange(len(j)), j] / leaf.segment_lengths[j]) / len(leaf.segment_lengths)
    return np.where(made.labels == 2, share, -1.0)


def with_noise(made: phytofit.SimulatedPhytomer, std_cm: float, random: np.random.Generator) -> np.ndarray:
    return phytofit.simulation.add_noise(made.points, std_cm, random)


def with_holes(made: phytofit.SimulatedPhytomer, share: float, random: np.random.Generator) -> np.ndarray:
    """Without spheres of 6 cm around points of the leaf, but its tip, until so much of the leaf is gone."""
    place, keep = along_leaf(made), np.ones(len(made.points), bool)
    leaf = made.labels == 2
    while keep[leaf].mean() > 1.0 - share:
        left = np.flatnonzero(keep & leaf & (place < 0.85))
        if len(left) == 0:
            break
        center = made.points[random.choice(left)]
        keep &= (np.linalg.norm(made.points - center, axis=1) > 3.0) | (place > 0.95)
    return made.points[keep]


def without_tip(made: phytofit.SimulatedPhytomer, share: float, random: np.random.Generator) -> np.ndarray:
    return made.points[along_leaf(made) < 1.0 - share]


def with_outliers(made: phytofit.SimulatedPhytomer, share: float, random: np.random.Generator) -> np.ndarray:
    """So large a share of all points is outliers."""
    return np.concatenate([made.points, phytofit.simulation.add_outliers(made.points, share / (1.0 - share), random)])


def from_cameras(made: phytofit.SimulatedPhytomer, views: float, random: np.random.Generator) -> np.ndarray:
    """As so many cameras see it."""
    number = int(random.integers(2**31))
    return phytofit.simulate(
        SPECIES, fixed=dict(zip(SPECIES.space.names, made.x.tolist(), strict=True)), n_views=int(views), seed=number
    ).points


def fewer(made: phytofit.SimulatedPhytomer, n_points: float, random: np.random.Generator) -> np.ndarray:
    return made.points[random.permutation(len(made.points))[: int(n_points)]]


def among_others(made: phytofit.SimulatedPhytomer, n_leaves: float, random: np.random.Generator) -> np.ndarray:
    """With leaves of others at the same stem, at least 60 degrees to the side, and a piece of wall behind."""
    upright = (made.points - made.pose[:3, 3]) @ made.pose[:3, :3]
    parts = [upright]
    for _ in range(int(n_leaves)):
        other = phytofit.simulate(SPECIES, n_points=3000, noise_cm=0.5, seed=int(random.integers(2**31)))
        leaf = ((other.points - other.pose[:3, 3]) @ other.pose[:3, :3])[other.labels == 2]
        turn = np.deg2rad(random.uniform(60.0, 300.0))
        c, s = np.cos(turn), np.sin(turn)
        leaf[:, 2] += random.uniform(0.0, made.organs[0].segment_lengths.sum()) - other.x[1]
        parts.append(leaf @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    if n_leaves:
        side = 40.0 * (1.0 if random.random() < 0.5 else -1.0)
        parts.append(random.uniform([-20.0, side - 1.0, 0.0], [40.0, side + 1.0, 40.0], (500, 3)))
    return np.concatenate(parts) @ made.pose[:3, :3].T + made.pose[:3, 3]


NOISE, HOLES, TIPS = (0.1, 0.25, 0.5, 1.0, 1.5, 2.0), (0.0, 0.1, 0.2, 0.4, 0.6), (0.0, 0.05, 0.1, 0.2, 0.3)
OUTLIERS, POINTS = (0.0, 0.1, 0.2, 0.3, 0.4), (300.0, 1000.0, 2500.0, 5000.0)
VIEWS, OTHERS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0), (1.0, 2.0, 4.0)
SWEEPS = {
    "noise": Sweep("cm", NOISE, NOISE[:5], with_noise, noise_cm=0.0),
    HOLED: Sweep("share", HOLES, HOLES[:4], with_holes),
    "tip cut off": Sweep("share of the midrib", TIPS, TIPS, without_tip),
    "outliers": Sweep("share of the points", OUTLIERS, OUTLIERS, with_outliers),
    "views": Sweep("cameras around the plant", VIEWS, VIEWS[2:], from_cameras),
    "points": Sweep("number", POINTS, POINTS, fewer),
    "leaves of others": Sweep("number, and a wall", OTHERS, (), among_others, seeded=True),
}


class Job(NamedTuple):
    """A phytomer of a step of a sweep, untouched at step 0; whether the peers measure it, too."""

    sweep: str
    step: float
    number: int
    with_peers: bool

    @property
    def seed(self) -> int:
        """Other phytomers at each step."""
        if self.step == 0.0:
            return FIRST_SEED + self.number
        at = [(name, step) for name, sweep in SWEEPS.items() for step in sweep.steps].index(self[:2])
        return FIRST_SEED + (1 + at) * SEEDS + self.number


def measured(job: Job) -> Outcome:
    sweep = SWEEPS[job.sweep]
    made = phytofit.simulate(SPECIES, n_points=sweep.n_points, noise_cm=sweep.noise_cm, seed=job.seed)
    points = sweep.cloud(made, job.step, np.random.default_rng(job.seed))
    seed_point = made.organs[1].axis[12] if sweep.seeded else None
    true = {t.name: t.value for t in phytofit.measure(made.organs)}
    peers = peer_errors(points, seed_point, true["leaf_length"]) if job.with_peers else (np.nan, np.nan)
    try:
        result = phytofit.fit(points, "cm", seed_point=seed_point, threads=1)
    except phytofit.PhytofitError as refused:
        none = np.full(len(TRAITS), np.nan)
        return Outcome(none, none, (str(refused),), False, peers)
    traits = {t.name: t for t in result.traits}
    return Outcome(
        np.array([traits[name].value - true[name] for name in TRAITS]),
        np.array([covers(traits[name], true[name]) for name in TRAITS]),
        result.flags,
        True,
        peers,
    )


def peer_errors(points: np.ndarray, seed_point: np.ndarray | None, length: float) -> tuple[float, float]:
    """Errors of leaf length of the paper's method and of the baseline without a model, NaN where they find none."""

    def paper() -> float:
        result = phytofit.fit(points, "cm", seed_point=seed_point, method="paper", threads=1)
        return next(t.value for t in result.traits if t.name == "leaf_length")

    errors = []
    for peer in (paper, lambda: model_free.measure(points, seed_point)["leaf_length"]):
        try:
            errors.append(peer() - length)
        except phytofit.PhytofitError:
            errors.append(np.nan)
    return errors[0], errors[1]


def sweeps(pool: ProcessPoolExecutor, phytomers: int, untouched: int, n_peers: int, wanted: list[str]) -> None:
    steps = [(name, step) for name in wanted for step in SWEEPS[name].steps if step]
    jobs = [Job(HOLED, 0.0, i, i < n_peers) for i in range(untouched)]
    jobs += [Job(name, step, i, i < n_peers) for name, step in steps for i in range(phytomers)]
    outcomes = defaultdict(list)
    for job, outcome in zip(jobs, progress(pool.map(measured, jobs, chunksize=1), len(jobs)), strict=True):
        outcomes[job[:2]].append(outcome)
    for name in wanted:
        outcomes[name, 0.0] = outcomes[HOLED, 0.0]
    print(
        f"\n{phytomers} simulated phytomers a step, {untouched} that are untouched (step 0 of each sweep that has one):"
    )
    print(
        "median absolute error (95th percentile) of those that were found; coverage of the 95 % intervals: of each of"
    )
    print(
        "the four traits, of all, of the unflagged; last, leaf length by the paper's method and by the baseline without"
    )
    print(f"a model: median absolute error of those that found one, of the first {min(n_peers, phytomers)}")
    figure = Figure(figsize=(17.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 4).ravel()
    axes[-1].axis("off")
    for ax, name in zip(axes, wanted, strict=False):
        sweep = SWEEPS[name]
        print(f"\n{name}, {sweep.unit}")
        print(
            f"{'':>8}"
            + "".join(f"{trait:>18}" for trait in TRAITS)
            + "   covered: each      all  unflagged   flagged  refused    paper's  model-free"
        )
        shown = [print_step(step, outcomes[name, step], n_peers) for step in sweep.steps]
        print_where_it_works(sweep, [o for step in sweep.works for o in outcomes[name, step] if o.found])
        lines = draw(ax, name, sweep, np.array(shown))
    if len(wanted) < len(SWEEPS):
        return
    axes[-1].legend(lines, [line.get_label() for line in lines], fontsize=10, loc="center")
    PICTURE.parent.mkdir(exist_ok=True)
    figure.savefig(PICTURE, dpi=110)
    print(f"\nplotted: {PICTURE.relative_to(PICTURE.parents[2])}")


def print_step(step: float, those: list[Outcome], n_peers: int) -> tuple[float, ...]:
    """Median error of leaf length, how many intervals hold (%), how many are flagged (%), and the peers' errors."""
    errors = np.abs([o.error for o in those if o.found]).reshape(-1, len(TRAITS))
    covered = np.array([o.covered for o in those if o.found]).reshape(-1, len(TRAITS))
    plain = np.array([o.covered for o in those if o.found and not o.flags]).reshape(-1, len(TRAITS))
    flagged = np.mean([bool(o.flags) for o in those])
    refused = sum(not o.found for o in those)
    median, most = (np.quantile(errors, q, axis=0) if len(errors) else np.full(4, np.nan) for q in (0.5, 0.95))
    cells = "".join(f"{a:9.2f} ({b:6.2f})" for a, b in zip(median, most, strict=True))
    held = [100 * np.nanmean(c) if len(c) else np.nan for c in (covered, plain)]
    each = " ".join(f"{share:3.0f}" for share in 100 * np.nanmean(covered, axis=0)) if len(covered) else ""
    others = np.nanmedian(np.abs([o.peers for o in those[:n_peers]]), axis=0) if n_peers else np.full(2, np.nan)
    print(
        f"{step:8g}{cells}  {each:15}{held[0]:6.0f} %{held[1]:9.0f} %{100 * flagged:8.0f} %{refused:9}"
        f"{others[0]:11.2f}{others[1]:12.2f}",
        flush=True,
    )
    return median[0], held[0], 100 * flagged, *others


def print_where_it_works(sweep: Sweep, outcomes: list[Outcome]) -> None:
    """Coverage of each trait over the steps at which the method is said to work."""
    steps = ", ".join(f"{step:g}" for step in sweep.works)
    for kind, those in (("all", outcomes), ("unflagged", [o for o in outcomes if not o.flags])):
        if those:
            held = 100 * np.nanmean([o.covered for o in those], axis=0)
            each = ", ".join(f"{trait} {share:.1f} %" for trait, share in zip(TRAITS, held, strict=True))
            print(f"  at {steps}, {kind} {len(those)}: {each}", flush=True)


def draw(ax, name: str, sweep: Sweep, shown: np.ndarray) -> list:  # type: ignore[no-untyped-def,type-arg]
    x = np.arange(len(sweep.steps))
    if np.isfinite(shown[:, 3:]).any():
        ax.plot(x, shown[:, 3], color="0.45", marker="v", lw=1.0, label="the same by the paper's method")
        ax.plot(x, shown[:, 4], color="0.7", marker="x", lw=1.0, label="the same without a model (model_free.py)")
    ax.plot(x, shown[:, 0], color="#0072B2", marker="o", label="leaf length: median absolute error, cm")
    ax.set_xticks(x, [f"{step:g}" for step in sweep.steps])
    ax.set_xlabel(f"{name} ({sweep.unit})")
    ax.set_ylabel("error, cm")
    ax.set_yscale("symlog", linthresh=1.0)
    ax.set_yticks([0.0, 0.5, 1.0, 3.0, 10.0, 30.0], ["0", "0.5", "1", "3", "10", "30"])
    ax.set_ylim(0.0, 60.0)
    ax.grid(alpha=0.25)
    other = ax.twinx()
    other.plot(x, shown[:, 1], color="#D55E00", marker="s", ls="--", label="true value within the interval, %")
    other.plot(x, shown[:, 2], color="#009E73", marker="^", ls=":", label="flagged, %")
    other.set_ylim(-3.0, 103.0)
    other.set_ylabel("%")
    return [*ax.get_lines(), *other.get_lines()]


def field_points(number: int = 0) -> np.ndarray:
    return phytofit.read_cloud(sorted((DATA / "field").glob("*.ply"))[number], "cm").points


def among_pieces(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """With pieces of another field phytomer, turned at random, 5 to 20 cm from points of this one, and a background."""
    other, parts = field_points(1), [points]
    for _ in range(N_PIECES):
        piece = other[np.linalg.norm(other - random.choice(other), axis=1) < PIECE_CM]
        toward = random.normal(size=3)
        place = random.choice(points) + random.uniform(5.0, 20.0) * toward / np.linalg.norm(toward)
        parts.append((piece - piece.mean(axis=0)) @ Rotation.random(random_state=random).as_matrix() + place)
    low, high = points.min(axis=0), points.max(axis=0)
    thin = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]  # the view's direction, about
    sheet = random.uniform(low - 10.0, high + 10.0, (len(points) // 2, 3))
    sheet -= ((sheet - points.mean(axis=0)) @ thin - 20.0 - random.normal(0.0, 0.5, len(sheet)))[:, np.newaxis] * thin
    return np.concatenate([*parts, sheet])


def field_length(job: tuple[str, int, np.ndarray]) -> tuple[float, float, float, bool, bool, float, float]:
    """Leaf length and its interval (not a number where the cloud is refused), whether its tip is said to be missing,
    whether it has a flag, and how far the sphere was from the leaf's ends, base and tip, or the next piece of another;
    midrib (k, 3) of the untouched leaf."""
    how, number, midrib = job
    points, away, seed_point = field_points(), np.full(2, np.inf), None
    random = np.random.default_rng(number)
    if how == "noise":
        points = phytofit.simulation.add_noise(points, 0.5, random)
    elif how == "sphere":
        center = points[np.random.default_rng(number).integers(len(points))]
        points = points[phytofit.simulation.occlude(points, 6.0, random)]
        away = np.linalg.norm(center - midrib[[0, -1]], axis=1)
    elif how == "pieces":
        crowded, seed_point = among_pieces(points, random), midrib[list(SEEDED)]  # it has gaps: one for each piece
        away[0] = cKDTree(points).query(crowded[len(points) :])[0].min()
        points = crowded
    try:
        result = phytofit.fit(points, "cm", random_start=True, seed=number, threads=1, seed_point=seed_point)
    except phytofit.NoPhytomerError:
        return np.nan, np.nan, np.nan, False, True, *away
    length = next(t for t in result.traits if t.name == "leaf_length")
    high = np.inf if length.high is None else length.high
    return length.value, length.low, high, not result.estimate.tip_seen, bool(result.flags), *away


def field(pool: ProcessPoolExecutor) -> None:
    if not DATA.is_dir():
        sys.exit(f"{DATA} is absent: the field phytomer can't be measured")
    whole = phytofit.fit(field_points(), "cm")
    untouched = next(t.value for t in whole.traits if t.name == "leaf_length")
    print(f"\nThe paper's corrupted field phytomers (Fig. 7); leaf length of the untouched cloud {untouched:.2f} cm")
    for how in ("noise", "sphere", "pieces"):
        jobs = [(how, number, whole.organs[1].axis) for number in range(1, COPIES + 1)]
        measured = np.array(list(progress(pool.map(field_length, jobs), COPIES))).T
        refused = int(np.isnan(measured[0]).sum())
        measured = measured[:, np.isfinite(measured[0])]
        value, low, high, missing, flagged, near, away = measured
        kept = away > 3.0 + 1.0  # cm: the sphere's radius, and some: it took nothing of the tip
        off = np.abs(value - untouched)
        held = np.mean((low <= untouched) & (untouched <= high))
        print(
            f"  {how:7} {COPIES} copies, {kept.sum()} with the tip: within 1 cm {np.sum(off[kept] <= 1.0)}, "
            f"median {np.median(off[kept]):.2f} cm off, at most {off[kept].max():.2f}; "
            f"interval holds it for {100 * held:.0f} % of all; tip missing or doubtful: {missing.sum():.0f}"
            f"{f'; refused: {refused}' if refused else ''}"
        )
        for i in np.flatnonzero(off > 1.0):
            at = {
                "noise": "",
                "sphere": f"; its sphere: {near[i]:.1f} cm from the leaf's base, {away[i]:.1f} cm from its tip",
                "pieces": f"; the next piece is {near[i]:.1f} cm away",
            }
            print(f"    copy {i + 1}: {value[i] - untouched:+.2f} cm{', flagged' if flagged[i] else ''}{at[how]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help="field, sweeps; both by default")
    parser.add_argument("--phytomers", type=int, default=100, help="a step")
    parser.add_argument("--untouched", type=int, default=330, help="step 0 of holes, tip and outliers")
    parser.add_argument(
        "--only", nargs="+", default=list(SWEEPS), choices=list(SWEEPS), help="these sweeps; no picture"
    )
    parser.add_argument(
        "--peers", type=int, default=3, help="phytomers a step that the other methods measure too: they take long"
    )
    arguments = parser.parse_args()
    parts = {
        "field": field,
        "sweeps": lambda pool: sweeps(pool, arguments.phytomers, arguments.untouched, arguments.peers, arguments.only),
    }
    run_parts(parts, arguments.parts)


if __name__ == "__main__":
    main()
