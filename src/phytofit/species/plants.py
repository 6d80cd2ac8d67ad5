"""The ``[plant]`` section of a species file: how whole plants of the species are built."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from phytofit.models.grammar import PROFILES, PlantGrammar, Profile

__all__ = ["PlantSection"]

Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=1e4)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0, le=1e4)]
Count = Annotated[int, Field(strict=True, ge=0, le=200)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Leaves(_Section):
    mean: Positive
    std: Positive
    least: Annotated[int, Field(strict=True, ge=1, le=100)]
    most: Annotated[int, Field(strict=True, ge=1, le=100)]

    @model_validator(mode="after")
    def _in_order(self) -> "_Leaves":
        if not self.least <= self.mean <= self.most:
            raise ValueError("expected least <= mean <= most")
        return self


class _Divergence(_Section):
    unit: Literal["deg"]
    mean: Annotated[float, Field(strict=True, ge=0.0, le=360.0)]
    std: Positive


class _Tassel(_Section):
    unit: Literal["cm"]
    odds: Number
    branches: Count
    branch_length: Positive


class _Profile(_Section):
    unit: str
    bottom: Positive
    middle: Positive
    top: Positive
    plant_spread: Number
    spread: Positive
    correlation: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)]


class PlantSection(_Section):
    """As :class:`phytofit.models.grammar.PlantGrammar` has it, with units."""

    leaves: _Leaves
    divergence: _Divergence
    rolled_leaves: Count
    tassel: _Tassel | None = None
    profiles: dict[str, _Profile]

    @field_validator("profiles")
    @classmethod
    def _all_there(cls, profiles: dict[str, _Profile]) -> dict[str, _Profile]:
        if set(profiles) != set(PROFILES):
            raise ValueError(f"expected {', '.join(PROFILES)}, no more and no less")
        for name, profile in profiles.items():
            if profile.unit != PROFILES[name]:
                raise ValueError(f"{name}: unit: expected {PROFILES[name]!r}, got {profile.unit!r}")
        return profiles

    def grammar(self) -> PlantGrammar:
        """What the section says."""
        tassel: dict[str, Any] = {"flowering_odds": 0.0, "n_branches": 0, "branch_length": 0.0}
        if self.tassel is not None:
            given = self.tassel
            tassel = {
                "flowering_odds": given.odds,
                "n_branches": given.branches,
                "branch_length": given.branch_length,
            }
        return PlantGrammar(
            n_leaves=(self.leaves.mean, self.leaves.std),
            least_leaves=self.leaves.least,
            most_leaves=self.leaves.most,
            divergence=(self.divergence.mean, self.divergence.std),
            n_rolled=self.rolled_leaves,
            profiles={name: Profile(**p.model_dump(exclude={"unit"})) for name, p in self.profiles.items()},
            **tassel,
        )
