"""Reads recordings back, from front to back: also those that were cut off by a crash, up to where they end."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import zstandard
from mcap import records
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader

from companion.errors import CompanionError
from companion.io.messages import Kind, Message
from companion.recorder import topics

_KINDS: Final[Mapping[str, Kind]] = {topic.name: kind for kind, topic in topics.TOPICS.items()}
_DAMAGE: Final = (McapError, ValueError, struct.error, EOFError, zstandard.ZstdError)
_MOST_RECORD_BYTES: Final = 1 << 28


class RecordingError(CompanionError):
    """A file is no recording of ours, or cannot be read."""


class RecordingFile:
    """One MCAP file of the recorder.

    Parameters
    ----------
    path
        Of the file.

    Attributes
    ----------
    about
        Its metadata, after the first message was read.
    damage
        Why it was not read to its end; None: it was.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.damage: str | None = None

    def messages(self, *, images: bool = True) -> Iterator[Message]:
        """Yield what was recorded, in the order of the recording; times are the service's monotonic clock.

        Parameters
        ----------
        images
            Whether frames are decoded; else they come without their image.

        Raises
        ------
        RecordingError
            When it is no recording of ours.
        """
        try:
            with self.path.open("rb") as file:
                yield from self._messages(
                    StreamReader(file, validate_crcs=True, record_size_limit=_MOST_RECORD_BYTES),
                    images=images,
                )
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from error

    def _messages(self, reader: StreamReader, *, images: bool) -> Iterator[Message]:
        names: dict[int, str] = {}
        offset_ns: int | None = None
        frame: Message | None = None
        for record in self._records(reader):
            match record:
                case records.Channel():
                    names[record.id] = record.topic
                case records.Metadata(name=topics.METADATA):
                    self.about = dict(record.metadata)
                    offset_ns = int(self.about.get("monotonic_to_wall_ns", "0"))
                case records.Message():
                    if offset_ns is None:
                        raise RecordingError(f"{self.path}: not a recording of void-companion")
                    topic = names.get(record.channel_id, "")
                    if topic == topics.IMAGE:
                        if frame is not None:
                            yield self._with_image(frame, record.data) if images else frame
                            frame = None
                        continue
                    message = self._message(topic, record, offset_ns)
                    if message is not None and message.kind is Kind.FRAME:
                        frame = message  # its image follows
                    elif message is not None:
                        yield message
        if offset_ns is None:
            raise RecordingError(f"{self.path}: not a recording of void-companion")

    def _records(self, reader: StreamReader) -> Iterator[records.McapRecord]:
        """Yield records up to the first that cannot be read."""
        try:
            yield from reader.records
        except _DAMAGE as error:
            self.damage = f"cut off or damaged: {type(error).__name__}"

    def _message(self, topic: str, record: records.Message, offset_ns: int) -> Message | None:
        time_ns = record.log_time - offset_ns
        parts = topic.split("/")
        if len(parts) == 4 and parts[1] == "mavlink":
            fields = {"link": int(parts[2]), "direction": parts[3]}
            return Message(Kind.MAVLINK, time_ns, record.sequence, fields, record.data)
        kind = _KINDS.get(topic)
        if kind is None:
            return None
        found: dict[str, Any] = json.loads(record.data)
        if kind is Kind.FRAME:
            time_ns = found["exposed_ns"]
        return Message(kind, time_ns, record.sequence, found)

    def _with_image(self, frame: Message, data: bytes) -> Message:
        picture, _ = topics.picture_of(data)
        image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise RecordingError(f"{self.path}: a frame that is no picture")
        return replace(frame, image=np.asarray(image, np.uint8))
