"""The interface of a sink: what runs in the I/O process and takes what the flight publishes.

How to add one
--------------
Write a class with the four methods of `Sink` and a factory ``build(config, desk) -> Sink``, and name the factory
(``package.module:function``) in ``companion.io.sinks``. It then runs in the I/O process, on a thread of its own:

- `Sink.start` is called first. Say there, or at any later time and from any thread, what you want to be told:
  ``desk.want(Wants(frozenset({Kind.FRAME, Kind.POSE}), frames_hz=15.0))``. Nothing is published for nobody: where no sink
  wants a kind, it costs the flight nothing. Want less while nobody looks.
- `Sink.take` is called with each message, in order. It may take its time: what waits meanwhile is bounded by kind, and the
  oldest of a kind make room (``desk.dropped`` counts them). The flight never waits, and neither do other sinks.
- `Sink.idle` is called about once a second while nothing comes.
- `Sink.stop` is called once at the end; the process is killed a second and a half after the service has asked it to end.

A sink that serves a network runs its event loop on another thread of its own, and ``take`` hands over by
``loop.call_soon_threadsafe``.

The way back is ``desk.ask(name, fields)``, which returns a ``concurrent.futures.Future`` of an `Answer`
(``await asyncio.wrap_future(...)`` in a coroutine). ``desk.log`` writes to the service's log.

===============  ==============================================================================================
request          what it does
===============  ==============================================================================================
apply_settings   ``{"values": {"guidance.agree_deg": 12.0, ...}}``: takes them in flight as a reload would
                 (``companion.reload``); all or none. The answer's fields: ``at_once`` and ``new_worker`` (what was taken),
                 ``refused`` (reason by key: needs a restart; then nothing is taken)
record           ``{"on": true}``: begins or ends a recording, where there is a recorder
===============  ==============================================================================================

What is published (times in ns of the service's monotonic clock; ``time_ns`` is when it was true)

===========  ==================================================================================================
kind         fields
===========  ==================================================================================================
FRAME        ``seq``, ``time_of``, ``height_px``, ``width_px``, ``taken_ns``; ``message.image`` is (H, W) uint8,
             ``time_ns`` the exposure
POSE         ``north_m``, ``east_m``, ``down_m``, ``q_ned_from_body`` (w, x, y, z), ``speed_m_s``
SETPOINT     ``planner`` ("system/component"), ``state``, ``goal_ned`` and ``decided_ned`` (north and east in local NED of what
             was asked for and of what the switch S made of it; null where there is none), and ``companion.log_fields.verdict_fields``: ``planned``,
             ``action`` (forwarded, substituted, held, turned, dropped, unprotected), ``sent``, ``yaw_deg``
DETECTION    the fields of ``guidance.observation.DetectionReport``; ``time_ns`` is when it came
DETAILS      ``frame_seq``, ``frame_ns``, ``method``, and ``message.arrays()`` as ``companion.vision.details`` lists them
STATE        ``previous``, ``state``, ``reason`` of the switch S; sent again to who begins to listen
STATUS       twice a second: the fields of the status line (state, reason, rates, ages, pose, links, worker)
LINK         ``link``, ``url``, ``state``; sent again to who begins to listen
LOG          ``event``, ``level``, ``time`` and what else the line holds
MAVLINK      ``link`` (number, the planner's links first), ``direction`` ("in", "out"); ``message.data`` is one or
             several whole frames
LOOP         ``name`` and what it found: the health and component loops, on which decisions depend
CONFIG       ``active``: the configuration that acts, by table; ``set``: what of it is not a default; sent again to who
             begins to listen
CONTROL      ``name`` and more: what sinks are told to do; always sent
===========  ==================================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Protocol

from companion.config import Config
from companion.io.messages import Answer, Kind, Message, Wants

__all__ = ["Answer", "Desk", "Kind", "Message", "Sink", "SinkFactory", "SinkLog", "Wants"]


class SinkLog(Protocol):
    """Writes to the service's log; callable from any thread, never blocks for long."""

    def info(self, event: str, **fields: Any) -> None:
        """Write a line; ``event`` is a stable snake_case name."""
        ...

    def warning(self, event: str, **fields: Any) -> None:
        """Write a warning."""
        ...

    def error(self, event: str, **fields: Any) -> None:
        """Write an error."""
        ...


class Desk(Protocol):
    """What a sink is given: its voice towards the service."""

    @property
    def log(self) -> SinkLog:
        """The service's log."""
        ...

    @property
    def dropped(self) -> Mapping[Kind, int]:
        """Messages that this sink was too slow for, by kind."""
        ...

    def want(self, wants: Wants) -> None:
        """Say what to be told from now on; callable from any thread."""
        ...

    def ask(self, name: str, fields: Mapping[str, Any]) -> Future[Answer]:
        """Ask the service for something; callable from any thread.

        The answer is always given: where the service is gone, it is a refusal.
        """
        ...


class Sink(Protocol):
    """Takes what the flight publishes; all methods are called on one thread, the sink's own.

    An exception is logged and ends this sink, not the others.
    """

    def start(self) -> None:
        """Begin."""
        ...

    def take(self, message: Message) -> None:
        """Take one message."""
        ...

    def idle(self) -> None:
        """Do what is due by time; called about once a second while nothing comes."""
        ...

    def stop(self) -> None:
        """End: close files and sockets within a second."""
        ...


SinkFactory = Callable[[Config, Desk], Sink]
"""Builds a sink; raises ``companion.errors.ConfigError`` where the configuration cannot be used."""
