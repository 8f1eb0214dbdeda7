"""Filters of links as text, such as ``deny out planner message=30,31`` (pure)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

_RULE: Final = re.compile(
    r"(?P<verb>allow|deny) (?P<direction>in|out) (?P<link>\*|(?:planner|autopilot)(?:\.[1-9][0-9]?)?)(?P<terms>(?: \S+)*)"
)
_TERM: Final = re.compile(r"(system|component|message)=([0-9]+(?:-[0-9]+)?(?:,[0-9]+(?:-[0-9]+)?)*)")
_GREATEST: Final = {"system": 255, "component": 255, "message": 0xFFFFFF}
_FORM: Final = (
    "allow or deny, in or out, a link (planner, planner.2, autopilot, *), then any of system=IDS component=IDS"
    " message=IDS with IDS as 1,5-7"
)

Ranges = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class FilterRule:
    """One rule; a term that was left out holds for every frame.

    Attributes
    ----------
    allows
        Whether it lets through what it matches.
    incoming
        On what the link receives; else on what is sent on it.
    link
        ``planner``, ``planner.2``, ``autopilot`` or ``*``.
    system, component, message
        Of the frame: of its sender, and the id of its message.
    """

    allows: bool
    incoming: bool
    link: str
    system: Ranges = ()
    component: Ranges = ()
    message: Ranges = ()

    def concerns(self, link: str) -> bool:
        """Return whether it is a rule for the link of this name; ``planner`` is for each ``planner.N``."""
        return self.link in ("*", link, link.partition(".")[0])

    def matches(self, system_id: int, component_id: int, message_id: int) -> bool:
        """Return whether a frame of this sender and message is meant."""
        return (
            _within(system_id, self.system)
            and _within(component_id, self.component)
            and _within(message_id, self.message)
        )


def parse_filter_rule(text: str) -> FilterRule:
    """Read a rule.

    Raises
    ------
    ValueError
        Saying what is allowed.
    """
    match = _RULE.fullmatch(" ".join(text.split()))
    if match is None:
        raise ValueError(_FORM)
    terms: dict[str, Ranges] = {}
    for word in match["terms"].split():
        term = _TERM.fullmatch(word)
        if term is None or term[1] in terms:
            raise ValueError(_FORM)
        terms[term[1]] = _ranges(term[1], term[2])
    return FilterRule(match["verb"] == "allow", match["direction"] == "in", match["link"], **terms)


def _ranges(name: str, text: str) -> Ranges:
    ranges = []
    for part in text.split(","):
        low, _, high = part.partition("-")
        first, last = int(low), int(high or low)
        if not first <= last <= _GREATEST[name]:
            raise ValueError(f"{name} ids from 0 to {_GREATEST[name]}, the lower one first")
        ranges.append((first, last))
    return tuple(ranges)


def _within(number: int, ranges: Ranges) -> bool:
    return not ranges or any(first <= number <= last for first, last in ranges)
