"""What the service and the worker say to each other.

One message is one packet of JSON on a socket that keeps packets apart; pixels never cross it (see
``frame_slots``). The worker's packets are checked field by field before anything is made of them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter, ValidationError

from companion.config import CameraConfig, DetectorConfig
from companion.guidance.observation import DetectionReport, Pose

MAX_PACKET_BYTES = 1 << 17
"""Longest packet either side sends; far above a report with all its bearings."""


class MessageError(ValueError):
    """A packet is not one of the messages below."""


@dataclass(frozen=True, slots=True)
class Start:
    """First to the worker: what to build. ``pipeline`` is ``package.module:factory``."""

    pipeline: str
    detector: DetectorConfig
    camera: CameraConfig
    kind: Literal["start"] = "start"


@dataclass(frozen=True, slots=True)
class MapSlots:
    """To the worker, with the memory's file descriptor: frames are there from now on."""

    slot_bytes: int
    n_slots: int
    kind: Literal["map_slots"] = "map_slots"


@dataclass(frozen=True, slots=True)
class Detect:
    """To the worker: a frame lies in a slot. The slot stays as it is until the answer."""

    frame_id: int
    slot: int
    height_px: int
    width_px: int
    seq: int
    time_ns: int
    pose: Pose | None
    details: bool = False
    """Whether somebody wants to know what the detector saw on the way."""
    kind: Literal["detect"] = "detect"


@dataclass(frozen=True, slots=True)
class Ready:
    """From the worker: the pipeline is built."""

    kind: Literal["ready"] = "ready"


@dataclass(frozen=True, slots=True)
class Unusable:
    """From the worker: the configuration cannot be used, and why."""

    message: str
    kind: Literal["unusable"] = "unusable"


@dataclass(frozen=True, slots=True)
class Answer:
    """From the worker: the report on the frame it was given."""

    frame_id: int
    report: DetectionReport
    kind: Literal["answer"] = "answer"


@dataclass(frozen=True, slots=True)
class Details:
    """From the worker, behind an answer where that was asked for: what the detector saw on the way to it.

    Attributes
    ----------
    fields, data
        For ``companion.io``, as they are: nothing here reads them.
    """

    fields: bytes
    data: bytes
    kind: Literal["details"] = "details"


@dataclass(frozen=True, slots=True)
class Failed:
    """From the worker, last: an exception ended it."""

    error: str
    traceback: str
    kind: Literal["failed"] = "failed"


ToWorker = Start | MapSlots | Detect
_FromWorkerJson = Ready | Unusable | Answer | Failed
FromWorker = _FromWorkerJson | Details

_DETAILS: Final = b"D"
"""Details are no JSON: they are long, and only pass through."""
_LENGTH: Final = struct.Struct("<cI")

_to_worker: TypeAdapter[ToWorker] = TypeAdapter(Annotated[ToWorker, Field(discriminator="kind")])
_from_worker: TypeAdapter[_FromWorkerJson] = TypeAdapter(
    Annotated[_FromWorkerJson, Field(discriminator="kind")]
)


def pack_to_worker(message: ToWorker) -> bytes:
    """Return the packet of a message to the worker."""
    return _to_worker.dump_json(message)


def unpack_to_worker(packet: bytes) -> ToWorker:
    """Read a packet in the worker."""
    return _to_worker.validate_json(packet)


def pack_from_worker(message: FromWorker) -> bytes:
    """Return the packet of a message from the worker."""
    if isinstance(message, Details):
        return _LENGTH.pack(_DETAILS, len(message.fields)) + message.fields + message.data
    return _from_worker.dump_json(message)


def unpack_from_worker(packet: bytes) -> FromWorker:
    """Read a packet of the worker.

    Raises
    ------
    MessageError
        When it is none of the messages.
    """
    if packet[:1] == _DETAILS:
        return _details(packet)
    try:
        return _from_worker.validate_json(packet)
    except ValidationError as error:
        first = error.errors()[0]
        raise MessageError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _details(packet: bytes) -> Details:
    begin = _LENGTH.size
    if len(packet) < begin:
        raise MessageError("details cut short")
    end = begin + int(_LENGTH.unpack_from(packet)[1])
    if len(packet) < end:
        raise MessageError("details cut short")
    return Details(packet[begin:end], packet[end:])
