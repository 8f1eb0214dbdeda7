"""One recording: an MCAP file, and a tlog of the autopilot's links beside it."""

from __future__ import annotations

import contextlib
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, cast

from mcap.writer import CompressionType, Writer

from companion.config.recorder import RecorderConfig
from companion.io.messages import Kind, Message
from companion.recorder import topics
from companion.recorder.chunk_index import pack_index_of
from companion.recorder.disk import GrowingFile
from companion.recorder.frames import Frames

_TLOG_BYTES: Final = 16 * 1024
_TLOG_TIME: Final = struct.Struct(">Q")


@dataclass(frozen=True, slots=True)
class ChunkLimits:
    """When a chunk is full: compressed and written together. What is in an unfinished one is lost when we die.

    Attributes
    ----------
    size_bytes
        Of what is in it. Smaller: less is lost, and the index of a file, which is kept in memory until its end, is longer.
    span_s
        From its first message to the one that ends it, by the messages' own times; None: whatever it takes.
    """

    size_bytes: int = 128 * 1024
    span_s: float | None = 1.0


class McapFile:
    """Writes messages of the feed into one MCAP file.

    Parameters
    ----------
    file
        To write to.
    config
        What is recorded of frames.
    offset_ns
        Wall time less our monotonic time.
    about
        Metadata: how the recording began, by whom.
    chunks
        When a chunk is full.

    Raises
    ------
    OSError
        From every call, when the disk does not take it.
    """

    def __init__(
        self,
        file: GrowingFile,
        config: RecorderConfig,
        offset_ns: int,
        about: Mapping[str, str],
        chunks: ChunkLimits,
    ) -> None:
        self._frames = Frames(config)
        self._offset_ns = offset_ns
        self._writer = Writer(
            cast("IO[Any]", file), chunk_size=chunks.size_bytes, compression=CompressionType.ZSTD
        )
        pack_index_of(self._writer)
        self._span_ns = None if chunks.span_s is None else round(chunks.span_s * 1e9)
        self._chunk_begin_ns: int | None = None
        self._file = file
        self._written_bytes = 0
        self._channels: dict[str, int] = {}
        self._writer.start(profile="", library="void-companion")
        self._writer.add_metadata(topics.METADATA, {**about, "monotonic_to_wall_ns": str(offset_ns)})
        self._add_json(
            topics.TRANSFORM, "foxglove.FrameTransform", topics.up_transform(offset_ns), offset_ns, 0
        )

    def write(self, message: Message) -> None:
        """Write one message; kinds that are not recorded are left out."""
        self._write(message)
        if self._span_ns is None:
            return
        # By the messages' times, not the clock's: the same flight makes the same file. An exposure may be older than the chunk.
        if self._written_bytes != self._file.tell():  # a chunk was full
            self._written_bytes = self._file.tell()
            self._chunk_begin_ns = None
        if self._chunk_begin_ns is None:
            self._chunk_begin_ns = message.time_ns
        elif message.time_ns - self._chunk_begin_ns >= self._span_ns:
            self._writer.flush()  # type: ignore[no-untyped-call]  # the library has it without a type
            self._chunk_begin_ns = None

    def _write(self, message: Message) -> None:
        wall_ns = message.time_ns + self._offset_ns
        match message.kind:
            case Kind.FRAME:
                self._frame(message, wall_ns)
                return
            case Kind.MAVLINK:
                topic = f"/mavlink/{message.fields['link']}/{message.fields['direction']}"
                channel = self._channel(topic, topics.MAVLINK_ENCODING, 0)
                self._add(channel, message.data, wall_ns, wall_ns, message.seq)
                return
            case Kind.POSE:
                fields = topics.pose_in_frame(message.fields, wall_ns)
                transform = topics.body_transform(message.fields, wall_ns)
                self._add_json(topics.TRANSFORM, "foxglove.FrameTransform", transform, wall_ns, message.seq)
            case Kind.LOG:
                fields = topics.log_entry(message.fields, wall_ns)
            case _:
                fields = dict(message.fields)
        topic_of = topics.TOPICS.get(message.kind)
        if topic_of is not None:
            self._add_json(topic_of.name, topic_of.schema, fields, wall_ns, message.seq)

    def note(self, name: str, fields: Mapping[str, Any], now_ns: int, seq: int) -> None:
        """Write something of the recorder's own among the control messages."""
        self.write(Message(Kind.CONTROL, now_ns, seq, {"name": name, **fields}))

    def finish(self) -> None:
        """Write the index. Without it the file can be read all the same, from front to back."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # the library has it without a type

    def _frame(self, message: Message, wall_ns: int) -> None:
        image = message.image
        if image is None:
            return
        picture = self._frames.picture(image, message.fields["taken_ns"])
        if picture is None:
            return
        taken_ns = message.fields["taken_ns"] + self._offset_ns
        topic = topics.TOPICS[Kind.FRAME]
        fields = {**message.fields, "exposed_ns": message.time_ns, "lossless": self._frames.is_lossless}
        self._add_json(topic.name, topic.schema, fields, taken_ns, message.seq)
        if topics.IMAGE not in self._channels:
            schema = self._writer.register_schema(
                topics.IMAGE_SCHEMA, "ros2msg", topics.IMAGE_DEFINITION.encode()
            )
            self._channel(topics.IMAGE, "cdr", schema)
        data = topics.compressed_image(picture, self._frames.format, wall_ns)
        self._add(self._channels[topics.IMAGE], data, taken_ns, wall_ns, message.seq)

    def _add_json(self, topic: str, schema: str, fields: Mapping[str, Any], wall_ns: int, seq: int) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            schema_id = self._writer.register_schema(schema, "jsonschema", topics.json_schema(schema))
            channel = self._channel(topic, "json", schema_id)
        self._add(channel, json.dumps(fields).encode(), wall_ns, wall_ns, seq)

    def _channel(self, topic: str, encoding: str, schema_id: int) -> int:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)
        return channel

    def _add(self, channel: int, data: bytes, log_ns: int, publish_ns: int, seq: int) -> None:
        self._writer.add_message(
            channel, max(0, log_ns), data, publish_time=max(0, publish_ns), sequence=seq & 0xFFFFFFFF
        )


class TlogFile:
    """Writes the MAVLink of the autopilot's links as ground stations log it: time in us, big endian, before each frame.

    What came from the autopilot, and what was sent to it: setpoints as they were substituted.

    Parameters
    ----------
    file
        To write to.
    offset_ns
        Wall time less our monotonic time.
    """

    def __init__(self, file: GrowingFile, offset_ns: int) -> None:
        self._file = file
        self._offset_ns = offset_ns
        self._waiting = bytearray()

    def write(self, message: Message) -> None:
        """Take frames; they are written some at a time."""
        stamp = _TLOG_TIME.pack((message.time_ns + self._offset_ns) // 1000)
        for frame in frames_of(message.data):
            self._waiting += stamp + frame
        if len(self._waiting) > _TLOG_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        waiting, self._waiting = bytes(self._waiting), bytearray()
        self._file.write(waiting)


def frames_of(data: bytes) -> list[bytes]:
    """Return the single frames of several whole ones, by their lengths."""
    frames: list[bytes] = []
    at = 0
    while at + 2 < len(data):
        if data[at] == 0xFD:
            end = at + 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        else:
            end = at + 8 + data[at + 1]
        frames.append(data[at:end])
        at = end
    return frames


class OpenRecording:
    """The files of a recording that is being written.

    Parameters
    ----------
    name
        Path without its ending.
    config
        What is recorded.
    offset_ns
        Wall time less our monotonic time.
    about
        Metadata.
    autopilot_links
        Numbers of the links whose MAVLink goes into the tlog.
    chunks
        When a chunk is full.

    Raises
    ------
    OSError
        From every call, when the disk does not take it.
    """

    def __init__(
        self,
        name: Path,
        config: RecorderConfig,
        offset_ns: int,
        about: Mapping[str, str],
        autopilot_links: frozenset[int],
        chunks: ChunkLimits,
    ) -> None:
        self._autopilot_links = autopilot_links
        self._files = [GrowingFile(name.with_name(name.name + ".mcap"))]
        self._tlog: TlogFile | None = None
        try:
            self._mcap = McapFile(self._files[0], config, offset_ns, about, chunks)
            if config.tlog:
                self._files.append(GrowingFile(name.with_name(name.name + ".tlog")))
                self._tlog = TlogFile(self._files[1], offset_ns)
        except OSError:
            self.abandon()
            raise

    @property
    def paths(self) -> tuple[Path, ...]:
        """Its files, the MCAP first."""
        return tuple(file.path for file in self._files)

    @property
    def size_bytes(self) -> int:
        """What has been written."""
        return sum(file.tell() for file in self._files)

    def write(self, message: Message) -> None:
        """Write one message."""
        self._mcap.write(message)
        if (
            self._tlog is not None
            and message.kind is Kind.MAVLINK
            and message.fields["link"] in self._autopilot_links
        ):
            self._tlog.write(message)

    def note(self, name: str, fields: Mapping[str, Any], now_ns: int, seq: int) -> None:
        """Write something of the recorder's own."""
        self._mcap.note(name, fields, now_ns, seq)

    def sync(self) -> None:
        """Have what was written on the disk: a vehicle that falls takes the power with it."""
        if self._tlog is not None:
            self._tlog.flush()
        for file in self._files:
            file.sync()

    def finish(self) -> None:
        """Write the index and close."""
        self._mcap.finish()
        self.sync()
        self.abandon()

    def abandon(self) -> None:
        """Close the files as they are."""
        for file in self._files:
            with contextlib.suppress(OSError):
                file.close()
