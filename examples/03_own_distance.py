"""A distance of your own: register it in phytofit.paper.DISTANCES and fit with it.

A distance is made for one reference cloud, once a fit, and then called for every candidate.  This one is the mean
distance, both ways, in which no point counts for more than 2 cm: a few stray points can't decide it.
"""

import argparse

import numpy as np
from scipy.spatial import cKDTree

import phytofit
import phytofit.paper

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--quick", action="store_true", help="small settings: shows that it runs, measures badly")
quick = parser.parse_args().quick
small = {"n_samples": 60, "n_points": 800, "n_generations": 3} if quick else {}


# start of the distance
def truncated(reference, most_cm=2.0):
    """Mean of the two mean distances between the clouds, each point's cut at `most_cm`."""
    tree = cKDTree(reference.points)  # (m, 3) cm

    def distance(points, organ, limit):
        """Of a candidate laid on the reference: points (3, n) float32, cm; organ (n,), 0 stem, 1 leaf.

        Must be exact where it is at most `limit`; above, any value above `limit` will do.  So it is safe to ignore it.
        """
        forward, _ = tree.query(points.T)
        backward, _ = cKDTree(points.T).query(reference.points)
        return float(0.5 * (np.minimum(forward, most_cm).mean() + np.minimum(backward, most_cm).mean()))

    return distance


phytofit.paper.DISTANCES["truncated"] = truncated
# end of the distance

made = phytofit.simulate(outlier_share=0.05, seed=3)
truth = {trait.name: trait.value for trait in phytofit.measure(made.organs)}
print(f"{len(made.points)} points, one in twenty-one of them an outlier")
for name in ("hausdorff", "truncated"):
    result = phytofit.fit(made.points, "cm", method="paper", distance=name, **small)
    traits = {trait.name: trait.value for trait in result.traits}
    print(f"{name} distance {result.error:.2f} cm")
    for trait in ("stem_diameter", "leaf_length", "leaf_angle", "leaf_width"):
        print(f"    {trait:16}{traits[trait]:9.2f}   true {truth[trait]:.2f}")
