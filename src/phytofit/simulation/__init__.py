"""Plants whose truth is known: organs to clouds, with noise, occlusion, outliers, a random pose."""

from phytofit.simulation.phytomer import SimulatedPhytomer, simulate
from phytofit.simulation.plant import SimulatedPlant, simulate_plant
from phytofit.simulation.scan import add_noise, add_outliers, occlude, random_pose, visible

__all__ = [
    "SimulatedPhytomer",
    "SimulatedPlant",
    "add_noise",
    "add_outliers",
    "occlude",
    "random_pose",
    "simulate",
    "simulate_plant",
    "visible",
]
