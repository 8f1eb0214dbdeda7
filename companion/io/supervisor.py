"""Keeps the I/O process running beside the flight: starts it, feeds it, answers it, starts it again with back-off.

Whatever it does, the flight goes on: packets are sent without waiting, what it does not take is dropped and counted, and it
is killed when it has taken nothing for ten seconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

from companion.children.output import OutputLines
from companion.children.process import status_in_words
from companion.config import Config
from companion.io.feed import Feed
from companion.io.messages import (
    Answer,
    FromIo,
    LogLine,
    PacketError,
    Ready,
    Request,
    Unusable,
    Wanted,
    Wants,
)
from companion.io.process import IoProcess
from companion.log import Log
from companion.vision.backoff import RestartBackoff

RequestHandler = Callable[[Mapping[str, Any]], Awaitable[Answer]]
"""Does what a sink asks for; what it raises is the answer's reason."""

FLUSH_S: Final = 0.02
_STALLED_S: Final = 10.0
_START_S: Final = 30.0
_STOP_S: Final = 1.5
"""The sinks' time to close what they have open; with the kill after it the service ends within two seconds."""
_FIRST_DELAY_S: Final = 1.0
_LONGEST_DELAY_S: Final = 60.0
_MOST_REQUESTS: Final = 16
"""Requests that may be worked on at once; more are refused."""


class IoSupervisor:
    """Owns the I/O process for as long as `run` runs.

    It lives in real time, whatever clock the flight has: nothing that is decided depends on it.

    Parameters
    ----------
    feed
        What it is fed from.
    sinks
        Names of the sinks' factories.
    config
        What they are built from; `set_config` gives a newer one to the next process.
    handlers
        By name what sinks may ask for.
    now_ns
        The service's monotonic time.
    log
        Takes ``io_started``, ``io_died``, ``io_unusable``, ``io_output``, ``io_failed``, ``io_request_failed``, and what the
        sinks log.
    """

    def __init__(
        self,
        feed: Feed,
        sinks: Sequence[str],
        config: Config,
        *,
        handlers: Mapping[str, RequestHandler],
        now_ns: Callable[[], int],
        log: Log,
    ) -> None:
        self._feed = feed
        self._sinks = tuple(sinks)
        self._config = config
        self._handlers = dict(handlers)
        self._now_ns = now_ns
        self._log = log
        self._tasks: set[asyncio.Task[None]] = set()
        self._restarts = 0
        self._pid: int | None = None
        self._was_ready = asyncio.Event()

    @property
    def pid(self) -> int | None:
        """Of the running process."""
        return self._pid

    @property
    def restarts(self) -> int:
        """Times that it was started again."""
        return self._restarts

    def set_config(self, config: Config) -> None:
        """Take what the next process is built from."""
        self._config = config

    async def wait_ready(self) -> None:
        """Wait until its sinks have been built once."""
        await self._was_ready.wait()

    async def run(self) -> None:
        """Keep the process running until cancelled; it is gone when this returns."""
        backoff = RestartBackoff(_FIRST_DELAY_S, _LONGEST_DELAY_S)
        # A thread of its own: starting blocks, and the process dies with the thread that made it.
        starter = ThreadPoolExecutor(1, thread_name_prefix="io-starter")
        try:
            while True:
                began_s = time.monotonic()
                life = _Life(self._feed, self._on_message, self._log)
                try:
                    reason = await self._live(life, starter)
                finally:
                    status = await asyncio.shield(_ended(life, starter))
                    self._pid = None
                if life.unusable is not None:
                    self._log.error("io_unusable", error=life.unusable)
                    return  # the service flies without it
                delay_s = backoff.delay_after_s(time.monotonic() - began_s)
                self._log.error(
                    "io_died",
                    reason=reason,
                    status=status_in_words(status),
                    restart_delay_s=delay_s,
                    output=life.tail,
                )
                await asyncio.sleep(delay_s)
                self._restarts += 1
        except Exception:  # noqa: BLE001  a fault in here must not end the flight: it goes on without
            self._log.exception("io_failed")
        finally:
            self._feed.want(Wants())
            for task in self._tasks:
                task.cancel()
            # Not waited for in this thread: the process is gone, and if not, it dies with that thread.
            starter.shutdown(wait=False)

    async def _live(self, life: _Life, starter: ThreadPoolExecutor) -> str:
        """Feed one process until it ends; return why."""
        if self._restarts:  # the first one is told from the beginning, where that is wanted
            self._feed.restart()
        try:
            await life.start(starter, self._config, self._sinks)
        except OSError as error:
            return f"cannot be started: {error}"
        self._pid = life.pid
        return await life.feed_until_end()

    def _on_message(self, message: FromIo) -> None:
        match message:
            case Ready():
                self._was_ready.set()
                self._log.info("io_started", pid=self._pid, sinks=list(self._sinks))
            case Wanted():
                self._feed.want(Wants(message.kinds, message.frames_hz))
            case LogLine():
                taken = {"event", "level", "time"}
                fields = {
                    (f"{key}_" if key in taken else key): value for key, value in message.fields.items()
                }
                getattr(self._log, message.level)(message.event, **fields)
            case Request():
                self._begin(message)
            case Unusable():
                pass  # the end follows, and says so

    def _begin(self, request: Request) -> None:
        handler = self._handlers.get(request.name)
        if handler is None or len(self._tasks) >= _MOST_REQUESTS:
            why = f"nobody here does {request.name!r}" if handler is None else "too many requests at once"
            self._feed.answer(request.number, Answer(accepted=False, reasons=(why,)), self._now_ns())
            return
        task = asyncio.get_running_loop().create_task(self._carry_out(request, handler), name="io-request")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _carry_out(self, request: Request, handler: RequestHandler) -> None:
        try:
            answer = await handler(request.fields)
        except Exception as error:  # noqa: BLE001  whatever a request leads to, the flight goes on
            answer = Answer(accepted=False, reasons=(str(error) or repr(error),))
            self._log.warning("io_request_failed", request=request.name, error=repr(error))
        self._feed.answer(request.number, answer, self._now_ns())


async def _ended(life: _Life, starter: ThreadPoolExecutor) -> int | None:
    return await life.stop(starter)


class _Life:
    """One I/O process from its start to its end."""

    def __init__(self, feed: Feed, on_message: Callable[[FromIo], None], log: Log) -> None:
        self.unusable: str | None = None
        self._feed = feed
        self._on_message = on_message
        self._log = log
        self._process: IoProcess | None = None
        self._waiting: deque[tuple[bytes, int | None]] = deque()
        self._end: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._is_ready = False
        self._took_s = 0.0
        self._output = OutputLines(lambda line: self._log.warning("io_output", pid=self.pid, line=line))

    @property
    def pid(self) -> int | None:
        """The process id."""
        return None if self._process is None else self._process.pid

    @property
    def tail(self) -> str:
        """The last lines of its own output."""
        return self._output.last_words

    async def start(self, starter: ThreadPoolExecutor, config: Config, sinks: Sequence[str]) -> None:
        """Start the process; raises OSError where there is none to be had."""
        loop = asyncio.get_running_loop()
        starting = loop.run_in_executor(starter, IoProcess.start, config, sinks)
        try:
            self._process = await asyncio.shield(starting)
        except asyncio.CancelledError:
            with contextlib.suppress(OSError):
                self._process = await starting  # so that it is ended
            raise
        self._took_s = time.monotonic()
        loop.add_reader(self._process.message_fd, self._read)
        loop.add_reader(self._process.output_fd, self._read_output)

    async def feed_until_end(self) -> str:
        """Send what is published until the process ends or takes nothing any more; return why."""
        while not self._end.done():
            self._send()
            patience_s = _STALLED_S if self._is_ready else _START_S
            if (self._waiting or not self._is_ready) and time.monotonic() - self._took_s > patience_s:
                return f"has taken nothing for {patience_s:g} s"
            await asyncio.wait((self._end,), timeout=FLUSH_S)
        return self._end.result()

    async def stop(self, starter: ThreadPoolExecutor) -> int | None:
        """Give it what is left, ask it to end, and wait until it is gone."""
        process, self._process = self._process, None
        if process is None:
            return None
        loop = asyncio.get_running_loop()
        loop.remove_reader(process.message_fd)
        loop.remove_reader(process.output_fd)
        if not self._end.done():
            self._send_to(process)
        return await loop.run_in_executor(starter, process.stop, _STOP_S)

    def _send(self) -> None:
        if self._process is not None:
            self._send_to(self._process)

    def _send_to(self, process: IoProcess) -> None:
        """Send what waits, as far as the kernel takes it at once."""
        if not self._waiting:  # else the feed is where more may wait: there it is bounded by kind
            self._waiting.extend(self._feed.packets())
        while self._waiting:
            packet, fd = self._waiting[0]
            try:
                process.send_packet(packet, fd)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                if fd is None:
                    self._ended(f"cannot be spoken to: {error}")
                    return
                # The ring has been replaced by a larger one, whose announcement follows.
            self._waiting.popleft()
            self._took_s = time.monotonic()

    def _read(self) -> None:
        process = self._process
        if process is None:
            return
        try:
            message = process.receive()
        except (BlockingIOError, InterruptedError):
            return
        except (PacketError, OSError) as error:
            self._ended(f"said what is no message: {error}")
            return
        match message:
            case None:
                self._ended("ended by itself")
                return
            case Ready():
                self._is_ready = True
            case Unusable():
                self.unusable = message.message
        self._on_message(message)

    def _ended(self, reason: str) -> None:
        if self._process is not None:
            self._read_output()  # its last words
            asyncio.get_running_loop().remove_reader(self._process.message_fd)
        if not self._end.done():
            self._end.set_result(reason)

    def _read_output(self) -> None:
        if self._process is not None:
            self._output.read_from(self._process)
