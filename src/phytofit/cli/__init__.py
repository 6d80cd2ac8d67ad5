"""The command line: parse, call, print, exit code (0 all measured; 1 some inputs failed; 2 nothing could be done)."""

import sys

from phytofit.cli import demo, fit, recipe, reconstruct, run, segment, simulate, validate
from phytofit.cli.console import app, err

__all__ = ["app", "main"]

COMMANDS = (demo, fit, run, segment, reconstruct, simulate, validate, recipe)  # each adds its own when it is imported


def main() -> None:
    """Entry point of the ``phytofit`` command."""
    try:
        app()
    except KeyboardInterrupt:
        err.print("stopped; results that were finished are kept")
        sys.exit(130)
