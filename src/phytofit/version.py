"""Which phytofit this is: not by its version number alone, which stays while the code changes."""

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

__all__ = ["state_of_the_code"]

LIBRARIES = ("numpy", "scipy", "numba")  # whose versions change numbers, too


def state_of_the_code(more: Sequence[Path] = ()) -> str:
    """A name for the code as it is, of the package and of `more` folders: another state of it makes other results."""
    found = hashlib.sha256(" ".join(version(name) for name in LIBRARIES).encode())
    for folder in (Path(__file__).parent, *more):
        for path in sorted(path for ending in ("*.py", "*.toml") for path in folder.rglob(ending)):
            inside = path.relative_to(folder.parent)
            if not any(part.startswith(".") for part in inside.parts):  # where joblib keeps copies of functions
                found.update(inside.as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:12]
