"""An optimiser of your own: CMA-ES of the package cmaes in place of the cross-entropy method.

phytofit.paper.minimise asks little of an optimiser: `done`, `ask()`, `tell(xs, errors)` and `n_elite`.  The
objective knows nothing of optimisers, and the optimiser nothing of plants.  Needs the package: pip install cmaes
"""

import argparse
import sys

import numpy as np

import phytofit
import phytofit.cloud
import phytofit.paper
import phytofit.start

try:
    from cmaes import CMA
except ModuleNotFoundError:
    sys.exit("this example needs the package cmaes, which phytofit does not install: pip install cmaes")

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--quick", action="store_true", help="small settings: shows that it runs, measures badly")
quick = parser.parse_args().quick
n_samples, n_points, n_generations = (40, 800, 8) if quick else (60, 5000, 60)


# start of the optimiser
class CmaSearch:
    """CMA-ES in the space of a ParameterSpace, each parameter in units of its prior's spread."""

    n_elite = None  # CMA-ES ranks the whole generation: every error has to be exact

    def __init__(self, space, mean, n_samples, n_generations, seed=0):
        self.space = space
        self.n_samples, self.n_generations = n_samples, n_generations
        self.history = []
        bounds = (np.stack([space.lower, space.upper], axis=1) - space.mean[:, np.newaxis]) / space.std[:, np.newaxis]
        # 0.5: the first generation spreads half as far as the prior
        self._cma = CMA((mean - space.mean) / space.std, 0.5, bounds, seed=seed, population_size=n_samples)

    @property
    def done(self):
        return len(self.history) >= self.n_generations

    @property
    def mean(self):
        return self.space.mean + self.space.std * self._cma.mean

    def ask(self):
        """Candidates (n_samples, k)."""
        return self.space.mean + self.space.std * np.array([self._cma.ask() for _ in range(self.n_samples)])

    def tell(self, xs, errors):
        """Take the candidates' errors (n_samples,), cm, and return what `progress` is to be told."""
        self._cma.tell(list(zip((xs - self.space.mean) / self.space.std, errors.tolist(), strict=True)))
        best = int(np.argmin(errors))
        self.history.append((float(errors[best]), xs[best]))
        return self.history[-1]


# end of the optimiser

made = phytofit.simulate(random_orientation=False, seed=1)
species = phytofit.load_species("sorghum").leading(7)  # Eq. (1), and the stem above the leaf
start = phytofit.start.start_poses(made.points, stem_radius=2.7, up=np.array([0.0, 0.0, 1.0]))[0]
upright = (made.points - start.pose[:3, 3]) @ start.pose[:3, :3]
reference = phytofit.paper.Reference.of(upright[phytofit.cloud.thin(upright, n_points)])
objective = phytofit.paper.PaperObjective(species.model, reference, n_points=n_points)

search = CmaSearch(species.space, species.space.mean, n_samples, n_generations)
phytofit.paper.minimise(search, objective)

errors = [error for error, _ in search.history]
print(f"best of generation 1: {errors[0]:.2f} cm; best of all {len(errors)}: {min(errors):.2f} cm")
_, x = min(search.history, key=lambda found: found[0])
for name, value, true in zip(species.space.names, x, made.x, strict=False):
    print(f"{name:22}{value:9.2f}   true {true:.2f}")
