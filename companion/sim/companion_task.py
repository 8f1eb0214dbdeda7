"""The service on the event loop of its caller, seen through its log like ``companion_process.CompanionProcess``.

For simulated time (``companion.sim.lockstep``), which two processes could not share. The service is the real one: its
own sockets, its own worker process, its configuration checked as a file's is.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self, cast

import structlog
from pydantic import ValidationError
from structlog.typing import EventDict, WrappedLogger

from companion.clock import Clock
from companion.config import Config
from companion.errors import CompanionError, ConfigError, first_of
from companion.frames.source import FrameSource
from companion.io.feed import Feed
from companion.log import Log
from companion.mavlink.endpoint import Endpoint
from companion.service import Service
from companion.sim.companion_process import CompanionProcessError, Event
from companion.vision.pipeline import VOID_PIPELINE

_MOST_OF_A_COMPLAINT = 600


class CompanionTask:
    """One run of the service as a task; ``async with`` starts it and ends it.

    Parameters
    ----------
    tables
        The configuration. Both links, where they are not given, get ports that the system chooses.
    clock
        Where time comes from.
    open_frames
        Makes the frame source.
    on_event
        Called with every event of its log, as it comes.
    feed
        Told what happens in it.
    pipeline
        What its worker runs (``companion.vision.pipeline.load_factory``).

    Raises
    ------
    companion.errors.ConfigError
        When the configuration cannot be used.
    """

    def __init__(
        self,
        tables: Mapping[str, Mapping[str, Any]],
        *,
        clock: Clock,
        open_frames: Callable[[], FrameSource],
        on_event: Callable[[Event], None] | None = None,
        feed: Feed | None = None,
        pipeline: str = VOID_PIPELINE,
    ) -> None:
        links = {"planner": "udpin:127.0.0.1:0", "autopilot": "udpin:127.0.0.1:0"}
        merged = {**tables, "link": {**links, **tables.get("link", {})}}
        try:
            config = Config.model_validate(merged)
        except ValidationError as error:
            first = error.errors()[0]
            raise ConfigError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
        self.events: list[Event] = []
        self._on_event = on_event
        self._news = asyncio.Event()
        self._service = Service(
            config,
            clock=clock,
            log=_event_log(config.log.level, self._take),
            open_frames=open_frames,
            feed=feed,
            pipeline=pipeline,
        )
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._task = asyncio.get_running_loop().create_task(self._service.run(), name="companion service")
        self._task.add_done_callback(lambda _: self._news.set())
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        try:
            await self.stop()
        except CompanionError:
            if exc_type is None:  # what is under way already says more
                raise

    @property
    def links(self) -> tuple[Endpoint, ...]:
        """The links of the service, the planner's side first."""
        return self._service.links

    def of(self, name: str) -> list[Event]:
        """Return its events of one name so far."""
        return [event for event in self.events if event.get("event") == name]

    async def wait_for(self, name: str, timeout_s: float = 20.0) -> Event:
        """Return the first event of this name, those that have come already included.

        Raises
        ------
        CompanionProcessError
            When it does not come in time, or the service ends before.
        """
        try:
            async with asyncio.timeout(timeout_s):
                while True:
                    if found := self.of(name):
                        return found[0]
                    if self._task is None or self._task.done():
                        await self.stop()
                        raise CompanionProcessError(f"the service ended without '{name}'")
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise CompanionProcessError(
                f"the service did not say '{name}' within {timeout_s:g} s{self._last_complaint()}"
            ) from None

    def _last_complaint(self) -> str:
        """Return the last thing that it warned of, to stand behind a message; empty where there was none."""
        for event in reversed(self.events):
            if event.get("level") in ("warning", "error"):
                said = ", ".join(
                    f"{key}: {value}"
                    for key, value in event.items()
                    if key not in ("event", "level", "traceback")
                )
                return f"; it said {event.get('event')}: {said}"[:_MOST_OF_A_COMPLAINT]
        return ""

    async def stop(self) -> None:
        """End the service.

        Raises
        ------
        companion.errors.CompanionError
            What ended it, where that was not this call.
        """
        task, self._task = self._task, None
        if task is None:
            return
        self._service.stop()
        try:
            await task
        except* CompanionError as group:
            raise first_of(group) from group

    def _take(self, event: Event) -> None:
        self.events.append(event)
        self._news.set()
        if self._on_event is not None:
            self._on_event(event)


def _event_log(level: str, take: Callable[[Event], None]) -> Log:
    """Return a logger that hands its events on instead of writing them."""

    def hand_on(_: WrappedLogger, method: str, event: EventDict) -> EventDict:
        take({**event, "level": method})
        raise structlog.DropEvent

    return cast(
        "Log",
        structlog.wrap_logger(
            None,
            processors=[structlog.processors.format_exc_info, hand_on],
            wrapper_class=structlog.make_filtering_bound_logger(level),
            context_class=dict,
        ).bind(),
    )
