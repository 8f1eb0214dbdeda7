"""The computer and our processes on it, looked at in a thread: a sensor on a slow bus must not hold up a setpoint."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from companion.clock import Clock
from companion.host_status import Host, first_number

_FRESH_NS: Final = 500_000_000
_SANE_DEG_C: Final = (-40.0, 150.0)
"""Zones of parts that are off tell anything."""
_MIB: Final = 1 << 20


class Machine:
    """Looks at the machine at most twice a second, however many ask.

    Parameters
    ----------
    folder
        The disk is that which this folder is on.
    clock
        Monotonic time.
    root
        Where ``proc`` and ``sys`` are.
    """

    def __init__(self, folder: Path, *, clock: Clock, root: Path = Path("/")) -> None:
        self._host = Host(folder, root=root)
        self._root = root
        self._clock = clock
        self._looking = asyncio.Lock()
        self._seen: dict[str, Any] = {}
        self._seen_ns: int | None = None

    async def look(self, processes: Mapping[str, int | None]) -> dict[str, Any]:
        """Return ``{"host": ..., "processes": ...}``; what the machine does not tell is None.

        Parameters
        ----------
        processes
            Our processes by name; None: not running.
        """
        async with self._looking:
            now_ns = self._clock.now_ns()
            if self._seen_ns is None or now_ns - self._seen_ns > _FRESH_NS:
                self._seen = await asyncio.to_thread(self._read, dict(processes))
                self._seen_ns = now_ns
            return self._seen

    def _read(self, processes: Mapping[str, int | None]) -> dict[str, Any]:
        host = self._host.look()
        return {
            "host": {
                "uptime_s": host.uptime_s,
                "cpu_load": host.cpu_load,
                "memory_used_mib": host.memory_used_mib,
                "memory_total_mib": host.memory_total_mib,
                "disk_used_mib": host.disk_used_mib,
                "disk_total_mib": host.disk_total_mib,
                "temperatures_deg_c": temperatures_deg_c(self._root),
            },
            "processes": {
                name: {"pid": pid, **process_use(pid, self._root)}
                for name, pid in processes.items()
                if pid is not None
            },
        }


def temperatures_deg_c(root: Path) -> dict[str, float]:
    """Return the temperature of each thermal zone by the name that the kernel gives it."""
    found: dict[str, float] = {}
    for zone in sorted((root / "sys/class/thermal").glob("thermal_zone*")):
        millidegrees = first_number(_text(zone / "temp"))
        if millidegrees is None or not _SANE_DEG_C[0] < millidegrees / 1000 < _SANE_DEG_C[1]:
            continue
        name = _text(zone / "type").strip() or zone.name
        found[zone.name if name in found else name] = round(millidegrees / 1000, 1)
    return found


def process_use(pid: int, root: Path = Path("/")) -> dict[str, float | None]:
    """Return resident memory and processor time of a process; None where it is gone."""
    rss_pages = cpu_ticks = None
    statm = _text(root / f"proc/{pid}/statm").split()
    if len(statm) > 1 and statm[1].isdecimal():
        rss_pages = int(statm[1])
    # The name in brackets may hold anything; user and system time are fields 14 and 15 (proc_pid_stat(5)).
    stat = _text(root / f"proc/{pid}/stat").rpartition(")")[2].split()
    if len(stat) > 12 and stat[11].isdecimal() and stat[12].isdecimal():
        cpu_ticks = int(stat[11]) + int(stat[12])
    return {
        "rss_mib": None if rss_pages is None else round(rss_pages * os.sysconf("SC_PAGE_SIZE") / _MIB, 1),
        "cpu_s": None if cpu_ticks is None else cpu_ticks / os.sysconf("SC_CLK_TCK"),
    }


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:  # not on this machine, a zone that is switched off, or a process that has ended
        return ""
