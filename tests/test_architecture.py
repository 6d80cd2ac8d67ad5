"""The layout of the package: imports go one way, names are kept, files stay short."""

import ast
import importlib
import sys
from pathlib import Path

import pytest

import phytofit

SOURCE = Path(phytofit.__file__).parent
MOST_LINES = 500

# From the top down.  A module may import from the layers below its own, and within its own package.
LAYERS = [
    {"__init__", "__main__"},
    {"cli"},
    {"batch"},
    {"pipeline"},
    {"report", "viewer", "export"},
    {"io"},
    {"plots"},
    {"recipe", "validation"},
    {"fitting"},
    {"results"},
    {"engine", "paper"},
    {"start"},
    {"reconstruct", "segmentation", "simulation"},
    {"traits"},
    {"species"},
    {"models"},
    {"cloud", "geometry"},
    {"kernels"},
    {"display", "ordering", "parameters", "parsing", "small_files"},
    {"bundled", "errors", "silence", "text", "version"},
]
DEPTH = {name: depth for depth, layer in enumerate(LAYERS) for name in layer}

# A result's `plot` and `to_frame` import what stands above it when they are called, and only then.
RESULTS = ("results/fitted.py", "segmentation/whole.py", "reconstruct/depth.py")
SHOWS_ITSELF = {(file, part) for file in RESULTS for part in ("plots", "io")}

# What a user needs; the rest is imported from its module.
PUBLIC = """
CAMERAS Agreement Camera CloudError Comparison Fit InputError NoPhytomerError NoStemError OutputError PaperFit
PhytofitError PlantRun PointCloud Reconstruction Remark Segmentation SegmentedLeaf SettingError SimulatedPhytomer
SimulatedPlant simulate_plant
Species SpeciesError Status Trait UnitError agreement compare fit from_points load_camera load_species measure
read_cloud read_measures read_results recipe reconstruct run save_fit save_reconstruction save_segmentation segment
separate_plants simulate write_cloud
"""

FILES = sorted(SOURCE.rglob("*.py"))
IDS = [str(path.relative_to(SOURCE)) for path in FILES]


def module_of(path):
    """Dotted name of a source file, phytofit and all."""
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def part_of(module):
    """What of phytofit a module belongs to: the name that stands in LAYERS."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def imports_of(path):
    package = module_of(path) if path.name == "__init__.py" else module_of(path).rpartition(".")[0]
    return imports_in(path.read_text(encoding="utf-8"), package)


def imports_in(text, package):
    """Dotted names of the modules that a module of a package imports, wherever in it, relative ones resolved."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            if base == "phytofit":  # the names may be modules
                for alias in node.names:
                    yield f"phytofit.{alias.name}" if alias.name in DEPTH else "phytofit"
            else:
                yield base


def third_party(path):
    names = {name.split(".")[0] for name in imports_of(path)}
    return names - set(sys.stdlib_module_names) - {"phytofit"}


def own(path):
    return {part_of(name) for name in imports_of(path) if name.split(".")[0] == "phytofit"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import numpy as np, os.path", {"numpy", "os.path"}),
        ("import phytofit.models", {"phytofit.models"}),
        ("from phytofit.models.organs import mesh", {"phytofit.models.organs"}),
        ("from phytofit import fitting, fit", {"phytofit.fitting", "phytofit"}),
        ("from . import nearest", {"phytofit.kernels"}),
        ("from .nearest import Bins", {"phytofit.kernels.nearest"}),
        ("from ..models import mesh", {"phytofit.models"}),
        ("from .. import start", {"phytofit.start"}),
        ("def f():\n    if f:\n        from phytofit.cli import main", {"phytofit.cli"}),
    ],
)
def test_the_walk_sees_every_way_to_import(text, expected):
    assert set(imports_in(text, "phytofit.kernels")) == expected


def test_every_module_has_its_layer():
    homeless = [name for path, name in zip(FILES, IDS, strict=True) if part_of(module_of(path)) not in DEPTH]
    assert not homeless, "put the new modules where they belong in LAYERS"


def test_imports_go_one_way():
    wrong = []
    for path, name in zip(FILES, IDS, strict=True):
        me = part_of(module_of(path))
        inside = {me} if path.parent != SOURCE else set()
        above = {other for other in own(path) - inside if DEPTH[other] <= DEPTH[me]}
        upwards = {other for other in above if (name, other) not in SHOWS_ITSELF}
        wrong += [f"{name} imports {other}, which stands beside or above it" for other in sorted(upwards)]
    assert not wrong


def test_results_import_what_shows_them_only_when_it_is_asked_for():
    for name in RESULTS:
        tree = ast.parse((SOURCE / name).read_text(encoding="utf-8"))
        at_once = {node.module for node in tree.body if isinstance(node, ast.ImportFrom)}
        assert not at_once & {"phytofit.plots", "phytofit.io"}, name


def test_the_optimiser_has_never_heard_of_plants():
    for path in (SOURCE / "paper" / "cross_entropy.py", SOURCE / "engine" / "scoring.py"):
        assert own(path) <= {"errors", "parameters"}, path.name
        assert third_party(path) <= {"numpy", "scipy"}, path.name


def test_kernels_know_numpy_only():
    for path in (SOURCE / "kernels").glob("*.py"):
        assert own(path) <= {"kernels"}, path.name
        assert third_party(path) <= ({"numpy", "numba"} if path.name == "compiling.py" else {"numpy"}), path.name


def test_what_shows_results_never_sees_the_engine():
    for name in ("report", "viewer", "plots", "export"):
        for path in (SOURCE / name).glob("*.py"):
            assert not own(path) & {"engine", "paper"}, path.name


def test_files_stay_short():
    assert not [
        name
        for path, name in zip(FILES, IDS, strict=True)
        if len(path.read_text(encoding="utf-8").splitlines()) > MOST_LINES
    ]


def is_sorted(names):
    """Plainly, or as ruff sorts (RUF022): constants, then classes, then functions, each alphabetically."""

    def isort_key(name):
        return (0 if name.isupper() else 1 if name[:1].isupper() else 2), name

    return list(names) in (sorted(names), sorted(names, key=str.lower), sorted(names, key=isort_key))


def test_public_names():
    names = phytofit.__all__
    assert set(names) == set(PUBLIC.split())
    assert len(names) == len(set(names))
    assert is_sorted(names)
    for name in names:
        assert getattr(phytofit, name) is not None


def test_every_module_names_what_it_offers():
    for path in FILES:
        if path.name == "__main__.py":
            continue
        module = importlib.import_module(module_of(path))
        if module.__name__ == "phytofit.kernels":  # a bare package: its modules are what it offers
            assert not hasattr(module, "__all__")
            continue
        names = module.__all__
        assert len(names) == len(set(names)), module.__name__
        assert is_sorted(names), module.__name__
        for name in names:
            assert hasattr(module, name), f"{module.__name__}.{name}"


def test_public_names_come_from_modules_that_offer_them():
    tree = ast.parse((SOURCE / "__init__.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("phytofit."):
            offered = importlib.import_module(node.module).__all__
            assert {alias.name for alias in node.names} <= set(offered), node.module
