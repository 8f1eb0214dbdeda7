"""The parameter protocol for our own component (pure).

https://mavlink.io/en/services/parameter.html

Every value is a MAV_PARAM_TYPE_REAL32 (``companion.tuning`` says why). A ground station that sets one gets the value in
force back, and a status text that says why where that is not the one it asked for.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from typing import Final, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.framing import RawFrame

PARAM_REQUEST_READ: Final = 20
PARAM_REQUEST_LIST: Final = 21
PARAM_SET: Final = 23
MESSAGE_IDS: Final = frozenset({PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_SET})

_NAME_BYTES: Final = 16
_READ: Final = struct.Struct("<hBB16s")
_LIST: Final = struct.Struct("<BB")
_SET: Final = struct.Struct("<fBB16sB")
_AT_ONCE: Final = 4
"""PARAM_VALUE sent per `ParameterServer.due`: a whole table at once is more than a slow telemetry link takes."""


class ParameterStore(Protocol):
    """What the parameters are: names in alphabetical order, numbers, and what a change of one does."""

    def names(self) -> tuple[str, ...]:
        """Return all names, at most 16 ASCII characters each; always the same ones."""
        ...

    def number(self, name: str) -> float:
        """Return a value in force."""
        ...

    def set_number(self, name: str, number: float, now_ns: int) -> str | None:
        """Change a value; return in words why not, or None where it was done."""
        ...


@dataclass(frozen=True, slots=True)
class Request:
    """One message of the parameter protocol, as it came.

    Attributes
    ----------
    message_id
        One of `MESSAGE_IDS`.
    target_system, target_component
        Whom it is for; 0 is everybody.
    name
        Which; "" where the index says it.
    index
        Its place; -1 where the name says it.
    number, type
        PARAM_SET: value and MAV_PARAM_TYPE.
    """

    message_id: int
    target_system: int
    target_component: int
    name: str = ""
    index: int = -1
    number: float = 0.0
    type: int = 0


def read_request(frame: RawFrame) -> Request:
    """Return a frame of one of `MESSAGE_IDS` as a value.

    Raises
    ------
    ValueError
        When the frame is of another message.
    """
    match frame.message_id:
        case _ if frame.message_id == PARAM_REQUEST_LIST:
            system, component = _LIST.unpack(_padded(frame, _LIST.size))
            return Request(frame.message_id, system, component)
        case _ if frame.message_id == PARAM_REQUEST_READ:
            index, system, component, name = _READ.unpack(_padded(frame, _READ.size))
            return Request(frame.message_id, system, component, _name(name) if index < 0 else "", index)
        case _ if frame.message_id == PARAM_SET:
            number, system, component, name, kind = _SET.unpack(_padded(frame, _SET.size))
            return Request(frame.message_id, system, component, _name(name), number=number, type=kind)
    raise ValueError(f"message {frame.message_id} is not of the parameter protocol")


class ParameterServer:
    """Answers the parameter protocol from a store.

    Parameters
    ----------
    store
        The parameters.
    """

    def __init__(self, store: ParameterStore) -> None:
        self._store = store
        self._names = store.names()
        self._waiting: deque[int] = deque()

    def answer(self, request: Request, now_ns: int) -> tuple[list[mavlink.MAVLink_message], str | None]:
        """Return what answers a request at once, and in words why a value was not set.

        A list is sent by and by (`due`). Asked for again meanwhile, what was sent already comes once more behind the
        rest: whoever asks has it all in the end, and nobody who asks often can keep it from coming to its end.
        """
        names = self._names
        if request.message_id == PARAM_REQUEST_LIST:
            pending = set(self._waiting)
            self._waiting.extend(index for index in range(len(names)) if index not in pending)
            return [], None
        if request.message_id == PARAM_REQUEST_READ:
            index = names.index(request.name) if request.name in names else request.index
            return ([self._value(index)] if 0 <= index < len(names) else []), None
        if request.name not in names:
            return [], None
        why_not: str | None
        if request.type != mavlink.MAV_PARAM_TYPE_REAL32:
            why_not = f"{request.name}: type {request.type}; allowed: 9 (REAL32)"
        else:
            why_not = self._store.set_number(request.name, request.number, now_ns)
        return [self._value(names.index(request.name))], why_not

    def announce(self, name: str) -> mavlink.MAVLink_message:
        """Return PARAM_VALUE of a parameter that has changed by itself, so that ground stations show it."""
        return self._value(self._names.index(name))

    def due(self) -> list[mavlink.MAVLink_message]:
        """Return the next few values of a list that was asked for."""
        few = min(_AT_ONCE, len(self._waiting))
        return [self._value(self._waiting.popleft()) for _ in range(few)]

    def _value(self, index: int) -> mavlink.MAVLink_message:
        name = self._names[index]
        return mavlink.MAVLink_param_value_message(
            name.encode("ascii").ljust(_NAME_BYTES, b"\0"),
            self._store.number(name),
            mavlink.MAV_PARAM_TYPE_REAL32,
            len(self._names),
            index,
        )


def _name(field: bytes) -> str:
    return field.split(b"\0")[0].decode("ascii", "replace")


def _padded(frame: RawFrame, size: int) -> bytes:
    """Return the payload with the zeros that MAVLink 2 trims, without what a later version may add."""
    return frame.payload.ljust(size, b"\0")[:size]
