"""What the planner asks for, in local NED, and how an answer in local NED is said in the planner's own kind (pure).

`wish_of` goes one way, `express` the other: between them the switch S needs to know of no frame but local NED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import assert_never

from companion.config import GuidanceConfig
from companion.guidance.coordinates import heading_rad, wrap_rad
from companion.guidance.dialect import Autopilot, Motion, Reading
from companion.guidance.geodesy import Anchor, to_global, to_local
from companion.guidance.observation import Pose
from companion.guidance.setpoint import (
    Decision,
    Drop,
    Forward,
    GlobalSetpoint,
    LocalSetpoint,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Setpoint,
    Stay,
    Verdict,
)

NO_REFERENCE = "no global reference"
"""It is not known where latitude and longitude lie in local NED."""
_STANDING_M = 0.01
"""A goal that is given relative to the vehicle and no further away than this asks it to stay where it is."""
_STANDING_M_S = 0.01
_AHEAD_STEPS = 2.0
"""A velocity has no goal: its direction is judged as far ahead as two of the longest steps."""
_HOLD_GAIN_HZ = 0.5
"""Speed toward a held place for each metre away from it. Well below what pose and vehicle lag by (about 1 s)."""
_HOLD_SPEED_M_S = 0.5
_PX4_STOPS_S = 1.5
_ARDUPILOT_STOPS_S = 4.1
"""From the last velocity to standing still, with default parameters: the mode is left after 1.15 s, then it brakes."""


@dataclass(frozen=True, slots=True)
class Wish:
    """A setpoint as the switch S sees it.

    Attributes
    ----------
    goal
        North and east in local NED, m; None where it cannot be told, see ``unknown``.
    unknown
        Why there is no goal.
    refused
        Why it is not to be followed even where the way is free, "" where it may be.
    yaw_rad
        Azimuth that is asked for; None: the planner leaves it open.
    yaw_rate_rad_s
        Rate that is asked for, None: none.
    carries
        Velocity or acceleration terms could carry the vehicle away from the goal.
    is_relative
        The goal moves with the vehicle (an offset or a velocity).
    body_bearing_rad
        Where the goal is given in the body frame: its direction from the vehicle's nose, which turns with it.
    """

    goal: tuple[float, float] | None
    unknown: str = ""
    refused: str = ""
    yaw_rad: float | None = None
    yaw_rate_rad_s: float | None = None
    carries: bool = False
    is_relative: bool = False
    body_bearing_rad: float | None = None

    def goal_m(self, pose: Pose) -> float:
        """Return the horizontal distance to the goal; infinite where it is not known."""
        if self.goal is None:
            return math.inf
        return math.hypot(self.goal[0] - pose.north_m, self.goal[1] - pose.east_m)

    def asks_to_stay(self, goal_m: float) -> bool:
        """Whether the goal is where the vehicle is, and stays there with it."""
        return self.is_relative and goal_m <= _STANDING_M

    def wants_to_move(self, goal_m: float, arrive_radius_m: float) -> bool:
        """Whether the planner wants to get somewhere; a relative goal is never arrived at."""
        return goal_m > (_STANDING_M if self.is_relative else arrive_radius_m)


def wish_of(
    setpoint: Setpoint,
    reading: Reading,
    *,
    pose: Pose | None,
    anchor: Anchor | None,
    autopilot: Autopilot,
    config: GuidanceConfig,
) -> Wish:
    """Return what a setpoint asks for.

    Parameters
    ----------
    setpoint
        As on the wire.
    reading
        How the autopilot reads it.
    pose
        The vehicle's newest, where there is one.
    anchor
        Where local NED lies on the globe, where that is known.
    autopilot
        Whose projection holds.
    config
        ``max_step_m``, ``arrive_radius_m``, and what to do with velocities.
    """
    heading = 0.0 if pose is None else heading_rad(pose.q_ned_from_body)
    used = setpoint.used_fields()
    yaw = used.get("yaw")
    if yaw is not None and reading.yaw_is_relative:
        yaw = wrap_rad(heading + yaw)
    goal: tuple[float, float] | None = None
    unknown = refused = ""
    body_bearing: float | None = None
    terms = any(name.startswith("af") for name in used)
    if reading.motion is Motion.VELOCITY:
        speed_m_s = math.hypot(setpoint.vx, setpoint.vy)
        ahead_m = _AHEAD_STEPS * max(config.max_step_m, config.arrive_radius_m)
        moves = speed_m_s > _STANDING_M_S
        scale = ahead_m / speed_m_s if moves else 0.0
        goal, body_bearing = _relative(scale * setpoint.vx, scale * setpoint.vy, reading, pose, heading)
        terms = terms or speed_m_s > 0.0  # however slow, it does not pass as it came
        if moves and config.velocity == "hold":
            refused = "velocity setpoints are held"
    else:
        terms = terms or any(name in used for name in ("vx", "vy", "vz"))
        if isinstance(setpoint, GlobalSetpoint):
            if anchor is None:
                unknown = NO_REFERENCE
            else:
                goal = to_local(anchor, setpoint.lat_int, setpoint.lon_int, autopilot)
        elif reading.motion is Motion.OFFSET:
            offset_m = math.hypot(setpoint.x, setpoint.y)
            scale = 1.0 if offset_m > _STANDING_M else 0.0
            goal, body_bearing = _relative(scale * setpoint.x, scale * setpoint.y, reading, pose, heading)
            terms = terms or (offset_m > 0.0 and scale == 0.0)  # repeated, the least offset carries away
        else:
            goal = (setpoint.x, setpoint.y)
            # A climb rate in place of a height is the planner's way to give z: it carries nowhere sideways.
            if "z" not in used:
                terms = any(name in used for name in ("vx", "vy", "afx", "afy", "afz"))
    if goal is None and not unknown:
        unknown = "no pose from the autopilot"
    return Wish(
        goal=goal,
        unknown=unknown,
        refused=refused,
        yaw_rad=yaw,
        yaw_rate_rad_s=used.get("yaw_rate"),
        carries=terms,
        is_relative=reading.motion is not Motion.POSITION,
        body_bearing_rad=body_bearing,
    )


def express(
    decision: Decision,
    setpoint: Setpoint,
    reading: Reading,
    *,
    pose: Pose | None,
    anchor: Anchor | None,
    autopilot: Autopilot,
    config: GuidanceConfig,
) -> Verdict:
    """Return a decision of the switch S as a change to the planner's own message.

    Parameters
    ----------
    decision
        In local NED.
    setpoint, reading
        What the planner sent, and how the autopilot reads it.
    pose
        The vehicle's newest where it is fresh enough to measure from, else None: what is relative to the vehicle
        then asks it to stay.
    anchor, autopilot, config
        As for `wish_of`.
    """
    match decision:
        case Forward() | Drop():
            return decision
        case Stay() | Rewrite():
            pass
        case _:
            assert_never(decision)
    match reading.motion:
        case Motion.POSITION:
            return _as_position(decision, setpoint, anchor, autopilot)
        case Motion.OFFSET:
            return _as_offset(decision, reading, pose)
        case Motion.VELOCITY:
            horizon_s = config.velocity_horizon_s or stops_by_itself_s(autopilot)
            return _as_velocity(decision, setpoint, reading, pose, config.max_step_m / horizon_s, horizon_s)


def stops_by_itself_s(autopilot: Autopilot) -> float:
    """Return how long a velocity outlives the last setpoint, braking included, with the autopilot's default parameters."""
    return _PX4_STOPS_S if autopilot is Autopilot.PX4 else _ARDUPILOT_STOPS_S


def _as_position(
    decision: Stay | Rewrite, setpoint: Setpoint, anchor: Anchor | None, autopilot: Autopilot
) -> Verdict:
    if isinstance(decision, Stay):
        return Drop("no pose to hold")
    if isinstance(setpoint, LocalSetpoint):
        return decision
    if anchor is None:
        return Drop(NO_REFERENCE)
    lat_int, lon_int = to_global(anchor, decision.x, decision.y, autopilot)
    return RewriteGlobal(lat_int, lon_int, decision.yaw, decision.action)


def _as_offset(decision: Stay | Rewrite, reading: Reading, pose: Pose | None) -> Verdict:
    if isinstance(decision, Stay) or pose is None:
        return RewriteOffset(0.0, 0.0, 0.0, None, decision.action)
    heading = heading_rad(pose.q_ned_from_body)
    x, y = _to_frame(decision.x - pose.north_m, decision.y - pose.east_m, reading, heading)
    z = None if decision.down_m is None else decision.down_m - pose.down_m
    return RewriteOffset(x, y, z, _yaw(decision.yaw, reading, heading), decision.action)


def _as_velocity(
    decision: Stay | Rewrite,
    setpoint: Setpoint,
    reading: Reading,
    pose: Pose | None,
    cap_m_s: float,
    horizon_s: float,
) -> Verdict:
    if isinstance(decision, Stay) or pose is None:
        return RewriteVelocity(0.0, 0.0, None, decision.action)
    heading = heading_rad(pose.q_ned_from_body)
    north_m, east_m = decision.x - pose.north_m, decision.y - pose.east_m
    distance_m = math.hypot(north_m, east_m)
    if decision.down_m is None:
        # It moves on: at the planner's speed, but no further than the step within the horizon.
        planned_m_s = math.hypot(setpoint.vx, setpoint.vy)
        speed_m_s = min(planned_m_s, distance_m / horizon_s)
    else:  # back to the place that is held, or a probe
        speed_m_s = min(_HOLD_SPEED_M_S, cap_m_s, _HOLD_GAIN_HZ * distance_m)
    scale = speed_m_s / distance_m if distance_m > 0.0 else 0.0
    vx, vy = _to_frame(scale * north_m, scale * east_m, reading, heading)
    return RewriteVelocity(vx, vy, _yaw(decision.yaw, reading, heading), decision.action)


def _relative(
    x: float, y: float, reading: Reading, pose: Pose | None, heading: float
) -> tuple[tuple[float, float] | None, float | None]:
    """Return the goal of a vector from the vehicle, and its direction from the nose where it turns with it."""
    bearing = math.atan2(y, x) if reading.in_body_frame and math.hypot(x, y) > 0.0 else None
    if pose is None:
        return None, bearing
    if reading.in_body_frame:
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = x * cos - y * sin, x * sin + y * cos
    return (pose.north_m + x, pose.east_m + y), bearing


def _to_frame(north: float, east: float, reading: Reading, heading: float) -> tuple[float, float]:
    if not reading.in_body_frame:
        return north, east
    cos, sin = math.cos(heading), math.sin(heading)
    return north * cos + east * sin, -north * sin + east * cos


def _yaw(yaw: float | None, reading: Reading, heading: float) -> float | None:
    if yaw is None or not reading.yaw_is_relative:
        return yaw
    return wrap_rad(yaw - heading)
