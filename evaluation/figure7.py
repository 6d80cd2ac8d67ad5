"""Fig. 7: a field phytomer made noisy, or with a hole, 50 times: leaf length by each method; a surface of points."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import phytofit
import phytofit.simulation
from benchmarks import model_free
from evaluation.draw import BLACK, faceted, outline, save, side_of
from evaluation.jobs import console, run_all
from evaluation.settings import COLORS, MARKERS, NAMES, Budget, clouds, read
from evaluation.tables import write_markdown, write_table

WAYS = {"noise": "0.5 cm noise added", "sphere": "a sphere of 6 cm removed"}
NOISE_CM, SPHERE_CM = 0.5, 6.0
TIP_CM = SPHERE_CM / 2.0 + 1.0  # a sphere nearer to the tip than this may have taken something of it
POISSON_DEPTH = 8  # of the octree: cells of a two hundredth of the cloud's size
OPEN3D = "pip install 'phytofit[peers]', and on Debian apt-get install libusb-1.0-0 libgl1 libx11-6"
UNTOUCHED = "untouched"
SIMULATED = {  # the comparison where the truth is known: noise, cm, and spheres removed
    "0.05 cm noise": (0.05, 0),
    "0.5 cm noise": (0.5, 0),
    "0.05 cm noise, three spheres of 6 cm removed": (0.05, 3),
    "0.5 cm noise, three spheres of 6 cm removed": (0.5, 3),
}


def make(budget: Budget, out: Path) -> None:
    simulated(budget, out)
    paths = clouds("field")[:1]
    if not paths:
        return
    path = paths[0]
    tip = phytofit.fit(read(path)).organs[1].axis[-1]
    jobs = [
        (path, how, number, method, budget.search if method == "paper" else {})
        for method in ("likelihood", "paper", "without a model")
        for how in (UNTOUCHED, *WAYS)
        for number in range(1, 2 if how == UNTOUCHED else budget.copies + 1)
    ]
    table = pd.DataFrame(run_all(length, jobs, "Fig. 7, leaf lengths"))
    centers = table[["center_x", "center_y", "center_z"]].to_numpy()
    table.insert(3, "tip_taken", np.linalg.norm(centers - tip, axis=1) < TIP_CM)
    table = table.drop(columns=["center_x", "center_y", "center_z"])
    write_table(table, "fig7", out)
    summary(table, out)
    lengths(table, out)
    pictures(path, out)


def corrupted(path: Path, how: str, number: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Points of the field phytomer made worse, and the centre of the sphere that was removed."""
    points = read(path).points
    random = np.random.default_rng(number)
    if how == "noise":
        return phytofit.simulation.add_noise(points, NOISE_CM, random), None
    if how == "sphere":
        center = points[np.random.default_rng(number).integers(len(points))]  # the first that `occlude` draws
        return points[phytofit.simulation.occlude(points, SPHERE_CM, random)], center
    return points, None


def length(path: Path, how: str, number: int, method: str, settings: dict[str, int]) -> dict[str, Any]:
    """Leaf length of a copy, cm, from a random starting mean, NaN where none is found; and where the sphere was, NaN
    where there was none."""
    points, center = corrupted(path, how, number)
    x, y, z = (np.nan,) * 3 if center is None else center.tolist()
    row: dict[str, Any] = {"method": method, "how": how, "copy": number, "center_x": x, "center_y": y, "center_z": z}
    row |= {"leaf_length": np.nan, "low": np.nan, "high": np.nan, "flags": ""}
    try:
        if method == "without a model":
            return row | {"leaf_length": model_free.measure(points)["leaf_length"]}
        start = {} if how == UNTOUCHED else {"random_start": True, "seed": number}
        result = phytofit.fit(points, "cm", method=method, threads=1, **start, **settings)
    except phytofit.NoPhytomerError:
        return row
    found = next(t for t in result.traits if t.name == "leaf_length")
    ends = [np.nan if end is None else end for end in (found.low, found.high)]
    return row | {"leaf_length": found.value, "low": ends[0], "high": ends[1], "flags": ";".join(result.flags)}


def summary(table: pd.DataFrame, out: Path) -> None:
    rows = []
    for method, mine in table.groupby("method", sort=False):
        untouched = mine.loc[mine["how"] == UNTOUCHED, "leaf_length"].item()
        for how, what in WAYS.items():
            those = mine[(mine["how"] == how) & ~mine["tip_taken"]]
            off = (those["leaf_length"] - untouched).abs()
            found = off[off.notna()]
            rows.append(
                [
                    NAMES[method],
                    f"{untouched:.1f}",
                    what,
                    f"{len(those)}",
                    f"{(found <= 1.0).sum()}",
                    f"{(found <= 5.0).sum()}",
                    f"{found.median():.2f}",
                    f"{found.max():.1f}",
                ]
            )
    head = [
        "method",
        "untouched, cm",
        "copies",
        "with their tip",
        "within 1 cm",
        "within 5 cm",
        "median off, cm",
        "most, cm",
    ]
    write_markdown(rows, head, "fig7", out)


def lengths(table: pd.DataFrame, out: Path) -> None:
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    axes = figure.subplots(1, len(WAYS), sharey=True)
    for ax, (how, what) in zip(axes, WAYS.items(), strict=True):
        for k, (method, mine) in enumerate(table.groupby("method", sort=False)):
            own = mine.loc[mine["how"] == UNTOUCHED, "leaf_length"].item()
            those = mine[mine["how"] == how]
            x = those["copy"] + 0.25 * (k - 1)
            below = (those["leaf_length"] - those["low"]).clip(lower=0.0).fillna(0.0)
            above = (those["high"] - those["leaf_length"]).clip(lower=0.0).fillna(0.0)
            ax.errorbar(
                x, those["leaf_length"], [below, above], fmt=MARKERS[method], ms=3.5, lw=0.8, color=COLORS[method],
                label=NAMES[method],
            )  # fmt: skip
            ax.axhline(own, color=COLORS[method], lw=1.0, ls="--", zorder=0)
            if method == "likelihood":
                ax.axhspan(own - 5.0, own + 5.0, color="0.92", zorder=-1)
        ax.set(xlabel="copy", title=what)
        ax.grid(alpha=0.25)
    axes[0].set_ylabel("leaf length (cm)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle("Dashed: the same method on the untouched cloud; grey: ± 5 cm, as the paper found", fontsize=11)
    save(figure, out / "fig7d.png")


def pictures(path: Path, out: Path) -> None:
    """A noisy and an occluded copy, the fit on each, and the surface that screened Poisson reconstruction makes."""
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    axes = figure.subplots(len(WAYS), 3)
    for row, (how, what) in zip(axes, WAYS.items(), strict=True):
        points, _ = corrupted(path, how, 1)
        result = phytofit.fit(points, "cm", random_start=True, seed=1)
        view = side_of(result.organs)
        box = points @ view.T
        for ax in row[:2]:
            ax.plot(*box[:, :2].T, ".", ms=1.2, color=BLACK, zorder=1, rasterized=True)
        outline(row[1], result.organs, view, COLORS["likelihood"])
        surface = run_all(poisson, [(points,)], f"Fig. 7, surface, {how}", one_by_one=True)[0]
        row[0].set_title(f"(a) {what}", fontsize=10)
        row[1].set_title("(b) the fitted model", fontsize=10)
        if surface is None:
            row[2].text(0.5, 0.5, "Open3D is not installed", ha="center", transform=row[2].transAxes)
        else:
            faceted(row[2], *surface[:2], view)
            row[2].set_title(f"(c) screened Poisson: {surface[2]} pieces, {surface[3]} handles", fontsize=10)
        for ax in row:
            ax.set(aspect="equal", xlabel="cm", ylabel="cm")
            ax.set_xlim(box[:, 0].min() - 3.0, box[:, 0].max() + 3.0)
            ax.set_ylim(box[:, 1].min() - 3.0, box[:, 1].max() + 3.0)
            ax.grid(alpha=0.25)
    save(figure, out / "fig7abc.png")


def poisson(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, int] | None:
    """Vertices and faces of the screened Poisson surface (Kazhdan and Hoppe, 2013) of points (n, 3), how many pieces
    it has, and how many handles (its genus), of which a leaf on a stem has none; None without Open3D."""
    try:
        import open3d  # noqa: PLC0415  an extra, and without a wheel for some versions of Python
    except (ImportError, OSError) as error:
        console.print(f"Fig. 7 (c) is left out ({error}): {OPEN3D}", highlight=False, soft_wrap=True)
        return None
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(20))
    cloud.orient_normals_consistent_tangent_plane(20)
    surface, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=POISSON_DEPTH, n_threads=1
    )
    closed = open3d.geometry.TriangleMesh(surface)
    pieces = len(closed.cluster_connected_triangles()[1])
    handles = pieces - closed.euler_poincare_characteristic() // 2
    surface.remove_vertices_by_mask(np.asarray(density) < np.quantile(density, 0.05))  # far from any point
    return np.asarray(surface.vertices), np.asarray(surface.triangles), pieces, int(handles)


def simulated(budget: Budget, out: Path) -> None:
    """Where the baseline without a model wins and where it breaks, beside both methods, on phytomers with a truth."""
    jobs = [
        (method, name, number, budget.search if method == "paper" else {})
        for name in SIMULATED
        for method in NAMES
        for number in range(budget.baseline)
    ]
    done = pd.DataFrame(run_all(compared, jobs, "Fig. 7, methods on simulated phytomers"))
    write_table(done, "methods", out)
    rows = []
    for name in SIMULATED:
        for method in NAMES:
            those = done[(done["way"] == name) & (done["method"] == method)]
            cells = [
                f"{those[t].abs().median():.2f} ({those[t].abs().max():.1f}){'°' if 'angle' in t else ' cm'}"
                for t in ("leaf_length", "leaf_angle", "leaf_width", "stem_diameter")
            ]
            rows.append([name if method == next(iter(NAMES)) else "", NAMES[method], *cells])
    write_markdown(
        rows,
        ["cloud", "median absolute error (largest)", "leaf length", "leaf angle", "leaf width", "stem diameter"],
        "methods",
        out,
    )


def compared(method: str, way: str, number: int, settings: dict[str, int]) -> dict[str, Any]:
    """Errors of the traits of one simulated phytomer."""
    noise, spheres = SIMULATED[way]
    made = phytofit.simulate(noise_cm=noise, n_spheres=spheres, seed=500_000 + number)
    true = {t.name: t.value for t in phytofit.measure(made.organs)}
    try:
        if method == "without a model":
            found = model_free.measure(made.points)
        else:
            result = phytofit.fit(made.points, "cm", method=method, threads=1, **settings)
            found = {t.name: t.value for t in result.traits}
    except phytofit.NoPhytomerError:
        found = dict.fromkeys(true, np.nan)
    return {"way": way, "method": method, "number": number} | {name: found[name] - true[name] for name in found}
