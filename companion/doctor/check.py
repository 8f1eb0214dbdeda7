"""One line of the checklist."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How it stands."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Check:
    """A judgement.

    Attributes
    ----------
    name
        Of what was looked at.
    level
        ``fail``: it will not protect. ``warn``: it will, and something may go worse than it needs to.
    found
        What was seen.
    advice
        What to do about it; "" where nothing is to be done.
    """

    name: str
    level: Level
    found: str
    advice: str = ""
