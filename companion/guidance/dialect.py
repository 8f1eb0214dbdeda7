"""What the connected autopilot makes of a setpoint: the same message moves PX4 and ArduPilot differently (pure).

====================  ====================================  ===============================================
setpoint              PX4                                   ArduPilot Copter
====================  ====================================  ===============================================
LOCAL_NED, frame 1    each axis by itself: position, else   position where none of its three bits is set,
                      velocity                              velocity likewise; yaw absolute
frame 7               refused                               position is an offset, north and east
frame 8               velocity, forward and right; a        position is an offset, velocity too is forward
                      position in it is not read            and right; yaw relative to the heading
frame 9               refused                               as frame 8
GLOBAL_INT            position or velocity (north, east)    position or velocity (north, east)
====================  ====================================  ===============================================

Measured on PX4 v1.16.1 and ArduCopter 4.7-dev; yaw and the rules on bits from their sources
(``mavlink_receiver.cpp``, ``GCS_MAVLink_Copter.cpp``).
https://mavlink.io/en/messages/common.html#MAV_FRAME
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.guidance.setpoint import GlobalSetpoint, LocalSetpoint, MavFrame, Setpoint, TypeMask

# Plain integers: an IntFlag takes a microsecond for each operation.
_POSITION = int(TypeMask.POSITION_IGNORE)
_X_Y = int(TypeMask.X_IGNORE | TypeMask.Y_IGNORE)
_Z = int(TypeMask.Z_IGNORE)
_VELOCITY = int(TypeMask.VELOCITY_IGNORE)
_VX_VY = int(TypeMask.VX_IGNORE | TypeMask.VY_IGNORE)
_VZ = int(TypeMask.VZ_IGNORE)
_ACCELERATION = int(TypeMask.ACCELERATION_IGNORE)
_FORCE = int(TypeMask.FORCE_SET)

_GLOBAL_FRAMES_PX4 = (MavFrame.GLOBAL_INT, MavFrame.GLOBAL_RELATIVE_ALT_INT, MavFrame.GLOBAL_TERRAIN_ALT_INT)
_GLOBAL_FRAMES_ARDUPILOT = (
    *_GLOBAL_FRAMES_PX4,
    MavFrame.GLOBAL,
    MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_TERRAIN_ALT,
)
_TERRAIN_FRAMES = (MavFrame.GLOBAL_TERRAIN_ALT, MavFrame.GLOBAL_TERRAIN_ALT_INT)
_OFFSET_FRAMES = (MavFrame.LOCAL_OFFSET_NED, MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED)
_BODY_FRAMES = (MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED)


class Autopilot(Enum):
    """Whose rules hold: HEARTBEAT.autopilot. UNKNOWN before the first one."""

    UNKNOWN = "unknown"
    PX4 = "PX4"
    ARDUPILOT = "ArduPilot"
    OTHER = "other"


class Motion(Enum):
    """How a setpoint moves the vehicle horizontally."""

    POSITION = "position"
    OFFSET = "offset"
    VELOCITY = "velocity"


@dataclass(frozen=True, slots=True)
class Reading:
    """How the autopilot reads a setpoint.

    Attributes
    ----------
    motion
        By a position, by an offset from where the vehicle is, or by a velocity.
    in_body_frame
        Offset or velocity are forward and right of the heading, not north and east.
    yaw_is_relative
        yaw is an angle from the heading, not an azimuth.
    """

    motion: Motion
    in_body_frame: bool = False
    yaw_is_relative: bool = False


@dataclass(frozen=True, slots=True)
class NotUnderstood:
    """The autopilot refuses it, or it moves the vehicle in a way that is not treated.

    Attributes
    ----------
    reason
        The same words for the same kind.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class Ambiguous:
    """It depends on the autopilot, which is not known yet."""


def understand(setpoint: Setpoint, autopilot: Autopilot) -> Reading | NotUnderstood | Ambiguous:
    """Return how the connected autopilot reads a setpoint.

    Parameters
    ----------
    setpoint
        As on the wire.
    autopilot
        Before its first HEARTBEAT only what PX4 and ArduPilot read alike is understood. Of any other autopilot
        the same holds, and what they read differently is not understood.
    """
    if autopilot is Autopilot.PX4:
        return _by_px4(setpoint)
    if autopilot is Autopilot.ARDUPILOT:
        return _by_ardupilot(setpoint)
    px4, ardupilot = _by_px4(setpoint), _by_ardupilot(setpoint)
    if px4 == ardupilot or (isinstance(px4, NotUnderstood) and isinstance(ardupilot, NotUnderstood)):
        return px4
    return Ambiguous() if autopilot is Autopilot.UNKNOWN else NotUnderstood("depends on the autopilot")


def _by_px4(setpoint: Setpoint) -> Reading | NotUnderstood:
    mask, frame = setpoint.type_mask, setpoint.coordinate_frame
    uses_acceleration = mask & _ACCELERATION != _ACCELERATION
    if mask & _FORCE and uses_acceleration:
        return NotUnderstood("force")
    if isinstance(setpoint, GlobalSetpoint):
        if not mask & _POSITION:
            return Reading(Motion.POSITION) if frame in _GLOBAL_FRAMES_PX4 else _frame(frame)
        return _velocity_or_why_not(mask, Reading(Motion.VELOCITY))
    if frame == MavFrame.BODY_NED:
        if mask & _VELOCITY:
            return _frame(frame)
        return Reading(Motion.VELOCITY, in_body_frame=True)
    if frame != MavFrame.LOCAL_NED:
        return _frame(frame)
    if not mask & _POSITION:
        return Reading(Motion.POSITION)
    # PX4 takes each axis by itself; one that is neither held nor moved stops all three.
    vertical = not (mask & _Z and mask & _VZ)
    if vertical and not mask & _X_Y:
        return Reading(Motion.POSITION)
    if vertical and mask & _X_Y == _X_Y and not mask & _VX_VY:
        return Reading(Motion.VELOCITY)
    return _why_not(mask)


def _by_ardupilot(setpoint: Setpoint) -> Reading | NotUnderstood:
    mask, frame = setpoint.type_mask, setpoint.coordinate_frame
    uses_acceleration = not mask & _ACCELERATION  # one bit is enough to ignore all three
    if mask & _FORCE and uses_acceleration:
        return NotUnderstood("force")
    in_body_frame = frame in _BODY_FRAMES and isinstance(setpoint, LocalSetpoint)
    if isinstance(setpoint, LocalSetpoint) and frame not in (MavFrame.LOCAL_NED, *_OFFSET_FRAMES):
        return _frame(frame)
    if mask & _POSITION:
        reading = Reading(Motion.VELOCITY, in_body_frame=in_body_frame, yaw_is_relative=in_body_frame)
        return _velocity_or_why_not(mask, reading)
    uses_velocity = not mask & _VELOCITY
    if not uses_velocity and uses_acceleration:
        return NotUnderstood("position with acceleration")  # ArduPilot stops
    if isinstance(setpoint, GlobalSetpoint):
        if frame not in _GLOBAL_FRAMES_ARDUPILOT:
            return _frame(frame)
        if uses_velocity and frame in _TERRAIN_FRAMES:
            return NotUnderstood("velocity above terrain")  # ArduPilot stops
        return Reading(Motion.POSITION)
    if frame == MavFrame.LOCAL_NED:
        return Reading(Motion.POSITION)
    return Reading(Motion.OFFSET, in_body_frame=in_body_frame, yaw_is_relative=in_body_frame)


def _velocity_or_why_not(mask: int, reading: Reading) -> Reading | NotUnderstood:
    return _why_not(mask) if mask & _VELOCITY else reading


def _frame(frame: int) -> NotUnderstood:
    return NotUnderstood(f"coordinate_frame {frame}")


def _why_not(mask: int) -> NotUnderstood:
    if mask & _POSITION != _POSITION:
        return NotUnderstood("partial position")
    if mask & _VELOCITY != _VELOCITY:
        return NotUnderstood("partial velocity")
    if mask & _ACCELERATION != _ACCELERATION:
        return NotUnderstood("acceleration only")
    return NotUnderstood("no position")
