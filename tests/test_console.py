"""How the command line speaks and ends: one line for what is wrong, the log, streams, signals, terminals."""

import logging
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import phytofit.cli.console
from phytofit.cli import app
from phytofit.cli.messages import at_command_line
from phytofit.errors import SettingError

PHYTOFIT = [sys.executable, "-m", "phytofit"]


def run(*arguments, columns=200):
    environment = {"COLUMNS": str(columns), "NO_COLOR": "1", "TERM": "dumb"}
    return CliRunner(env=environment).invoke(app, [str(a) for a in arguments])


def one_line(done, code=2):
    assert done.exit_code == code, done.output
    assert isinstance(done.exception, SystemExit), done.exception
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    return line


def test_version_and_help_by_their_short_names():
    assert run("--version").stdout == f"phytofit {phytofit.__version__}\n"
    assert run("-h").stdout == run("--help").stdout == run().stdout
    assert run("fit", "-h").stdout == run("fit", "--help").stdout
    assert run().exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ("fit leaf.ply --unit cm", "no such option: --unit; did you mean --units? see phytofit fit --help"),
        ("simulte", "no such command 'simulte'; did you mean simulate? see phytofit --help"),
        ("fit leaf.ply --method papr", "'papr'; did you mean paper?"),
        ("fit leaf.ply -u inch", "expected cm, mm, m, none, got 'inch'"),
        ("fit leaf.ply --species sorgum", "'sorgum'; did you mean sorghum?"),
        ("run scan --camera kinect_v2", "'kinect_v2'; did you mean kinect-v2?"),
        ("simulate --set leaf_lenght=3", "'leaf_lenght'; did you mean leaf_length?"),
        ("fit", "missing argument 'CLOUDS'; see phytofit fit --help"),
        ("fit leaf.ply --seed x", "invalid value for '--seed': expected a whole number, got 'x'; see"),
        ("simulate --noise x", "invalid value for '--noise': expected a number, got 'x'; see"),
        ("simulate --noise nan", "invalid value for '--noise': expected 0 or more, got nan; see"),
        ("simulate --outliers 1", "invalid value for '--outliers': expected 0 to below 1, got 1; see"),
        ("fit leaf.ply --threads 0", "invalid value for '--threads': expected 1 to 1,024, got 0; see"),
    ],
)
def test_what_is_wrong_with_the_arguments_is_one_line_with_what_was_meant(arguments, found):
    assert found in one_line(run(*arguments.split()))


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        ("fit leaf.ply --distance chamfer", "--distance"),
        ("simulate --sphere-diameter 3", "--sphere-diameter"),
        ("run plant.ply --step 30", "--step"),
        ("validate results --truth truth.csv --views 3", "--views"),
    ],
)
def test_options_that_would_change_nothing_are_refused(arguments, option):
    line = one_line(run(*arguments.split()))
    assert line.startswith(f"error: {option}: ")
    assert "leave it out" in line


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("up: expected one of x, y, got 'north'", "--up: expected one of x, y, got 'north'"),
        ("seed_point: expected three numbers", "--seed-point: expected three numbers"),
        ("sphere diameter: expected more", "--sphere-diameter: expected more"),
        ("a.ply: no unit given; state its unit: mm", "a.ply: no unit given; state its unit (--units): mm"),
        ("up.ply: damaged", "up.ply: damaged"),
    ],
)
def test_the_librarys_messages_get_the_names_of_options(said, told):
    assert at_command_line(SettingError(said)) == told


@pytest.fixture
def faulty(monkeypatch):
    """The command `simulate`, whose simulation has a fault that nobody foresaw."""

    def fails(*_, **__):
        raise ZeroDivisionError("division by [/] zero")

    monkeypatch.setattr("phytofit.simulation.simulate", fails)


def test_what_nobody_foresaw_is_one_line_and_the_log_has_the_details(faulty, tmp_path):
    line = one_line(run("simulate", "--out", tmp_path / "[out]"))
    log = tmp_path / "[out]" / "phytofit.log"
    assert line == f"error: unexpected error: ZeroDivisionError: division by [/] zero; details are in {log}"
    assert "Traceback" in log.read_text()
    assert phytofit.__version__ in log.read_text().splitlines()[0]
    assert "Traceback" in run("simulate", "--verbose", "--out", tmp_path).stderr


def test_quiet_shows_errors_only_and_logs_all(tmp_path):
    done = run("simulate", "-q", "--out", tmp_path)
    assert (done.exit_code, done.output) == (0, "")
    assert "1 phytomer in" in (tmp_path / "phytofit.log").read_text()
    assert "1 phytomer in" in run("simulate", "--out", tmp_path).stdout
    assert "no such command" in one_line(run("simulat"))
    assert str(tmp_path) not in repr(logging.getLogger("phytofit").handlers)


def test_the_log_is_no_reason_to_fail(tmp_path):
    (tmp_path / "phytofit.log").mkdir()
    assert run("simulate", "--out", tmp_path).exit_code == 0


@pytest.mark.parametrize("name", ["[red]x[!]", "a\x1b[31mb", "a\nb", "=cmd", "$x$", "ü–²", "-x"])
def test_names_are_shown_as_they_are(tmp_path, name):
    cloud = tmp_path / f"{name}.ply"
    cloud.write_bytes(b"no cloud")
    line = one_line(run("fit", "--units", "cm", "--out", tmp_path / "out", "--", cloud))
    assert "\x1b" not in line
    assert name.replace("\x1b", "\\x1b").replace("\n", " ") in line


SIGNALS = [(signal.SIGTERM, 143), pytest.param(signal.SIGINT, 130, marks=pytest.mark.long)]


@pytest.fixture(scope="module")
def slow_plant(tmp_path_factory):
    """A cloud that keeps `fit` busy for a while: many generations of the paper's search."""
    folder = tmp_path_factory.mktemp("slow")
    made = phytofit.simulate(seed=3, n_points=2000)
    np.savetxt(folder / "leaf.xyz", made.points)
    return [*PHYTOFIT, "fit", str(folder / "leaf.xyz"), "-u", "cm", "--method", "paper", "--generations", "10000"]


@pytest.fixture
def heeding_interrupts():
    """What runs in the background, as these tests may, ignores an interrupt, and so would what it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "code"), SIGNALS)
@pytest.mark.usefixtures("heeding_interrupts")
def test_a_signal_ends_it_with_one_line(slow_plant, tmp_path, number, code):
    started = subprocess.Popen([*slow_plant, "--out", str(tmp_path)], stderr=subprocess.PIPE, text=True)
    log = tmp_path / "phytofit.log"
    while not (log.exists() and log.read_text()) and started.poll() is None:
        time.sleep(0.05)
    started.send_signal(number)
    _, said = started.communicate(timeout=60)
    assert said == "error: stopped; the results that were finished are kept\n"
    assert started.returncode == code
    assert {p.name for p in tmp_path.iterdir()} == {"phytofit.log"}


def test_a_pipe_that_nobody_reads_and_a_terminal_without_umlauts(tmp_path):
    """`| head -0` of a command that prints, and ASCII as the only encoding."""
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "COLUMNS": "60"}
    reader, writer = os.pipe()
    os.close(reader)
    piped = subprocess.run(
        [*PHYTOFIT, "simulate", "--out", str(tmp_path)], stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (piped.returncode, piped.stderr) == (0, "")
    assert (tmp_path / "truth.csv").exists()
    shown = subprocess.run(
        [*PHYTOFIT, "fit", "süß–².ply"], capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    assert shown.stderr == "error: su\\xdf-2.ply: no such file, expected a file of points; check the path\n"
