"""The grammar of a grass: productions, expanded to a flat list of symbols, and how probable such a plant is.

An L-system (Prusinkiewicz and Lindenmayer, The Algorithmic Beauty of Plants, 1990) with the productions

    S(i) -> I(i) N(i) H(i) L(i) S(i + 1)      while leaf i has a collar
    S(i) -> W(i) ...                          while leaves are still rolled up in the whorl
    S(i) -> T                                 once all are out, in a plant that flowers

internode, node, sheath, blade, rolled leaf of the whorl, tassel.  No interpreter is needed: it has no branches but its
end.  Section VI of the paper proposes such a grammar for plants of several phytomers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phytofit.errors import SettingError

__all__ = ["KINDS", "PROFILES", "Plant", "PlantGrammar", "Profile", "Symbol"]

FloatArray = NDArray[np.float64]
KINDS = ("internode", "node", "sheath", "blade", "whorl", "tassel")
PROFILES: Mapping[str, str] = {  # what changes along the plant, and its unit
    "internode_length": "cm",
    "stem_diameter": "cm",
    "sheath_length": "cm",
    "leaf_length": "cm",
    "leaf_width": "cm",
    "leaf_angle": "deg",
    "leaf_bend": "deg",
}
LEAST_SHARE = 0.05  # of a profile's largest value, below which its parabola doesn't fall
SLIM = 0.3  # share of its final diameter, of the stem of a plant without leaves; it grows while half of them come out
YOUNG = 0.25  # of the final size, at which a leaf's collar comes out of the whorl and its internode begins to grow
GROWING = 3  # phytomers below the newest collar that are still growing
ROLLED = 0.35  # share of its width that a leaf shows that is still rolled up


@dataclass(frozen=True)
class Profile:
    """A quantity along the plant, by relative rank: 0 is the lowest leaf, 1 the highest.

    A parabola through its values at the ``bottom``, in the ``middle`` and at the ``top``, times log-normal factors: one
    of the plant (``plant_spread``), and one of each phytomer (``spread``), which neighbours share by ``correlation``.
    """

    bottom: float
    middle: float
    top: float
    plant_spread: float
    spread: float
    correlation: float

    def typical(self, rank: FloatArray) -> FloatArray:
        """Values (n,) at relative ranks (n,)."""
        a, b, c = self.bottom, self.middle, self.top
        parabola = a + rank * (4.0 * b - 3.0 * a - c) + rank**2 * (2.0 * a + 2.0 * c - 4.0 * b)
        value: FloatArray = np.maximum(parabola, LEAST_SHARE * max(a, b, c))
        return value

    def covariance(self, n: int) -> FloatArray:
        """Of the logarithms of n neighbours' factors, (n, n)."""
        apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        covariance: FloatArray = self.plant_spread**2 + self.spread**2 * self.correlation**apart
        return covariance

    def drawn(self, rank: FloatArray, random: np.random.Generator) -> FloatArray:
        """Values (n,) of one plant."""
        factors = random.multivariate_normal(np.zeros(len(rank)), self.covariance(len(rank)), method="cholesky")
        drawn: FloatArray = self.typical(rank) * np.exp(factors)
        return drawn

    def log_probability(self, rank: FloatArray, values: FloatArray) -> float:
        """Log density, nats, of positive values (n,) at relative ranks (n,), the plant's factor integrated out."""
        logs = np.log(values / self.typical(rank))
        covariance = self.covariance(len(rank))
        return float(
            -0.5 * logs @ np.linalg.solve(covariance, logs)
            - 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
            - np.log(values).sum()
        )


@dataclass(frozen=True)
class Symbol:
    """One symbol of a plant: its kind, of `KINDS`; the rank of its phytomer, from 1; and its numbers, cm and deg."""

    kind: str
    rank: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class Plant:
    """A plant as the grammar writes it: its symbols from the ground up, and how many leaves it has in the end."""

    symbols: tuple[Symbol, ...]
    n_leaves: int

    def of(self, kind: str) -> tuple[Symbol, ...]:
        """Its symbols of one kind, from the ground up."""
        return tuple(symbol for symbol in self.symbols if symbol.kind == kind)

    @property
    def text(self) -> str:
        """The plant as a word of the grammar: ``I1 N1 H1 L1 I2 ...``."""
        letters = dict(zip(KINDS, "INHLWT", strict=True))
        return " ".join(f"{letters[it.kind]}{it.rank}" for it in self.symbols)


@dataclass(frozen=True)
class PlantGrammar:
    """How plants of a species are built.

    ``n_leaves`` mean and spread of the number of leaves in the end, within ``least_leaves`` and ``most_leaves``;
    ``divergence`` mean and spread, deg, of the angle from one leaf to the next around the stem; ``n_rolled`` leaves are
    seen in the whorl while more are to come; ``flowering_odds`` to one, that a plant with all leaves out has a tassel,
    of ``n_branches`` of ``branch_length`` cm; ``profiles`` as in `PROFILES`.
    """

    n_leaves: tuple[float, float]
    least_leaves: int
    most_leaves: int
    divergence: tuple[float, float]
    n_rolled: int
    flowering_odds: float
    n_branches: int
    branch_length: float
    profiles: Mapping[str, Profile]

    def draw(self, random: np.random.Generator, *, n_leaves: int | None = None, n_collars: int | None = None) -> Plant:
        """A plant of any age, from a seedling to a flowering one.

        n_leaves : that it has in the end; drawn by default
        n_collars : how many of them have unfolded; drawn by default, all ages alike
        """
        if n_leaves is None:
            mean, spread = self.n_leaves
            n_leaves = int(np.clip(round(random.normal(mean, spread)), self.least_leaves, self.most_leaves))
        if not n_leaves >= 1:
            raise SettingError(f"leaves: expected 1 or more, got {n_leaves}")
        if n_collars is None:
            n_collars = int(random.integers(min(2, n_leaves), n_leaves + 1))
        if not 1 <= n_collars <= n_leaves:
            raise SettingError(f"unfolded leaves: expected 1 to {n_leaves}, all that the plant has, got {n_collars}")
        rank = np.arange(n_leaves) / max(1, n_leaves - 1)
        drawn = {name: profile.drawn(rank, random) for name, profile in self.profiles.items()}
        mean, spread = self.divergence
        azimuth = random.uniform(0.0, 360.0) + np.cumsum(random.normal(mean, spread, n_leaves))
        size = _grown(n_leaves, n_collars)
        for name in ("internode_length", "sheath_length", "leaf_length", "leaf_width"):
            drawn[name] = drawn[name] * size
        drawn["stem_diameter"] = drawn["stem_diameter"] * _thickened(n_leaves, n_collars)
        return Plant(tuple(self._expanded(drawn, azimuth % 360.0, n_leaves, n_collars, random)), n_leaves)

    def _expanded(
        self,
        drawn: Mapping[str, FloatArray],
        azimuth: FloatArray,
        n_leaves: int,
        n_collars: int,
        random: np.random.Generator,
    ) -> Sequence[Symbol]:
        symbols: list[Symbol] = []
        for i in range(n_collars):
            at = {name: float(values[i]) for name, values in drawn.items()}
            blade = {"azimuth": float(azimuth[i]), **{n: at[f"leaf_{n}"] for n in ("length", "width", "angle", "bend")}}
            symbols += [
                Symbol("internode", i + 1, {"length": at["internode_length"], "diameter": at["stem_diameter"]}),
                Symbol("node", i + 1, {}),
                Symbol("sheath", i + 1, {"length": at["sheath_length"]}),
                Symbol("blade", i + 1, blade),
            ]
        for i in range(n_collars, min(n_leaves, n_collars + self.n_rolled)):
            values = {
                "azimuth": float(azimuth[i]),
                "length": float(drawn["leaf_length"][i]),
                "width": float(ROLLED * drawn["leaf_width"][i]),
            }
            symbols.append(Symbol("whorl", i + 1, values))
        flowers = random.random() < self.flowering_odds / (1.0 + self.flowering_odds)
        if n_collars == n_leaves and flowers and self.n_branches:
            tassel = {"branches": float(self.n_branches), "length": self.branch_length}
            symbols.append(Symbol("tassel", n_leaves, tassel))
        return symbols

    def log_probability(self, plant: Plant) -> float:
        """Log probability, nats, of the symbols of a plant, up to a constant: its number of leaves, its phyllotaxy and
        its profiles.  Leaves that are still growing count as what they would be grown."""
        collars = len(plant.of("blade"))
        rank = np.arange(collars) / max(1, plant.n_leaves - 1)
        size = _grown(plant.n_leaves, collars)[:collars]
        found = {
            "internode_length": np.array([it.values["length"] for it in plant.of("internode")]) / size,
            "stem_diameter": np.array([it.values["diameter"] for it in plant.of("internode")])
            / _thickened(plant.n_leaves, collars),
            "sheath_length": np.array([it.values["length"] for it in plant.of("sheath")]) / size,
        }
        grows = {"length": size, "width": size, "angle": 1.0, "bend": 1.0}
        for name, by in grows.items():
            found[f"leaf_{name}"] = np.array([it.values[name] for it in plant.of("blade")]) / by
        total = sum(self.profiles[name].log_probability(rank, values) for name, values in found.items())
        mean, spread = self.n_leaves
        total -= 0.5 * ((plant.n_leaves - mean) / spread) ** 2
        azimuth = np.array([it.values["azimuth"] for it in plant.of("blade")])
        turned = (np.diff(azimuth) - self.divergence[0] + 180.0) % 360.0 - 180.0
        return float(total - np.sum(0.5 * (turned / self.divergence[1]) ** 2 + np.log(self.divergence[1])))


def _thickened(n_leaves: int, n_collars: int) -> float:
    """Share of its final diameter that a stem has."""
    return SLIM + (1.0 - SLIM) * min(1.0, 2.0 * n_collars / n_leaves)


def _grown(n_leaves: int, n_collars: int) -> FloatArray:
    """Share (n,) of their final size that phytomers have, the newest least."""
    if n_collars == n_leaves:
        return np.ones(n_leaves)
    below = n_collars - 1.0 - np.arange(n_leaves)  # phytomers above that have a collar, negative in the whorl
    share: FloatArray = YOUNG + (1.0 - YOUNG) * np.clip((below + 1.0) / GROWING, 0.0, 1.0)
    return share
