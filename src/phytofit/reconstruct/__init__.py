"""From images to a plant's cloud."""

from phytofit.reconstruct.cameras import CAMERAS, Camera, load_camera
from phytofit.reconstruct.depth import Reconstruction, reconstruct
from phytofit.reconstruct.depth_files import depth_files

__all__ = ["CAMERAS", "Camera", "Reconstruction", "depth_files", "load_camera", "reconstruct"]
