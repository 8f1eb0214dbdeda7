"""Keeps one vision worker running: hands it the newest frame, watches its deadline, starts it again.

The worker is expendable. It may crash, hang or be killed at any time; the event loop never waits for it, and
nothing it said counts after its death. A late or dead worker means *no report*, never the last one again.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from companion.children.output import OutputLines
from companion.children.process import status_in_words
from companion.clock import Clock
from companion.config import CameraConfig, DetectorConfig
from companion.errors import ConfigError, WorkerError
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport, Pose
from companion.log import Log
from companion.vision.backoff import RestartBackoff
from companion.vision.frame_slots import N_SLOTS, FrameSlots
from companion.vision.messages import (
    Answer,
    Details,
    Detect,
    Failed,
    FromWorker,
    MapSlots,
    MessageError,
    Ready,
    Start,
    Unusable,
)
from companion.vision.pipeline import VOID_PIPELINE
from companion.vision.worker_process import WorkerProcess

WorkerState = Literal["starting", "ready", "busy", "backoff", "stopped"]

_MAX_FRAME_BYTES = 1 << 26
_GRACE_S = 0.3


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """The worker as it stands.

    Attributes
    ----------
    state
        ``stopped`` before ``run`` and after it; ``backoff`` while a restart is waited for.
    pid
        Of the running process.
    restarts
        Times that it was started again.
    last_report_ns
        When the last report came (our monotonic time).
    frames_offered, frames_replaced, frames_refused
        Frames given to ``offer``; those that a newer one replaced before the worker could take them; those
        there was no memory for.
    last_error
        Why the last worker ended, or "".
    """

    state: WorkerState
    pid: int | None
    restarts: int
    last_report_ns: int | None
    frames_offered: int
    frames_replaced: int
    frames_refused: int
    last_error: str


class VisionSupervisor:
    """Owns the worker process for as long as ``run`` runs.

    Parameters
    ----------
    detector, camera
        What the worker builds its pipeline from, and the deadlines and delays that it is held to.
    clock
        Monotonic time and waiting.
    on_report
        Called on the event loop with each report, at once.
    log
        Takes ``worker_starting``, ``worker_ready``, ``worker_died``, ``worker_replaced``, ``worker_output`` and
        ``frame_refused``.
    pipeline
        ``package.module:factory`` of what the worker runs (``companion.vision.pipeline``).
    on_details
        Called with what the detector saw on the way to a report, behind that report; None: nobody looks.
    wants_details
        Asked with each frame whether somebody does: it takes the worker some milliseconds.
    """

    def __init__(
        self,
        detector: DetectorConfig,
        camera: CameraConfig,
        *,
        clock: Clock,
        on_report: Callable[[DetectionReport], None],
        log: Log,
        pipeline: str = VOID_PIPELINE,
        on_details: Callable[[Details], None] | None = None,
        wants_details: Callable[[], bool] = lambda: False,
    ) -> None:
        self._on_details = on_details
        self._wants_details = wants_details
        self._detector = detector
        self._camera = camera
        self._pipeline = pipeline
        self._start_message = Start(pipeline, detector, camera)
        self._clock = clock
        self._on_report = on_report
        self._log = log
        self._state: WorkerState = "stopped"
        self._starts = 0
        self._last_report_ns: int | None = None
        self._last_error = ""
        self._offered = 0
        self._replaced = 0
        self._refused = 0
        self._slots: FrameSlots | None = None
        self._waiting: Detect | None = None
        self._in_flight: Detect | None = None
        self._life: _Life | None = None
        self._was_ready = asyncio.Event()

    @property
    def status(self) -> WorkerStatus:
        """The worker as it stands now."""
        return WorkerStatus(
            state=self._state,
            pid=None if self._life is None else self._life.pid,
            restarts=max(0, self._starts - 1),
            last_report_ns=self._last_report_ns,
            frames_offered=self._offered,
            frames_replaced=self._replaced,
            frames_refused=self._refused,
            last_error=self._last_error,
        )

    def offer(self, frame: Frame, pose: Pose | None) -> None:
        """Hand over a frame; it replaces one that still waits. Never blocks.

        The pixels are copied here, once: the image may be used again at once.

        Parameters
        ----------
        frame
            Its image is (H, W) uint8.
        pose
            The vehicle at the frame's time, where it is known; one with a NaN in it is not.
        """
        image = frame.image
        if image.ndim != 2 or image.dtype != np.uint8 or not 0 < image.size <= _MAX_FRAME_BYTES:
            raise ValueError(
                f"expected (H, W) uint8 of up to {_MAX_FRAME_BYTES} bytes, got {image.shape} {image.dtype}"
            )
        self._offered += 1
        if self._state == "stopped":
            return
        try:
            slots = self._slots_for(image.size)
        except OSError as error:
            self._refused += 1
            if self._refused == 1:
                self._log.error("frame_refused", reason=f"no shared memory: {error}", bytes=image.size)
            return
        self._replaced += self._waiting is not None
        slot = 0 if self._in_flight is None else 1 - self._in_flight.slot
        slots.write(slot, image)
        height_px, width_px = image.shape
        self._waiting = Detect(
            self._offered,
            slot,
            height_px,
            width_px,
            frame.seq,
            frame.time_ns,
            _finite_or_none(pose),
            self._on_details is not None and self._wants_details(),
        )
        self._dispatch()

    def replace(self, detector: DetectorConfig) -> None:
        """Build the worker from other settings: the present one ends, the next one starts at once.

        There are no reports in between, which is some seconds. Try settings with :meth:`validate` of another supervisor first.
        """
        self._detector = detector
        self._start_message = Start(self._pipeline, detector, self._camera)
        if self._life is not None:
            self._life.inbox.put_nowait(_Replaced())

    async def validate(self) -> None:
        """Have a worker build its pipeline once, and end it again.

        Raises
        ------
        companion.errors.ConfigError
            When the camera file or the detector's parameters cannot be used; says why.
        companion.errors.WorkerError
            When the worker does not come up for any other reason.
        """
        async with _WorkerThread() as thread:
            life = _Life(thread, self._clock, self._log, self._detector)
            try:
                await life.start(self._start_message)
                message = await life.inbox.get()
            except OSError as error:
                raise WorkerError(f"the vision worker cannot be started: {error}") from error
            finally:
                await life.stop()
        match message:
            case Ready():
                return
            case Unusable():
                raise ConfigError(message.message)
            case _:
                raise WorkerError(f"the vision worker cannot be started: {life.cause_of(message)}")

    async def wait_ready(self) -> None:
        """Wait until a worker has been ready for the first time."""
        await self._was_ready.wait()

    async def run(self) -> None:
        """Keep a worker running until cancelled; the process is gone when this returns.

        Raises
        ------
        companion.errors.ConfigError
            When the first worker says that the camera file or the detector's parameters cannot be used.
        """
        backoff = RestartBackoff(self._detector.restart_delay_s, self._detector.restart_delay_max_s)
        try:
            async with _WorkerThread() as thread:
                while True:
                    self._state = "starting"
                    self._starts += 1
                    life = self._life = _Life(thread, self._clock, self._log, self._detector)
                    grace_s = 0.0
                    try:
                        death = await self._live(life)
                        grace_s = death.grace_s
                        self._last_error = death.reason
                    finally:
                        self._life = self._in_flight = None
                        self._state = "backoff"
                        exit_status = await life.stop(grace_s)
                    if death.is_wanted:
                        self._log.info("worker_replaced", reason=death.reason, pid=life.pid)
                        continue
                    delay_s = backoff.delay_after_s(life.answered_for_s)
                    self._log.error(
                        "worker_died",
                        reason=death.reason,
                        status=status_in_words(exit_status),
                        pid=life.pid,
                        restart_delay_s=delay_s,
                        **death.details,
                    )
                    await self._clock.sleep_until_ns(self._clock.now_ns() + round(delay_s * 1e9))
        finally:
            self._state = "stopped"
            self._waiting = None
            if self._slots is not None:
                self._slots.close()
                self._slots = None

    async def _live(self, life: _Life) -> _Death:
        """Serve one worker until it ends; return why."""
        started_ns = self._clock.now_ns()
        try:
            await life.start(self._start_message)
        except OSError as error:
            return _Death(f"cannot be started: {error}")
        self._log.info("worker_starting", pid=life.pid)
        while True:
            message = await life.inbox.get()
            match message:
                case Ready() if self._state == "starting":
                    life.disarm()
                    self._state = "ready"
                    self._was_ready.set()
                    self._log.info(
                        "worker_ready", pid=life.pid, start_s=(self._clock.now_ns() - started_ns) / 1e9
                    )
                case Answer() if self._is_awaited(message):
                    life.disarm()
                    life.note_answer()
                    self._in_flight = None
                    self._state = "ready"
                    self._last_report_ns = self._clock.now_ns()
                    self._on_report(message.report)
                case Details():
                    if self._on_details is not None:
                        self._on_details(message)
                case _Replaced():
                    return _Death("settings changed", is_wanted=True)
                case Unusable() if not self._was_ready.is_set():
                    raise ConfigError(message.message)  # it never worked, and no restart will mend a file
                case Failed():
                    return _Death(message.error, {"traceback": message.traceback}, _GRACE_S)
                case _Overrun() if not life.is_overrun(message):
                    continue  # the answer was there first
                case _Overrun():
                    return _Death(message.reason)
                case _:
                    details = {"output": life.tail} if life.tail else {}
                    return _Death(life.cause_of(message), details, _GRACE_S)
            self._dispatch()

    def _is_awaited(self, answer: Answer) -> bool:
        awaited = self._in_flight
        return (
            awaited is not None
            and answer.frame_id == awaited.frame_id
            and answer.report.frame_ns == awaited.time_ns
        )

    def _slots_for(self, frame_bytes: int) -> FrameSlots:
        if self._slots is None or self._slots.slot_bytes < frame_bytes:
            larger = FrameSlots(frame_bytes)
            if self._slots is not None:
                self._slots.close()  # the worker keeps its own mapping until it is told
            self._slots = larger
        return self._slots

    def _dispatch(self) -> None:
        """Give the worker the waiting frame, when it has nothing to do."""
        life, frame, slots = self._life, self._waiting, self._slots
        if life is None or frame is None or slots is None or self._state != "ready":
            return
        try:
            if life.mapped is not slots:
                life.map_slots(slots)
            life.ask(frame)
        except OSError:
            return  # it has just died, which its socket is about to say; the frame waits for the next one
        self._waiting = None
        self._in_flight = frame
        self._state = "busy"
        life.arm(self._detector.deadline_s, f"no answer within {self._detector.deadline_s} s")


def _finite_or_none(pose: Pose | None) -> Pose | None:
    if pose is None:
        return None
    numbers = (pose.north_m, pose.east_m, pose.down_m, *pose.q_ned_from_body)
    return pose if all(map(math.isfinite, numbers)) else None


@dataclass(frozen=True, slots=True)
class _Death:
    """Why a worker is given up, what else is known, and how long it may take to end by itself."""

    reason: str
    details: dict[str, str] = field(default_factory=dict)
    grace_s: float = 0.0
    is_wanted: bool = False


@dataclass(frozen=True, slots=True)
class _Overrun:
    """The time allowed for what was asked last has passed."""

    turn: int
    reason: str


@dataclass(frozen=True, slots=True)
class _Replaced:
    """Another worker is wanted in its place."""


@dataclass(frozen=True, slots=True)
class _Ended:
    """The worker has closed its socket, or said what is no message."""

    reason: str


class _WorkerThread:
    """The thread that starts and stops workers: that blocks, and a worker dies with the thread that made it."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="worker-starter")
        self._process: WorkerProcess | None = None

    async def __aenter__(self) -> _WorkerThread:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._executor.submit(self._stop)
        await asyncio.to_thread(self._executor.shutdown)

    async def start(self, threads: int) -> WorkerProcess:
        """Start a process.

        Raises
        ------
        OSError
            When it cannot be started.
        """
        return await asyncio.get_running_loop().run_in_executor(self._executor, self._start, threads)

    async def stop(self, grace_s: float) -> int | None:
        """End the process that was started last, if any, also where ``start`` was cancelled."""
        return await asyncio.get_running_loop().run_in_executor(self._executor, self._stop, grace_s)

    def _start(self, threads: int) -> WorkerProcess:
        self._process = WorkerProcess.start(threads)
        return self._process

    def _stop(self, grace_s: float = 0.0) -> int | None:
        process, self._process = self._process, None
        return None if process is None else process.stop(grace_s)


class _Life:
    """One worker from its start to its end; everything that happens to it arrives in ``inbox``, in order."""

    def __init__(self, thread: _WorkerThread, clock: Clock, log: Log, config: DetectorConfig) -> None:
        self.inbox: asyncio.Queue[FromWorker | _Overrun | _Ended | _Replaced] = asyncio.Queue()
        self.mapped: FrameSlots | None = None
        self.pid: int | None = None
        self._thread = thread
        self._clock = clock
        self._log = log
        self._config = config
        self._process: WorkerProcess | None = None
        self._watch: asyncio.Task[None] | None = None
        self._turn = 0
        self._first_answer_ns: int | None = None
        self._last_answer_ns = 0
        self._output = OutputLines(lambda line: self._log.warning("worker_output", pid=self.pid, line=line))

    @property
    def tail(self) -> str:
        """The last lines of its own output."""
        return self._output.last_words

    @property
    def answered_for_s(self) -> float:
        """Time between its first and its last answer."""
        first_ns = self._first_answer_ns
        return 0.0 if first_ns is None else (self._last_answer_ns - first_ns) / 1e9

    async def start(self, message: Start) -> None:
        """Start the process and have it build its pipeline.

        Raises
        ------
        OSError
            When there is no process to be had.
        """
        self.arm(self._config.start_timeout_s, f"not up within {self._config.start_timeout_s} s")
        self._process = process = await self._thread.start(self._config.threads)
        self.pid = process.pid
        loop = asyncio.get_running_loop()
        loop.add_reader(process.message_fd, self._on_message)
        loop.add_reader(process.output_fd, self._on_output)
        self.ask(message)

    async def stop(self, grace_s: float = 0.0) -> int | None:
        """Stop listening, end the process and wait until it is gone; return its exit status."""
        self.disarm()
        process, self._process = self._process, None
        if process is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(process.message_fd)
            loop.remove_reader(process.output_fd)
        return await self._thread.stop(grace_s)

    def ask(self, message: Start | Detect) -> None:
        """Send a message that is answered; raises OSError when the worker is gone."""
        process = self._running()
        process.send(message)
        self._clock.answer_owed(process.message_fd, "start" if isinstance(message, Start) else "frame")

    def map_slots(self, slots: FrameSlots) -> None:
        """Tell where frames lie from now on; raises OSError when the worker is gone."""
        self._running().send(MapSlots(slots.slot_bytes, N_SLOTS), slots.fd)
        self.mapped = slots

    def _running(self) -> WorkerProcess:
        if self._process is None:
            raise BrokenPipeError("the worker is gone")
        return self._process

    def arm(self, limit_s: float, reason: str) -> None:
        """Allow this much time for what is asked now; ``_Overrun`` arrives when it has passed."""
        self.disarm()
        due_ns = self._clock.now_ns() + round(limit_s * 1e9)
        self._watch = asyncio.create_task(self._overrun(due_ns, self._turn, reason), name="worker-deadline")

    def disarm(self) -> None:
        """Wait for nothing: it has answered, or it is over."""
        self._turn += 1
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None

    def is_overrun(self, overrun: _Overrun) -> bool:
        """Return whether that time-out is of what is still waited for."""
        return overrun.turn == self._turn

    def note_answer(self) -> None:
        """Remember how long it has been answering."""
        self._last_answer_ns = self._clock.now_ns()
        if self._first_answer_ns is None:
            self._first_answer_ns = self._last_answer_ns

    def cause_of(self, message: FromWorker | _Overrun | _Ended | _Replaced) -> str:
        """Return why this message is the end of the worker."""
        match message:
            case _Overrun() | _Ended():
                return message.reason
            case Unusable():
                return message.message
            case Failed():
                return f"{message.error}\n{message.traceback}"
            case _Replaced():
                return "settings changed"
            case _:
                return f"said {message.kind} out of turn"

    async def _overrun(self, due_ns: int, turn: int, reason: str) -> None:
        await self._clock.sleep_until_ns(due_ns)
        self.inbox.put_nowait(_Overrun(turn, reason))

    def _on_message(self) -> None:
        process = self._process
        if process is None:
            return
        try:
            message = process.receive()
        except BlockingIOError:
            return
        except (MessageError, OSError) as error:
            self._end(f"said what is no message: {error}")
            return
        if message is None:
            self._end("ended by itself")
        else:
            self.inbox.put_nowait(message)

    def _end(self, reason: str) -> None:
        process = self._process
        if process is not None:
            self._on_output()  # its last words, before they are asked for
            asyncio.get_running_loop().remove_reader(process.message_fd)
        self.inbox.put_nowait(_Ended(reason))

    def _on_output(self) -> None:
        if self._process is not None:
            self._output.read_from(self._process)
