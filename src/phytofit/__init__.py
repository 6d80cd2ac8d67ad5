"""phytofit: plant traits from 3D point clouds, by fitting parametric plant models.

>>> import phytofit
>>> result = phytofit.fit(phytofit.read_cloud("leaf.ply", units="cm"))
>>> result.parameters["leaf_length"], [trait.value for trait in result.traits]
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phytofit.cloud import PointCloud, from_points, read_cloud, write_cloud
    from phytofit.errors import (
        CloudError,
        InputError,
        NoPhytomerError,
        NoStemError,
        OutputError,
        PhytofitError,
        SettingError,
        SpeciesError,
        Status,
        UnitError,
    )
    from phytofit.fitting import fit
    from phytofit.io import save_fit, save_reconstruction, save_segmentation
    from phytofit.pipeline import PlantRun, run
    from phytofit.recipe import recipe
    from phytofit.reconstruct import CAMERAS, Camera, Reconstruction, load_camera, reconstruct
    from phytofit.results import Fit, PaperFit, Remark
    from phytofit.segmentation import Segmentation, SegmentedLeaf, segment, separate_plants
    from phytofit.simulation import SimulatedPhytomer, SimulatedPlant, simulate, simulate_plant
    from phytofit.species import Species, load_species
    from phytofit.traits import Trait, measure
    from phytofit.validation import Agreement, Comparison, agreement, compare, read_measures, read_results

__all__ = [
    "CAMERAS",
    "Agreement",
    "Camera",
    "CloudError",
    "Comparison",
    "Fit",
    "InputError",
    "NoPhytomerError",
    "NoStemError",
    "OutputError",
    "PaperFit",
    "PhytofitError",
    "PlantRun",
    "PointCloud",
    "Reconstruction",
    "Remark",
    "Segmentation",
    "SegmentedLeaf",
    "SettingError",
    "SimulatedPhytomer",
    "SimulatedPlant",
    "Species",
    "SpeciesError",
    "Status",
    "Trait",
    "UnitError",
    "agreement",
    "compare",
    "fit",
    "from_points",
    "load_camera",
    "load_species",
    "measure",
    "read_cloud",
    "read_measures",
    "read_results",
    "recipe",
    "reconstruct",
    "run",
    "save_fit",
    "save_reconstruction",
    "save_segmentation",
    "segment",
    "separate_plants",
    "simulate",
    "simulate_plant",
    "write_cloud",
]

MODULES = {  # that are imported when the first of their names is asked for, so that ``import phytofit`` takes no time
    "phytofit.cloud": (
        "PointCloud",
        "from_points",
        "read_cloud",
        "write_cloud",
    ),
    "phytofit.errors": (
        "CloudError",
        "InputError",
        "NoPhytomerError",
        "NoStemError",
        "OutputError",
        "PhytofitError",
        "SettingError",
        "SpeciesError",
        "Status",
        "UnitError",
    ),
    "phytofit.results": (
        "Fit",
        "PaperFit",
        "Remark",
    ),
    "phytofit.fitting": ("fit",),
    "phytofit.pipeline": (
        "PlantRun",
        "run",
    ),
    "phytofit.recipe": ("recipe",),
    "phytofit.reconstruct": (
        "CAMERAS",
        "Camera",
        "Reconstruction",
        "load_camera",
        "reconstruct",
    ),
    "phytofit.io": (
        "save_fit",
        "save_reconstruction",
        "save_segmentation",
    ),
    "phytofit.segmentation": (
        "Segmentation",
        "SegmentedLeaf",
        "segment",
        "separate_plants",
    ),
    "phytofit.simulation": (
        "SimulatedPhytomer",
        "SimulatedPlant",
        "simulate",
        "simulate_plant",
    ),
    "phytofit.species": (
        "Species",
        "load_species",
    ),
    "phytofit.traits": (
        "Trait",
        "measure",
    ),
    "phytofit.validation": (
        "Agreement",
        "Comparison",
        "agreement",
        "compare",
        "read_measures",
        "read_results",
    ),
}
HOMES = {name: module for module, names in MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("phytofit")
    if name not in HOMES:
        raise AttributeError(f"module 'phytofit' has no attribute {name!r}")
    value = getattr(importlib.import_module(HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """Importing ``phytofit.recipe``, the module, does not hide ``phytofit.recipe``, the function."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
