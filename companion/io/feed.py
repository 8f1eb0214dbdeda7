"""What the service tells the I/O process: published from the loops of the flight, which never wait for anybody.

Publishing appends to a bounded queue, which takes about a microsecond, and nothing at all where no sink has asked for that
kind. What it takes to make packets of it is done by whoever drains the feed (``supervisor``), a few dozen times a second.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from typing import Any, Final, Literal

from pydantic import TypeAdapter

from companion.config import Config
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport, Pose
from companion.io.frame_ring import FrameRing
from companion.io.messages import ALWAYS, MAX_PACKET_BYTES, Answer, Kind, Wants, pack
from companion.io.queues import KindQueues
from companion.log import json_line

Direction = Literal["in", "out"]

_PACKET_BYTES: Final = 60_000
"""Packets are filled up to here: some of them fit into the kernel's buffer."""
_report_json: Final = TypeAdapter(DetectionReport)

_Item = tuple[Kind, int, int, Any, bytes]


class Feed:
    """Takes what happens; every call returns at once, and none fails.

    All but `log` are for the thread of the event loop.
    """

    def __init__(self) -> None:
        self._queues: KindQueues[_Item] = KindQueues()
        self._numbers = itertools.count(1)
        self._kinds: frozenset[Kind] = ALWAYS
        self._frame_interval_ns = 0
        self._frame_due_ns = 0
        self._retained: dict[tuple[Kind, str], _Item] = {}
        self._ring: FrameRing | None = None
        self._lost_frames = 0
        self._told_dropped: dict[str, int] = {}

    # ------------------------------------------------------------------ who listens

    def want(self, wants: Wants) -> None:
        """Publish from now on what is wanted, beginning with what holds now: the configuration, the state, the links."""
        new = wants.kinds - self._kinds
        self._kinds = wants.kinds | ALWAYS
        self._frame_interval_ns = round(1e9 / wants.frames_hz) if wants.frames_hz > 0 else 0
        for (kind, _), item in self._retained.items():
            if kind in new:
                self._queues.put(kind, item[2], item)

    def wants(self, kind: Kind) -> bool:
        """Return whether anybody listens to that kind; ask before making what is costly to make."""
        return kind in self._kinds

    @property
    def dropped(self) -> dict[str, int]:
        """Messages lost so far because nobody took them in time, by kind."""
        lost = {str(kind): count for kind, count in self._queues.dropped.items()}
        if self._lost_frames:
            lost["frame_memory"] = self._lost_frames
        return lost

    # ------------------------------------------------------------------ what happens

    def frame(self, frame: Frame, now_ns: int) -> None:
        """Tell that a frame was taken; its pixels are copied, at most as often as anybody wants them."""
        if Kind.FRAME not in self._kinds:
            return
        if self._frame_interval_ns:
            interval_ns = self._frame_interval_ns
            if now_ns < self._frame_due_ns - interval_ns // 8:
                return
            # From the time that was due, so that 15 of 30 frames are 15 although they jitter; no burst after a gap.
            self._frame_due_ns = max(self._frame_due_ns + interval_ns, now_ns + interval_ns // 2)
        ring = self._ring_for(frame.image.size)
        if ring is None:
            self._lost_frames += 1
            return
        height_px, width_px = frame.image.shape
        fields = {
            "number": ring.write(frame.image),
            "seq": frame.seq,
            "time_of": frame.time_of,
            "height_px": height_px,
            "width_px": width_px,
            "taken_ns": now_ns,
        }
        self._put(Kind.FRAME, frame.time_ns, fields)

    def pose(self, pose: Pose, speed_m_s: float) -> None:
        """Tell the vehicle's newest pose."""
        if Kind.POSE in self._kinds:
            self._put(Kind.POSE, pose.time_ns, (pose, speed_m_s))

    def setpoint(self, fields: Mapping[str, Any], now_ns: int) -> None:
        """Tell what was decided on a setpoint."""
        if Kind.SETPOINT in self._kinds:
            self._put(Kind.SETPOINT, now_ns, fields)

    def detection(self, report: DetectionReport, now_ns: int) -> None:
        """Tell a report of the worker."""
        if Kind.DETECTION in self._kinds:
            self._put(Kind.DETECTION, now_ns, report)

    def details(self, fields: bytes, data: bytes, now_ns: int) -> None:
        """Tell what the detector saw on the way to its last report: JSON and bytes, as the worker made them."""
        if Kind.DETAILS in self._kinds:
            self._put(Kind.DETAILS, now_ns, fields, data)

    def state(self, previous: str, state: str, reason: str, now_ns: int) -> None:
        """Tell that the switch S changed its state."""
        fields = {"previous": previous, "state": state, "reason": reason}
        self._put(Kind.STATE, now_ns, fields, retained_as="switch")

    def status(self, fields: Mapping[str, Any], now_ns: int) -> None:
        """Tell rates and ages of now."""
        if Kind.STATUS in self._kinds:
            self._put(Kind.STATUS, now_ns, fields)

    def link(self, name: str, url: str, state: str, now_ns: int) -> None:
        """Tell that a link was opened, closed, or is waited for."""
        self._put(Kind.LINK, now_ns, {"link": name, "url": url, "state": state}, retained_as=name)

    def log(self, event: Mapping[str, Any], now_ns: int) -> None:
        """Tell a line of the log; callable from any thread."""
        if Kind.LOG in self._kinds:
            self._put(Kind.LOG, now_ns, dict(event))

    def mavlink(self, link: int, direction: Direction, data: bytes, now_ns: int) -> None:
        """Tell whole frames that came in on a link, or left on it, together."""
        if Kind.MAVLINK in self._kinds:
            self._put(Kind.MAVLINK, now_ns, (link, direction), data)

    def loop(self, name: str, now_ns: int, fields: Mapping[str, Any]) -> None:
        """Tell that a loop ran on which decisions depend."""
        if Kind.LOOP in self._kinds:
            self._put(Kind.LOOP, now_ns, {"name": name, **fields})

    def config(self, config: Config, now_ns: int) -> None:
        """Tell the configuration that acts from now on."""
        self._put(Kind.CONFIG, now_ns, config, retained_as="config")

    def control(self, name: str, fields: Mapping[str, Any], now_ns: int, *, retain: bool = False) -> None:
        """Tell all sinks to do something, such as to begin a recording; retained, also those that are started later."""
        self._put(Kind.CONTROL, now_ns, {"name": name, **fields}, retained_as=name if retain else None)

    def answer(self, number: int, answer: Answer, now_ns: int) -> None:
        """Answer a sink's request."""
        fields = {
            "number": number,
            "accepted": answer.accepted,
            "reasons": list(answer.reasons),
            "fields": dict(answer.fields),
        }
        self._put(Kind.ANSWER, now_ns, fields)

    # ------------------------------------------------------------------ to the process

    def restart(self) -> None:
        """Forget what waits and who listened: another process will say what it wants."""
        self._queues.clear()
        self._kinds = ALWAYS
        self._told_dropped = {}
        for (kind, _), item in self._retained.items():
            if kind in ALWAYS:
                self._queues.put(kind, item[2], item)
        if self._ring is not None:
            self._announce_ring(self._ring)

    def packets(self) -> Iterator[tuple[bytes, int | None]]:
        """Take what waits, as packets, each with a file descriptor that goes with it or None."""
        if self.dropped != self._told_dropped:
            self._told_dropped = self.dropped
            self.control("dropped", {"by": "feed", "counts": self._told_dropped}, 0)
        packed: list[bytes] = []
        size = 0
        for item in self._queues.take_all():
            kind, time_ns, seq, content, data = item
            part = pack(kind, time_ns, seq, _fields_of(content), data)
            if len(part) > MAX_PACKET_BYTES:
                self._queues.dropped[kind] += 1
                continue
            if packed and (size + len(part) > _PACKET_BYTES or kind is Kind.RING):
                yield b"".join(packed), None
                packed, size = [], 0
            if kind is Kind.RING:
                if self._ring is not None and content["frame_bytes"] == self._ring.frame_bytes:
                    yield part, self._ring.fd
                continue
            packed.append(part)
            size += len(part)
        if packed:
            yield b"".join(packed), None

    def close(self) -> None:
        """Let go of the memory; nothing is published after that."""
        self._kinds = frozenset()
        self._queues.clear()
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    def _put(
        self, kind: Kind, time_ns: int, content: Any, data: bytes = b"", *, retained_as: str | None = None
    ) -> None:
        seq = next(self._numbers)
        item = (kind, time_ns, seq, content, data)
        if retained_as is not None:
            self._retained[kind, retained_as] = item
        if kind in self._kinds:
            self._queues.put(kind, seq, item)

    def _ring_for(self, frame_bytes: int) -> FrameRing | None:
        ring = self._ring
        if ring is None or ring.frame_bytes < frame_bytes:
            try:
                larger = FrameRing(frame_bytes)
            except OSError:
                return None
            if ring is not None:
                ring.close()  # the other side keeps its own mapping until it is told
            ring = self._ring = larger
            self._announce_ring(ring)
        return ring

    def _announce_ring(self, ring: FrameRing) -> None:
        seq = next(self._numbers)
        self._queues.put(Kind.RING, seq, (Kind.RING, 0, seq, {"frame_bytes": ring.frame_bytes}, b""))


def _fields_of(content: Any) -> bytes:
    """Return what was published as a JSON object; numbers that JSON does not know become text."""
    match content:
        case bytes():
            return content
        case DetectionReport():
            return _report_json.dump_json(content)
        case Config():
            content = {
                "active": content.model_dump(mode="json"),
                "set": content.model_dump(mode="json", exclude_unset=True),
            }
        case (Pose() as pose, speed_m_s):
            content = {
                "north_m": pose.north_m,
                "east_m": pose.east_m,
                "down_m": pose.down_m,
                "q_ned_from_body": pose.q_ned_from_body,
                "speed_m_s": speed_m_s,
            }
        case (int() as link, str() as direction):
            return b'{"link": %d, "direction": "%s"}' % (link, direction.encode())
    try:
        return json.dumps(content, allow_nan=False).encode()
    except (TypeError, ValueError):
        return json_line(None, "", content).encode("utf-8", "backslashreplace")
