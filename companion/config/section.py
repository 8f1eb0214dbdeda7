"""What every table of the configuration shares: strictness, and faults between keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from pydantic import BaseModel, ConfigDict, model_validator


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Two keys, each right by itself, that cannot both hold.

    Attributes
    ----------
    key
        Dotted below the table that was checked.
    found, allowed
        For people.
    """

    key: str
    found: str
    allowed: str


class DisagreementError(ValueError):
    """Carries every disagreement of one table through pydantic's validation."""

    def __init__(self, disagreements: tuple[Disagreement, ...]) -> None:
        super().__init__("; ".join(f"{d.key}: found {d.found}; allowed: {d.allowed}" for d in disagreements))
        self.disagreements = disagreements


class Section(BaseModel):
    """A table of the configuration: frozen, unknown keys and wrong types refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def _disagreements(self) -> tuple[Disagreement, ...]:
        """Return what is wrong between keys that are right one by one."""
        return ()

    @model_validator(mode="after")
    def _check_between_keys(self) -> Self:
        if found := self._disagreements():
            raise DisagreementError(found)
        return self
