"""Which setpoints of position and velocity PX4 takes, and what it makes of them. Pure; measured on PX4 v1.16.1.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.setpoint import GlobalSetpoint, MavFrame, Setpoint, TypeMask
from companion.sim.telemetry import ORIGIN_ALT_M, local_of
from companion.sim.vehicle import Target, Vector3

_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Refusal:
    """The setpoint is not taken and does not count as a sign of life."""

    reason: str


def interpret(
    setpoint: Setpoint,
    heading_rad: float,
    *,
    system_id: int,
    component_id: int,
    home_down_m: float = 0.0,
) -> Target | Refusal:
    """Return what the position controller is asked for, or why the setpoint is refused.

    - Targets (0, 0), (system, 0) and (system, component) are for us, others not.
    - A local position is taken in LOCAL_NED alone. A velocity is taken in BODY_NED too, where none of its bits is
      set; a position beside it is not read (source).
    - A global position is taken where none of its bits is set, in the three _INT frames (source).
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
    home_down_m
        What altitudes above home are above.
    """
    if setpoint.target_system not in (0, system_id) or setpoint.target_component not in (0, component_id):
        return Refusal(f"target ({setpoint.target_system}, {setpoint.target_component})")
    if setpoint.type_mask & TypeMask.FORCE_SET:
        return Refusal("force is not supported")

    mask = setpoint.type_mask
    velocity = [_used(setpoint, name, mask & bit) for name, bit in (("vx", 8), ("vy", 16), ("vz", 32))]
    acceleration = [
        _used(setpoint, name, mask & bit) for name, bit in (("afx", 64), ("afy", 128), ("afz", 256))
    ]
    position: list[float | None] = [None, None, None]
    if isinstance(setpoint, GlobalSetpoint):
        if not mask & TypeMask.POSITION_IGNORE:
            found = global_position(setpoint, home_down_m)
            if found is None:
                return Refusal(f"coordinate_frame {setpoint.coordinate_frame}")
            position = list(found)
    elif setpoint.coordinate_frame == MavFrame.BODY_NED:
        if mask & TypeMask.VELOCITY_IGNORE:
            velocity = [None, None, None]
        velocity = _turned(velocity, heading_rad)
    elif setpoint.coordinate_frame == MavFrame.LOCAL_NED:
        position = [_used(setpoint, name, mask & bit) for name, bit in (("x", 1), ("y", 2), ("z", 4))]
    else:
        return Refusal(f"coordinate_frame {setpoint.coordinate_frame}")
    if all(v is None for v in (*position, *velocity, *acceleration)):
        return Refusal(f"no position, velocity or acceleration in frame {setpoint.coordinate_frame}")

    yaw_rad = _used(setpoint, "yaw", mask & TypeMask.YAW_IGNORE)
    yaw_rate_rad_s = _used(setpoint, "yaw_rate", mask & TypeMask.YAW_RATE_IGNORE)
    if any(p is None and v is None for p, v in zip(position, velocity, strict=True)):
        return Target((None, None, None), _ZERO, yaw_rad, yaw_rate_rad_s)
    vx, vy, vz = (v if v is not None else 0.0 for v in velocity)
    return Target((position[0], position[1], position[2]), (vx, vy, vz), yaw_rad, yaw_rate_rad_s)


def global_position(setpoint: GlobalSetpoint, home_down_m: float) -> Vector3 | None:
    """Return a global position in local NED, or None where its frame is not one of the three _INT ones.

    The ground is flat and level with home.
    """
    north, east = local_of(setpoint.lat_int, setpoint.lon_int)
    match setpoint.coordinate_frame:
        case MavFrame.GLOBAL_INT:
            return north, east, ORIGIN_ALT_M - setpoint.alt
        case MavFrame.GLOBAL_RELATIVE_ALT_INT | MavFrame.GLOBAL_TERRAIN_ALT_INT:
            return north, east, home_down_m - setpoint.alt
        case _:
            return None


def _used(setpoint: Setpoint, name: str, ignored: int) -> float | None:
    value: float = getattr(setpoint, name)
    return None if ignored or not math.isfinite(value) else value


def _turned(velocity: list[float | None], heading_rad: float) -> list[float | None]:
    """Return a velocity forward, right, down as north, east, down."""
    forward, right, down = velocity
    if forward is None or right is None:
        return [None, None, down]
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return [forward * cos - right * sin, forward * sin + right * cos, down]
