"""Simulated whole plants: drawn from a species' grammar, and scanned."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import SettingError
from phytofit.models import LEAF, Organ, move
from phytofit.models.grammar import Plant
from phytofit.models.plant import PlantOrgan, plant_organs
from phytofit.parsing import checked_whole
from phytofit.simulation.scan import add_noise, anywhere, check_scan, seen_from
from phytofit.species import Species, load_species
from phytofit.traits import Trait, measure

__all__ = ["SimulatedPlant", "simulate_plant"]

FloatArray = NDArray[np.float64]
N_SHAPE = 7  # parameters of a leaf's model before those of what real leaves do beyond the paper's
OF_STEM = ("collar_offset", "stem_diameter_above", "stem_taper")  # of a leaf's parameters: the plant has its own
LEAN_DEG = 5.0  # standard deviation of the stem's turn from foot to top, each way


@dataclass(frozen=True)
class SimulatedPlant:
    """A cloud with its truth: ``points`` (n, 3) cm; ``labels`` (n,) 1 stem and tassel, rank + 1 a leaf, 0 outlier;
    ``plant`` as the grammar writes it; ``organs`` in the cloud's frame; ``pose`` (4, 4) from the plant's frame
    (the foot of the stem at the origin, +z up) to the cloud's."""

    points: FloatArray
    labels: NDArray[np.int64]
    plant: Plant
    organs: tuple[PlantOrgan, ...]
    pose: FloatArray

    @property
    def leaves(self) -> tuple[PlantOrgan, ...]:
        """Blades and rolled leaves, from the ground up."""
        return tuple(it for it in self.organs if it.organ.kind == LEAF)

    @property
    def traits(self) -> list[Trait]:
        """The true traits: those of :func:`phytofit.measure` of the stem and of each leaf; of each leaf with a collar,
        where that is and which way the leaf points; of the plant its height, the number of leaves, and their area."""
        stem = self.organs[0].organ
        of_organs = measure((stem, *(it.organ for it in self.leaves)), method="truth")
        up = self.pose[:3, 2]
        highest = max(float(((it.organ.axis - self.pose[:3, 3]) @ up).max()) for it in self.organs)
        areas = [trait.value for trait in of_organs if trait.name == "leaf_area"]
        found = [
            Trait("plant", 0, "plant_height", highest, "cm", method="truth"),
            Trait("plant", 0, "leaf_count", float(len(self.leaves)), "1", method="truth"),
            Trait("plant", 0, "plant_leaf_area", float(sum(areas)), "cm²", method="truth"),
            *of_organs,
        ]
        node = np.cumsum([it.values["length"] for it in self.plant.of("internode")])
        sheaths = [it.values["length"] for it in self.plant.of("sheath")]
        nodes = np.append(0.0, np.cumsum(stem.segment_lengths))
        along = np.maximum.accumulate(node + sheaths)
        places = np.stack([np.interp(along, nodes, column) for column in stem.axis.T], axis=1)
        heights = (places - self.pose[:3, 3]) @ up

        def of_leaf(rank: int, name: str, value: float, unit: str) -> None:
            found.append(Trait("leaf", rank, name, value, unit, method="truth"))

        for leaf in self.leaves:
            of_leaf(leaf.rank, "leaf_tip_height", float((leaf.organ.axis[-1] - self.pose[:3, 3]) @ up), "cm")
        for i, blade in enumerate(self.plant.of("blade")):
            azimuth = blade.values["azimuth"]
            of_leaf(blade.rank, "collar_height", float(heights[i]), "cm")
            of_leaf(blade.rank, "sheath_length", sheaths[i], "cm")
            of_leaf(blade.rank, "leaf_azimuth", azimuth, "deg")
            if i:
                below = self.plant.of("blade")[i - 1].values["azimuth"]
                of_leaf(blade.rank, "collar_distance", float(along[i] - along[i - 1]), "cm")
                of_leaf(blade.rank, "divergence_angle", abs((azimuth - below + 180.0) % 360.0 - 180.0), "deg")
        return found


def simulate_plant(
    species: Species | None = None,
    *,
    n_leaves: int | None = None,
    n_collars: int | None = None,
    n_points: int = 20_000,
    noise_cm: float = 0.5,
    noise_reach_cm: float = 0.0,
    n_views: int | None = None,
    outlier_share: float = 0.0,
    random_orientation: bool = True,
    seed: int = 0,
) -> SimulatedPlant:
    """Draw a whole plant from the species' grammar, of any age, and scan it.

    `n_leaves` is how many the plant has in the end, `n_collars` how many of them have unfolded; both are drawn by
    default.  Each leaf's shape beyond the paper's model is drawn from the species' prior.  `n_points` are what the
    cloud has before outliers are added; the rest as of :func:`phytofit.simulate`.  `n_views` cameras see no leaf
    behind another.

    Raises SettingError for numbers that can't be, and for a species whose file has no section ``[plant]``.
    """
    species = load_species() if species is None else species
    if species.plant is None:
        raise SettingError(
            f"species {species.name}: expected a file with a section [plant], which says how plants grow"
        )
    check_scan(n_points, noise_cm, noise_reach_cm, n_views, outlier_share, seed)
    for name, count in (("leaves", n_leaves), ("unfolded leaves", n_collars)):
        if count is not None:
            checked_whole(name, count, 1)
    random = np.random.default_rng(seed)
    plant = species.plant.draw(random, n_leaves=n_leaves, n_collars=n_collars)
    shapes = {symbol.rank: _shape(species, random) for symbol in plant.of("blade")}
    lean = random.normal(0.0, LEAN_DEG, 2)
    found = plant_organs(plant, species.model, shapes, lean=(float(lean[0]), float(lean[1])))
    points, which = seen_from([it.organ for it in found], n_points, n_views, random)
    labels = np.array([it.rank + 1 for it in found])[which]
    points = add_noise(points, noise_cm, random, noise_reach_cm)
    points, labels, pose = anywhere(points, labels, outlier_share, random, turned=random_orientation)
    moved: tuple[Organ, ...] = move([it.organ for it in found], pose)
    organs = tuple(replace(it, organ=organ) for it, organ in zip(found, moved, strict=True))
    return SimulatedPlant(points, labels, plant, organs, pose)


def _shape(species: Species, random: np.random.Generator) -> FloatArray:
    """What a leaf does beyond the paper's model, (k,): the species' parameters after the seventh, from their prior."""
    space = species.space
    drawn = np.clip(random.normal(space.mean, space.std), space.lower, space.upper)
    own = np.array([name in OF_STEM for name in space.names])
    return np.asarray(np.where(own, space.mean, drawn)[N_SHAPE:])
