"""How kernels are compiled: once for all kernels, so that they agree on rounding and on caching."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config

__all__ = ["kernel"]

F = TypeVar("F", bound=Callable[..., Any])


def _cache_folder() -> str | None:
    """A writable folder for compiled code that belongs to exactly these sources; None where there is none.

    Numba asks only whether a kernel's own file has changed, but kernels are compiled into each other, and an
    installation may be read-only: so the folder is the user's, and named after all the sources.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"kernels-{digest.hexdigest()[:16]}"
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "phytofit" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError:
        return None


CACHE_FOLDER = _cache_folder()


def kernel(function: F) -> F:
    """Compile a kernel: no GIL, cached on disk.

    Sums may be reassociated (they then use the machine's vector units), but NaN and infinity keep their meaning.
    """
    others = config.CACHE_DIR  # type: ignore[attr-defined]
    config.CACHE_DIR = CACHE_FOLDER or others  # type: ignore[attr-defined]
    try:
        compiled = numba.njit(
            cache=CACHE_FOLDER is not None,
            nogil=True,
            error_model="numpy",
            fastmath={"reassoc", "contract", "nsz", "arcp"},
        )(function)
    finally:
        config.CACHE_DIR = others  # type: ignore[attr-defined]
    return cast(F, compiled)
