"""Makes the pictures of the README and of the documentation that show results of real clouds.

    make pictures                        all of them
    python docs/pictures.py plant leaf   some of them

plant  docs/images/plant.png and reconstruction.png: the sorghum plant of ../shared/data/mccormick2016_turntable, from
       its 12 depth images
leaf   docs/images/leaf.png: the greenhouse leaf 0007 of ../shared/data/sodhi2018

docs/images/robustness.png and sections_*.png are made by `make bench-accuracy`, the paper's figures by `make paper`.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import phytofit
from phytofit.pipeline import run

DATA = Path(__file__).parents[2] / "shared" / "data"
IMAGES = Path(__file__).parent / "images"


def plant() -> None:
    source = DATA / "mccormick2016_turntable"
    with tempfile.TemporaryDirectory() as folder:
        run(source, folder, camera="kinect-v2", pattern="DepthImage_*.png")
        shutil.copy(Path(folder) / "plant.png", IMAGES / "plant.png")
        shutil.copy(Path(folder) / "reconstruction" / "reconstruction.png", IMAGES / "reconstruction.png")


def leaf() -> None:
    cloud = phytofit.read_cloud(DATA / "sodhi2018" / "greenhouse" / "0007.ply", "cm")
    with tempfile.TemporaryDirectory() as folder:
        made = phytofit.save_fit(phytofit.fit(cloud), cloud, folder)
        shutil.copy(made / "fit.png", IMAGES / "leaf.png")


PICTURES = {"plant": plant, "leaf": leaf}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*PICTURES, []], help="all by default")
    for name in parser.parse_args().names or PICTURES:
        PICTURES[name]()
