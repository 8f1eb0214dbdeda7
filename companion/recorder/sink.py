"""The recorder as a sink of the I/O process: begins and ends recordings, keeps them within their limits.

What the disk does not take ends the recording, with one announcement; the flight knows nothing of it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import cv2

from companion.config import Config
from companion.io.sink import Desk, Kind, Message, Sink, Wants
from companion.recorder.disk import MIB, Limits, make_room, new_name
from companion.recorder.recording import ChunkLimits, OpenRecording

ALWAYS_KINDS: Final = frozenset(Kind) - {Kind.DETAILS, Kind.RING, Kind.ANSWER}
_HELD: Final = frozenset({Kind.CONFIG, Kind.STATE, Kind.LINK})
"""What holds until it changes stands at the beginning of every file."""
_CHECK_S: Final = 1.0
_SYNC_S: Final = 2.0
_ROOM_BYTES: Final = MIB
"""A recording is not begun for less."""


def build(config: Config, desk: Desk) -> Sink:
    """Build the recorder (``companion.io.sink.SinkFactory``)."""
    cv2.setNumThreads(1)
    return Recorder(config, desk)


def folder_of(config: Config, environment: Mapping[str, str]) -> Path:
    """Return the folder that recordings go to."""
    if config.recorder.folder:
        return Path(config.recorder.folder)
    logs = environment.get("LOGS_DIRECTORY", "").partition(":")[0]
    return Path(logs) / "recordings" if logs else Path("recordings")


def wants_of(config: Config) -> Wants:
    """Return what a recording is made of."""
    recorder = config.recorder
    without = {Kind.FRAME} if recorder.frames == "none" else set()
    return Wants(ALWAYS_KINDS - without, recorder.frames_hz)


class Recorder:
    """Writes what the feed tells while a recording is on.

    Parameters
    ----------
    config
        The whole configuration.
    desk
        Towards the service.
    folder
        Where recordings go; None: where the configuration says.
    monotonic_s
        Time for what is due by time.
    wall_offset_ns
        Wall time less the service's monotonic time; None: as this machine's clocks say when a file begins.
    chunks
        When what is compressed and written together is full.
    """

    def __init__(
        self,
        config: Config,
        desk: Desk,
        *,
        folder: Path | None = None,
        monotonic_s: Callable[[], float] = time.monotonic,
        wall_offset_ns: int | None = None,
        chunks: ChunkLimits | None = None,
    ) -> None:
        self._config = config.recorder
        self._wants = wants_of(config)
        self._desk = desk
        self._folder = folder if folder is not None else folder_of(config, os.environ)
        self._monotonic_s = monotonic_s
        self._wall_offset_ns = wall_offset_ns
        self._chunks = ChunkLimits() if chunks is None else chunks
        self._limits = Limits(
            round(self._config.file_mib * MIB),
            round(self._config.total_mib * MIB),
            round(self._config.keep_free_mib * MIB),
        )
        self._autopilot_links = frozenset(
            range(
                len(config.link.planner_urls), len(config.link.planner_urls) + len(config.link.autopilot_urls)
            )
        )
        self._recording: OpenRecording | None = None
        self._held: dict[tuple[Kind, str], Message] = {}
        self._begun_by = ""
        self._reason = ""
        self._end_s: float | None = None
        self._checked_s = self._synced_s = 0.0
        self._lost = 0
        self._last_seq = 0
        self._files = self._attempts = 0

    @property
    def is_recording(self) -> bool:
        """Whether a recording is on."""
        return self._recording is not None

    # ------------------------------------------------------------------ the sink

    def start(self) -> None:
        """Begin where recordings are always on."""
        if self._config.start == "always":
            self._begin("always")
        else:
            self._tell()

    def take(self, message: Message) -> None:
        """Take one message."""
        self._last_seq = message.seq
        if message.kind in _HELD:
            self._held[message.kind, str(message.fields.get("link", ""))] = message
        if message.kind is Kind.CONTROL:
            self._control(message)
            if message.fields.get("name") == "recorder_state":
                return
        recording = self._recording
        if recording is not None:
            self._guarded(lambda: recording.write(message))
            self._look_after()

    def idle(self) -> None:
        """Do what is due by time."""
        self._look_after()

    def stop(self) -> None:
        """Finish the recording."""
        self._end("the service ends")

    # ------------------------------------------------------------------ begin and end

    def _control(self, message: Message) -> None:
        on = message.fields.get("on") is True
        match message.fields.get("name"):
            case "record" if on:
                self._begin("command")
            case "record":
                self._end("command")
            case "armed" if self._config.start == "armed" and on:
                self._begin("armed")
            case "armed" if self._begun_by == "armed" and self._recording is not None:
                self._end_s = self._monotonic_s() + self._config.stop_after_s

    def _begin(self, by: str) -> None:
        self._end_s = None
        if self._recording is not None:
            if by == "command":
                self._begun_by = by  # a command holds longer than arming
            return
        self._begun_by = by
        self._reason = ""
        self._attempts += 1
        self._guarded(self._open)
        if (opened := self._now()) is not None:
            self._desk.want(self._wants)
            self._desk.log.info("recording_started", file=str(opened.paths[0]), by=by)
            self._tell()

    def _now(self) -> OpenRecording | None:
        """Return the recording that is on by now."""
        return self._recording

    def _open(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        why_not = make_room(self._folder, self._limits, keep=frozenset(), wanted_bytes=_ROOM_BYTES)
        if why_not is not None:
            raise OSError(0, why_not)
        self._files += 1
        offset_ns = self._wall_offset_ns
        if offset_ns is None:
            offset_ns = time.time_ns() - time.monotonic_ns()
        about = {
            "version": version("void-companion"),
            "begun_by": self._begun_by,
            "number": str(self._files),
            "boot_id": _boot_id(),
        }
        name = new_name(self._folder, time.time_ns())
        self._recording = OpenRecording(
            name, self._config, offset_ns, about, self._autopilot_links, self._chunks
        )
        for message in self._held.values():
            self._recording.write(message)

    def _end(self, why: str) -> None:
        recording = self._recording
        if recording is None:
            return
        self._note_losses()
        self._guarded(recording.finish)
        self._end_s = None
        if self._recording is not None:
            self._recording = None
            self._desk.log.info(
                "recording_ended", file=str(recording.paths[0]), reason=why, bytes=recording.size_bytes
            )
            self._desk.want(Wants())
            self._tell()

    def _guarded(self, action: Callable[[], None]) -> None:
        """Do what may fail on the disk; where it does, the recording is over."""
        try:
            action()
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _fail(self, reason: str) -> None:
        recording, self._recording = self._recording, None
        self._reason = reason
        self._end_s = None
        file = ""
        if recording is not None:
            recording.abandon()
            file = str(recording.paths[0])
        self._desk.want(Wants())
        self._desk.log.warning("recording_stopped", reason=reason, file=file, folder=str(self._folder))
        self._desk.ask("announce", {"text": f"recording stopped, {reason}", "problem": True})
        self._tell()

    # ------------------------------------------------------------------ what is due

    def _look_after(self) -> None:
        on, now_s = self._recording, self._monotonic_s()
        if on is None or now_s - self._checked_s < _CHECK_S:
            return
        self._checked_s = now_s
        if self._end_s is not None and now_s >= self._end_s:
            self._end("disarmed")
            return
        self._note_losses()
        look = self._next_file if on.size_bytes >= self._limits.file_bytes else self._keep_room
        self._guarded(lambda: look(on))
        if now_s - self._synced_s >= _SYNC_S and (still_on := self._now()) is not None:
            self._synced_s = now_s
            self._guarded(still_on.sync)
            self._tell()

    def _next_file(self, recording: OpenRecording) -> None:
        recording.finish()
        self._recording = None
        self._open()
        if (opened := self._now()) is not None:
            self._desk.log.info("recording_goes_on", file=str(opened.paths[0]))

    def _keep_room(self, recording: OpenRecording) -> None:
        why_not = make_room(self._folder, self._limits, keep=frozenset(recording.paths))
        if why_not is not None:
            recording.finish()  # there is room for its index still
            raise OSError(0, why_not)

    def _note_losses(self) -> None:
        """Write what this sink was too slow for: a replay has to know."""
        lost, recording = sum(self._desk.dropped.values()), self._recording
        if lost != self._lost and recording is not None:
            self._lost = lost
            counts = {str(kind): count for kind, count in self._desk.dropped.items()}
            fields = {"by": "recorder", "counts": counts}
            self._guarded(lambda: recording.note("dropped", fields, time.monotonic_ns(), self._last_seq))

    def _tell(self) -> None:
        """Tell the service how it stands."""
        recording = self._recording
        fields: dict[str, Any] = {
            "recording": recording is not None,
            "begun_by": self._begun_by if recording is not None else "",
            "file": "" if recording is None else str(recording.paths[0]),
            "bytes": 0 if recording is None else recording.size_bytes,
            "folder": str(self._folder),
            "reason": self._reason,
            "attempts": self._attempts,
            "lost_messages": sum(self._desk.dropped.values()),
        }
        self._desk.ask("recorder_state", fields)


def _boot_id() -> str:
    """Return what tells one start of this machine from another: monotonic times are of one."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""
