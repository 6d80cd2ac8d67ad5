"""A species of your own: write its TOML file, simulate plants of it, and fit one.

The numbers describe no real plant.  Put your own measurements in their place.
"""

import argparse
import tempfile
from pathlib import Path

import phytofit

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--out", type=Path, help="folder for the species file; a new temporary one by default")
parser.add_argument("--quick", action="store_true", help="small settings: shows that it runs, measures badly")
arguments = parser.parse_args()
small = {"n_samples": 60, "n_points": 800, "n_generations": 3} if arguments.quick else {}

SPECIES = """
name = "small-grass"
model = "phytomer"

[parameters.stem_diameter]
unit = "cm"
mean = 1.2
std = 0.4
lower = 0.1
range = [0.8, 1.6]

[parameters.stem_length]
unit = "cm"
mean = 8.0
std = 3.0
lower = 0.5
range = [6.0, 10.0]

[parameters.leaf_angle]
unit = "deg"
mean = 35.0
std = 15.0
lower = 0.0
upper = 180.0
range = [25.0, 45.0]

[parameters.leaf_length]
unit = "cm"
mean = 25.0
std = 8.0
lower = 3.0
range = [20.0, 30.0]

[parameters.leaf_width]
unit = "cm"
mean = 2.0
std = 0.7
lower = 0.2
range = [1.5, 2.5]

[parameters.leaf_rotate_angle]
unit = "deg"
mean = 3.0
std = 2.0
range = [2.0, 4.0]

[parameters.stem_length_above]
unit = "cm"
mean = 4.0
std = 2.0
lower = 0.0
range = [3.0, 6.0]
"""

folder = arguments.out or Path(tempfile.mkdtemp(prefix="phytofit-"))
folder.mkdir(parents=True, exist_ok=True)
file = folder / "small-grass.toml"
file.write_text(SPECIES, encoding="utf-8")

species = phytofit.load_species(file)
print(f"{species.name}: {len(species.space)} parameters, {', '.join(species.space.names)}")

made = phytofit.simulate(species, noise_cm=0.1, seed=5)
result = phytofit.fit(made.points, "cm", species=species, **small)
for (name, value), true in zip(result.parameters.items(), made.x, strict=True):
    print(f"{name:22}{value:9.2f}   true {true:.2f}")
print(f"From the command line: phytofit fit leaf.ply --units cm --species {file}")
