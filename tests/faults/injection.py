"""Failures of the file system, at the k-th change of it below a folder: a full disk, or the end of the program."""

import errno
import os
import sys
from contextlib import contextmanager
from pathlib import Path

CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate"}
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
DELETIONS = {"os.remove", "os.rmdir"}
MAKING = {"open", "os.mkdir"}
state = {"active": None, "hooked": False}  # a hook can't be taken away: there is one, that asks this


class Killed(BaseException):
    """The program ends here: nothing that follows changes the disk."""


class Injection:
    """Counts the changes below `folder`, and lets the `at`-th fail (from 0; None: none does): as `kind` says.

    "error": the disk is full once; "full": from then on, for whatever is made anew; "kill": nothing that
    follows is done; "exit": the process ends, as it would by kill -9.
    """

    def __init__(self, folder, at=None, kind="error"):
        self.folder, self.at, self.kind = os.fspath(folder), at, kind
        self.events = []

    def see(self, event, args):
        if not self._changes(event, args):
            return
        self.events.append(event)
        n = len(self.events) - 1
        if self.at is None or n < self.at or (self.kind == "error" and n > self.at):
            return
        if self.kind == "exit":
            os._exit(9)
        if self.kind == "kill":
            raise Killed
        if n == self.at or event in MAKING:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _changes(self, event, args):
        if event == "open":
            path, _, flags = args
            return isinstance(path, str) and path.startswith(self.folder) and bool(flags & WRITES)
        inside = isinstance(args[0], str | bytes) and os.fsdecode(args[0]).startswith(self.folder)
        return event in CHANGES and (inside or args[-1] not in (-1, None))  # or relative to an open folder


def _hook(event, args):
    active = state["active"]
    if active is not None and (event == "open" or event in CHANGES):
        active.see(event, args)


@contextmanager
def injected(folder, at=None, kind="error"):
    """Failures as `Injection` says, while the block runs; gives the changes that it saw."""
    if not state["hooked"]:
        sys.addaudithook(_hook)
        state["hooked"] = True
    state["active"] = Injection(folder, at, kind)
    try:
        yield state["active"].events
    finally:
        state["active"] = None


def files_in(folder):
    """Bytes of each file below a folder, hidden ones too, by its path there; the log of the run left out."""
    paths = (path for path in Path(folder).rglob("*") if path.is_file() and path.name != "phytofit.log")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def is_hidden(name):
    return any(part.startswith(".") for part in Path(name).parts)
