"""How results come into a folder: whole or not at all, whatever stops the program, and nothing of the user's is lost.

What is being written is hidden: ``.phytofit-part-OWNER``.  A folder of finished files is first renamed to
``.phytofit-done-OWNER``; from then on it counts.  Then each file or folder in it goes to its place; what was there goes
to ``.phytofit-old-OWNER``, which is deleted last.  So at each moment the old result or the new one is whole, and
:func:`repair` can tell which: what is done is put in place, what is old returns if nothing is in its place, parts are
deleted.  OWNER says whose it is, so that what another program is writing at the moment is left alone.
"""

import contextlib
import hashlib
import itertools
import json
import os
import platform
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from phytofit.errors import OutputError, PhytofitError

__all__ = [
    "check_made",
    "delete_made",
    "file_hash",
    "made_in",
    "prepare_folder",
    "repair",
    "translated",
    "whole_file",
    "whole_files",
    "whole_folder",
]

PART, DONE, OLD = ".phytofit-part-", ".phytofit-done-", ".phytofit-old-"
GONE = ".gone"  # names of what a finished result replaces by nothing
HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]
PROCESS = uuid.uuid4().hex[:8]  # a process that ended may have had our number
COUNT = itertools.count()
ROOM = "choose another folder, or make room"
LONGEST_S = 86_400.0  # what another machine began a day ago, it has given up
RECORDS = ("fit.json", "segmentation.json", "reconstruction.json", "stage.json")  # which say what was made beside them


def prepare_folder(folder: Path) -> Path:
    """Make sure that results can be written to the folder, and repair what an earlier run left there; OutputError if
    they can't."""
    with translated(folder, "results can't be written there", "choose another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        repair(folder)
        probe = folder / _hidden(PART)
        try:
            probe.touch()
        finally:
            _forget(probe)
    return folder


def repair(folder: Path) -> None:
    """Finish or take back what runs that were stopped left in a folder; OSError if that can't be done."""
    left = sorted(path for path in folder.glob(".phytofit-*") if _is_abandoned(path))
    for done in (path for path in left if path.name.startswith(DONE)):
        _install(done)
    for old in (path for path in left if path.name.startswith(OLD)):
        for entry in old.iterdir() if old.exists() else ():
            if not os.path.lexists(folder / entry.name):
                entry.rename(folder / entry.name)
        _delete(old)
    for part in (path for path in left if path.name.startswith(PART)):
        _delete(part)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden file to write into, which becomes ``path`` when all is written; OutputError if it can't."""
    part = path.with_name(_hidden(PART) + path.suffix)
    with translated(path, "can't be written", ROOM):
        try:
            yield part
            part.replace(path)
        finally:
            _forget(part)


@contextmanager
def whole_files(folder: Path, instead_of: Iterable[Path] = ()) -> Iterator[Path]:
    """A hidden folder to write into; when all is written its files go to ``folder``, in the place of older ones, and
    `instead_of` those that are deleted: all of this is done, or nothing.  OutputError if it can't."""
    prepare_folder(folder)
    with (
        translated(folder, "the result can't be written", ROOM),
        _installed(folder) as part,
    ):
        yield part
        gone = [path.name for path in instead_of if not (part / path.name).exists()]
        if gone:
            (part / GONE).write_text("\n".join(gone), encoding="utf-8")


@contextmanager
def whole_folder(folder: Path, name: str, *marks: str) -> Iterator[Path]:
    """A hidden folder to write into; when all is written it becomes ``folder/name``, in the place of an older one.

    Of that, what phytofit did not make, or what was changed since, is kept: under its own name, or as ``NAME.yours``
    where the new result has a file of that name.  A link is followed.

    Raises OutputError where there is a folder of that name with none of the files `marks`: no result of this kind.
    """
    target = folder / name
    with translated(target, "the result can't be written", ROOM):
        target = target.resolve() if target.is_symlink() else target
        if os.path.lexists(target) and not _is_empty(target) and not any((target / it).is_file() for it in marks):
            raise OutputError(
                f"{target}: it is there already, and holds no {marks[0]} of an earlier run; choose another folder, or "
                "move it away"
            )
        prepare_folder(target.parent)
        with _installed(target.parent) as part:
            (part / target.name).mkdir()
            yield part / target.name
            if target.is_dir():
                _keep(target, part / target.name)


def made_in(folder: Path) -> set[tuple[str, str | None]]:
    """Path in a result's folder, and SHA-256, of each file that phytofit made there, as the result's records say; of
    the records themselves, too."""
    made: set[tuple[str, str | None]] = set()
    for record in RECORDS:
        with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
            said = json.loads((folder / record).read_text(encoding="utf-8"))
            if "phytofit" in said:
                made |= {*said.get("files", {}).items(), *said.get("made", {}).items()}
                made.add((record, file_hash(folder / record)))
    return made


def check_made(path: Path, is_ours: Callable[[Path], bool]) -> None:
    """OutputError if there is a file of that name that phytofit did not make."""
    with translated(path, "can't be read", "choose another folder"):
        if os.path.lexists(path) and not (path.is_file() and is_ours(path)):
            raise OutputError(
                f"{path}: it is there already, and not as phytofit made it; move it away, or choose another folder"
            )


def delete_made(folder: Path) -> None:
    """Delete what phytofit made of a result, and its folder if nothing else is in it; OutputError if that fails."""
    with translated(folder, "can't be deleted", "delete it"):
        for name, known in made_in(folder):
            if (folder / name).is_file() and file_hash(folder / name) == known:
                (folder / name).unlink()
        for path in sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True):
            if _is_empty(path):
                path.rmdir()
        if _is_empty(folder):
            folder.rmdir()


def file_hash(path: Path) -> str | None:
    """SHA-256 of a file; None if it can't be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


@contextmanager
def _installed(folder: Path) -> Iterator[Path]:
    """A hidden folder, whose entries go to `folder` when all is written."""
    part = folder / _hidden(PART)
    done = part.with_name(part.name.replace(PART, DONE))
    try:
        part.mkdir()
        yield part
        part.rename(done)
    finally:
        _forget(part)
    _install(done)


def _keep(old: Path, new: Path) -> None:
    """Copy what is the user's from an old result to the new one that takes its place."""
    made = made_in(old)
    for path in sorted(old.rglob("*")):
        inside = path.relative_to(old)
        if path.name.startswith(".phytofit-"):
            continue
        if path.is_symlink() or not path.is_dir():
            if (inside.as_posix(), file_hash(path)) in made:
                continue
            to = _free(new / inside)
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, to, follow_symlinks=False)


def _free(path: Path) -> Path:
    """The path, or one like it with ``yours`` in its name, where nothing is."""
    tries = itertools.chain([""], (f".yours{n if n > 1 else ''}" for n in itertools.count(1)))
    return next(to for add in tries if not os.path.lexists(to := path.with_name(f"{path.stem}{add}{path.suffix}")))


def _install(done: Path) -> None:
    """Put each file and folder of a finished result in its place, and those away that it replaces; take all back if
    that fails."""
    folder, old = done.parent, done.with_name(done.name.replace(DONE, OLD))
    gone = (done / GONE).read_text(encoding="utf-8").splitlines() if (done / GONE).exists() else []
    moved = []
    try:
        for name in sorted({*gone, *(entry.name for entry in done.iterdir())} - {GONE}):
            moved.append(name)
            if os.path.lexists(folder / name):
                old.mkdir(exist_ok=True)
                (folder / name).rename(old / name)
            if os.path.lexists(done / name):
                (done / name).rename(folder / name)
    except BaseException:
        with contextlib.suppress(OSError):  # then the next start goes on from here
            for name in moved:
                if os.path.lexists(old / name):
                    if os.path.lexists(folder / name):
                        (folder / name).rename(done / name)
                    (old / name).rename(folder / name)
                elif not os.path.lexists(done / name) and name not in gone:
                    (folder / name).rename(done / name)
            _delete(done)
            _delete(old)
        raise
    with contextlib.suppress(OSError):  # the same
        _delete(old)
        _delete(done)


def _hidden(kind: str) -> str:
    return f"{kind}{HOST}-{os.getpid()}-{PROCESS}-{next(COUNT)}"


def _is_abandoned(path: Path) -> bool:
    """Whether who made a hidden file or folder has ended."""
    host, number, process = [*path.name.split("-")[2:5], "", "", ""][:3]
    if host == HOST and number.isdecimal() and sys.platform != "win32":
        return process != PROCESS if int(number) == os.getpid() else not _is_running(int(number))
    try:
        return time.time() - path.lstat().st_mtime > LONGEST_S
    except OSError:
        return False


def _is_running(number: int) -> bool:
    try:
        os.kill(number, 0)
    except PermissionError:  # another user's
        return True
    except (OSError, OverflowError):
        return False
    return True


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _delete(path: Path) -> None:
    """Delete a file, a link, or a folder with all in it, where there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _forget(path: Path) -> None:
    """The same, of what is only in the way; what can't be deleted now is by the next start."""
    with contextlib.suppress(OSError):
        _delete(path)


@contextmanager
def translated(path: Path, what: str, remedy: str) -> Iterator[None]:
    """OSError, and text that is none, as OutputError, in one sentence."""
    try:
        yield
    except PhytofitError:
        raise
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise OutputError(f"{path}: {what} ({reason}); {remedy}") from None
