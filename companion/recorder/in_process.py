"""A recorder without the I/O process, for simulated time: it takes what happens before time goes on, so that nothing is lost."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final

from companion.clock import Clock
from companion.config import Config
from companion.config.recorder import RecorderConfig
from companion.errors import CompanionError
from companion.io.feed import Feed
from companion.io.messages import Answer, Kind, Message, Wants
from companion.io.receiver import Receiver
from companion.recorder.recording import ChunkLimits
from companion.recorder.sink import Recorder, wants_of

_DRAIN_NS: Final = 20_000_000
_EPOCH_NS: Final = 1_767_225_600_000_000_000
"""2026-01-01: simulated time has no date of its own, and the same flight makes the same file."""
_LEAN: Final = frozenset({Kind.FRAME, Kind.DETECTION, Kind.STATE, Kind.LOOP, Kind.CONFIG, Kind.MAVLINK})
_LEAN_CHUNKS: Final = ChunkLimits(1 << 22, None)


class InProcessRecorder:
    """Gives a feed to a service of the same event loop, and records what it tells.

    Parameters
    ----------
    folder
        Where the recording goes.
    frames
        ``png``, ``jpeg`` or ``none``.
    is_lean
        Only what a replay needs, and packed for size in place of safety: for reference recordings.
    """

    def __init__(self, folder: Path, *, frames: str = "png", is_lean: bool = False) -> None:
        recorder = RecorderConfig.model_validate(
            {"start": "always", "frames": frames, "frames_hz": 0.0, "keep_free_mib": 0.0, "tlog": False}
        )
        config = Config.model_construct(**{**dict(Config()), "recorder": recorder})
        self.feed = Feed()
        wants = wants_of(config)
        self.feed.want(Wants(wants.kinds & _LEAN, wants.frames_hz) if is_lean else wants)
        self._is_lean = is_lean
        self._receiver = Receiver()
        self._desk = _Desk()
        self._recorder = Recorder(
            config,
            self._desk,
            folder=folder,
            wall_offset_ns=_EPOCH_NS,
            chunks=_LEAN_CHUNKS if is_lean else ChunkLimits(),
        )
        self._recorder.start()

    async def run(self, clock: Clock) -> None:
        """Record until cancelled."""
        while True:
            self.drain()
            await clock.sleep_until_ns(clock.now_ns() + _DRAIN_NS)

    def drain(self) -> None:
        """Record what has happened by now."""
        for packet, fd in self.feed.packets():
            for message in self._receiver.messages(packet, () if fd is None else (os.dup(fd),)):
                if not (self._is_lean and _is_needless(message)):
                    self._recorder.take(message)

    def close(self) -> None:
        """Record what is left, and finish the file.

        Raises
        ------
        companion.errors.CompanionError
            When something could not be recorded.
        """
        self.drain()
        self._recorder.stop()
        self._receiver.close()
        self.feed.close()
        if self._desk.problem:
            raise CompanionError(f"not recorded: {self._desk.problem}")


def _is_needless(message: Message) -> bool:
    """Return whether a replay does without: what goes on to the planner is no decision."""
    fields = message.fields
    return message.kind is Kind.MAVLINK and fields["link"] == 0 and fields["direction"] == "out"


class _Desk:
    """A service's end with nobody behind it."""

    def __init__(self) -> None:
        self.problem = ""
        self.dropped: Mapping[Kind, int] = {}

    @property
    def log(self) -> _Desk:
        return self

    def info(self, event: str, **fields: Any) -> None:
        pass

    def warning(self, event: str, **fields: Any) -> None:
        self.problem = f"{event}: {fields.get('reason', '')}"

    def error(self, event: str, **fields: Any) -> None:
        self.warning(event, **fields)

    def want(self, wants: Wants) -> None:
        pass

    def ask(self, name: str, fields: Mapping[str, Any]) -> Future[Answer]:  # noqa: ARG002  the interface of a desk
        future: Future[Answer] = Future()
        future.set_result(Answer(accepted=True))
        return future
