"""A recording as a frame source: at recorded speed, as fast as possible, or looped."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from companion.clock import Clock
from companion.errors import SourceError
from companion.frames.counts import FrameCounts
from companion.frames.recording import Recording, open_recording
from companion.frames.source import Frame
from companion.log import Log


class FileSource:
    """Plays a video file or a folder of images.

    Decoding runs in one thread, one image ahead. At recorded speed an image is delivered when it is due; a
    consumer that comes late gets the newest image that is due, never a backlog. As fast as possible, every
    image is delivered as soon as it is asked for.

    Parameters
    ----------
    path
        Video file or folder of images (``companion.frames.recording``).
    clock
        Where ``time_ns`` comes from.
    log
        Takes the events ``image_undecodable``, ``image_size_changed`` and ``recording_ended_early``.
    fps_hz
        Frame rate where the recording does not say.
    fastest
        Deliver as fast as possible: ``time_ns`` is then when the image was decoded.
    loop
        Start again at the end; times and numbers keep increasing.

    Attributes
    ----------
    counts
        What became of the images.
    """

    def __init__(
        self,
        path: Path,
        *,
        clock: Clock,
        log: Log,
        fps_hz: float = 10.0,
        fastest: bool = False,
        loop: bool = False,
    ) -> None:
        self._path = path
        self._clock = clock
        self._log = log.bind(source=str(path))
        self._fps_hz = fps_hz
        self._fastest = fastest
        self._loop = loop
        self.counts = FrameCounts()
        self._started_ns: int | None = None
        self._executor: ThreadPoolExecutor | None = None
        self._player: _Player | None = None

    @property
    def started_ns(self) -> int | None:
        """Our monotonic time at which the recording's first image was due; None before that is known."""
        return self._started_ns

    async def __aenter__(self) -> Self:
        """Open the recording.

        Raises
        ------
        companion.errors.SourceError
            When there is nothing that can be played.
        """
        executor = ThreadPoolExecutor(1, thread_name_prefix="frame-decoder")
        try:
            recording = await asyncio.wrap_future(executor.submit(open_recording, self._path, self._fps_hz))
        except BaseException:
            executor.shutdown(wait=False)
            raise
        self._executor = executor
        self._player = _Player(self._path, recording, self.counts, self._log, loop=self._loop)
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """Close the recording once the image in work is done."""
        executor, player = self._executor, self._player
        self._executor = self._player = None
        if executor is not None and player is not None:
            closed = executor.submit(player.close)
            executor.shutdown(wait=False)
            await asyncio.wrap_future(closed)

    async def frames(self) -> AsyncGenerator[Frame, None]:
        """Yield frames when they are due; ends with the recording.

        Raises
        ------
        companion.errors.SourceError
            When not one image of the recording can be decoded.
        """
        executor, player = self._executor, self._player
        if executor is None or player is None:
            raise RuntimeError("the source is not open; use it in `async with`")

        def decode_ahead() -> Future[_Played | None]:
            elapsed_ns = None if self._started_ns is None else self._clock.now_ns() - self._started_ns
            return executor.submit(player.next_image, None if self._fastest else elapsed_ns)

        ahead = decode_ahead()
        passed_over = False
        try:
            while (played := await asyncio.wrap_future(ahead)) is not None:
                if self._started_ns is None:
                    self._started_ns = self._clock.now_ns() - played.offset_ns
                ahead = decode_ahead()
                if self._fastest:
                    due_ns = self._clock.now_ns()
                else:
                    due_ns = self._started_ns + played.offset_ns
                    # Only ever one in a row: where decoding is slower than the recording, every image is
                    # overtaken by the time it is there, and late ones are better than none.
                    passed_over = not passed_over and self._is_overtaken(played)
                    if passed_over:
                        self.counts.skipped_late += 1
                        continue
                    await self._clock.sleep_until_ns(due_ns)
                self.counts.delivered += 1
                yield Frame(played.image, due_ns, played.seq)
        finally:
            ahead.cancel()

    def _is_overtaken(self, played: _Played) -> bool:
        """Whether the next image is due already: the consumer came late."""
        next_ns = played.next_offset_ns
        return (
            next_ns is not None
            and self._started_ns is not None
            and self._started_ns + next_ns <= self._clock.now_ns()
        )


@dataclass(frozen=True, slots=True)
class _Played:
    image: NDArray[np.uint8]
    offset_ns: int
    seq: int
    next_offset_ns: int | None


class _Player:
    """The decoding thread's part: which image is next, over all rounds of a looped recording."""

    def __init__(
        self, path: Path, recording: Recording, counts: FrameCounts, log: Log, *, loop: bool
    ) -> None:
        self._path = path
        self._recording = recording
        self._counts = counts
        self._log = log
        self._loop = loop
        self._seq = 0
        self._round_offset_ns = 0
        self._round_first_seq = 0
        self._last_offset_ns = 0
        self._shape: tuple[int, ...] | None = None
        self._size_announced = False

    def next_image(self, elapsed_ns: int | None) -> _Played | None:
        """Return the newest image due at ``elapsed_ns``, else the next one; None at the end.

        Parameters
        ----------
        elapsed_ns
            Time since the first image was due; None: pass over nothing.
        """
        fruitless_rounds = 0
        while True:
            if elapsed_ns is not None:
                skipped = self._recording.skip_until(elapsed_ns - self._round_offset_ns)
                self._seq += skipped
                self._counts.skipped_late += skipped
            recorded = self._recording.read()
            if recorded is None:
                if missing := self._recording.missing:
                    self._counts.undecodable += missing
                    self._log.warning("recording_ended_early", missing_frames=missing)
                fruitless_rounds += 1
                if self._shape is None:
                    raise SourceError(f"{self._path}: not one image of this recording can be decoded")
                if not self._loop or fruitless_rounds > 1:
                    return None
                self._start_next_round(elapsed_ns)
                continue
            seq, self._seq = self._seq, self._seq + 1
            self._last_offset_ns = recorded.offset_ns
            if recorded.image is None:
                self._counts.undecodable += 1
                self._log.warning("image_undecodable", seq=seq)
                continue
            if not self._has_the_size_of_the_first(recorded.image):
                continue
            return _Played(recorded.image, self._round_offset_ns + recorded.offset_ns, seq, self._next_ns())

    def close(self) -> None:
        """Close the recording."""
        self._recording.close()

    def _start_next_round(self, elapsed_ns: int | None) -> None:
        self._recording.rewind()
        round_ns = self._last_offset_ns + self._recording.interval_ns
        round_images = self._seq - self._round_first_seq
        self._round_offset_ns += round_ns
        if elapsed_ns is not None:  # whole rounds that a consumer slept through are not decoded
            rounds = max(0, (elapsed_ns - self._round_offset_ns) // round_ns)
            self._round_offset_ns += rounds * round_ns
            self._seq += rounds * round_images
            self._counts.skipped_late += rounds * round_images
        self._round_first_seq = self._seq

    def _has_the_size_of_the_first(self, image: NDArray[np.uint8]) -> bool:
        if self._shape is None:
            self._shape = image.shape
        if image.shape == self._shape:
            return True
        self._counts.wrong_size += 1
        if not self._size_announced:
            self._size_announced = True
            self._log.warning("image_size_changed", first=self._shape, found=image.shape)
        return False

    def _next_ns(self) -> int | None:
        next_ns = self._recording.next_offset_ns()
        if next_ns is None and self._loop:
            next_ns = self._last_offset_ns + self._recording.interval_ns
        return None if next_ns is None else self._round_offset_ns + next_ns
