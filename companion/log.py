"""Structured logs: text for people on a terminal, one JSON object a line for everything else.

An event is a stable snake_case name with fields: ``log.info("worker_ready", pid=412)``. In JSON every line
has ``event``, ``level``, ``time`` (ISO 8601, UTC) and the fields. systemd's journal is told each line's priority.

Writing never blocks the caller: lines go through a bounded queue to one writer thread. When the sink
stalls (a full pipe, a stopped terminal), lines are dropped and counted, and ``log_lines_dropped`` says so as
soon as the sink takes lines again.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TextIO, cast

import numpy as np
import structlog
from structlog.typing import EventDict, FilteringBoundLogger, Processor, WrappedLogger

from companion.config import LogConfig

Log = FilteringBoundLogger
"""The type of a logger, for those who are given one."""

_QUEUE_LINES = 2000
_FLUSH_S = 1.0
_RETRY_S = 0.5
_MAX_DEPTH = 6
_SEVERITY = {"debug": 10, "info": 20, "warning": 30, "warn": 30, "error": 40, "exception": 40, "critical": 50}
_JOURNAL_PRIORITY = {
    "debug": 7,
    "info": 6,
    "warning": 4,
    "warn": 4,
    "error": 3,
    "exception": 3,
    "critical": 2,
}


class LevelGate:
    """Lets events through that are at least as severe as a level, which may change while the log is open.

    Parameters
    ----------
    level
        ``debug``, ``info``, ``warning`` or ``error``.
    """

    def __init__(self, level: str) -> None:
        self._least = _SEVERITY[level]

    def set_level(self, level: str) -> None:
        """Take another level."""
        self._least = _SEVERITY[level]

    def __call__(self, logger: WrappedLogger, method: str, event: EventDict) -> EventDict:  # noqa: ARG002  structlog's signature
        """Return the event, or drop it."""
        if _SEVERITY.get(method, _SEVERITY["critical"]) < self._least:
            raise structlog.DropEvent
        return event


class LineWriter:
    """A bounded queue of lines and the thread that writes them.

    Parameters
    ----------
    sink
        Writes bytes; it may block for as long as it likes and may raise OSError, which loses the line.
    dropped_line
        Makes the line that announces how many lines were dropped.
    capacity
        Lines that may wait.
    """

    def __init__(
        self, sink: Callable[[bytes], None], dropped_line: Callable[[int], str], capacity: int = _QUEUE_LINES
    ) -> None:
        self._sink = sink
        self._dropped_line = dropped_line
        self._queue: queue.Queue[str | None] = queue.Queue(capacity)
        self._lock = threading.Lock()
        self._dropped = 0
        self._announced = 0
        # A daemon: a sink that never comes back must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="log-writer", daemon=True)
        self._closed = False
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Lines lost so far: the queue was full, or the sink failed."""
        return self._dropped

    def write(self, line: str) -> None:
        """Queue one line, or drop and count it. Never blocks; callable from any thread."""
        if self._closed:
            self._count_dropped(1)
            return
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            self._count_dropped(1)

    def close(self, timeout_s: float = _FLUSH_S) -> None:
        """Write what waits, for at most ``timeout_s``, and stop; what is left then is lost."""
        self._closed = True
        deadline_s = time.monotonic() + timeout_s
        try:
            self._queue.put(None, timeout=timeout_s)
        except queue.Full:
            return
        self._thread.join(max(0.0, deadline_s - time.monotonic()))

    def _count_dropped(self, lines: int) -> None:
        with self._lock:
            self._dropped += lines

    def _run(self) -> None:
        while True:
            line = self._queue.get()
            if self._dropped > self._announced:
                dropped = self._dropped
                if self._write(self._dropped_line(dropped - self._announced)):
                    self._announced = dropped
            if line is None:
                return
            if not self._write(line):
                self._count_dropped(1)

    def _write(self, line: str) -> bool:
        try:
            self._sink((line + "\n").encode("utf-8", "backslashreplace"))
        except (OSError, ValueError):  # gone for good or for now (ValueError: a closed file object)
            return False
        return True


def descriptor_sink(fd: int) -> Callable[[bytes], None]:
    """Return a sink that writes to a file descriptor, blocking or not.

    It bypasses ``sys.stderr``: a thread that is stuck inside that object would lock up the interpreter's exit.
    """

    def write(data: bytes) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[os.write(fd, view) :]
            except BlockingIOError:
                select.select([], [fd], [], _RETRY_S)

    return write


def wants_json(config: LogConfig, stream: TextIO | None) -> bool:
    """Return whether lines are JSON. systemd's journal is a socket, so ``auto`` sees no terminal there."""
    if config.format != "auto":
        return config.format == "json"
    try:
        return stream is None or not stream.isatty()
    except ValueError:  # closed
        return True


def is_journal(stream: TextIO | None) -> bool:
    """Return whether a stream leads to systemd's journal: ``JOURNAL_STREAM`` names its file then (systemd.exec)."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        found = os.fstat(stream.fileno()) if stream is not None and device else None
    except (OSError, ValueError):  # not a file, or closed
        return False
    return found is not None and (device, inode) == (str(found.st_dev), str(found.st_ino))


@contextlib.contextmanager
def open_log(
    config: LogConfig,
    stream: TextIO | None = None,
    *,
    gate: LevelGate | None = None,
    tap: Processor | None = None,
) -> Iterator[Log]:
    """Yield the service's logger; its lines are written out when the context ends.

    Records of other libraries' ``logging`` (asyncio, mavsdk) go the same way meanwhile, as
    ``library_message``.

    Parameters
    ----------
    config
        Level and format.
    stream
        Where lines go; standard error where it is None. One without a file descriptor works too.
    gate
        What is logged, where that may change meanwhile; by default ``config.level`` for good.
    tap
        Sees every event that is logged, and returns it.
    """
    stream = sys.stderr if stream is None else stream
    as_json = wants_json(config, stream)
    render: Processor = json_line if as_json else _console_renderer(stream)
    if is_journal(stream):
        render = _with_priority(render)
    stamp = structlog.processors.TimeStamper(fmt="iso", utc=True, key="time")

    def dropped_line(lines: int) -> str:
        event: EventDict = {"event": "log_lines_dropped", "level": "warning", "lines": lines}
        return str(render(None, "warning", stamp(None, "warning", event)))

    writer = LineWriter(_sink_of(stream), dropped_line)
    processors: list[Processor] = [
        LevelGate(config.level) if gate is None else gate,
        structlog.processors.add_log_level,
        stamp,
        structlog.processors.format_exc_info,
        *(() if tap is None else (tap,)),
        render,
    ]
    log = cast(
        "Log",
        structlog.wrap_logger(
            _Lines(writer),
            processors=processors,
            wrapper_class=structlog.make_filtering_bound_logger(
                config.level if gate is None else "debug"  # else the gate alone decides
            ),
            context_class=dict,
        ).bind(),
    )
    handler = _LibraryHandler(log)
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield log
    finally:
        root.removeHandler(handler)
        writer.close()


def json_line(logger: WrappedLogger, method: str, event: EventDict) -> str:  # noqa: ARG001  structlog's signature
    """Render one event as a JSON object in one line, whatever its fields hold.

    Numbers that JSON does not know (NaN, infinities) become text; objects become their ``repr``.
    """
    leading = {key: event[key] for key in ("event", "level", "time") if key in event}
    return json.dumps(_plain({**leading, **event}, _MAX_DEPTH), ensure_ascii=False, allow_nan=False)


def _plain(value: object, depth: int) -> object:
    if value is None or isinstance(value, bool | str):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, np.generic):
        return _plain(value.item(), depth)
    if depth > 0 and isinstance(value, Mapping):
        return {str(key): _plain(item, depth - 1) for key, item in value.items()}
    if depth > 0 and isinstance(value, list | tuple | set | frozenset):
        return [_plain(item, depth - 1) for item in value]
    return repr(value)


def _with_priority(render: Processor) -> Processor:
    """Put the priority before each line that the journal takes off again and keeps (sd-daemon(3))."""

    def rendered(logger: WrappedLogger, method: str, event: EventDict) -> str:
        return (
            f"<{_JOURNAL_PRIORITY.get(method, _JOURNAL_PRIORITY['error'])}>{render(logger, method, event)!s}"
        )

    return rendered


def _console_renderer(stream: TextIO | None) -> structlog.dev.ConsoleRenderer:
    return structlog.dev.ConsoleRenderer(
        colors=stream is not None and not stream.closed and stream.isatty() and "NO_COLOR" not in os.environ,
        exception_formatter=structlog.dev.plain_traceback,
        timestamp_key="time",
    )


def _sink_of(stream: TextIO | None) -> Callable[[bytes], None]:
    if stream is None:  # started with standard error closed: the descriptor may be somebody else's by now
        return lambda _data: None
    try:
        return descriptor_sink(stream.fileno())
    except (OSError, ValueError):  # not a file (io.UnsupportedOperation is both), or closed

        def write(data: bytes) -> None:
            stream.write(data.decode())
            stream.flush()

        return write


class _Lines:
    """What structlog wraps: every level's method takes the rendered line."""

    def __init__(self, writer: LineWriter) -> None:
        self.msg = self.debug = self.info = self.warning = self.warn = writer.write
        self.error = self.critical = self.exception = self.fatal = self.log = writer.write


class _LibraryHandler(logging.Handler):
    """Takes records of the standard library's logging into the structured log."""

    def __init__(self, log: Log) -> None:
        super().__init__(logging.WARNING)
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        fields: dict[str, Any] = {"logger": record.name}
        if record.exc_info:
            fields["exc_info"] = record.exc_info
        try:
            fields["message"] = record.getMessage()
        except (TypeError, ValueError):  # the library's format does not fit its arguments
            fields["message"] = str(record.msg)
        self._log.log(record.levelno, "library_message", **fields)
