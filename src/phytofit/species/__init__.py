"""Species as data: a TOML file gives the model, its constants and the prior of its parameters."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from phytofit.bundled import species_folder, species_names
from phytofit.errors import InputError, SettingError, SpeciesError
from phytofit.models.grammar import PlantGrammar
from phytofit.models.phytomer import N_PAPER, Phytomer
from phytofit.parameters import Parameter, ParameterSpace
from phytofit.small_files import read_toml, shortened
from phytofit.species.plants import PlantSection
from phytofit.text import one_line

__all__ = ["STEM_ABOVE", "Species", "load_species"]

STEM_ABOVE = {"equal": 1.0, "none": 0.0, "free": np.nan}  # times as long as below the leaf
MOST = 1e6  # of any number, cm or deg; larger ones are slips, and overflow where they are squared
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MOST, le=MOST)]  # no text, no true or false


@dataclass(frozen=True)
class Species:
    """A plant species (or cultivar) as the fit sees it.

    ``space`` is the prior of the model's parameters; ``ranges`` (k, 2) what a simulation draws from, uniformly;
    ``own_shape_odds`` to one are the odds, before a cloud is seen, that a leaf has a shape of its own, not that of the
    first six parameters; ``plant``, if the file has it, how whole plants are built.
    """

    name: str
    model: Phytomer
    space: ParameterSpace
    ranges: NDArray[np.float64]
    own_shape_odds: float = 100.0
    plant: PlantGrammar | None = None

    def leading(self, n: int) -> "Species":
        """The species with the first `n` of its parameters only: 6 are the paper's."""
        return replace(self, space=ParameterSpace(self.space.parameters[:n]), ranges=self.ranges[:n])

    def with_stem_above(self, how: str) -> "Species":
        """The species whose stem above the leaf is "free" (a parameter of its own), "equal" to that below, or "none".

        The last two have the six parameters of Eq. (1) only.  Raises SettingError for anything else.
        """
        if how not in STEM_ABOVE:
            raise SettingError(f"stem_above: expected one of {', '.join(STEM_ABOVE)}, got {how!r}")
        if how == "free":
            return self
        return replace(self.leading(N_PAPER), model=replace(self.model, stem_above=STEM_ABOVE[how]))


class _Constants(BaseModel):
    model_config = ConfigDict(extra="forbid")
    n_pieces: Annotated[int, Field(strict=True, ge=2, le=1000)] = 30
    widest_share: Annotated[float, Field(ge=0, lt=1)] = 0.5
    slow_share: Annotated[float, Field(ge=0, le=1)] = 0.2
    concavity: Annotated[float, Field(ge=1, le=3)] = 2.0


class _Parameter(BaseModel):
    model_config = ConfigDict(extra="forbid")
    unit: str
    mean: Number
    std: Annotated[Number, Field(gt=0)]
    lower: Number | None = None
    upper: Number | None = None
    discrepancy: Annotated[Number, Field(ge=0)] = 0.0
    range: tuple[Number, Number]


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, Field(min_length=1)]
    model: Literal["phytomer"]
    own_shape_odds: Annotated[Number, Field(gt=0)] = 100.0
    constants: _Constants = _Constants()
    parameters: dict[str, _Parameter]
    plant: PlantSection | None = None


def load_species(species: str | Path = "sorghum") -> Species:
    """Read a species by name, or from a TOML file of the user's.

    The parameters must be those of the model, in any order; of the phytomer's, those after the sixth may be left out
    from any one on.  Raises SpeciesError, which names the file, the key, and what was expected.
    """
    if str(species) in species_names():
        given, where = tomllib.loads(species_folder().joinpath(f"{species}.toml").read_text(encoding="utf-8")), species
    else:
        given, where = _read(Path(species)), species
    try:
        file = _File.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = shortened(".".join(str(part) for part in first["loc"]))
        raise SpeciesError(f"{where}: {key}: {first['msg']} (got {shortened(repr(first['input']))})") from None
    except OverflowError:
        raise SpeciesError(f"{where}: a number is too large; expected lengths in cm and angles in degrees") from None
    return _assemble(file, str(where))


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path, f"a species file, or one of the species {', '.join(species_names())}")
    except InputError as error:
        raise SpeciesError(str(error)) from None


def _assemble(file: _File, where: str) -> Species:
    known = Phytomer.PARAMETERS
    unknown = sorted(set(file.parameters) - set(known))
    given = max((known.index(name) for name in file.parameters if name in known), default=0)
    missing = [name for name in known[: max(given, N_PAPER)] if name not in file.parameters]
    if unknown or missing:
        found = f"unknown {shortened(', '.join(unknown))}" if unknown else f"no {', '.join(missing)}"
        raise SpeciesError(f"{where}: parameters: {found}; the {file.model} has {', '.join(known)}")
    parameters, ranges = [], []
    for name, unit in zip(known, Phytomer.UNITS, strict=True):
        if name not in file.parameters:
            continue
        p = file.parameters[name]
        if p.unit != unit:
            raise SpeciesError(f"{where}: parameters.{name}.unit: expected {unit!r}, got {shortened(repr(p.unit))}")
        lower = -np.inf if p.lower is None else p.lower
        upper = np.inf if p.upper is None else p.upper
        if not lower <= p.range[0] <= p.range[1] <= upper:
            raise SpeciesError(
                f"{where}: parameters.{name}.range: expected two ascending numbers within the bounds "
                f"[{lower:g}, {upper:g}], got {list(p.range)}"
            )
        try:
            parameters.append(Parameter(name, unit, p.mean, p.std, lower, upper, p.discrepancy))
        except SettingError as error:
            raise SpeciesError(f"{where}: {error}") from None
        ranges.append(p.range)
    model = Phytomer(**file.constants.model_dump())
    return Species(
        name=one_line(file.name),
        model=model,
        space=ParameterSpace(parameters),
        ranges=np.array(ranges, float),
        own_shape_odds=file.own_shape_odds,
        plant=None if file.plant is None else file.plant.grammar(),
    )
