"""Which setpoints ArduPilot Copter takes in GUIDED, and what it makes of them. Pure.

Frames, offsets and what is refused as measured on ArduCopter 4.7-dev; which bits count and the relative yaw of the
body frames from its source. https://ardupilot.org/dev/docs/copter-commands-in-guided-mode.html
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from companion.guidance.coordinates import wrap_rad
from companion.guidance.setpoint import GlobalSetpoint, LocalSetpoint, MavFrame, Setpoint, TypeMask
from companion.sim.offboard_input import Refusal, global_position
from companion.sim.vehicle import Target, Vector3

_OFFSET_FRAMES = (MavFrame.LOCAL_OFFSET_NED, MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED)
_BODY_FRAMES = (MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED)
_INT_FRAMES: dict[int, int] = {
    MavFrame.GLOBAL: MavFrame.GLOBAL_INT,
    MavFrame.GLOBAL_RELATIVE_ALT: MavFrame.GLOBAL_RELATIVE_ALT_INT,
    MavFrame.GLOBAL_TERRAIN_ALT: MavFrame.GLOBAL_TERRAIN_ALT_INT,
}
"""ArduPilot takes these as the others."""
_TURNS_FROM_M = 0.5
_TURNS_FROM_M_S = 0.3
"""Without a yaw it turns toward where it travels, beyond these: at rest there is no such direction."""


@dataclass(frozen=True, slots=True)
class Guided:
    """A setpoint that was taken.

    Attributes
    ----------
    target
        For the position controller, local NED.
    times_out
        It has to be repeated (velocities). A position is flown to and held for ever.
    """

    target: Target
    times_out: bool


def interpret(
    setpoint: Setpoint,
    *,
    position_ned_m: Vector3,
    heading_rad: float,
    home_down_m: float,
    system_id: int,
    component_id: int,
) -> Guided | Refusal:
    """Return what GUIDED flies, or why the setpoint is not taken: the vehicle stops where it is then.

    - A position counts where none of its three bits is set, a velocity and an acceleration likewise.
    - Frames 7, 8 and 9 are offsets from where the vehicle is, 8 and 9 turned by its heading; there yaw is an angle
      from the heading.
    - Yaw alone is not supported.
    - A target that is not for this system is ignored.

    Raises
    ------
    FloatingPointError
        On NaN in a used field, as the simulated ArduPilot ended on it.
    """
    if setpoint.target_system not in (0, system_id) or setpoint.target_component not in (0, component_id):
        return Refusal(f"target ({setpoint.target_system}, {setpoint.target_component})")
    if setpoint.nonfinite_used_fields():
        raise FloatingPointError(f"{setpoint.nonfinite_used_fields()} of a setpoint")
    mask, frame = setpoint.type_mask, setpoint.coordinate_frame
    uses_acceleration = not mask & TypeMask.ACCELERATION_IGNORE
    if mask & TypeMask.FORCE_SET and uses_acceleration:
        return Refusal("force is not supported")
    is_local = isinstance(setpoint, LocalSetpoint)
    if is_local and frame not in (MavFrame.LOCAL_NED, *_OFFSET_FRAMES):
        return Refusal(f"coordinate_frame {frame}")
    in_body_frame = is_local and frame in _BODY_FRAMES
    turn = heading_rad if in_body_frame else 0.0
    position: Vector3 | None = None
    if not mask & TypeMask.POSITION_IGNORE:
        if isinstance(setpoint, GlobalSetpoint):
            as_int = dataclasses.replace(setpoint, coordinate_frame=_INT_FRAMES.get(frame, frame))
            found = global_position(as_int, home_down_m)
            if found is None:
                return Refusal(f"coordinate_frame {frame}")
            above_terrain = as_int.coordinate_frame == MavFrame.GLOBAL_TERRAIN_ALT_INT
            if above_terrain and not mask & TypeMask.VELOCITY_IGNORE:
                return Refusal("velocity above terrain")
            position = found
        else:
            position = _turned((setpoint.x, setpoint.y, setpoint.z), turn)
            if frame in _OFFSET_FRAMES:
                north, east, down = (p + o for p, o in zip(position_ned_m, position, strict=True))
                position = (north, east, down)
    velocity: Vector3 | None = None
    if not mask & TypeMask.VELOCITY_IGNORE:
        velocity = _turned((setpoint.vx, setpoint.vy, setpoint.vz), turn)
    if position is None and velocity is None:
        return Refusal("no position and no velocity")
    if position is not None and velocity is None and uses_acceleration:
        return Refusal("position with acceleration")
    yaw = None if mask & TypeMask.YAW_IGNORE else setpoint.yaw
    if yaw is not None and in_body_frame:
        yaw = wrap_rad(heading_rad + yaw)
    rate = None if mask & TypeMask.YAW_RATE_IGNORE else setpoint.yaw_rate
    if yaw is None and rate is None:
        yaw = _travel(position, velocity, position_ned_m)
    if position is None:
        return Guided(Target((None, None, None), velocity or (0.0, 0.0, 0.0), yaw, rate), times_out=True)
    return Guided(Target(position, velocity or (0.0, 0.0, 0.0), yaw, rate), times_out=velocity is not None)


def _travel(position: Vector3 | None, velocity: Vector3 | None, here: Vector3) -> float | None:
    """Return the azimuth of where it travels, None at rest."""
    if position is not None:
        north, east, least = position[0] - here[0], position[1] - here[1], _TURNS_FROM_M
    elif velocity is not None:
        north, east, least = velocity[0], velocity[1], _TURNS_FROM_M_S
    else:
        return None
    return math.atan2(east, north) if math.hypot(north, east) >= least else None


def _turned(vector: Vector3, angle_rad: float) -> Vector3:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    x, y, z = vector
    return x * cos - y * sin, x * sin + y * cos, z
