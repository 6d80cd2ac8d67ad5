"""The log of a run: what was done, with details of what failed, in a text file beside the results."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from phytofit.text import one_line

__all__ = ["LOG", "open_log"]

LOG = logging.getLogger("phytofit")
FILE = "phytofit.log"


class _Quiet(logging.FileHandler):
    """Whatever keeps a line from being written (a full disk): the results go on."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (logging's own name)
        pass


class _OneLine(logging.Formatter):
    """Each entry in one line, whatever names it holds; the traceback of a fault below it."""

    def format(self, record: logging.LogRecord) -> str:
        head = f"{self.formatTime(record)} {record.levelname.lower()}: {one_line(record.getMessage())}"
        return head if record.exc_info is None else f"{head}\n{self.formatException(record.exc_info)}"


@contextmanager
def open_log(folder: Path) -> Iterator[Path | None]:
    """Append what is logged to ``folder/phytofit.log`` meanwhile: its path, or None where that can't be written."""
    path = folder / FILE
    if str(path.resolve()) in (handler.baseFilename for handler in LOG.handlers if isinstance(handler, _Quiet)):
        yield path  # it is open
        return
    before = LOG.level
    try:
        handler = _Quiet(path, encoding="utf-8", errors="backslashreplace")
    except OSError:
        yield None
        return
    handler.setFormatter(_OneLine())
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        yield path
    finally:
        LOG.setLevel(before)
        LOG.removeHandler(handler)
        with suppress(OSError):  # what was still to be written
            handler.close()
