"""The parts of a fit by the paper's method, put together by hand, in the order in which phytofit.fit uses them.

A step can be left out or replaced here; the next examples replace the distance, the species and the optimiser.
"""

import argparse

import numpy as np

import phytofit
import phytofit.cloud
import phytofit.models
import phytofit.paper
import phytofit.start

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--quick", action="store_true", help="small settings: shows that it runs, measures badly")
quick = parser.parse_args().quick
n_points = 800 if quick else 5000

# 1. A cloud, cleaned.  It stands upright, and we say so below.
made = phytofit.simulate(random_orientation=False, seed=1)
cloud = phytofit.from_points(made.points, "cm")
points = cloud.points[phytofit.cloud.remove_outliers(cloud.points)]
print(f"{len(points)} of {len(cloud)} points are no outliers")

# 2. Where the stem stands and on which side the leaf is.
species = phytofit.load_species("sorghum").leading(7)  # Eq. (1), and the stem above the leaf
start = phytofit.start.start_poses(points, stem_radius=2.7, up=np.array([0.0, 0.0, 1.0]))[0]
print(f"a stem of {2 * start.radius:.1f} cm, from {-start.foot:.1f} cm below the leaf to {start.top:.1f} cm above it")

# 3. The reference, seen from there: thinned, with its search structures.
rotation, place = start.pose[:3, :3], start.pose[:3, 3]
upright = (points - place) @ rotation
reference = phytofit.paper.Reference.of(upright[phytofit.cloud.thin(upright, n_points)])

# 4. The objective: candidates -> organs -> points -> ICP -> distance.
objective = phytofit.paper.PaperObjective(species.model, reference, n_points=n_points)

# 5. The search, from the prior with the stem's lengths as they were just seen.
space = species.space
mean = space.mean
mean[space.index("stem_length")] = np.clip(-start.foot, 1.0, None)
mean[space.index("stem_length_above")] = np.clip(start.top, 0.0, None)
settings = {"n_samples": 60, "n_generations": 3} if quick else {}
search = phytofit.paper.CrossEntropy(space, mean=mean, seed=0, **settings)
phytofit.paper.minimise(
    search,
    objective,
    progress=lambda g: print(f"generation {g.index}: best {g.best_error:.2f} cm, elite within {g.threshold:.2f} cm"),
)

# 6. The estimate is the last elite's mean.  Where ICP lays it is its pose.
registration, error = objective.register(search.mean)
pose = start.pose @ registration.T_target_source
organs = phytofit.models.move([organ.row(0) for organ in species.model.organs(search.mean)], pose)
print(f"Hausdorff distance {error:.2f} cm after {registration.iterations} rounds of ICP")

# 7. Traits are measured on organs, fitted or true.
for fitted, true in zip(phytofit.measure(organs), phytofit.measure(made.organs), strict=True):
    print(f"{fitted.name:22}{fitted.value:9.2f} {fitted.unit:8}   true {true.value:.2f}")
