"""A mission as the fake autopilots fly it, and its download. No I/O.

https://mavlink.io/en/services/mission.html; as measured on PX4 v1.16.1: POSITION_TARGET_GLOBAL_INT carries the waypoint,
POSITION_TARGET_LOCAL_NED a point on the way to it, 0.4 m ahead; OFFBOARD in between leaves the item as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.sim.vehicle import Target, Vector3

_AHEAD_M = 0.4
_REACHED_M = 0.5
_LEAST_TURN_M = 1.0
"""Nearer than this the heading stays: the direction to a point that is reached says nothing."""


class Mission:
    """Waypoints in local NED, one after the other.

    Parameters
    ----------
    waypoints
        North, east, down in m.
    """

    def __init__(self, waypoints: Sequence[Vector3] = ()) -> None:
        self.waypoints = tuple(waypoints)
        self.current = 0
        self.is_complete = not self.waypoints

    def advance(self, position_ned_m: Vector3) -> None:
        """Go on to the next waypoint where the present one is reached; call it in the mission only."""
        if self.is_complete or math.dist(position_ned_m, self.waypoints[self.current]) > _REACHED_M:
            return
        if self.current + 1 < len(self.waypoints):
            self.current += 1
        else:
            self.is_complete = True

    def goal(self) -> Vector3 | None:
        """Return the present waypoint, or None where there is none."""
        return self.waypoints[self.current] if self.waypoints else None

    def target(self, position_ned_m: Vector3, yaw_rad: float, speed_m_s: float) -> Target | None:
        """Return what to fly toward the present waypoint at a speed, nose ahead; None where there is none."""
        goal = self.goal()
        if goal is None:
            return None
        north, east = goal[0] - position_ned_m[0], goal[1] - position_ned_m[1]
        distance_m = math.hypot(north, east)
        yaw = math.atan2(east, north) if distance_m > _LEAST_TURN_M else yaw_rad
        if distance_m <= _AHEAD_M:
            return Target(goal, yaw_rad=yaw)
        share = _AHEAD_M / distance_m
        ahead = (position_ned_m[0] + share * north, position_ned_m[1] + share * east, goal[2])
        speed = min(speed_m_s, distance_m) / distance_m
        return Target(ahead, (speed * north, speed * east, 0.0), yaw_rad=yaw)


def mission_count(mission: Mission, system_id: int, component_id: int, mission_type: int) -> Any:
    """Return the answer to MISSION_REQUEST_LIST; other kinds of missions (fence, rally points) are empty."""
    count = len(mission.waypoints) if mission_type == mavlink.MAV_MISSION_TYPE_MISSION else 0
    return mavlink.MAVLink_mission_count_message(system_id, component_id, count, mission_type)


def mission_item(
    mission: Mission,
    seq: int,
    globe: tuple[int, int, int] | None,
    home_alt_m: float,
    *,
    system_id: int,
    component_id: int,
    mission_type: int,
) -> Any:
    """Return the answer to MISSION_REQUEST_INT.

    Parameters
    ----------
    seq
        Which item is asked for.
    globe
        Its latitude and longitude (1e-7 deg) and altitude (mm); None: there is none of this number.
    home_alt_m
        What the altitude of an item counts from.
    mission
        The mission.
    system_id, component_id, mission_type
        As asked.
    """
    if globe is None or mission_type != mavlink.MAV_MISSION_TYPE_MISSION:
        return mavlink.MAVLink_mission_ack_message(
            system_id, component_id, mavlink.MAV_MISSION_INVALID_SEQUENCE, mission_type
        )
    return mavlink.MAVLink_mission_item_int_message(
        system_id,
        component_id,
        seq,
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        mavlink.MAV_CMD_NAV_WAYPOINT,
        int(seq == mission.current),
        1,
        0.0,
        0.0,
        0.0,
        math.nan,
        globe[0],
        globe[1],
        globe[2] / 1e3 - home_alt_m,
        mission_type,
    )
