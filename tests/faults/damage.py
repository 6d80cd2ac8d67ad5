"""Valid files damaged at random, for readers that must read what is given or refuse it in one line.

A test of a reader gives `assert_reads_or_refuses` valid files and the call; what is drawn depends on the seed alone.
"""

import time
import tracemalloc
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from phytofit.errors import InputError

N_SHORT, N_LONG = 50, 10_000  # damaged files a reader in `make test`, and in `make test-long`
MOST_BYTES, MOST_SECONDS = 200e6, 10.0  # for one small file

WORDS = [b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\0", b"999999999999", b"-1", b"nan", b"inf", b"1e308"]
WORDS += [
    b"\n",
    b"\r",
    b" ",
    b"\t",
    b",",
    b";",
    b'"',
    b"'",
    b"#",
    b"//",
    b"{",
    b"}",
    b"[",
    b"]",
    b"=",
    b"null",
    b"true",
]
WORDS += [b"1_000", b"-0", b"1e-320", b"\xc3", b"\xef\xbb\xbf", b"\xff\xfe", b"x", b"list", b"end_header\n", b"COUNT"]


def damaged(random: np.random.Generator, content: bytes) -> bytes:
    """The content with words put in, bytes overwritten, lines lost, doubled or swapped, or its end cut off."""
    for _ in range(random.integers(1, 5)):
        kind = random.integers(0, 6)
        in_head = random.random() < 0.5
        at = int(random.integers(0, max(1, min(len(content), 400) if in_head else len(content))))
        if kind == 0:
            content = content[:at] + WORDS[random.integers(0, len(WORDS))] + content[at:]
        elif kind == 1:
            new = random.bytes(int(random.integers(1, 9)))
            content = content[:at] + new + content[at + len(new) :]
        elif kind == 2:
            word = WORDS[random.integers(0, len(WORDS))]
            content = content[:at] + word + content[at + len(word) :]
        elif kind == 3:
            content = content[:at] + content[at + int(random.integers(1, 60)) :]
        elif kind == 4:
            lines = content.split(b"\n")
            i, j = random.integers(0, len(lines), 2)
            lines[i : i + 1] = [[lines[i]] * 2, [], [lines[j]]][random.integers(0, 3)]
            content = b"\n".join(lines)
        else:
            content = content[:at] if random.random() < 0.3 else content
    return content


def assert_reads_or_refuses(
    call: Callable[[Path], object],
    valid: Sequence[tuple[str, bytes]],
    folder: Path,
    capfd: pytest.CaptureFixture[str],
    n: int,
    *,
    seed: int = 0,
) -> None:
    """Call with `n` damaged copies of the valid files (name, content): only an InputError of one short line may come.

    Nothing may be printed, not even past Python; no warning other than a UserWarning; no more memory and time than a
    small file can need.  The valid files themselves must be read.
    """
    random = np.random.default_rng(seed)
    for name, content in valid:
        (folder / name).write_bytes(content)
        call(folder / name)
    capfd.readouterr()
    for i in range(n):
        name, content = valid[i % len(valid)]
        path = folder / name
        path.write_bytes(damaged(random, content))
        start, traced = time.process_time(), i % 20 == 0
        if traced:
            tracemalloc.start()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", UserWarning)
                call(path)
        except InputError as error:
            said = str(error)
            assert said.isprintable(), f"file {i} of seed {seed}: {said!r}"
            assert len(said) < 500, f"file {i} of seed {seed}: {said!r}"
            assert name in said, f"file {i} of seed {seed}: {said!r}"
        except Exception as error:
            kept = folder / f"kept_{i}_{name}"
            path.replace(kept)
            raise AssertionError(f"file {i} of seed {seed}, kept as {kept}: {error!r}") from error
        if traced:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < MOST_BYTES, f"file {i} of seed {seed} took {peak / 1e6:.0f} MB"
        assert time.process_time() - start < MOST_SECONDS, f"file {i} of seed {seed}"
    assert capfd.readouterr() == ("", "")
