"""Where a frame goes, by MAVLink's rules and the filters of the links (pure).

- A frame without a target, or with target system 0, goes to every link.
- A targeted one goes to the links on which its target has been heard; a target that nobody has heard of is nowhere.
  Within the vehicle's own system (which is ours) the component must have been heard too, where one is named.
- Never back to the link it came from.

On top of these: a setpoint only ever crosses from one side to the other, so that nothing can go round the interception;
and within a side a frame does not go to a link on which its own sender is heard (two links to one autopilot would
otherwise play its telemetry back to it).

A frame of an unknown message has no target that could be read: it goes to every link.

With one link on each side there is nothing to choose: everything crosses, as on a wire, whoever it is for.

https://mavlink.io/en/guide/routing.html
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from pymavlink.dialects.v20.common import mavlink_map

from companion.config.link_filter import FilterRule
from companion.mavlink.framing import HEADER_V1, HEADER_V2, MAGIC_V1, RawFrame

SETPOINTS: Final = frozenset({82, 84, 86})
"""SET_ATTITUDE_TARGET, SET_POSITION_TARGET_LOCAL_NED, SET_POSITION_TARGET_GLOBAL_INT."""
_MOST_SENDERS: Final = 4096
"""Senders that are remembered: ids are the sender's choice, memory is ours."""


def _target_offsets() -> dict[int, tuple[int, int | None]]:
    """Return, for each message with a target, where in the payload its system and component stand."""
    sizes = {"b": 1, "B": 1, "c": 1, "h": 2, "H": 2, "i": 4, "I": 4, "f": 4, "q": 8, "Q": 8, "d": 8}
    offsets: dict[int, tuple[int, int | None]] = {}
    for message_id, message in mavlink_map.items():
        at, found = 0, {}
        codes = bytes(message.native_format).decode().lstrip("<")
        for name, code, length in zip(
            message.ordered_fieldnames,
            codes,
            [message.array_lengths[i] for i in range(len(codes))],
            strict=True,
        ):
            if name in ("target_system", "target_component"):
                found[name] = at
            at += sizes[code] * max(1, length)
        if "target_system" in found:
            offsets[message_id] = (found["target_system"], found.get("target_component"))
    return offsets


_TARGETS: Final = _target_offsets()


class Target(NamedTuple):
    """Whom a frame is for; 0 means all."""

    system_id: int
    component_id: int


_EVERYBODY: Final = Target(0, 0)


def target_of(frame: RawFrame) -> Target:
    """Return whom a frame is for; a message that is unknown or names nobody is for everybody.

    A field that MAVLink 2 trimmed is 0, as is a component where the message names none.
    """
    offsets = _TARGETS.get(frame.message_id)
    if offsets is None or not frame.verified:
        return _EVERYBODY
    data = frame.data
    start = HEADER_V1 if data[0] == MAGIC_V1 else HEADER_V2
    length = data[1]
    system_at, component_at = offsets
    system_id = data[start + system_at] if system_at < length else 0
    if not system_id or component_at is None or component_at >= length:
        return Target(system_id, 0)
    return Target(system_id, data[start + component_at])


@dataclass(frozen=True, slots=True)
class LinkPlace:
    """One link among all.

    Attributes
    ----------
    name
        ``planner``, ``planner.2``, ``autopilot``...
    is_autopilot_side
        On which side of the interception it is.
    """

    name: str
    is_autopilot_side: bool


class Router:
    """Remembers who was heard where, and says where frames go.

    Sets of links are bit masks: bit i is link i of those it was made with.

    Parameters
    ----------
    places
        All links, of both sides.
    filters
        Rules in order; the first that matches a frame on a link decides. Where none does, it passes, unless the link has
        an ``allow`` rule in that direction.
    """

    def __init__(self, places: Sequence[LinkPlace], filters: Sequence[FilterRule] = ()) -> None:
        self.own_system_id = 0
        """The vehicle's, and so ours; 0 while it is not known."""
        count = len(places)
        everywhere = (1 << count) - 1
        self._autopilot_side = sum(1 << i for i, place in enumerate(places) if place.is_autopilot_side)
        self.is_wire = count == 2 and self._autopilot_side in (1, 2)
        self._others = [everywhere & ~(1 << i) for i in range(count)]
        sides = [
            self._autopilot_side if place.is_autopilot_side else everywhere & ~self._autopilot_side
            for place in places
        ]
        self._across = [everywhere & ~side for side in sides]
        self._beside = [side & ~(1 << i) for i, side in enumerate(sides)]
        self._components: dict[int, int] = {}
        self._systems: dict[int, int] = {}
        self._rules_in = [_rules_of(place, filters, incoming=True) for place in places]
        self._rules_out = [_rules_of(place, filters, incoming=False) for place in places]
        self.filters_in = any(self._rules_in)
        self.filters_out = any(self._rules_out)

    def learn(self, link: int, frame: RawFrame) -> bool:
        """Remember that a verified frame's sender is heard on a link; return whether it is remembered, for good.

        What may be garbage names nobody.
        """
        if not frame.verified:
            return False
        bit = 1 << link
        key = frame.system_id << 8 | frame.component_id
        heard = self._components.get(key, 0)
        if not heard and len(self._components) >= _MOST_SENDERS:
            return False
        self._components[key] = heard | bit
        self._systems[frame.system_id] = self._systems.get(frame.system_id, 0) | bit
        return True

    def admits(self, link: int, frame: RawFrame) -> bool:
        """Return whether the filters let in a frame that a link received."""
        return _passes(self._rules_in[link], frame)

    def destinations(self, link: int, frame: RawFrame) -> int:
        """Return the links to which a frame that came in on ``link`` goes, before the filters."""
        if self.is_wire:
            return self._others[link]
        if frame.message_id in _TARGETS:
            mask = self._heard_of(target_of(frame)) & self._others[link]
            if frame.message_id in SETPOINTS:
                mask &= self._across[link]
        else:
            mask = self._others[link]
        beside = self._beside[link]
        if mask & beside:
            mask &= ~(beside & self._components.get(frame.system_id << 8 | frame.component_id, 0))
        return mask

    def lets_out(self, link: int, frame: RawFrame) -> bool:
        """Return whether the filters let a frame leave on a link."""
        return _passes(self._rules_out[link], frame)

    def _heard_of(self, target: Target) -> int:
        if not target.system_id:
            return -1
        if not target.component_id:
            return self._systems.get(target.system_id, 0)
        heard = self._components.get(target.system_id << 8 | target.component_id, 0)
        if heard or target.system_id == self.own_system_id:
            return heard
        return self._systems.get(target.system_id, 0)


def _rules_of(place: LinkPlace, filters: Sequence[FilterRule], *, incoming: bool) -> tuple[FilterRule, ...]:
    return tuple(rule for rule in filters if rule.incoming == incoming and rule.concerns(place.name))


def _passes(rules: tuple[FilterRule, ...], frame: RawFrame) -> bool:
    for rule in rules:
        if rule.matches(frame.system_id, frame.component_id, frame.message_id):
            return rule.allows
    return not any(rule.allows for rule in rules)
