"""Whatever fails at whichever write: the old result or the new one is whole, and the next run goes on."""

import os
from pathlib import Path

import pytest
from commands import COMMANDS, World, fresh, run, with_notes
from injection import DELETIONS, MAKING, Killed, files_in, injected, is_hidden

from phytofit.io import replacing

SAMPLE = 15  # in the daily tests every so many-th write fails


@pytest.fixture(scope="module")
def world():
    return World()


class Case:
    """A command over an old result, with the user's notes in it: the state before, and as it is when nothing fails."""

    def __init__(self, world, command, folder):
        self.world, self.command, self.folder = world, command, folder / "try"
        self.template = folder / "template"
        self.template.mkdir()
        world.lay_out(self.template)
        fresh(self.template, self.folder)
        self.expect(0)
        with_notes(self.folder / "out")
        fresh(self.folder, self.template)  # that is the old result, and its inputs
        self.old = files_in(self.folder / "out")
        with injected(self.folder / "out") as events:
            self.expect(1)
        self.events = list(events)
        self.new = files_in(self.folder / "out")
        self.notes = {name for name in self.old if name.endswith("note.txt")}
        assert not [name for name in self.new if is_hidden(name)]
        assert {name for name in self.notes if name in self.new or Path(name).parent.name.startswith("leaf_")}

    def expect(self, version):
        done = run(self.world, self.command, self.folder, version)
        assert done.exit_code == 0, done.output

    def fail(self, at, kind):
        """Run with a failure; what was said, None if the program was killed, and what is there afterwards."""
        fresh(self.template, self.folder)
        done = None
        with injected(self.folder / "out", at, kind):
            try:
                done = run(self.world, self.command, self.folder, 1)
            except Killed:
                assert kind == "kill"
        return done, files_in(self.folder / "out")

    def check(self, at, kind, monkeypatch):
        done, there = self.fail(at, kind)
        where = f"{self.command}, {kind} at {at}, {self.events[at]}"
        assert (done is None) == (kind == "kill"), where
        seen = {name: content for name, content in there.items() if not is_hidden(name)}
        for name, content in seen.items():
            assert self.is_whole(name, content), f"{where}: {name}"
        if done is not None:
            assert done.exception is None or isinstance(done.exception, SystemExit), where
            assert "Traceback" not in done.output, where
            if done.exit_code == 0:
                assert seen == self.new, where
            else:
                assert "error: " in done.stderr, where
                lost = self.old.keys() & self.new.keys() - there.keys()
                assert not [name for name in lost if not name.endswith("stage.json")], where
            if self.events[at] not in DELETIONS and kind == "error":
                assert seen == there, f"{where}: {there.keys() - seen.keys()}"
        self.check_results_are_of_one_run(seen, where)
        assert not [name for name in self.notes if not self.is_kept(name, there)], where
        with monkeypatch.context() as another:
            another.setattr(replacing, "PROCESS", f"{at:08}")  # another process begins
            self.expect(1)
        assert files_in(self.folder / "out") == self.new, where

    def is_kept(self, name, there):
        """Where it was, or in the old result that was being replaced."""
        *_, result, note = ("", *Path(name).parts)
        return name in there or any(is_hidden(other) and other.endswith(f"/{result}/{note}") for other in there)

    def is_whole(self, name, content):
        if content in (self.old.get(name), self.new.get(name)):
            return True
        if name == "failed.csv":  # a cloud that could not be written
            return content.startswith(b"cloud,file,reason\n") and content.endswith(b"\n")
        if not name.endswith(".csv"):
            return self.command == "fit" and name == "traits.xlsx"
        lines = {*self.old.get(name, b"").splitlines(), *self.new.get(name, b"").splitlines()}
        return content.endswith(b"\n") and set(content.splitlines()) <= lines

    def check_results_are_of_one_run(self, seen, where):
        """All files of a result are the old ones, or all the new ones."""
        units = {os.path.dirname(name).split("/phytomers")[0] for name in seen} - {"", "leaves"}  # noqa: PTH120
        together = {f"{unit}/" for unit in units}
        if self.command in ("reconstruct", "simulate", "validate") and "kill" not in where:
            together = {""}
        for unit in together:
            mine, old, new = (
                {name: it for name, it in state.items() if name.startswith(unit) and not name.endswith("stage.json")}
                for state in (seen, self.old, self.new)
            )
            assert mine in (old, new), f"{where}: {unit}: {sorted(mine)}"


@pytest.fixture
def case(request, world, tmp_path, monkeypatch):
    world.patch(monkeypatch)
    return Case(world, request.param, tmp_path)


@pytest.mark.parametrize("case", COMMANDS, indirect=True)
def test_a_failure_at_some_writes(case, monkeypatch):
    for i, at in enumerate(range(2, len(case.events), SAMPLE)):
        case.check(at, ("kill", "error", "full")[i % 3], monkeypatch)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["kill", "error", "full"])
@pytest.mark.parametrize("case", COMMANDS, indirect=True)
def test_a_failure_at_each_write(case, kind, monkeypatch):
    for at, event in enumerate(case.events):
        if kind != "full" or event in MAKING:  # else it is like an error
            case.check(at, kind, monkeypatch)
