"""One sink on a thread of its own, with a bounded queue in front of it: a slow one is slow for itself alone."""

from __future__ import annotations

import itertools
import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final, Literal

from companion.config import Config
from companion.io.messages import ALWAYS, Answer, FromIo, Kind, LogLine, Message, Request, Wants
from companion.io.queues import KindQueues
from companion.io.sink import Sink, SinkFactory

_IDLE_S: Final = 1.0


class Outbox:
    """Sends messages to the service; callable from any thread.

    Parameters
    ----------
    send
        Sends one message; raises OSError where the service is gone.
    """

    def __init__(self, send: Callable[[FromIo], None]) -> None:
        self._send = send
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._asked: dict[int, Future[Answer]] = {}
        self._is_closed = False

    def send(self, message: FromIo) -> bool:
        """Send a message; return whether the service is there."""
        with self._lock:
            try:
                self._send(message)
            except (OSError, ValueError):
                return False
        return True

    def ask(self, name: str, fields: Mapping[str, Any]) -> Future[Answer]:
        """Send a request; its answer comes by `on_answer`, or is a refusal where the service is gone."""
        future: Future[Answer] = Future()
        with self._lock:
            number = next(self._numbers)
            if not self._is_closed:
                self._asked[number] = future
        if number not in self._asked or not self.send(Request(number, name, dict(fields))):
            self._asked.pop(number, None)
            _resolve(future, Answer(accepted=False, reasons=("the service is gone",)))
        return future

    def on_answer(self, fields: Mapping[str, Any]) -> None:
        """Take the answer to a request."""
        future = self._asked.pop(fields["number"], None)
        if future is not None:
            _resolve(
                future,
                Answer(
                    accepted=fields["accepted"], reasons=tuple(fields["reasons"]), fields=fields["fields"]
                ),
            )

    def close(self) -> None:
        """Refuse what waits for an answer, and all that comes: the service is gone."""
        with self._lock:
            self._is_closed = True
            waiting, self._asked = self._asked, {}
        for future in waiting.values():
            _resolve(future, Answer(accepted=False, reasons=("the service is gone",)))


def _resolve(future: Future[Answer], answer: Answer) -> None:
    if future.set_running_or_notify_cancel():
        future.set_result(answer)


class OutboxLog:
    """The service's log, at the other end of an outbox."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox

    def info(self, event: str, **fields: Any) -> None:
        """Write a line."""
        self._write("info", event, fields)

    def warning(self, event: str, **fields: Any) -> None:
        """Write a warning."""
        self._write("warning", event, fields)

    def error(self, event: str, **fields: Any) -> None:
        """Write an error."""
        self._write("error", event, fields)

    def _write(self, level: Literal["info", "warning", "error"], event: str, fields: dict[str, Any]) -> None:
        self._outbox.send(LogLine(level, event, fields))


class SinkThread:
    """Runs one sink; implements ``companion.io.sink.Desk`` for it.

    Parameters
    ----------
    name
        How the log calls it.
    outbox
        Towards the service.
    on_wants
        Called, on any thread, when what the sink wants has changed.
    """

    def __init__(self, name: str, outbox: Outbox, on_wants: Callable[[], None]) -> None:
        self.name = name
        self.wants = Wants()
        self._outbox = outbox
        self._on_wants = on_wants
        self._log = OutboxLog(outbox)
        self._queues: KindQueues[Message] = KindQueues()
        self._wake = threading.Event()
        self._is_ending = False
        self._has_started = False
        self._thread: threading.Thread | None = None

    # ------------------------------------------------------------------ for the sink

    @property
    def log(self) -> OutboxLog:
        """The service's log."""
        return self._log

    @property
    def dropped(self) -> Mapping[Kind, int]:
        """Messages that this sink was too slow for, by kind."""
        return self._queues.dropped

    def want(self, wants: Wants) -> None:
        """Say what to be told from now on."""
        if wants != self.wants:
            self.wants = wants
            self._on_wants()

    def ask(self, name: str, fields: Mapping[str, Any]) -> Future[Answer]:
        """Ask the service for something."""
        return self._outbox.ask(name, fields)

    # ------------------------------------------------------------------ for the process

    def build(self, factory: SinkFactory, config: Config) -> None:
        """Build the sink and start its thread; raises what the factory raises."""
        sink = factory(config, self)
        self._thread = threading.Thread(target=self._run, args=(sink,), name=self.name, daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Queue a message that the sink wants, or may want: what came before it has started is judged then. Never blocks."""
        if not self._has_started or self._is_wanted(message):
            self._queues.put(message.kind, message.seq, message)
            self._wake.set()

    def end(self) -> None:
        """Have the sink take what waits and stop. Does not wait."""
        self._is_ending = True
        self._wake.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; return whether it came in time."""
        if self._thread is None:
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _is_wanted(self, message: Message) -> bool:
        return message.kind in self.wants.kinds or message.kind in ALWAYS

    def _run(self, sink: Sink) -> None:
        try:
            sink.start()
            self._has_started = True
            while True:
                woken = self._wake.wait(_IDLE_S)
                self._wake.clear()
                is_ending = self._is_ending  # before what waits is taken: nothing is put after it
                for message in self._queues.take_all():
                    if self._is_wanted(message):
                        sink.take(message)
                if is_ending:
                    break
                if not woken:
                    sink.idle()
            sink.stop()
        except Exception as error:  # noqa: BLE001  one sink's fault is not the others'
            self._log.error(
                "sink_failed", sink=self.name, error=repr(error), traceback=traceback.format_exc()[-5000:]
            )
            self.want(Wants())
