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
    from phytofit.cloud import PointCloud, from_points, read_cloud, remove_outliers, thin, write_cloud
    from phytofit.distances import DISTANCES, Reference
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
    from phytofit.fitted import Fit
    from phytofit.fitting import fit, mean_at
    from phytofit.likelihood import CloudLikelihood
    from phytofit.models import Organ, Phytomer, SurfaceSampler, mesh, move
    from phytofit.objectives import PaperObjective, Registration, minimise
    from phytofit.optimize import CrossEntropy, Generation
    from phytofit.outcome import Estimate
    from phytofit.parameters import Parameter, ParameterSpace
    from phytofit.plots import plot_convergence, plot_fit, plot_reconstruction, plot_segmentation
    from phytofit.pose import StartPose, start_poses
    from phytofit.preparation import Prepared, prepare
    from phytofit.recipe import recipe
    from phytofit.reconstruct import CAMERAS, Camera, Reconstruction, load_camera, reconstruct
    from phytofit.results import leaf_table, save_fit, save_reconstruction, save_segmentation, trait_table
    from phytofit.segmentation import Segmentation, SegmentedLeaf, segment, separate_plants
    from phytofit.simulation import SimulatedPhytomer, add_noise, add_outliers, occlude, simulate
    from phytofit.species import Species, load_species
    from phytofit.traits import Trait, measure
    from phytofit.validation import Agreement, Comparison, agreement, compare, read_measures, read_results

__all__ = [
    "CAMERAS",
    "DISTANCES",
    "Agreement",
    "Camera",
    "CloudError",
    "CloudLikelihood",
    "Comparison",
    "CrossEntropy",
    "Estimate",
    "Fit",
    "Generation",
    "InputError",
    "NoPhytomerError",
    "NoStemError",
    "Organ",
    "OutputError",
    "PaperObjective",
    "Parameter",
    "ParameterSpace",
    "PhytofitError",
    "Phytomer",
    "PointCloud",
    "Prepared",
    "Reconstruction",
    "Reference",
    "Registration",
    "Segmentation",
    "SegmentedLeaf",
    "SettingError",
    "SimulatedPhytomer",
    "Species",
    "SpeciesError",
    "StartPose",
    "Status",
    "SurfaceSampler",
    "Trait",
    "UnitError",
    "add_noise",
    "add_outliers",
    "agreement",
    "compare",
    "fit",
    "from_points",
    "leaf_table",
    "load_camera",
    "load_species",
    "mean_at",
    "measure",
    "mesh",
    "minimise",
    "move",
    "occlude",
    "plot_convergence",
    "plot_fit",
    "plot_reconstruction",
    "plot_segmentation",
    "prepare",
    "read_cloud",
    "read_measures",
    "read_results",
    "recipe",
    "reconstruct",
    "remove_outliers",
    "save_fit",
    "save_reconstruction",
    "save_segmentation",
    "segment",
    "separate_plants",
    "simulate",
    "start_poses",
    "thin",
    "trait_table",
    "write_cloud",
]

MODULES = {  # that are imported when the first of their names is asked for, so that ``import phytofit`` takes no time
    "phytofit.cloud": ("PointCloud", "from_points", "read_cloud", "remove_outliers", "thin", "write_cloud"),
    "phytofit.distances": ("DISTANCES", "Reference"),
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
    "phytofit.fitted": ("Fit",),
    "phytofit.fitting": ("fit", "mean_at"),
    "phytofit.likelihood": ("CloudLikelihood",),
    "phytofit.models": ("Organ", "Phytomer", "SurfaceSampler", "mesh", "move"),
    "phytofit.objectives": ("PaperObjective", "Registration", "minimise"),
    "phytofit.optimize": ("CrossEntropy", "Generation"),
    "phytofit.outcome": ("Estimate",),
    "phytofit.parameters": ("Parameter", "ParameterSpace"),
    "phytofit.plots": ("plot_convergence", "plot_fit", "plot_reconstruction", "plot_segmentation"),
    "phytofit.pose": ("StartPose", "start_poses"),
    "phytofit.preparation": ("Prepared", "prepare"),
    "phytofit.recipe": ("recipe",),
    "phytofit.reconstruct": ("CAMERAS", "Camera", "Reconstruction", "load_camera", "reconstruct"),
    "phytofit.results": ("leaf_table", "save_fit", "save_reconstruction", "save_segmentation", "trait_table"),
    "phytofit.segmentation": ("Segmentation", "SegmentedLeaf", "segment", "separate_plants"),
    "phytofit.simulation": ("SimulatedPhytomer", "add_noise", "add_outliers", "occlude", "simulate"),
    "phytofit.species": ("Species", "load_species"),
    "phytofit.traits": ("Trait", "measure"),
    "phytofit.validation": ("Agreement", "Comparison", "agreement", "compare", "read_measures", "read_results"),
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
