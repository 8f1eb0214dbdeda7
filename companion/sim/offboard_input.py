"""Which SET_POSITION_TARGET_LOCAL_NED PX4 takes, and what it makes of it. Pure; measured on PX4 v1.16.1.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.setpoint import LocalSetpoint, MavFrame, TypeMask
from companion.sim.vehicle import Target

_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Refusal:
    """The setpoint is not taken and does not count as a sign of life."""

    reason: str


def interpret(
    setpoint: LocalSetpoint, heading_rad: float, *, system_id: int, component_id: int
) -> Target | Refusal:
    """Return what the position controller is asked for, or why the setpoint is refused.

    - Targets (0, 0), (system, 0) and (system, component) are for us, others not.
    - A position is taken in LOCAL_NED alone; a velocity without position in BODY_NED too.
    - NaN in a field means the same as its bit in type_mask. With nothing left: refused.
    - With some axis neither held nor moved (x alone NaN, or x and y masked) the aim is zero velocity on all
      three: it does not follow z then. Setpoints of acceleration alone end there too.

    Parameters
    ----------
    setpoint
        As received.
    heading_rad
        The vehicle's azimuth, for velocities in the body frame.
    system_id, component_id
        Our own.
    """
    if setpoint.target_system not in (0, system_id) or setpoint.target_component not in (0, component_id):
        return Refusal(f"target ({setpoint.target_system}, {setpoint.target_component})")
    if setpoint.type_mask & TypeMask.FORCE_SET:
        return Refusal("force is not supported")

    mask = setpoint.type_mask
    position = [_used(setpoint, name, mask & bit) for name, bit in (("x", 1), ("y", 2), ("z", 4))]
    velocity = [_used(setpoint, name, mask & bit) for name, bit in (("vx", 8), ("vy", 16), ("vz", 32))]
    acceleration = [
        _used(setpoint, name, mask & bit) for name, bit in (("afx", 64), ("afy", 128), ("afz", 256))
    ]
    has_position = any(v is not None for v in position)

    if setpoint.coordinate_frame == MavFrame.BODY_NED:
        if has_position:
            return Refusal("position in frame 8")
        velocity = _turned(velocity, heading_rad)
    elif setpoint.coordinate_frame != MavFrame.LOCAL_NED:
        return Refusal(f"coordinate_frame {setpoint.coordinate_frame}")
    if not has_position and all(v is None for v in (*velocity, *acceleration)):
        return Refusal("no position, velocity or acceleration")

    yaw_rad = _used(setpoint, "yaw", mask & TypeMask.YAW_IGNORE)
    yaw_rate_rad_s = _used(setpoint, "yaw_rate", mask & TypeMask.YAW_RATE_IGNORE)
    if any(p is None and v is None for p, v in zip(position, velocity, strict=True)):
        return Target((None, None, None), _ZERO, yaw_rad, yaw_rate_rad_s)
    vx, vy, vz = (v if v is not None else 0.0 for v in velocity)
    return Target((position[0], position[1], position[2]), (vx, vy, vz), yaw_rad, yaw_rate_rad_s)


def _used(setpoint: LocalSetpoint, name: str, ignored: int) -> float | None:
    value: float = getattr(setpoint, name)
    return None if ignored or not math.isfinite(value) else value


def _turned(velocity: list[float | None], heading_rad: float) -> list[float | None]:
    """Return a velocity forward, right, down as north, east, down."""
    forward, right, down = velocity
    if forward is None or right is None:
        return [None, None, down]
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return [forward * cos - right * sin, forward * sin + right * cos, down]
