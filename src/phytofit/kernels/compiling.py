"""How kernels are compiled: once for all kernels, so that they agree on rounding and on caching."""

import os
import tempfile
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config

__all__ = ["kernel"]

F = TypeVar("F", bound=Callable[..., Any])


def _writable(folder: Path) -> bool:
    probe = folder / f".phytofit-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    try:
        folder.mkdir(exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError:
        return False
    return True


# An installation may be read-only; compiled code then goes to a folder of this user's own.
if not _writable(Path(__file__).parent / "__pycache__") and not config.CACHE_DIR:  # type: ignore[attr-defined]
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    config.CACHE_DIR = str(Path(tempfile.gettempdir()) / f"phytofit-numba-{user}")  # type: ignore[attr-defined]


def kernel(function: F) -> F:
    """Compile a kernel: no GIL, cached on disk.

    Sums may be reassociated (they then use the machine's vector units), but NaN and infinity keep their meaning.
    """
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})(
        function
    )
    return cast(F, compiled)
