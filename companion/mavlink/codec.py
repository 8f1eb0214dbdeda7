"""SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT on the wire: read them, and change them in place.

A rewritten frame keeps everything that says whose it is and when it was sent: seq, sysid, compid,
time_boot_ms, target and coordinate frame. The four bytes of z, and of vz where it stands for z, are not written:
there is no way to change the altitude from here, but for an offset in z that a held setpoint must not repeat.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED,
https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_GLOBAL_INT
"""

from __future__ import annotations

import math
import struct
from typing import Final

from companion.guidance.setpoint import (
    GlobalSetpoint,
    LocalSetpoint,
    Replacement,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Setpoint,
    TypeMask,
)
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
_TWO_FLOATS: Final = struct.Struct("<2f")
_TWO_INTS: Final = struct.Struct("<2i")
_MASK: Final = struct.Struct("<H")

# Offsets in the payload of both messages.
_X: Final = 4
_Z: Final = 12
_VX: Final = 16
_YAW: Final = 40
_TYPE_MASK: Final = 48

# Plain integers: an IntFlag takes a microsecond for each operation.
_POSITION_IGNORE: Final = int(TypeMask.POSITION_IGNORE)
_X_Y_IGNORE: Final = int(TypeMask.X_IGNORE | TypeMask.Y_IGNORE)
_Z_IGNORE: Final = int(TypeMask.Z_IGNORE)
_VX_VY_IGNORE: Final = int(TypeMask.VX_IGNORE | TypeMask.VY_IGNORE)
_VZ_IGNORE: Final = int(TypeMask.VZ_IGNORE)
_ACCELERATION_IGNORE: Final = int(TypeMask.ACCELERATION_IGNORE)
_YAW_IGNORE: Final = int(TypeMask.YAW_IGNORE)
_YAW_RATE_IGNORE: Final = int(TypeMask.YAW_RATE_IGNORE)
_NOT_FORCE: Final = 0x0FFF & ~int(TypeMask.FORCE_SET)

_FLOATS: Final = tuple(
    (offset, int(ignore))
    for offset, ignore in (
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
)
"""Offset of each float of the payload and the bit of type_mask that ignores it."""
_GLOBAL_FLOATS: Final = _FLOATS[2:]
"""Latitude and longitude are integers."""

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
    return LocalSetpoint(*_LOCAL.unpack_from(_padded(frame, _LOCAL.size)))


def unpack_global(frame: RawFrame) -> GlobalSetpoint:
    """Return the fields of a SET_POSITION_TARGET_GLOBAL_INT frame; a trimmed payload is padded with zeros.

    Raises
    ------
    ValueError
        When the frame is of another message.
    """
    if frame.message_id != SET_POSITION_TARGET_GLOBAL_INT:
        raise ValueError(f"expected message {SET_POSITION_TARGET_GLOBAL_INT}, got {frame.message_id}")
    return GlobalSetpoint(*_GLOBAL.unpack_from(_padded(frame, _GLOBAL.size)))


def unpack(frame: RawFrame) -> Setpoint | None:
    """Return the fields of a setpoint of position or velocity, or None where the frame is of another message."""
    match frame.message_id:
        case message_id if message_id == SET_POSITION_TARGET_LOCAL_NED:
            return unpack_local(frame)
        case message_id if message_id == SET_POSITION_TARGET_GLOBAL_INT:
            return unpack_global(frame)
    return None


def rewrite(frame: RawFrame, new: Replacement) -> bytes:
    """Return the frame with what moves the vehicle horizontally, and yaw, replaced.

    Of the planner's further terms none keeps pointing where it should not: what ``new`` does not set of the
    horizontal velocity, acceleration and yaw_rate is ignored by type_mask and written as 0; FORCE_SET is cleared. A
    MAVLink 2 payload is trimmed again, a MAVLink 1 frame stays one.

    Parameters
    ----------
    frame
        A verified, unsigned setpoint of the message and kind that ``new`` is for.
    new
        What is set, in the message's own frame.

    Raises
    ------
    ValueError
        When the frame may not be rewritten (another message or kind, signed, unknown incompatibility flags), or a new
        value is not finite or does not fit its field.
    """
    wanted = (
        SET_POSITION_TARGET_GLOBAL_INT if isinstance(new, RewriteGlobal) else SET_POSITION_TARGET_LOCAL_NED
    )
    either = isinstance(new, RewriteVelocity) and frame.message_id == SET_POSITION_TARGET_GLOBAL_INT
    if frame.message_id != wanted and not either:
        raise ValueError(f"expected message {wanted}, got {frame.message_id}")
    values = _values(new)
    if not all(map(math.isfinite, values)):
        raise ValueError(f"not finite: {new}")
    payload = _patchable(frame, _LOCAL.size)
    (type_mask,) = _MASK.unpack_from(payload, _TYPE_MASK)
    try:
        if isinstance(new, RewriteVelocity):
            _patch_velocity(payload, new)
            mask = type_mask & (_POSITION_IGNORE | _VZ_IGNORE) | _ACCELERATION_IGNORE
        else:
            mask = _patch_position(payload, type_mask, new)
        _TWO_FLOATS.pack_into(payload, _YAW, 0.0 if new.yaw is None else new.yaw, 0.0)
    except (OverflowError, struct.error) as error:
        raise ValueError(f"does not fit its field (a float32 or an int32): {new}") from error
    mask |= _YAW_RATE_IGNORE | (_YAW_IGNORE if new.yaw is None else 0)
    _MASK.pack_into(payload, _TYPE_MASK, mask & _NOT_FORCE)
    _zero_ignored(payload, mask, frame.message_id)
    return _reassemble(frame, payload)


def _values(new: Replacement) -> tuple[float, ...]:
    yaw = 0.0 if new.yaw is None else new.yaw
    match new:
        case Rewrite():
            return new.x, new.y, yaw
        case RewriteOffset():
            return new.x, new.y, yaw, 0.0 if new.z is None else new.z
        case RewriteVelocity():
            return new.vx, new.vy, yaw
        case RewriteGlobal():
            return (yaw,)


def _patch_velocity(payload: bytearray, new: RewriteVelocity) -> None:
    _TWO_FLOATS.pack_into(payload, _VX, new.vx, new.vy)


def _patch_position(payload: bytearray, type_mask: int, new: Rewrite | RewriteOffset | RewriteGlobal) -> int:
    """Set the position and return the bits of type_mask for it; velocities are ignored, but for a vz that stands for z."""
    if type_mask & _X_Y_IGNORE:
        raise ValueError(f"type_mask {type_mask} ignores x or y")
    climbs = bool(type_mask & _Z_IGNORE)
    if climbs and (not isinstance(new, Rewrite) or type_mask & _VZ_IGNORE):
        raise ValueError(f"type_mask {type_mask} ignores z, and no vz stands for it")
    if isinstance(new, RewriteGlobal):
        _TWO_INTS.pack_into(payload, _X, new.lat_int, new.lon_int)
    else:
        _TWO_FLOATS.pack_into(payload, _X, new.x, new.y)
    if isinstance(new, RewriteOffset) and new.z is not None:
        _FLOAT.pack_into(payload, _Z, new.z)
    return _ACCELERATION_IGNORE | _VX_VY_IGNORE | (_Z_IGNORE if climbs else _VZ_IGNORE)


def _zero_ignored(payload: bytearray, mask: int, message_id: int) -> None:
    """Write 0 into every float that type_mask ignores: what is there may be NaN."""
    for offset, ignore in _floats_of(message_id):
        if mask & ignore:
            payload[offset : offset + 4] = bytes(4)


def sanitise(frame: RawFrame) -> bytes:
    """Return the setpoint with 0 in every float field that type_mask ignores and that is NaN or infinite.

    Without such a field the frame comes back byte for byte.

    Raises
    ------
    ValueError
        When there is such a field and the frame may not be changed (signed, unknown incompatibility flags).
    """
    padded = _padded(frame, _LOCAL.size)
    (type_mask,) = _MASK.unpack_from(padded, _TYPE_MASK)
    offsets = [
        offset
        for offset, ignore in _floats_of(frame.message_id)
        if type_mask & ignore and not math.isfinite(_FLOAT.unpack_from(padded, offset)[0])
    ]
    if not offsets:
        return frame.data
    payload = _patchable(frame, _LOCAL.size)
    for offset in offsets:
        _FLOAT.pack_into(payload, offset, 0.0)
    return _reassemble(frame, payload)


def _floats_of(message_id: int) -> tuple[tuple[int, int], ...]:
    return _GLOBAL_FLOATS if message_id == SET_POSITION_TARGET_GLOBAL_INT else _FLOATS


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
