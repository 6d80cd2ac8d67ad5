"""Every command that writes, with results that are there at once: only what they write, and how, is tried."""

import importlib
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from typer.testing import CliRunner

from phytofit import cli, fit, from_points, load_species, simulate, write_cloud
from phytofit.io import COLUMNS
from phytofit.reconstruct import Reconstruction, load_camera
from phytofit.segmentation import Segmentation, SegmentedLeaf

PLOTS = ("io.phytomer.plot_fit", "io.phytomer.plot_convergence", "io.plant.plot_segmentation",
         "io.plant.plot_reconstruction", "pipeline.plant.plot_plant", "report.page.plot_agreement")  # fmt: skip


class World:
    """What the commands find: two versions of all results, of which `version` says the one that comes out now."""

    def __init__(self):
        self.version = 0
        made = simulate(load_species(), n_points=400, noise_cm=0.2, seed=3)
        first = fit(from_points(made.points, "cm"), n_samples=20, n_generations=2, threads=1)
        self.points = made.points
        self.fits = (first, replace(first, seed=1, x=first.x * 1.01))
        self.segmentations = (segmentation(made.points, 3), segmentation(made.points, 2))
        self.reconstructions = (reconstruction(made.points), reconstruction(made.points * 1.1))

    def patch(self, monkeypatch):
        """Let the commands find it."""

        def put(name, function):
            module, _, attribute = name.rpartition(".")
            monkeypatch.setattr(importlib.import_module(f"phytofit.{module}"), attribute, function)

        for module in ("fitting", "pipeline.plant"):
            put(f"{module}.fit", lambda cloud, **how: self.fits[self.version])
        for module in ("segmentation", "pipeline.plant"):
            put(f"{module}.segment", lambda cloud, **how: self.segmentations[self.version])
        for module in ("reconstruct", "pipeline.plant"):
            put(f"{module}.reconstruct", lambda *_, **how: self.reconstructions[self.version])
        for name in PLOTS:
            put(name, picture)

    def lay_out(self, folder):
        """The inputs of all commands, in a folder."""
        cloud = from_points(self.points, "cm")
        for name in ("a", "b"):
            write_cloud(folder / f"{name}.ply", cloud)
        (folder / "view.png").touch()  # which makes it a folder of images, too
        (folder / "results").mkdir()
        rows = [("a", 1, "leaf", 1, "leaf_length", 50.0, "cm", 48.0, 52.0, "good", "", "likelihood")]
        pd.DataFrame(rows, columns=COLUMNS).to_csv(folder / "results" / "traits.csv", index=False)
        for version in (0, 1):
            (folder / f"truth_{version}.csv").write_text(f"cloud,leaf_length_cm\na,{50 + version}.5\n")


def picture(*_, **__):
    figure = Figure(figsize=(1.0, 1.0))
    FigureCanvasAgg(figure)
    return figure


def segmentation(points, n_leaves):
    labels = np.ones(len(points), np.int64)
    height = points[:, 2] - points[:, 2].min()
    labels[height > 0.5 * height.max()] = 2 + np.arange(len(points))[height > 0.5 * height.max()] % n_leaves
    low, high = points.min(axis=0), points.max(axis=0)
    leaves = tuple(
        SegmentedLeaf(
            rank=rank,
            azimuth=90.0 * rank,
            collar=low,
            collar_distance=5.0 * rank,
            collar_height=5.0 * rank,
            tip=high,
            midrib=np.array([low, high]),
            length=30.0 + rank,
            n_points=50,
            flags=(),
        )
        for rank in range(1, n_leaves + 1)
    )
    path = np.array([low, [low[0], low[1], high[2]]])
    return Segmentation(from_points(points, "cm"), labels, path, 1.0, np.array([0.0, 0.0, 1.0]), leaves)


def reconstruction(points):
    ones = np.ones(len(points), np.int64)
    view, poses = from_points(points, "cm"), np.eye(4)[np.newaxis]
    nothing = {"turn": None, "step_deg": None, "loop": None, "contradicted": 0.0, "rejected": (), "flags": ()}
    return Reconstruction(
        view, 0 * ones, ones, load_camera("kinect-v2"), ("a.png",), poses, pairs=(), settings={}, **nothing
    )


def arguments(command, folder, version):
    """Of a command that reads what `World.lay_out` laid out, and writes to ``folder/out``."""
    out = ["--out", folder / "out"]
    cloud = [folder / "a.ply", "--units", "cm"]
    return {
        "fit": ["fit", *cloud, folder / "b.ply", "--mesh", "obj", "--xlsx", *out],
        "segment": ["segment", *cloud, folder / "b.ply", *out],
        "simulate": ["simulate", "-n", 2 - version, "--points", 150, "--seed", version, *out],
        "demo": ["demo", "--seed", version + 1, *out],
        "reconstruct": ["reconstruct", folder, "--camera", "kinect-v2", *out],
        "run": ["run", *cloud, "--seed", version, *out],
        "validate": ["validate", folder / "results", "--truth", folder / f"truth_{version}.csv", *out],
    }[command]


COMMANDS = ("fit", "segment", "simulate", "demo", "reconstruct", "run", "validate")


def run(world, command, folder, version):
    world.version = version
    runner = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"})
    return runner.invoke(cli.app, [str(argument) for argument in arguments(command, folder, version)])


def with_notes(out):
    """The user's own files in the folder of the results and in those of single results; what they hold, by name."""
    folders = [out, *(path for path in out.rglob("*") if path.is_dir() and path.name != "phytomers")]
    for folder in folders:
        (folder / "note.txt").write_text("mine")
    return {(folder / "note.txt").relative_to(out).as_posix() for folder in folders}


def fresh(template, folder):
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(template, folder, symlinks=True)
