"""The mission's goal, with its own freshness (pure).

Two sources: the mission item that MISSION_CURRENT names, and POSITION_TARGET_GLOBAL_INT while the autopilot flies its
mission. POSITION_TARGET_LOCAL_NED is none: in PX4's mission it is a smoothed point 0.4 m ahead, and while we fly it is
our own setpoint, read back.

https://mavlink.io/en/services/mission.html, https://mavlink.io/en/messages/common.html#POSITION_TARGET_GLOBAL_INT
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.takeover import InterceptionConfig

_RELATIVE_FRAMES = frozenset({3, 6})
_ABSOLUTE_FRAMES = frozenset({0, 5})
_GOAL_COMMANDS = frozenset({16, 82})
"""NAV_WAYPOINT and NAV_SPLINE_WAYPOINT. Others (take-off, land, loiter, return) are left to the autopilot."""


@dataclass(frozen=True, slots=True)
class MissionItem:
    """What is needed of MISSION_ITEM_INT: latitude and longitude in 1e-7 deg, altitude in m as ``frame`` says."""

    seq: int
    frame: int
    command: int
    lat_int: int
    lon_int: int
    alt_m: float


@dataclass(frozen=True, slots=True)
class Place:
    """A goal on the globe.

    Attributes
    ----------
    lat_int, lon_int
        1e-7 deg.
    alt_m
        Altitude, above home where ``relative``, else above mean sea level.
    relative
        Which of them.
    """

    lat_int: int
    lon_int: int
    alt_m: float
    relative: bool


def place_of(item: MissionItem) -> Place | None:
    """Return where a mission item lies, or None where it is no waypoint or its height cannot be told (terrain)."""
    if item.command not in _GOAL_COMMANDS or item.frame not in _RELATIVE_FRAMES | _ABSOLUTE_FRAMES:
        return None
    if not math.isfinite(item.alt_m) or (item.lat_int, item.lon_int) == (0, 0):
        return None
    return Place(item.lat_int, item.lon_int, item.alt_m, item.frame in _RELATIVE_FRAMES)


class MissionGoal:
    """Keeps the goal.

    Parameters
    ----------
    config
        How long it is good for.
    """

    def __init__(self, config: InterceptionConfig) -> None:
        self._config = config
        self._items: dict[int, MissionItem] = {}
        self._current: tuple[int, int] | None = None
        self._target: tuple[Place, int] | None = None

    def forget(self) -> None:
        """Forget everything: another mission, or the autopilot has restarted."""
        self._items = {}
        self._current = self._target = None

    def on_items(self, items: dict[int, MissionItem]) -> None:
        """Take a whole downloaded mission."""
        self._items = dict(items)

    def on_current(self, seq: int, now_ns: int) -> None:
        """Take MISSION_CURRENT."""
        if self._current is not None and self._current[0] != seq:
            self._target = None  # it was of the item before
        self._current = (seq, now_ns)

    def on_target(self, place: Place, now_ns: int, *, in_mission: bool) -> None:
        """Take POSITION_TARGET_GLOBAL_INT; out of the mission it is somebody's setpoint, and ignored."""
        if in_mission:
            self._target = (place, now_ns)

    def place(self, now_ns: int, *, in_mission: bool) -> Place | str:
        """Return the goal, or why there is none."""
        config, current = self._config, self._current
        max_age_ns = config.goal_max_age_s * 1e9
        if self._target is not None:  # said by the autopilot itself, so it comes before what was downloaded
            limit_ns = max_age_ns if in_mission else config.latched_goal_max_age_s * 1e9
            if now_ns - self._target[1] <= limit_ns:
                return self._target[0]
        if current is None or current[0] not in self._items:
            return "no goal of the mission"
        if now_ns - current[1] > max_age_ns:
            return "goal too old"
        return place_of(self._items[current[0]]) or "mission item is no waypoint"
