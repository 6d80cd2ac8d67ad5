"""What libraries in C and Rust print by themselves while a file is read, kept off the terminal.

Their errors are raised as well, and told once, as phytofit tells errors; a panic's own message goes to the stream's
file descriptor, where Python can't catch it.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["silenced"]

STDERR = 2  # the file descriptor


@contextmanager
def silenced() -> Iterator[None]:
    """Nothing that is written to the process's standard error meanwhile, by any thread, arrives there."""
    with suppress(OSError, ValueError, AttributeError):  # sys.stderr may be None, or closed
        sys.stderr.flush()
    try:
        kept = os.dup(STDERR)
    except OSError:  # there is none
        yield
        return
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, STDERR)
        os.close(nowhere)
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
