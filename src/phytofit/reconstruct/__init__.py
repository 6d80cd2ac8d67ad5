"""From images to a plant's cloud."""

from phytofit.reconstruct.cameras import CAMERAS, Camera, load_camera
from phytofit.reconstruct.depth import Reconstruction, reconstruct

__all__ = ["CAMERAS", "Camera", "Reconstruction", "load_camera", "reconstruct"]
