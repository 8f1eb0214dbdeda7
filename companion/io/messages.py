"""What crosses between the service and the I/O process.

Towards the I/O process one packet holds one message or several: a fixed header, the fields as JSON, and bytes that are no
JSON (MAVLink frames, arrays). Pixels never cross the socket (``frame_ring``). What comes back is one JSON object a packet,
checked field by field before anything is made of it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

MAX_PACKET_BYTES: Final = 1 << 17
"""Longest packet either side sends; the kernel's socket buffer holds about two."""

_HEADER: Final = struct.Struct("<BqQII")


class Kind(StrEnum):
    """What a message to the I/O process is about; ``companion.io.sink`` lists the fields of each."""

    FRAME = "frame"
    POSE = "pose"
    SETPOINT = "setpoint"
    DETECTION = "detection"
    DETAILS = "details"
    STATE = "state"
    STATUS = "status"
    LINK = "link"
    LOG = "log"
    MAVLINK = "mavlink"
    LOOP = "loop"
    CONFIG = "config"
    CONTROL = "control"
    ANSWER = "answer"
    RING = "ring"


ALWAYS: Final = frozenset({Kind.CONTROL, Kind.ANSWER})
"""Sent whether or not a sink has asked for them."""

_KINDS: Final = tuple(Kind)
_NUMBERS: Final = {kind: number for number, kind in enumerate(_KINDS)}


class PacketError(ValueError):
    """A packet is none of ours."""


@dataclass(frozen=True, slots=True)
class Message:
    """One thing that happened in the service.

    Attributes
    ----------
    kind
        What it is about.
    time_ns
        When, in our monotonic time; of a frame, when it was exposed.
    seq
        Counts everything published since the service began: a gap is what was dropped or not asked for.
    fields
        Plain values.
    data
        Bytes beside them: MAVLink frames, or the arrays of ``details``.
    image
        Of a frame, (H, W) uint8; not to be written to: all sinks share it.
    """

    kind: Kind
    time_ns: int
    seq: int
    fields: Mapping[str, Any] = field(default_factory=dict)
    data: bytes = b""
    image: NDArray[np.uint8] | None = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays in ``data``, by name; empty where there are none."""
        return unpack_arrays(self.fields.get("arrays", ()), self.data)


@dataclass(frozen=True, slots=True)
class Wants:
    """What a sink wants to be told; it may change at any time.

    Attributes
    ----------
    kinds
        ``details`` makes the vision worker hand out what it saw on the way to an answer, which costs it time.
    frames_hz
        Frames a second at the most; 0: every frame. Where several sinks want frames, the fastest decides for all.
    """

    kinds: frozenset[Kind] = frozenset()
    frames_hz: float = 0.0


def pack(kind: Kind, time_ns: int, seq: int, fields: bytes, data: bytes = b"") -> bytes:
    """Return one message's part of a packet; ``fields`` is a JSON object, or empty for none."""
    return _HEADER.pack(_NUMBERS[kind], time_ns, seq, len(fields), len(data)) + fields + data


def unpack(packet: bytes) -> Iterator[Message]:
    """Yield the messages of a packet.

    Raises
    ------
    PacketError
        When it is cut short or holds no message.
    """
    at = 0
    while at < len(packet):
        try:
            number, time_ns, seq, fields_bytes, data_bytes = _HEADER.unpack_from(packet, at)
            kind = _KINDS[number]
        except (struct.error, IndexError) as error:
            raise PacketError(f"no message at byte {at}: {error}") from error
        begin = at + _HEADER.size
        middle, at = begin + fields_bytes, begin + fields_bytes + data_bytes
        if at > len(packet):
            raise PacketError(f"a message of {at - begin} bytes in a packet of {len(packet)}")
        try:
            fields = _fields_of(kind, packet[begin:middle])
        except (TypeError, ValueError) as error:
            raise PacketError(f"fields of {kind}: {error}") from error
        yield Message(kind, time_ns, seq, fields, packet[middle:at])


def _fields_of(kind: Kind, text: bytes) -> Mapping[str, Any]:
    if kind is Kind.MAVLINK:
        return _shared_fields(text)
    fields: dict[str, Any] = json.loads(text) if text else {}
    return fields


@lru_cache(maxsize=64)
def _shared_fields(text: bytes) -> Mapping[str, Any]:
    """Return the fields of what comes hundreds of times a second and is one of a few (link and direction); thousands may wait."""
    return MappingProxyType(json.loads(text) if text else {})


def pack_arrays(arrays: Mapping[str, NDArray[Any]]) -> tuple[list[list[Any]], bytes]:
    """Return how arrays are laid out (name, dtype, shape of each) and their bytes, one after the other."""
    layout = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    return layout, b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())


def unpack_arrays(layout: Any, data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays that `pack_arrays` packed; they cannot be written to.

    Raises
    ------
    PacketError
        When layout and data do not belong together.
    """
    arrays: dict[str, NDArray[Any]] = {}
    at = 0
    for name, dtype_text, shape in layout:
        try:
            dtype = np.dtype(dtype_text)
            count = int(np.prod(shape, dtype=np.int64))
            arrays[name] = np.frombuffer(data, dtype, count, at).reshape(shape)
        except (TypeError, ValueError) as error:
            raise PacketError(f"array {name}: {error}") from error
        at += count * dtype.itemsize
    return arrays


# ---------------------------------------------------------------------- back from the I/O process


@dataclass(frozen=True, slots=True)
class Ready:
    """The sinks have been built."""

    kind: Literal["ready"] = "ready"


@dataclass(frozen=True, slots=True)
class Unusable:
    """A sink cannot be built, and why: no restart will mend that."""

    message: str
    kind: Literal["unusable"] = "unusable"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What all sinks together want from now on."""

    kinds: frozenset[Kind]
    frames_hz: float
    kind: Literal["wanted"] = "wanted"


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line for the service's log."""

    level: Literal["debug", "info", "warning", "error"]
    event: str
    fields: dict[str, Any]
    kind: Literal["log"] = "log"


@dataclass(frozen=True, slots=True)
class Request:
    """A sink asks the service for something; the answer carries the number."""

    number: int
    name: str
    fields: dict[str, Any]
    kind: Literal["request"] = "request"


@dataclass(frozen=True, slots=True)
class Answer:
    """What the service says to a request.

    Attributes
    ----------
    accepted
        Whether it was done.
    reasons
        Why not, for people.
    fields
        What else there is to tell.
    """

    accepted: bool
    reasons: tuple[str, ...] = ()
    fields: Mapping[str, Any] = field(default_factory=dict)


FromIo = Ready | Unusable | Wanted | LogLine | Request

_from_io: TypeAdapter[FromIo] = TypeAdapter(Annotated[FromIo, Field(discriminator="kind")])


def pack_from_io(message: FromIo) -> bytes:
    """Return the packet of a message from the I/O process."""
    return _from_io.dump_json(message)


def unpack_from_io(packet: bytes) -> FromIo:
    """Read a packet of the I/O process.

    Raises
    ------
    PacketError
        When it is none of the messages.
    """
    try:
        return _from_io.validate_json(packet)
    except ValidationError as error:
        first = error.errors()[0]
        raise PacketError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
