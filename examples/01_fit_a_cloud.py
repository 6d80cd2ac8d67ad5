"""Fit one cloud: read it, or simulate it, and get a table of traits and a folder of results.

python examples/01_fit_a_cloud.py                          a simulated phytomer, estimate beside truth
python examples/01_fit_a_cloud.py leaf.ply --units cm      a cloud of your own
"""

import argparse
import tempfile
from pathlib import Path

import phytofit

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("cloud", nargs="?", type=Path, help="a point cloud; without one, a phytomer is simulated")
parser.add_argument("--units", help="unit of the cloud's coordinates: cm, mm, m, none")
parser.add_argument("--out", type=Path, help="folder for the results; a new temporary one by default")
parser.add_argument("--quick", action="store_true", help="small settings: shows that it runs, measures badly")
arguments = parser.parse_args()
small = {"n_samples": 60, "n_points": 800, "n_generations": 3} if arguments.quick else {}

if arguments.cloud:
    truth = {}
    cloud = phytofit.read_cloud(arguments.cloud, arguments.units)
else:
    made = phytofit.simulate(noise_cm=0.5, n_spheres=1, seed=7)  # the stem and the leaf of a plant, scanned
    truth = {trait.name: trait.value for trait in phytofit.measure(made.organs)}
    cloud = phytofit.from_points(made.points, "cm", name="simulated")

result = phytofit.fit(cloud, **small)

print(f"status: {result.status.value}")
for note in result.notes:
    print(f"note: {note}")
for remark in result.remarks:
    print(f"{remark.grade}: {remark}")
for trait in result.traits:
    beside = f"   true {trait_truth:.2f}" if (trait_truth := truth.get(trait.name)) is not None else ""
    print(f"{trait.name:22}{trait.value:9.2f} {trait.unit:8}{trait.quality:6}{beside}")

folder = phytofit.save_fit(result, cloud, arguments.out or Path(tempfile.mkdtemp(prefix="phytofit-")))
print(f"The model on the points: {folder / 'fit.png'}")
