"""Stages that are not done twice: each folder says what it was made from, and what was made."""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from phytofit.errors import InputError
from phytofit.io import file_hash, write_text
from phytofit.small_files import read_json
from phytofit.version import state_of_the_code

__all__ = ["KEY", "done", "is_edited", "key_of", "up_to_date"]

KEY = "stage.json"
EXPECTED = "what phytofit writes"


def key_of(stage: str, files: Sequence[Path], settings: Mapping[str, Any]) -> dict[str, Any]:
    """What a stage's result follows from: the code, input files by their content, settings."""
    said = {
        "phytofit": version("phytofit"),
        "code": state_of_the_code(),
        "stage": stage,
        "inputs": {path.name: file_hash(path) for path in files},
        "settings": dict(settings),
    }
    plain: dict[str, Any] = json.loads(json.dumps(said, default=repr))
    return plain


def up_to_date(folder: Path, key: Mapping[str, Any]) -> bool:
    """Whether the folder holds what a stage with this key made, unchanged."""
    said, made = _said(folder)
    return bool(made) and said == key and all(file_hash(folder / name) == was for name, was in made.items())


def is_edited(folder: Path, name: str) -> bool:
    """Whether of what a stage made, with whatever key, this file was changed; not if it was deleted."""
    _, made = _said(folder)
    return name in made and file_hash(folder / name) not in (None, made[name])


def done(folder: Path, key: Mapping[str, Any], made: Sequence[str]) -> None:
    """Said last, so that a stage that was stopped before is done again."""
    said = {**key, "made": {name: file_hash(folder / name) for name in made}}
    write_text(folder / KEY, json.dumps(said, indent=1) + "\n")


def _said(folder: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """The key of the folder's stage, and names and hashes of what it made; nothing where that can't be read."""
    try:
        said = read_json(folder / KEY, EXPECTED)
    except InputError:
        return {}, {}
    made = said.pop("made", None) if isinstance(said, dict) else None
    if not isinstance(made, dict) or not all(isinstance(was, str) for was in made.values()):
        return {}, {}
    return said, made
