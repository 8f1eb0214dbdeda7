"""MAVLink frames out of datagrams, and messages into frames, for the simulated parties.

Written apart from the service's own framing, so that the two check each other.
https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.setpoint import GlobalSetpoint, LocalSetpoint

RECEIVE_BUFFER_BYTES = 4 << 20
"""What the simulated parties ask for, so that none of a burst is lost on loopback; the system may give less."""

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_DECODING_ERRORS = (mavlink.MAVError, struct.error, ValueError, TypeError, LookupError)
"""What pymavlink raises on frames that are not sound."""


@dataclass(frozen=True, slots=True)
class ReceivedFrame:
    """One frame as it came.

    Attributes
    ----------
    raw
        All bytes, header to CRC or signature.
    name
        The message's name, or ``UNKNOWN_<id>`` for ids the dialect lacks; their CRC cannot be checked.
    message
        pymavlink's message object; None for unknown ids.
    seq, system_id, component_id
        From the header.
    """

    raw: bytes
    name: str
    message: Any
    seq: int
    system_id: int
    component_id: int


class FrameReader:
    """Finds the frames of datagrams, backing up one byte after each that is not sound."""

    def __init__(self) -> None:
        self._decoder = mavlink.MAVLink(None)
        self.bad_bytes = 0

    def read(self, datagram: bytes) -> Iterator[ReceivedFrame]:
        """Yield the sound frames of one datagram; the other bytes are counted in ``bad_bytes``."""
        place = 0
        in_step = True
        while place < len(datagram):
            frame = self._frame_at(datagram, place, in_step=in_step)
            in_step = frame is not None
            if frame is None:
                self.bad_bytes += 1
                place += 1
            else:
                yield frame
                place += len(frame.raw)

    def _frame_at(self, datagram: bytes, place: int, *, in_step: bool) -> ReceivedFrame | None:
        length = _frame_length(datagram, place)
        if length is None or place + length > len(datagram):
            return None
        raw = datagram[place : place + length]
        try:
            message = self._decoder.decode(bytearray(raw))
        except _DECODING_ERRORS:
            return None
        if raw[0] == _V2:
            seq, system_id, component_id = raw[4:7]
            message_id = int.from_bytes(raw[7:10], "little")
        else:
            seq, system_id, component_id, message_id = raw[2:6]
        if isinstance(message, mavlink.MAVLink_unknown):
            # Its CRC says nothing to us: believe it only between a frame and a frame, or the datagram's ends.
            end = place + length
            if not in_step or (end < len(datagram) and datagram[end] not in (_V1, _V2)):
                return None
            return ReceivedFrame(raw, f"UNKNOWN_{message_id}", None, seq, system_id, component_id)
        return ReceivedFrame(raw, message.get_type(), message, seq, system_id, component_id)


class FrameWriter:
    """Packs messages as MAVLink 2 with a sequence counter of its own.

    Parameters
    ----------
    system_id, component_id
        The sender.
    """

    def __init__(self, system_id: int, component_id: int) -> None:
        self._encoder = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)

    @property
    def next_seq(self) -> int:
        """The sequence number of the next frame."""
        return int(self._encoder.seq)

    def pack(self, message: Any) -> bytes:
        """Return the frame of a message, and count on."""
        raw = bytes(message.pack(self._encoder))
        self._encoder.seq = (self._encoder.seq + 1) % 256
        return raw


def local_setpoint(message: Any) -> LocalSetpoint:
    """Return a decoded SET_POSITION_TARGET_LOCAL_NED as a value."""
    return LocalSetpoint(
        time_boot_ms=message.time_boot_ms,
        x=message.x,
        y=message.y,
        z=message.z,
        vx=message.vx,
        vy=message.vy,
        vz=message.vz,
        afx=message.afx,
        afy=message.afy,
        afz=message.afz,
        yaw=message.yaw,
        yaw_rate=message.yaw_rate,
        type_mask=message.type_mask,
        target_system=message.target_system,
        target_component=message.target_component,
        coordinate_frame=message.coordinate_frame,
    )


def global_setpoint(message: Any) -> GlobalSetpoint:
    """Return a decoded SET_POSITION_TARGET_GLOBAL_INT as a value."""
    return GlobalSetpoint(**{name: getattr(message, name) for name in GlobalSetpoint.__slots__})


def _frame_length(datagram: bytes, place: int) -> int | None:
    """Return the length the header at ``place`` asks for, or None where there is no header."""
    if place + 3 > len(datagram):
        return None
    payload = datagram[place + 1]
    if datagram[place] == _V1:
        return 8 + payload
    if datagram[place] == _V2:
        return 12 + payload + (13 if datagram[place + 2] & _SIGNED else 0)
    return None
