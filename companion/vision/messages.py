"""What the service and the worker say to each other.

One message is one packet of JSON on a socket that keeps packets apart; pixels never cross it (see
``frame_slots``). The worker's packets are checked field by field before anything is made of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

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
class Failed:
    """From the worker, last: an exception ended it."""

    error: str
    traceback: str
    kind: Literal["failed"] = "failed"


ToWorker = Start | MapSlots | Detect
FromWorker = Ready | Unusable | Answer | Failed

_to_worker: TypeAdapter[ToWorker] = TypeAdapter(Annotated[ToWorker, Field(discriminator="kind")])
_from_worker: TypeAdapter[FromWorker] = TypeAdapter(Annotated[FromWorker, Field(discriminator="kind")])


def pack_to_worker(message: ToWorker) -> bytes:
    """Return the packet of a message to the worker."""
    return _to_worker.dump_json(message)


def unpack_to_worker(packet: bytes) -> ToWorker:
    """Read a packet in the worker."""
    return _to_worker.validate_json(packet)


def pack_from_worker(message: FromWorker) -> bytes:
    """Return the packet of a message from the worker."""
    return _from_worker.dump_json(message)


def unpack_from_worker(packet: bytes) -> FromWorker:
    """Read a packet of the worker.

    Raises
    ------
    MessageError
        When it is none of the messages.
    """
    try:
        return _from_worker.validate_json(packet)
    except ValidationError as error:
        first = error.errors()[0]
        raise MessageError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
