"""A camera as a frame source: one thread captures, the newest picture wins, and what fails is opened again."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Literal, Self

from companion.clock import Clock
from companion.errors import SourceError
from companion.frames.capture import Capture, CapturedImage, CaptureError, DamagedImageError
from companion.frames.counts import FrameCounts
from companion.frames.judge import ImageJudge
from companion.frames.mailbox import NewestMailbox
from companion.frames.source import Frame
from companion.log import Log

FUTURE_TOLERANCE_NS: Final = 5_000_000
OLDEST_NS: Final = 2_000_000_000
"""An exposure outside these limits around now is not our clock's; the time of arrival counts then."""

_LOOK_S: Final = 0.1
"""Longest wait for an image before the thread looks at its deadline and whether it has to stop."""
_MOST_HUNG: Final = 3


@dataclass(frozen=True, slots=True)
class CameraLimits:
    """What is asked of a camera.

    Attributes
    ----------
    timeout_s
        Longest time without a new picture; then it is opened again.
    size_px
        (width, height); None: that of the first picture.
    latency_s
        How long before its time stamp a picture was exposed.
    first_retry_s, last_retry_s
        Wait before it is opened again, doubled each time that this does not help.
    hung_s
        A thread that has been in one call to the driver for this long does not come back soon.
    """

    timeout_s: float = 1.0
    size_px: tuple[int, int] | None = None
    latency_s: float = 0.0
    first_retry_s: float = 0.1
    last_retry_s: float = 2.0
    hung_s: float = 15.0


class CameraSource:
    """Frames of a camera that may be unplugged, stall, freeze or send rubbish at any time. Does not end by itself.

    Parameters
    ----------
    open_capture
        Opens the camera, in the capture thread; raises SourceError or CaptureError with a reason.
    name
        Of the camera, for the log.
    clock
        What time stamps are checked against.
    log
        Takes ``camera_opened``, ``camera_lost``, ``camera_hangs`` and ``frame_time_refused``.
    limits
        What is asked of it.

    Attributes
    ----------
    counts
        What became of the pictures.
    """

    def __init__(
        self,
        open_capture: Callable[[], Capture],
        *,
        name: str,
        clock: Clock,
        log: Log,
        limits: CameraLimits = CameraLimits(),
    ) -> None:
        self._open_capture = open_capture
        self._clock = clock
        self._log = log.bind(source=name)
        self._limits = limits
        self.counts = FrameCounts()
        self._mailbox: NewestMailbox[_Stamped] | None = None
        self._thread: _CaptureThread | None = None
        self._hung: list[_CaptureThread] = []

    @property
    def fault(self) -> str:
        """Why there are no frames now, in short; "" while there are, or nothing is known."""
        return "" if self._thread is None else self._thread.fault.partition(";")[0]

    async def __aenter__(self) -> Self:
        """Start to open the camera and to capture."""
        self._mailbox = NewestMailbox()
        self._thread = self._started(self._mailbox)
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """End the thread, which closes the camera. A thread that hangs in the driver is left to itself."""
        thread, self._thread, self._mailbox = self._thread, None, None
        if thread is not None:
            await asyncio.to_thread(thread.stop)

    async def frames(self) -> AsyncGenerator[Frame, None]:
        """Yield the newest frame each time; does not end by itself.

        The image of a frame may be the driver's own memory: it is good until the next frame is asked for.
        """
        mailbox = self._mailbox
        if mailbox is None:
            raise RuntimeError("the source is not open; use it in `async with`")
        while True:
            try:
                newest = await asyncio.wait_for(mailbox.get(), min(1.0, self._limits.hung_s))
            except TimeoutError:
                self._replace_a_hung_thread(mailbox)
                continue
            self.counts.delivered += 1
            try:
                yield Frame(newest.captured.image, newest.time_ns, newest.seq, newest.time_of)
            finally:
                newest.captured.give_back()
                # Not kept while the next one is waited for, which may take for ever: a driver whose memory is still
                # mapped cannot be removed, and a camera that is plugged in again gets another name.
                del newest

    def _started(self, mailbox: NewestMailbox[_Stamped], first_seq: int = 0) -> _CaptureThread:
        thread = _CaptureThread(
            self._open_capture, self._clock, self._log, self.counts, mailbox, self._limits, first_seq
        )
        thread.start()
        return thread

    def _replace_a_hung_thread(self, mailbox: NewestMailbox[_Stamped]) -> None:
        """Start another thread where one does not come back from the driver; no thread can be ended from outside."""
        thread = self._thread
        if thread is None or thread.in_one_call_s() < self._limits.hung_s:
            return
        self._hung = [hung for hung in self._hung if hung.is_alive()]
        if len(self._hung) >= _MOST_HUNG:
            return
        self._log.error("camera_hangs", in_one_call_s=round(thread.in_one_call_s(), 1))
        thread.ask_to_stop()  # it closes what it has when it comes back
        self._hung.append(thread)
        self._thread = self._started(mailbox, thread.seq)


@dataclass(frozen=True, slots=True)
class _Stamped:
    captured: CapturedImage
    time_ns: int
    seq: int
    time_of: Literal["exposure", "arrival"]


class _CaptureThread:
    """The thread that everything of the driver happens in."""

    def __init__(
        self,
        open_capture: Callable[[], Capture],
        clock: Clock,
        log: Log,
        counts: FrameCounts,
        mailbox: NewestMailbox[_Stamped],
        limits: CameraLimits,
        first_seq: int,
    ) -> None:
        self._open_capture = open_capture
        self._clock = clock
        self._log = log
        self._counts = counts
        self._mailbox = mailbox
        self._limits = limits
        self._latency_ns = round(limits.latency_s * 1e9)
        self._judge = ImageJudge(limits.timeout_s, limits.size_px)
        self._stopping = threading.Event()
        # A daemon: a driver that hangs must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="camera-capture", daemon=True)
        self._call_began_ns = clock.now_ns()
        self.seq = first_seq
        self._last_time_ns = -1
        self._delivered_since_open = False
        self._refusal_announced = False
        self.fault = ""

    def start(self) -> None:
        self._thread.start()

    def ask_to_stop(self) -> None:
        self._stopping.set()

    def stop(self) -> None:
        """End the thread; waits as long as a driver that works may take."""
        self._stopping.set()
        self._thread.join(1.0)

    def is_alive(self) -> bool:
        return self._thread.is_alive()

    def in_one_call_s(self) -> float:
        """Return how long ago the thread last came by."""
        return (self._clock.now_ns() - self._call_began_ns) / 1e9

    def _run(self) -> None:
        retry_s = self._limits.first_retry_s
        announced = ""
        opened_before = False
        while not self._stopping.is_set():
            self._delivered_since_open = False
            self._call_began_ns = self._clock.now_ns()
            try:
                with contextlib.closing(self._open_capture()) as capture:
                    self._counts.reconnects += opened_before
                    opened_before = True
                    reason = self._captured_until_it_fails(capture)
            except (SourceError, CaptureError, OSError) as error:
                reason = str(error) or type(error).__name__
            if self._stopping.is_set():
                return
            self.fault = reason
            if self._delivered_since_open:
                retry_s, announced = self._limits.first_retry_s, ""
            if reason != announced:  # said once, not at every attempt
                announced = reason
                self._log.warning("camera_lost", reason=reason)
            self._stopping.wait(retry_s)
            retry_s = min(2 * retry_s, self._limits.last_retry_s)

    def _captured_until_it_fails(self, capture: Capture) -> str:
        """Deliver images until the camera fails; return why it did, or "" at the end."""
        self._judge.opened(self._clock.now_ns())
        look_s = min(_LOOK_S, self._limits.timeout_s / 2)
        while not self._stopping.is_set():
            self._call_began_ns = self._clock.now_ns()
            try:
                captured = capture.read(look_s)
            except DamagedImageError as error:
                self.seq += 1
                self._counts.undecodable += 1
                self._judge.damaged(str(error))
                captured = None
            if captured is not None and not self._stopping.is_set():  # one left to itself has nothing to say
                self._take(captured, capture)
            if reason := self._judge.overdue(self._clock.now_ns()):
                return reason
        return ""

    def _take(self, captured: CapturedImage, capture: Capture) -> None:
        now_ns = self._clock.now_ns()
        self.seq += 1 + captured.lost
        self._counts.lost_by_driver += captured.lost
        height_px, width_px = captured.image.shape
        verdict = self._judge.judge((width_px, height_px), captured.digest, now_ns)
        if verdict != "good":
            if verdict == "repeated":
                self._counts.repeated += 1
            else:
                self._counts.wrong_size += 1
            captured.give_back()
            return
        self.fault = ""
        time_ns, time_of = self._time_of(captured, now_ns)
        if not self._delivered_since_open:
            self._delivered_since_open = True
            self._log.info(
                "camera_opened", width_px=width_px, height_px=height_px, time_of=time_of, **capture.facts
            )
        replaced = self._mailbox.put(_Stamped(captured, time_ns, self.seq - 1, time_of))
        if replaced is not None:
            self._counts.skipped_late += 1
            replaced.captured.give_back()

    def _time_of(self, captured: CapturedImage, now_ns: int) -> tuple[int, Literal["exposure", "arrival"]]:
        time_ns = captured.time_ns
        if time_ns is not None:
            if time_ns > now_ns + FUTURE_TOLERANCE_NS:
                reason = "in the future: not CLOCK_MONOTONIC of this machine"
            elif time_ns < now_ns - OLDEST_NS:
                reason = "too far in the past"
            elif time_ns <= self._last_time_ns:
                reason = "not after the frame before"
            else:
                self._last_time_ns = min(time_ns, now_ns)
                return self._last_time_ns - self._latency_ns, "exposure"
            self._counts.time_refused += 1
            if not self._refusal_announced:
                self._refusal_announced = True
                self._log.warning("frame_time_refused", reason=reason, ahead_s=(time_ns - now_ns) / 1e9)
        self._last_time_ns = now_ns
        return now_ns - self._latency_ns, "arrival"
