"""What we read of the autopilot's telemetry, as small values (pure).

A message whose needed fields are not finite is `Unusable`, with the reason: it is never half used.
https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from companion.mavlink.framing import CURRENT_MODE, HEADER_V1, HEADER_V2, MAGIC_V1, RawFrame

ATTITUDE: Final = 30
ATTITUDE_QUATERNION: Final = 31
MAV_AUTOPILOT_ARDUPILOTMEGA: Final = 3
MAV_AUTOPILOT_INVALID: Final = 8
MAV_AUTOPILOT_PX4: Final = 12

_CUSTOM_MODE_ENABLED: Final = 1
_SAFETY_ARMED: Final = 128
_PX4_MAIN_OFFBOARD: Final = 6
_COPTER_GUIDED: Final = 4
_COPTER_TYPES: Final = frozenset({2, 3, 4, 13, 14, 15, 29, 35})
"""MAV_TYPE of the vehicles that ArduCopter flies: the numbers of its modes mean others on a plane or rover."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT, with the system and component that sent it."""

    system_id: int
    component_id: int
    type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


@dataclass(frozen=True, slots=True)
class CurrentMode:
    """CURRENT_MODE: the mode alone, at up to 50 Hz where it is asked for; PX4 sends it every 2 s by itself.

    https://mavlink.io/en/messages/common.html#CURRENT_MODE
    """

    custom_mode: int


class Attitude(NamedTuple):
    """ATTITUDE: Euler angles (rad) and body rates (rad/s), body FRD to local NED."""

    time_boot_ms: int
    roll: float
    pitch: float
    yaw: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float


class AttitudeQuaternion(NamedTuple):
    """ATTITUDE_QUATERNION: (w, x, y, z), body FRD to local NED, of length 1 within rounding."""

    time_boot_ms: int
    q_ned_from_body: tuple[float, float, float, float]
    rollspeed: float
    pitchspeed: float
    yawspeed: float


class LocalPosition(NamedTuple):
    """LOCAL_POSITION_NED: position (m) and velocity (m/s)."""

    time_boot_ms: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float


@dataclass(frozen=True, slots=True)
class Odometry:
    """What is needed of ODOMETRY: ``reset_counter`` grows with every jump of the estimate."""

    time_usec: int
    reset_counter: int


@dataclass(frozen=True, slots=True)
class GlobalPosition:
    """What is needed of GLOBAL_POSITION_INT: latitude and longitude in 1e-7 deg."""

    time_boot_ms: int
    lat_int: int
    lon_int: int


@dataclass(frozen=True, slots=True)
class GlobalOrigin:
    """GPS_GLOBAL_ORIGIN: where local NED begins, in 1e-7 deg."""

    lat_int: int
    lon_int: int


@dataclass(frozen=True, slots=True)
class ExtendedSysState:
    """EXTENDED_SYS_STATE; landed_state: 0 undefined, 1 on ground, 2 in air, 3 taking off, 4 landing."""

    vtol_state: int
    landed_state: int


@dataclass(frozen=True, slots=True)
class Unusable:
    """A message of interest that cannot be used, and why."""

    message_id: int
    reason: str


Telemetry = (
    Heartbeat
    | CurrentMode
    | Attitude
    | AttitudeQuaternion
    | LocalPosition
    | GlobalPosition
    | GlobalOrigin
    | Odometry
    | ExtendedSysState
)


class VehicleMode(NamedTuple):
    """Whether the vehicle is armed, and whether it takes setpoints (PX4 OFFBOARD, ArduCopter GUIDED)."""

    armed: bool
    offboard: bool


_HEARTBEAT: Final = struct.Struct("<IBBBBB")
_CUSTOM_MODE: Final = struct.Struct("<I")
_SIX_FLOATS: Final = struct.Struct("<I6f")
_QUATERNION: Final = struct.Struct("<I7f")
_GLOBAL_POSITION: Final = struct.Struct("<Iii")
_GLOBAL_ORIGIN: Final = struct.Struct("<ii")
_TIME_USEC: Final = struct.Struct("<Q")
_RESET_COUNTER_OFFSET: Final = 230
_ODOMETRY_BYTES: Final = 233
_QUATERNION_LENGTH_TOLERANCE: Final = 0.01


def decode(frame: RawFrame) -> Telemetry | Unusable:
    """Return the message of one of `MESSAGE_IDS` as a value.

    Raises
    ------
    ValueError
        When the frame is of another message.
    """
    reader = _READERS.get(frame.message_id)
    if reader is None:
        raise ValueError(f"message {frame.message_id} is not read; only {sorted(MESSAGE_IDS)} are")
    return reader(frame)


def vehicle_mode(heartbeat: Heartbeat) -> VehicleMode:
    """Return what an autopilot's HEARTBEAT says of its mode.

    PX4: ``custom_mode = main << 16 | sub << 24``, OFFBOARD is main mode 6. ArduCopter: GUIDED is 4.
    Any other autopilot, and ArduPilot on anything but a copter, never counts as taking setpoints.
    """
    armed = bool(heartbeat.base_mode & _SAFETY_ARMED)
    enabled = bool(heartbeat.base_mode & _CUSTOM_MODE_ENABLED)
    return VehicleMode(armed, enabled and is_offboard(heartbeat, heartbeat.custom_mode))


def is_offboard(vehicle: Heartbeat, custom_mode: int) -> bool:
    """Return whether a custom mode is the one in which this vehicle takes setpoints."""
    if vehicle.autopilot == MAV_AUTOPILOT_PX4:
        return custom_mode >> 16 & 0xFF == _PX4_MAIN_OFFBOARD
    if vehicle.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
        return vehicle.type in _COPTER_TYPES and custom_mode == _COPTER_GUIDED
    return False


def _heartbeat(frame: RawFrame) -> Heartbeat:
    custom_mode, kind, autopilot, base_mode, status = _HEARTBEAT.unpack_from(_padded(frame, 9))[:5]
    return Heartbeat(frame.system_id, frame.component_id, kind, autopilot, base_mode, custom_mode, status)


def _current_mode(frame: RawFrame) -> CurrentMode:
    return CurrentMode(_CUSTOM_MODE.unpack_from(_padded(frame, _CUSTOM_MODE.size))[0])


def _attitude(frame: RawFrame) -> Attitude | Unusable:
    values = _fields(_SIX_FLOATS, frame)
    return Attitude(*values) if _finite(values) else Unusable(frame.message_id, "not finite")


def _local_position(frame: RawFrame) -> LocalPosition | Unusable:
    values = _fields(_SIX_FLOATS, frame)
    return LocalPosition(*values) if _finite(values) else Unusable(frame.message_id, "not finite")


def _attitude_quaternion(frame: RawFrame) -> AttitudeQuaternion | Unusable:
    values = _fields(_QUATERNION, frame)
    if not _finite(values):
        return Unusable(frame.message_id, "not finite")
    time_boot_ms, w, x, y, z, rollspeed, pitchspeed, yawspeed = values
    length = math.hypot(w, x, y, z)
    if abs(length - 1.0) > _QUATERNION_LENGTH_TOLERANCE:
        return Unusable(frame.message_id, f"quaternion of length {length:.3g}")
    q = (w / length, x / length, y / length, z / length)
    return AttitudeQuaternion(time_boot_ms, q, rollspeed, pitchspeed, yawspeed)


def _global_position(frame: RawFrame) -> GlobalPosition | Unusable:
    time_boot_ms, lat_int, lon_int = _GLOBAL_POSITION.unpack_from(_padded(frame, _GLOBAL_POSITION.size))
    if not _on_globe(lat_int, lon_int):
        return Unusable(frame.message_id, "not on the globe")
    return GlobalPosition(time_boot_ms, lat_int, lon_int)


def _global_origin(frame: RawFrame) -> GlobalOrigin | Unusable:
    lat_int, lon_int = _GLOBAL_ORIGIN.unpack_from(_padded(frame, _GLOBAL_ORIGIN.size))
    return GlobalOrigin(lat_int, lon_int) if _on_globe(lat_int, lon_int) else Unusable(49, "not on the globe")


def _on_globe(lat_int: int, lon_int: int) -> bool:
    return abs(lat_int) <= 900_000_000 and abs(lon_int) <= 1_800_000_000


def _odometry(frame: RawFrame) -> Odometry:
    payload = _padded(frame, _ODOMETRY_BYTES)
    return Odometry(_TIME_USEC.unpack_from(payload)[0], payload[_RESET_COUNTER_OFFSET])


def _extended_sys_state(frame: RawFrame) -> ExtendedSysState:
    payload = _padded(frame, 2)
    return ExtendedSysState(payload[0], payload[1])


def _fields(layout: struct.Struct, frame: RawFrame) -> tuple[Any, ...]:
    """Return the first fields of the payload, read where it stands unless MAVLink 2 has trimmed it."""
    data = frame[0]
    if data[1] >= layout.size:
        return layout.unpack_from(data, HEADER_V1 if data[0] == MAGIC_V1 else HEADER_V2)
    return layout.unpack_from(_padded(frame, layout.size))


def _padded(frame: RawFrame, size: int) -> bytes:
    """Return the payload with the zeros that MAVLink 2 trims."""
    return frame.payload.ljust(size, b"\0")


def _finite(values: tuple[float, ...]) -> bool:
    return all(map(math.isfinite, values))


_READERS: Final[dict[int, Callable[[RawFrame], Telemetry | Unusable]]] = {
    0: _heartbeat,
    ATTITUDE: _attitude,
    ATTITUDE_QUATERNION: _attitude_quaternion,
    32: _local_position,
    33: _global_position,
    49: _global_origin,
    245: _extended_sys_state,
    331: _odometry,
    CURRENT_MODE: _current_mode,
}

MESSAGE_IDS: Final = frozenset(_READERS)
"""Ids of the messages that `decode` reads."""
