"""How much is done, on what data."""

import sys
from pathlib import Path
from typing import NamedTuple

import phytofit

ROOT = Path(__file__).parents[1]
DATA = ROOT / ".." / "shared" / "data" / "sodhi2018"
UNITS = {"0015_occl1": "mm"}  # of the paper's clouds; cm else
SPECIES = phytofit.load_species()
PAPERS = SPECIES.with_stem_above("equal")  # the paper's phytomer: six parameters, the leaf in the middle of its stem
COLORS = {"likelihood": "#0072B2", "paper": "#D55E00", "without a model": "#7F7F7F", "truth": "#000000"}
MARKERS = {"likelihood": "o", "paper": "s", "without a model": "^"}
NAMES = {"likelihood": "phytofit (default)", "paper": "the paper's method", "without a model": "without a model"}


class Budget(NamedTuple):
    """Numbers of everything; the paper's own, but for peers and ablations, unless `quick`."""

    seeds: int = 10  # of the search on the same phytomers
    phytomers: int = 50
    copies: int = 50  # of the field phytomer, with noise and with holes
    samples: int = 500
    points: int = 5000
    generations: int = 10
    cells: tuple[tuple[int, int], ...] = tuple((n, m) for m in (1000, 5000, 10000) for n in (100, 500, 1000))
    candidates: int = 20  # of a cell of Table I, that peers are measured on
    ablated: int = 10  # phytomers
    ablation_samples: int = 200
    baseline: int = 10  # phytomers, each way, of the comparison with the baseline

    @property
    def search(self) -> dict[str, int]:
        """Settings of the paper's method."""
        return {"n_samples": self.samples, "n_points": self.points, "n_generations": self.generations}


FULL = Budget(candidates=500, ablated=50, ablation_samples=500, baseline=50)
QUICK = Budget(2, 3, 2, 40, 500, 3, ((20, 300), (30, 300)), 2, 2, 40, 2)


def clouds(folder: str) -> list[Path]:
    """The paper's clouds of a folder; none, with a remark, where the data are absent."""
    if not DATA.is_dir():
        print(f"{DATA} is absent: what is measured on its clouds is left out", file=sys.stderr)
        return []
    return sorted((DATA / folder).glob("*.ply"))


def read(path: Path) -> phytofit.PointCloud:
    return phytofit.read_cloud(path, UNITS.get(path.stem, "cm"))
