"""SET_POSITION_TARGET_LOCAL_NED on the wire: read it, and change it in place.

A rewritten frame keeps everything that says whose it is and when it was sent: seq, sysid, compid,
time_boot_ms, target and coordinate frame. The four bytes of z are never written: there is no way to change the
altitude from here.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED
"""

from __future__ import annotations

import math
import struct
from typing import Final

from companion.guidance.setpoint import LocalSetpoint, Rewrite, TypeMask
from companion.mavlink.framing import (
    CHECKSUM_BYTES,
    HEADER_V1,
    HEADER_V2,
    INCOMPAT_SIGNED,
    MAGIC_V1,
    RawFrame,
    checksum,
)

SET_ATTITUDE_TARGET: Final = 82
SET_POSITION_TARGET_LOCAL_NED: Final = 84
SET_POSITION_TARGET_GLOBAL_INT: Final = 86

_LOCAL: Final = struct.Struct("<I11fHBBB")
_GLOBAL: Final = struct.Struct("<Iii9fHBBB")
_ATTITUDE: Final = struct.Struct("<I8fBBB3f")
_FLOAT: Final = struct.Struct("<f")
_X_Y: Final = struct.Struct("<2f")
_YAW_RATE_MASK: Final = struct.Struct("<2fH")

# Offsets in the payload.
_X: Final = 4
_VX: Final = 16
_YAW: Final = 40

_FLOATS: Final = (
    (4, TypeMask.X_IGNORE),
    (8, TypeMask.Y_IGNORE),
    (12, TypeMask.Z_IGNORE),
    (16, TypeMask.VX_IGNORE),
    (20, TypeMask.VY_IGNORE),
    (24, TypeMask.VZ_IGNORE),
    (28, TypeMask.AX_IGNORE),
    (32, TypeMask.AY_IGNORE),
    (36, TypeMask.AZ_IGNORE),
    (40, TypeMask.YAW_IGNORE),
    (44, TypeMask.YAW_RATE_IGNORE),
)
"""Offset of each float of the payload and the bit of type_mask that ignores it."""

_POSITION_ONLY: Final = int(
    TypeMask.VELOCITY_IGNORE | TypeMask.ACCELERATION_IGNORE | TypeMask.YAW_RATE_IGNORE
)

# ATTITUDE_TARGET_TYPEMASK
_BODY_RATE_IGNORE: Final = (1, 2, 4)
_THRUST_BODY_SET: Final = 32
_THROTTLE_IGNORE: Final = 64
_ATTITUDE_IGNORE: Final = 128


def unpack_local(frame: RawFrame) -> LocalSetpoint:
    """Return the fields of a SET_POSITION_TARGET_LOCAL_NED frame; a trimmed payload is padded with zeros.

    Raises
    ------
    ValueError
        When the frame is of another message.
    """
    if frame.message_id != SET_POSITION_TARGET_LOCAL_NED:
        raise ValueError(f"expected message {SET_POSITION_TARGET_LOCAL_NED}, got {frame.message_id}")
    values = _LOCAL.unpack_from(_padded(frame, _LOCAL.size))
    return LocalSetpoint(*values)


def rewrite(frame: RawFrame, new: Rewrite) -> bytes:
    """Return the frame with x, y, yaw and type_mask replaced and all further terms ignored.

    Velocity, acceleration and yaw_rate are ignored by type_mask and written as 0, so that nothing that the
    planner added keeps pointing where it should not; FORCE_SET is cleared. A MAVLink 2 payload is trimmed again,
    a MAVLink 1 frame stays one.

    Parameters
    ----------
    frame
        A verified, unsigned SET_POSITION_TARGET_LOCAL_NED that uses x, y and z.
    new
        Position in local NED (m) and yaw (rad).

    Raises
    ------
    ValueError
        When the frame may not be rewritten (another message, signed, unknown incompatibility flags, x, y or z
        not used), or a new value is not finite or does not fit a float32.
    """
    if frame.message_id != SET_POSITION_TARGET_LOCAL_NED:
        raise ValueError(f"expected message {SET_POSITION_TARGET_LOCAL_NED}, got {frame.message_id}")
    payload = _patchable(frame, _LOCAL.size)
    (type_mask,) = struct.unpack_from("<H", payload, 48)
    if type_mask & TypeMask.POSITION_IGNORE:
        raise ValueError(f"type_mask {type_mask} ignores a part of the position")
    yaw = 0.0 if new.yaw is None else new.yaw
    if not (math.isfinite(new.x) and math.isfinite(new.y) and math.isfinite(yaw)):
        raise ValueError(f"not finite: x {new.x}, y {new.y}, yaw {new.yaw}")
    mask = _POSITION_ONLY if new.yaw is not None else _POSITION_ONLY | TypeMask.YAW_IGNORE
    try:
        _X_Y.pack_into(payload, _X, new.x, new.y)
        payload[_VX:_YAW] = bytes(_YAW - _VX)
        _YAW_RATE_MASK.pack_into(payload, _YAW, yaw, 0.0, mask)
    except OverflowError as error:
        raise ValueError(f"does not fit a float32: x {new.x}, y {new.y}, yaw {new.yaw}") from error
    return _reassemble(frame, payload)


def sanitise(frame: RawFrame) -> bytes:
    """Return the frame with 0 in every float field that type_mask ignores and that is NaN or infinite.

    Without such a field the frame comes back byte for byte.

    Raises
    ------
    ValueError
        When there is such a field and the frame may not be changed (signed, unknown incompatibility flags).
    """
    padded = _padded(frame, _LOCAL.size)
    (type_mask,) = struct.unpack_from("<H", padded, 48)
    offsets = [
        offset
        for offset, ignore in _FLOATS
        if type_mask & ignore and not math.isfinite(_FLOAT.unpack_from(padded, offset)[0])
    ]
    if not offsets:
        return frame.data
    payload = _patchable(frame, _LOCAL.size)
    for offset in offsets:
        _FLOAT.pack_into(payload, offset, 0.0)
    return _reassemble(frame, payload)


def global_nonfinite_used_fields(frame: RawFrame) -> tuple[str, ...]:
    """Return the names of used float fields of a SET_POSITION_TARGET_GLOBAL_INT that are NaN or infinite.

    Latitude and longitude are integers and always finite.
    """
    values = _GLOBAL.unpack_from(_padded(frame, _GLOBAL.size))
    names = ("alt", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
    type_mask = values[12]
    return tuple(
        name
        for name, value, (_, ignore) in zip(names, values[3:12], _FLOATS[2:], strict=True)
        if not type_mask & ignore and not math.isfinite(value)
    )


def attitude_nonfinite_used_fields(frame: RawFrame) -> tuple[str, ...]:
    """Return the names of used float fields of a SET_ATTITUDE_TARGET that are NaN or infinite.

    https://mavlink.io/en/messages/common.html#SET_ATTITUDE_TARGET
    """
    values = _ATTITUDE.unpack_from(_padded(frame, _ATTITUDE.size))
    type_mask = values[11]
    q, rates, thrust, thrust_body = values[1:5], values[5:8], values[8], values[12:15]
    used: dict[str, tuple[float, ...]] = {}
    if not type_mask & _ATTITUDE_IGNORE:
        used["q"] = q
    for name, bit, rate in zip(("roll", "pitch", "yaw"), _BODY_RATE_IGNORE, rates, strict=True):
        if not type_mask & bit:
            used[f"body_{name}_rate"] = (rate,)
    if not type_mask & _THROTTLE_IGNORE:
        used["thrust"] = (thrust,)
    if type_mask & _THRUST_BODY_SET:
        used["thrust_body"] = thrust_body
    return tuple(name for name, fields in used.items() if not all(map(math.isfinite, fields)))


def target_system(frame: RawFrame) -> int:
    """Return target_system of a message 82, 84 or 86; 0 addresses every system."""
    offset = 36 if frame.message_id == SET_ATTITUDE_TARGET else 50
    payload = frame.payload
    return payload[offset] if len(payload) > offset else 0


def _padded(frame: RawFrame, size: int) -> bytes:
    return frame.payload.ljust(size, b"\0")


def _patchable(frame: RawFrame, size: int) -> bytearray:
    """Return the payload, padded, of a frame that may be changed."""
    if not frame.verified:
        raise ValueError("the checksum was not verified")
    if frame.incompat_flags:
        signed = frame.incompat_flags & INCOMPAT_SIGNED
        raise ValueError("signed" if signed else f"incompatibility flags {frame.incompat_flags:#x}")
    if frame.is_v1 and frame.data[1] < size:
        raise ValueError(f"a MAVLink 1 payload of {frame.data[1]} bytes, expected {size}")
    return bytearray(_padded(frame, size))


def _reassemble(frame: RawFrame, payload: bytearray) -> bytes:
    """Return the frame with a new payload: length and checksum renewed, the rest of the header kept."""
    if frame.data[0] == MAGIC_V1:
        header, body = frame.data[:HEADER_V1], bytes(payload)
    else:
        body = bytes(payload).rstrip(b"\0")  # never empty: what is changed here has a type_mask
        header = frame.data[:1] + bytes([len(body)]) + frame.data[2:HEADER_V2]
    data = header + body
    return data + checksum(data[1:], frame.message_id).to_bytes(CHECKSUM_BYTES, "little")
