"""The real ``companion run`` as a child process, seen through its log: for the demo, simulations and tests."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from companion.errors import CompanionError

_STOP_S = 20.0
_LAST_LINES = 20

Event = dict[str, Any]


class CompanionProcessError(CompanionError):
    """``companion run`` ended or did not say what was expected of it; holds its last words."""


def toml_of(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a configuration file's text; strings, numbers and booleans only.

    A JSON string, number or boolean is one of TOML too.
    """
    lines: list[str] = []
    for name, table in tables.items():
        lines.append(f"[{name}]")
        lines.extend(f"{key} = {json.dumps(value)}" for key, value in table.items())
    return "\n".join(lines) + "\n"


class CompanionProcess:
    """One run of the service; ``async with`` starts it and ends it.

    Parameters
    ----------
    tables
        The configuration. ``log.format`` is set to JSON, and both links, where they are not given, to
        ports that the system chooses.
    on_event
        Called with every event of its log, as it comes.
    """

    def __init__(
        self, tables: Mapping[str, Mapping[str, Any]], *, on_event: Callable[[Event], None] | None = None
    ) -> None:
        merged = {name: dict(table) for name, table in tables.items()}
        merged.setdefault("log", {}).setdefault("format", "json")
        link = merged.setdefault("link", {})
        link.setdefault("planner", "udpin:127.0.0.1:0")
        link.setdefault("autopilot", "udpin:127.0.0.1:0")
        self._tables = merged
        self._on_event = on_event
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._news = asyncio.Condition()
        self._folder = tempfile.TemporaryDirectory(prefix="void-companion-")
        self._other_lines: list[str] = []
        self.events: list[Event] = []

    async def __aenter__(self) -> Self:
        path = Path(self._folder.name) / "companion.toml"
        path.write_text(toml_of(self._tables), encoding="utf-8")
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "companion",
            "run",
            "-c",
            str(path),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            limit=1 << 20,
        )
        self._reader = asyncio.create_task(self._read(), name="companion log")
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        try:
            await self.stop()
        finally:
            self._folder.cleanup()

    @property
    def pid(self) -> int:
        """Its process id."""
        if self._process is None:
            raise RuntimeError("the process has not been started: use 'async with'")
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Its exit code, None while it runs."""
        return None if self._process is None else self._process.returncode

    @property
    def other_lines(self) -> list[str]:
        """What it wrote that is not an event; a traceback would stand here."""
        return self._other_lines

    def of(self, name: str) -> list[Event]:
        """Return its events of one name so far."""
        return [event for event in self.events if event.get("event") == name]

    async def wait_for(
        self, name: str, timeout_s: float = 20.0, *, where: Callable[[Event], bool] = lambda _: True
    ) -> Event:
        """Return the first event of this name, those that have come already included.

        Raises
        ------
        CompanionProcessError
            When it does not come in time, or the process ends before.
        """
        seen = 0

        def found() -> Event | None:
            nonlocal seen
            while seen < len(self.events):
                event = self.events[seen]
                seen += 1
                if event.get("event") == name and where(event):
                    return event
            return None

        try:
            async with asyncio.timeout(timeout_s), self._news:
                while True:
                    event = found()
                    if event is not None:
                        return event
                    if self._reader is not None and self._reader.done():
                        raise CompanionProcessError(
                            f"companion run ended without '{name}':\n{self._last_words()}"
                        )
                    await self._news.wait()
        except TimeoutError:
            raise CompanionProcessError(
                f"companion run did not say '{name}' within {timeout_s:g} s:\n{self._last_words()}"
            ) from None

    async def stop(self) -> int:
        """End it with SIGTERM, with SIGKILL after five seconds, and return its exit code."""
        process = self._process
        if process is None:
            return 0
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
        try:
            async with asyncio.timeout(_STOP_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
        if self._reader is not None:
            await self._reader
        return process.returncode or 0

    async def _read(self) -> None:
        process = self._process
        if process is None or process.stderr is None:
            return
        try:
            while line := await process.stderr.readline():
                text = line.decode(errors="replace").rstrip()
                try:
                    event = json.loads(text)
                except ValueError:
                    self._other_lines.append(text)
                    continue
                async with self._news:
                    self.events.append(event)
                    self._news.notify_all()
                if self._on_event is not None:
                    self._on_event(event)
        finally:
            async with self._news:
                self._news.notify_all()

    def _last_words(self) -> str:
        lines = [json.dumps(event) for event in self.events[-_LAST_LINES:]] + self._other_lines[-_LAST_LINES:]
        return "\n".join(lines) or "(it said nothing)"
