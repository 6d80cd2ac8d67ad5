"""Many clouds, one after the other: each for itself, whatever becomes of the others; what is done is on disk."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from phytofit.errors import OutputError, PhytofitError, SettingError
from phytofit.io import LOG, FolderTable, open_log, prepare_folder, result_names, write_failures, write_workbook
from phytofit.text import one_line

__all__ = ["Outcome", "each_cloud"]

T = TypeVar("T")


@dataclass(frozen=True)
class Outcome(Generic[T]):
    """What became of a cloud: ``result``, or None and in one line the ``failure``, which names the file."""

    path: Path
    name: str
    result: T | None
    failure: str = ""


def each_cloud(
    paths: Sequence[Path],
    folder: Path,
    measured: Callable[[Path, str], T],
    table: Callable[[Path], FolderTable],
    *,
    workbook: bool = False,
) -> Iterator[Outcome[T]]:
    """Measure each cloud by `measured`, which gets its file and the name of its result, and saves it in `folder`.

    After each, the `table` over all results in the folder is written, and ``failed.csv``, which lists the clouds that
    failed; ``phytofit.log`` says what was done, and where a failure is a fault of the program.  At the end comes the
    `workbook`, the table as XLSX.

    Raises SettingError where the first cloud does, being as wrong for the others; OutputError where the folder can't
    be used, or at the end where the tables could not be written.
    """
    prepare_folder(folder)
    over_all = table(folder)
    failed: dict[str, tuple[Path, str]] = {}
    unwritten = None
    with open_log(folder) as log:
        for i, (path, name) in enumerate(zip(paths, result_names(paths), strict=True)):
            try:
                made = Outcome(path, name, measured(path, name))
                LOG.info("%s: measured, see %s", one_line(path), one_line(folder / name))
            except SettingError as error:
                if i == len(failed):
                    raise
                made = Outcome(path, name, None, _named(path, str(error)))
            except PhytofitError as error:
                made = Outcome(path, name, None, _named(path, str(error)))
            except Exception as error:  # whatever it is, the others go on
                LOG.exception("%s: an internal error of phytofit", one_line(path))
                where = "" if log is None else f"; please report it with {log}"
                reason = f"an internal error of phytofit, {type(error).__name__}: {error}{where}"
                made = Outcome(path, name, None, _named(path, reason))
            if made.result is None:
                failed[name] = (path, made.failure)
                LOG.warning("%s", one_line(made.failure))
            unwritten = _tables(folder, over_all, failed, paths[: i + 1])
            yield made
    if unwritten is not None:
        raise unwritten
    if workbook and over_all.path.exists():
        write_workbook(over_all.path.with_suffix(".xlsx"), over_all.whole())


def _tables(
    folder: Path, over_all: FolderTable, failed: dict[str, tuple[Path, str]], tried: Iterable[Path]
) -> OutputError | None:
    """Write them; the error if that can't be done, since the next clouds may still be measured."""
    try:
        over_all.write()
        write_failures(folder, failed, tried)
    except OutputError as error:
        LOG.warning("%s", one_line(error))
        return error
    return None


def _named(path: Path, reason: str) -> str:
    return reason if str(path) in reason or path.name in reason else f"{path}: {reason}"
