"""From the images or the cloud of plants to the traits of all their leaves, stage by stage, and not twice."""

from phytofit.pipeline.plant import PlantRun, run
from phytofit.pipeline.traits import plant_traits

__all__ = ["PlantRun", "plant_traits", "run"]
