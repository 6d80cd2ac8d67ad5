"""Help: there at once, and true: what it shows are the defaults of the functions that are called."""

import ast
import inspect
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import phytofit
from phytofit.cli import app
from phytofit.cli.settings import defaults_of, entries_of
from phytofit.fitting import METHODS, fit
from phytofit.paper.distances import DISTANCES
from phytofit.parsing import AXES
from phytofit.pipeline import run
from phytofit.recipe import defaults
from phytofit.reconstruct import CAMERAS, reconstruct
from phytofit.simulation import simulate, simulate_plant
from phytofit.species import load_species

COMMANDS = ("fit", "run", "segment", "reconstruct", "simulate", "validate", "demo", "recipe")
SLOW = ("numpy", "scipy", "numba", "pandas", "matplotlib")
MOST_CPU_S = 0.5


def help_of(*command):
    done = CliRunner(env={"COLUMNS": "300", "NO_COLOR": "1", "TERM": "dumb"}).invoke(app, [*command, "--help"])
    assert done.exit_code == 0
    return " ".join(done.output.replace("│", " ").split())


def test_help_imports_nothing_slow():
    code = (
        "import sys\nfrom phytofit.cli import app\n"
        "for command in ([], *([name] for name in sys.argv[1:])):\n"
        "    app([*command, '--help'], standalone_mode=False)\n"
        f"print('slow:', sorted(set({SLOW!r}) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code, *COMMANDS], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("slow: []\n"), done.stdout[-200:] + done.stderr
    assert all(f"phytofit {name} " in done.stdout.replace("-c ", "phytofit ") for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_flag_does_not_look_as_if_it_took_a_value(name):
    said = help_of(name)
    assert "--quiet -q Show" in said
    assert "bool" not in said.replace("--help -h <bool>", "")  # that of typer itself


@pytest.mark.long  # and on a machine that does nothing else
def test_help_takes_less_than_half_a_second():
    """Of the processor; the least of five, since what else runs on the machine adds to it."""
    took = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", "phytofit", "fit", "--help"], stdout=subprocess.DEVNULL, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(took) < MOST_CPU_S


@pytest.mark.parametrize(
    ("module", "name", "function"),
    [
        ("fitting", "fit", fit),
        *(("fitting", function.__name__, function) for function in METHODS.values()),
        ("pipeline", "run", run),
        ("reconstruct", "reconstruct", reconstruct),
        ("simulation", "simulate", simulate),
        ("species", "load_species", load_species),
    ],
)
def test_defaults_are_read_as_python_reads_them(module, name, function):
    expected = {key: value for key, value in defaults(function).items() if not inspect.isfunction(value)}
    assert defaults_of(module, name) == expected


def test_names_are_read_as_python_reads_them():
    assert entries_of("paper.distances", "DISTANCES").keys() == DISTANCES.keys()
    assert entries_of("parsing", "AXES").keys() == AXES.keys()
    assert entries_of("reconstruct.cameras", "PRESETS").keys() == CAMERAS.keys()
    assert entries_of("fitting", "METHODS") == {name: function.__name__ for name, function in METHODS.items()}


def test_help_shows_the_defaults_of_the_functions():
    shown = help_of("fit")
    by_method = {name: defaults(function) for name, function in METHODS.items()}
    for setting in ("n_samples", "n_points", "n_generations"):
        assert ", ".join(f"{by_method[name][setting]} for {name}" for name in METHODS) in shown
    assert f"[default: {defaults(fit)['species']}]" in shown
    for name in (*DISTANCES, *AXES):
        assert name in shown
    for name in CAMERAS:
        assert name in help_of("run")
        assert name in help_of("reconstruct")
    of_simulate = help_of("simulate")
    for name in ("noise_cm", "sphere_diameter_cm"):
        assert f"[default: {defaults(simulate)[name]}]" in of_simulate
    number, of_plants = (defaults(function)["n_points"] for function in (simulate, simulate_plant))
    assert f"{number}, of plants {of_plants}." in of_simulate
    assert defaults(simulate)["noise_cm"] == defaults(simulate_plant)["noise_cm"]


def test_every_public_name_is_imported_when_it_is_asked_for():
    tree = ast.parse(Path(phytofit.__file__).read_text(encoding="utf-8"))
    (checked,) = [node for node in tree.body if isinstance(node, ast.If)]  # what type checkers see
    seen = {node.module: tuple(alias.name for alias in node.names) for node in checked.body}
    assert seen == phytofit.MODULES
    assert sorted(phytofit.HOMES) == sorted(phytofit.__all__)
    assert set(phytofit.__all__) <= set(dir(phytofit))
    with pytest.raises(AttributeError, match="no attribute 'fits'"):
        _ = phytofit.fits


def test_a_module_does_not_hide_the_function_of_its_name():
    code = "import phytofit.recipe, phytofit.reconstruct; phytofit.recipe(); print(phytofit.reconstruct.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "reconstruct\n", done.stderr
