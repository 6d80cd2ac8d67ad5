"""The same with real processes and files: one that is killed, one whose files can't grow, one asked to end."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest
from commands import World, run, with_notes
from injection import files_in, is_hidden

HERE = Path(__file__).parent
LIMITS = (700, 5_000)  # bytes, to which a file may grow
KILLED = """
import os, sys
sys.path.insert(0, {here!r})
from _pytest.monkeypatch import MonkeyPatch
from commands import World, run
from injection import injected
from pathlib import Path
folder, world = Path({folder!r}), World()
world.patch(MonkeyPatch())
for at in {places!r}:
    if os.fork() == 0:
        with injected(folder / "out", at, "exit"):
            run(world, {command!r}, folder, 1)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
"""


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.fixture
def folder(world, tmp_path, monkeypatch):
    world.patch(monkeypatch)
    world.lay_out(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", ["fit", "reconstruct"])
def test_files_that_can_not_grow_leave_the_old_result_whole(world, folder, command):
    """A disk that is full in the middle of a file: what is written of it never comes to stand under its name."""
    out = folder / "out"
    assert run(world, command, folder, 0).exit_code == 0
    notes = with_notes(out)
    old = files_in(out)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in LIMITS:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            done = run(world, command, folder, 1)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert isinstance(done.exception, SystemExit), done.output
        assert done.exit_code in (1, 2), done.output
        assert "error: " in done.stderr
        there = files_in(out)
        assert {name: there.get(name) for name in old} == old
        assert set(there) - set(old) <= {"failed.csv"}
    assert run(world, command, folder, 1).exit_code == 0
    assert not [name for name in files_in(out) if is_hidden(name)]
    assert notes <= set(files_in(out))


@pytest.mark.long
@pytest.mark.parametrize("command", ["fit", "segment", "run", "simulate"])
def test_a_process_that_is_killed_leaves_what_the_next_repairs(world, folder, command):
    out = folder / "out"
    assert run(world, command, folder, 0).exit_code == 0
    notes = with_notes(out)
    script = KILLED.format(here=str(HERE), folder=str(folder), command=command, places=[*range(3, 60, 5)])
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=300)
    assert "9" in done.stdout.split()
    assert run(world, command, folder, 1).exit_code == 0
    there = files_in(out)
    assert not [name for name in there if is_hidden(name)]
    assert {name for name in notes if name in there or (out / name).parent.exists()} <= set(there)


@pytest.mark.long
def test_a_full_disk_behind_standard_output_is_one_line(tmp_path):
    arguments = ["simulate", "--points", "150", "--out", str(tmp_path)]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "phytofit", *arguments], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert done.stderr.startswith("error: standard output: No space left")
    assert len(done.stderr.splitlines()) == 1
    assert (tmp_path / "truth.csv").is_file()


@pytest.mark.parametrize("arguments", [[], ["--help"], ["--version"], ["fit", "--help"]])
def test_help_on_a_full_disk_is_one_line(arguments):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "phytofit", *arguments], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: standard output: No space left")
