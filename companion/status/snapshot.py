"""The status of the service at one moment, as the socket and the metrics give it out."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from importlib.metadata import version
from typing import Any, Final

from companion.clock import Clock
from companion.interception import Interception
from companion.log import Log
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.proxy import InlineProxy
from companion.own import Own
from companion.status.machine import Machine
from companion.vision.supervisor import VisionSupervisor

_PACKAGE: Final = "void-companion"

Section = Callable[[int], Mapping[str, Any]]
"""Returns what a part of the service says of itself at a time (ns), at once."""


class Snapshots:
    """Makes snapshots of the running service.

    Parameters
    ----------
    flight, own, proxy, vision, links
        What is told of.
    source
        Returns what frames come from, what is wrong with that (None: nothing), and when the newest came (ns).
    machine
        The computer.
    processes
        Returns the pids of the processes that the service has started, by name; None: not running.
    sections
        Further parts by name, such as a recorder; may grow while the service runs.
    clock
        Monotonic time.
    log
        Takes ``status_section_failed``, once for each part whose status cannot be had.
    """

    def __init__(
        self,
        *,
        flight: Interception,
        own: Own,
        proxy: InlineProxy,
        vision: VisionSupervisor,
        links: Sequence[Endpoint],
        source: Callable[[], tuple[str, str | None, int | None]],
        machine: Machine,
        processes: Callable[[], Mapping[str, int | None]],
        sections: MutableMapping[str, Section],
        clock: Clock,
        log: Log,
    ) -> None:
        self._flight = flight
        self._own = own
        self._proxy = proxy
        self._vision = vision
        self._links = links
        self._source = source
        self._machine = machine
        self._processes = processes
        self._sections = sections
        self._clock = clock
        self._log = log
        self._version = version(_PACKAGE)
        self._started_ns = clock.now_ns()
        self._failed: set[str] = set()

    async def take(self) -> dict[str, Any]:
        """Return the status of now; plain values by stable names, ages in ms."""
        machine = await self._machine.look({"service": os.getpid(), **self._processes()})
        now_ns = self._clock.now_ns()
        worker = self._vision.status
        url, fault, newest_ns = self._source()
        statistics = self._flight.statistics
        return {
            "version": self._version,
            "pid": os.getpid(),
            "uptime_s": round((now_ns - self._started_ns) / 1e9, 1),
            **self._flight.status(now_ns),
            **self._own.status(now_ns),
            "armed": self._flight.armed,
            "autopilot_age_ms": self._flight.autopilot_age_ms(now_ns),
            "source": {"url": url, "fault": fault, "frame_age_ms": _age_ms(newest_ns, now_ns)},
            "worker": {
                "state": worker.state,
                "pid": worker.pid,
                "restarts": worker.restarts,
                "report_age_ms": _age_ms(worker.last_report_ns, now_ns),
                "frames_replaced": worker.frames_replaced,
                "frames_refused": worker.frames_refused,
                "last_error": worker.last_error,
            },
            "links": {link.name: link.status() for link in self._links},
            "counts": {
                "frames": statistics.frames_total,
                "detections": dict(statistics.detections),
                "reasons": dict(statistics.reasons),
                **self._proxy.counters.as_dict(),
            },
            **machine,
            **self._further(now_ns),
        }

    def _further(self, now_ns: int) -> dict[str, Any]:
        """Return what the other parts say; one that fails is left out, and the rest is told all the same."""
        found: dict[str, Any] = {}
        for name, section in self._sections.items():
            try:
                found[name] = dict(section(now_ns))
            except Exception:  # noqa: BLE001  what is wrong with one part must not hide the others
                if name not in self._failed:
                    self._failed.add(name)
                    self._log.exception("status_section_failed", section=name)
        return found


def _age_ms(then_ns: int | None, now_ns: int) -> int | None:
    return None if then_ns is None else round((now_ns - then_ns) / 1e6)
