"""The same phytomer in every format and dialect has the same traits."""

from pathlib import Path

import numpy as np
import pytest

import phytofit
from clouds_as_files import DIALECTS
from phytofit.cloud import read_cloud

SCALE_CM = {"mm": 0.1, "cm": 1.0, "m": 100.0}
TOLERANCE = {"cm": 0.02, "deg": 0.2, "deg/cm": 0.02, "cm²": 0.5}  # where a format rounds the coordinates by microns
SAMPLE = ("PLY, singles", "LAZ 1.4", "decimal comma, tabs")


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.round(phytofit.simulate(seed=3, n_points=900, noise_cm=0.1).points, 5)


@pytest.fixture(scope="module")
def traits(points: np.ndarray) -> dict[str, float]:
    return traits_of(phytofit.from_points(points, "cm"))


def traits_of(cloud: phytofit.PointCloud) -> dict[str, float]:
    return {f"{trait.name} {trait.unit}": trait.value for trait in phytofit.fit(cloud, threads=2).traits}


def check(name: str, points: np.ndarray, traits: dict[str, float], folder: Path) -> None:
    dialect = DIALECTS[name]
    path = folder / f"leaf{dialect.suffix}"
    path.write_bytes(dialect.write(points / SCALE_CM[dialect.unit or "cm"]))
    found = traits_of(read_cloud(path, dialect.unit or "cm"))
    assert found.keys() == traits.keys()
    for trait, value in traits.items():
        tolerance = TOLERANCE[trait.split()[1]] if dialect.error else 1e-6
        assert found[trait] == pytest.approx(value, abs=tolerance), (name, trait)


@pytest.mark.parametrize("name", SAMPLE)
def test_equal_traits(name: str, points: np.ndarray, traits: dict[str, float], tmp_path: Path) -> None:
    check(name, points, traits, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in DIALECTS if name not in SAMPLE])
def test_equal_traits_in_every_dialect(name: str, points: np.ndarray, traits: dict[str, float], tmp_path: Path) -> None:
    check(name, points, traits, tmp_path)
