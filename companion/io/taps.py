"""Where the feed listens in: at the links, and at the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from structlog.typing import EventDict, WrappedLogger

from companion.io.feed import Feed
from companion.mavlink.endpoint import FrameReceiver, Link, LinkCounters
from companion.mavlink.framing import RawFrame


class LatchedClock:
    """Monotonic time that stands still while one datagram is dealt with.

    What is decided on it then depends on the time that is recorded with it, and on no other: a replay decides the same.

    Parameters
    ----------
    now_ns
        The service's clock.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._latched_ns: int | None = None

    def now_ns(self) -> int:
        """Return the time, of the datagram where one is being dealt with."""
        return self._now_ns() if self._latched_ns is None else self._latched_ns

    def latch(self) -> int:
        """Let time stand still until `release`; return it."""
        self._latched_ns = None
        self._latched_ns = self._now_ns()
        return self._latched_ns

    def release(self) -> None:
        """Let time go on."""
        self._latched_ns = None


class TappedLink:
    """A link of the proxy whose frames are told to the feed, those that come in before they are dealt with.

    Parameters
    ----------
    link
        The link itself; its ``on_frames`` is taken over.
    number
        How the feed calls it.
    feed
        Is told.
    clock
        Stands still while what came in is dealt with.
    """

    def __init__(self, link: Link, number: int, feed: Feed, clock: LatchedClock) -> None:
        self.on_frames: FrameReceiver | None = None
        self._link = link
        self._number = number
        self._feed = feed
        self._clock = clock
        link.on_frames = self._received

    @property
    def counters(self) -> LinkCounters:
        """The link's."""
        return self._link.counters

    @counters.setter
    def counters(self, counters: LinkCounters) -> None:
        self._link.counters = counters

    def send(self, datagram: bytes) -> int:
        """Send whole frames to all peers and return how many took them. Never blocks, never raises."""
        taken = self._link.send(datagram)
        self._feed.mavlink(self._number, "out", datagram, self._clock.now_ns())
        return taken

    def _received(self, frames: list[RawFrame]) -> None:
        now_ns = self._clock.latch()
        try:
            if len(frames) == 1:
                self._feed.mavlink(self._number, "in", frames[0].data, now_ns)
            else:
                self._feed.mavlink(self._number, "in", b"".join(frame.data for frame in frames), now_ns)
            if self.on_frames is not None:
                self.on_frames(frames)
        finally:
            self._clock.release()


class LogTap:
    """Hands the events of a log to whoever listens; a processor of structlog that changes nothing."""

    def __init__(self) -> None:
        self.take: Callable[[Mapping[str, Any]], None] | None = None

    def __call__(self, logger: WrappedLogger, method: str, event: EventDict) -> EventDict:  # noqa: ARG002  structlog's signature
        """Return the event as it is."""
        if self.take is not None:
            self.take(event)
        return event
