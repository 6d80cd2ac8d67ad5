"""Odd arguments to every command: an exit code, one line that says what was wrong, never a traceback.

Every option of every command is given every odd value of its kind.  What can't be done ends with code 2 before anything
slow begins, so that all of them take seconds; where an odd value is allowed, nothing is said against it.
"""

import functools
import os
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from phytofit.cli import app

NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "-0",
    "1e400",
    "1_0",
    "99999999999999999999",
    "",
    "0x10",
    "½",
    "1,5",
    "one",
    " 3 ",
)
WORDS = (
    "",
    " ",
    "[/]",
    "[red]x[/]",
    "$x$",
    "\x1b[31mx",
    "a\nb",
    "=cmd",
    "-x",
    "--",
    "..",
    ".",
    "/",
    "x" * 300,
    "\udcff",
    "Ω",
    "%s {0}",
)
FILES = (
    *WORDS,
    "missing.ply",
    "/dev/null",
    "folder",
    "empty.ply",
    "photo.jpg",
    "depth.png",
    "table.csv",
    "fit.json",
    "*.nothing",
    "[",
)
MOST_CHARACTERS = 1500  # of an error
SAMPLE = 9  # in the daily tests every so many-th is tried
NEEDED = {  # by each command, so that only the odd one is wrong
    "fit": ["missing.ply"],
    "segment": ["missing.ply"],
    "run": ["missing.ply"],
    "reconstruct": ["folder", "--camera", "kinect-v2"],
    "simulate": ["--points", "50"],
    "validate": ["missing", "--truth", "missing.csv"],
    "demo": [],
    "recipe": [],
}


@functools.cache
def commands():
    return typer.main.get_command(app).commands


def odd_calls():
    """(command, arguments) of all of them."""
    for name, command in commands().items():
        for parameter in command.params:
            if parameter.param_type_name == "argument":
                yield from ((name, [value, *NEEDED[name][1:]]) for value in FILES)
                yield from ((name, ["--", value]) for value in FILES if name != "validate")
                continue
            option = max(parameter.opts, key=len)
            if parameter.is_flag:
                if option != "--help":
                    yield name, [*NEEDED[name], option, option]
                    yield name, [*NEEDED[name], f"{option}=1"]
                continue
            kind = str(parameter.type_descriptor.annotation)
            values = (
                NUMBERS
                if "int" in kind or "float" in kind
                else FILES
                if option in ("--out", "--truth", "--poses")
                else WORDS
            )
            yield from ((name, [*NEEDED[name], option, value]) for value in values)
            yield from ((name, [*NEEDED[name], f"{option}={value}"]) for value in values[:6])
            yield name, [*NEEDED[name], option]
        yield name, [*NEEDED[name], "--nonsense"]
        yield name, [*NEEDED[name], "-Z"]
    for value in (*WORDS, *FILES):
        yield value, []


CALLS = list(odd_calls())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Things that are no clouds, under the names that are given."""
    made = tmp_path_factory.mktemp("odd")
    (made / "folder").mkdir()
    (made / "empty.ply").touch()
    (made / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    (made / "depth.png").write_bytes(b"\x89PNG")
    (made / "table.csv").write_text("plant,height\na,3\n")
    (made / "fit.json").write_text("{}")
    before = Path.cwd()
    os.chdir(made)
    yield made
    os.chdir(before)


@pytest.fixture(autouse=True)
def nothing_is_measured(monkeypatch):
    """What would take long, and is another test's."""

    def stop(*_, **__):
        raise typer.Exit(0)

    monkeypatch.setattr("phytofit.fitting.fit", stop)
    monkeypatch.setattr("phytofit.io.save_simulated", lambda made, *_, **__: next(iter(made)) and [Path("missing.ply")])


def complaint(command, arguments):
    """What is wrong with how a call ends, or None."""
    runner = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"})
    done = runner.invoke(app, [command, *arguments])
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    faults = {
        "raised": done.exception is not None and not isinstance(done.exception, SystemExit),
        "an exit code of its own": done.exit_code not in (0, 1, 2),
        "a fault of the program": any(
            sign in done.output for sign in ("Traceback", "unexpected error", "internal error")
        ),
        "an escape sequence": "\x1b" in done.output,
        "said nothing": done.exit_code > 0 and not errors,
        "said too much": max(map(len, errors), default=0) > MOST_CHARACTERS,
    }
    found = [fault for fault, is_so in faults.items() if is_so]
    return f"{', '.join(found)}: {done.exception!r} {done.output[:2000]!r}" if found else None


def check(calls):
    found = [(command, arguments, said) for command, arguments in calls if (said := complaint(command, arguments))]
    assert not found, "\n".join(map(str, found))


def test_there_are_many():
    assert len(CALLS) > 800


def test_some_odd_arguments(folder):
    check(CALLS[::SAMPLE])


@pytest.mark.long
def test_all_odd_arguments(folder):
    check(CALLS)
