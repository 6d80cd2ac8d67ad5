"""The command line: parse, call, print, exit code (0 all measured; 1 some inputs failed; 2 nothing could be done)."""

import codecs
import contextlib
import signal
import sys

from phytofit.cli import demo, fit, recipe, reconstruct, run, segment, simulate, validate
from phytofit.cli.console import Terminated, app, end
from phytofit.cli.messages import in_ascii

__all__ = ["app", "main"]

COMMANDS = (demo, fit, run, segment, reconstruct, simulate, validate, recipe)  # each adds its own when it is imported


def main() -> None:
    """Entry point of the ``phytofit`` command."""
    signal.signal(signal.SIGTERM, lambda *_: end(Terminated))
    signal.signal(signal.SIGINT, lambda *_: end(KeyboardInterrupt))
    codecs.register_error("phytofit.ascii", in_ascii)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):  # replaced by something that is no text stream
            stream.reconfigure(errors="phytofit.ascii")  # type: ignore[union-attr]
    app(prog_name="phytofit")
