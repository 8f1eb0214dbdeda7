"""The command protocol for our own component (pure).

https://mavlink.io/en/services/command.html

=====================================  ====================================================================
command                                answer
=====================================  ====================================================================
NAV_GUIDED_ENABLE (92), USER_1         param1 1 engages, 0 lets go; refused with the reason in a status text
(31010)
REQUEST_MESSAGE (512)                  HEARTBEAT, AUTOPILOT_VERSION, ONBOARD_COMPUTER_STATUS
REQUEST_AUTOPILOT_CAPABILITIES (520)   AUTOPILOT_VERSION
SET_MESSAGE_INTERVAL (511)             of NAMED_VALUE_FLOAT, DEBUG_VECT, ONBOARD_COMPUTER_STATUS
GET_MESSAGE_INTERVAL (510)             MESSAGE_INTERVAL of the same
anything else                          UNSUPPORTED
=====================================  ====================================================================
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.framing import RawFrame

COMMAND_INT: Final = 75
COMMAND_LONG: Final = 76
MESSAGE_IDS: Final = frozenset({COMMAND_INT, COMMAND_LONG})

AUTOPILOT_VERSION: Final = 148
MESSAGE_INTERVAL: Final = 244

_LONG: Final = struct.Struct("<7fHBBB")
_INT: Final = struct.Struct("<4fiifHBBBBB")
_GUIDED_ENABLE: Final = 92
_USER_1: Final = 31010
_MOST_INTERVAL_US: Final = 3_600_000_000


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG or COMMAND_INT.

    Attributes
    ----------
    number
        MAV_CMD.
    params
        param1 to param4; the rest is a place, which no command of ours has.
    target_system, target_component
        Whom it is for; 0 is everybody.
    system_id, component_id
        Who sent it.
    """

    number: int
    params: tuple[float, float, float, float]
    target_system: int
    target_component: int
    system_id: int
    component_id: int


def read_command(frame: RawFrame) -> Command:
    """Return a COMMAND_LONG or COMMAND_INT as a value.

    Raises
    ------
    ValueError
        When the frame is of another message.
    """
    if frame.message_id == COMMAND_LONG:
        values = _LONG.unpack(frame.payload.ljust(_LONG.size, b"\0")[: _LONG.size])
        number, system, component = values[7:10]
    elif frame.message_id == COMMAND_INT:
        values = _INT.unpack(frame.payload.ljust(_INT.size, b"\0")[: _INT.size])
        number, system, component = values[7:10]
    else:
        raise ValueError(f"message {frame.message_id} is no command")
    p1, p2, p3, p4 = values[:4]
    return Command(number, (p1, p2, p3, p4), system, component, frame.system_id, frame.component_id)


class Streams(Protocol):
    """Messages that are sent again and again, whose interval can be set."""

    def interval_us(self, message_id: int) -> int | None:
        """Return an interval as MESSAGE_INTERVAL has it (-1: off); None for a message that is not sent so."""
        ...

    def set_interval_us(self, message_id: int, interval_us: int) -> None:
        """Set one: us, 0 the configured one, -1 off."""
        ...


class CommandServer:
    """Carries out commands to our component and makes their COMMAND_ACK.

    Parameters
    ----------
    engage
        Takes whether to engage; returns whether it was done.
    messages
        By message id what REQUEST_MESSAGE is answered with.
    streams
        Whose interval can be set.
    """

    def __init__(
        self,
        *,
        engage: Callable[[bool, int, str], bool],
        messages: Mapping[int, Callable[[int], mavlink.MAVLink_message]],
        streams: Streams,
    ) -> None:
        self._engage = engage
        self._messages = messages
        self._streams = streams

    def answer(self, command: Command, now_ns: int) -> list[mavlink.MAVLink_message]:
        """Return COMMAND_ACK and, behind it, what was asked for."""
        result, extra = self._carry_out(command, now_ns)
        ack = mavlink.MAVLink_command_ack_message(
            command.number, int(result), 0, 0, command.system_id, command.component_id
        )
        return [ack, *extra]

    def _carry_out(self, command: Command, now_ns: int) -> tuple[Result, list[mavlink.MAVLink_message]]:
        p1, p2 = command.params[:2]
        match command.number:
            case _ if command.number in (_GUIDED_ENABLE, _USER_1):
                if p1 not in (0.0, 1.0):
                    return Result.DENIED, []
                done = self._engage(p1 == 1.0, now_ns, f"{command.system_id}/{command.component_id}")
                return (Result.ACCEPTED if done else Result.TEMPORARILY_REJECTED), []
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._message(p1, now_ns)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return self._message(AUTOPILOT_VERSION, now_ns) if p1 == 1.0 else (Result.DENIED, [])
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_interval(p1, p2), []
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                interval_us = self._streams.interval_us(_whole(p1))
                if interval_us is None:
                    return Result.UNSUPPORTED, []
                return Result.ACCEPTED, [mavlink.MAVLink_message_interval_message(_whole(p1), interval_us)]
        return Result.UNSUPPORTED, []

    def _message(self, number: float, now_ns: int) -> tuple[Result, list[mavlink.MAVLink_message]]:
        build = self._messages.get(_whole(number))
        return (Result.UNSUPPORTED, []) if build is None else (Result.ACCEPTED, [build(now_ns)])

    def _set_interval(self, number: float, interval_us: float) -> Result:
        message_id = _whole(number)
        if self._streams.interval_us(message_id) is None:
            return Result.UNSUPPORTED
        if not math.isfinite(interval_us) or not -1 <= interval_us <= _MOST_INTERVAL_US:
            return Result.DENIED
        self._streams.set_interval_us(message_id, round(interval_us))
        return Result.ACCEPTED


def version_message(version: str, system_id: int, component_id: int) -> mavlink.MAVLink_message:
    """Return AUTOPILOT_VERSION of our component.

    Parameters
    ----------
    version
        Of the package, ``MAJOR.MINOR.PATCH`` and what may follow.
    system_id, component_id
        Ours: they make the uid, which has no other meaning.
    """
    numbers = [0, 0, 0]
    for place, part in enumerate(version.split(".")[:3]):
        digits = part[: len(part) - len(part.lstrip("0123456789"))]
        numbers[place] = min(255, int(digits or 0))
    major, minor, patch = numbers
    is_release = version == f"{major}.{minor}.{patch}"
    kind = mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL if is_release else mavlink.FIRMWARE_VERSION_TYPE_DEV
    capabilities = (
        mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    )
    nothing = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        capabilities,
        major << 24 | minor << 16 | patch << 8 | kind,
        0,
        0,
        0,
        nothing,
        nothing,
        nothing,
        0,
        0,
        system_id << 8 | component_id,
    )


def _whole(number: float) -> int:
    """Return a float parameter as a whole number; -1 where it is none."""
    return int(number) if math.isfinite(number) and number == int(number) else -1
