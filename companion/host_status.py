"""What this computer says of itself: load, memory, temperature, disk (Linux: /proc and /sys).

What a machine does not tell is None: not every one has a thermometer.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_MIB: Final = 1 << 20
_SANE_DEG_C: Final = (-40.0, 150.0)
"""Zones of parts that are off tell anything."""


@dataclass(frozen=True, slots=True)
class HostStatus:
    """One look at the machine.

    Attributes
    ----------
    uptime_s
        Since it was started.
    cpu_load
        Share of the processors busy since the look before, 0 to 1; None at the first look.
    cpu_temperature_deg_c
        The warmest thermal zone.
    memory_used_mib, memory_total_mib
        What programs use, and all there is.
    disk_used_mib, disk_total_mib
        Of the file system that was asked about.
    """

    uptime_s: float | None
    cpu_load: float | None
    cpu_temperature_deg_c: float | None
    memory_used_mib: int | None
    memory_total_mib: int | None
    disk_used_mib: int | None
    disk_total_mib: int | None


class Host:
    """Looks at the machine; keeps what the load is counted from.

    Parameters
    ----------
    folder
        The disk is that which this folder is on.
    root
        Where ``proc`` and ``sys`` are.
    """

    def __init__(self, folder: Path, *, root: Path = Path("/")) -> None:
        self._folder = folder
        self._root = root
        self._busy_before: tuple[int, int] | None = None

    def look(self) -> HostStatus:
        """Return how the machine is now: some small reads, well under a millisecond."""
        used, total = memory_mib(_text(self._root / "proc/meminfo"))
        disk_used, disk_total = disk_mib(self._folder)
        return HostStatus(
            uptime_s=first_number(_text(self._root / "proc/uptime")),
            cpu_load=self._load(),
            cpu_temperature_deg_c=temperature_deg_c(self._root),
            memory_used_mib=used,
            memory_total_mib=total,
            disk_used_mib=disk_used,
            disk_total_mib=disk_total,
        )

    def _load(self) -> float | None:
        now = busy_and_all(_text(self._root / "proc/stat"))
        before, self._busy_before = self._busy_before, now
        if now is None or before is None or now[1] <= before[1]:
            return None
        return min(1.0, max(0.0, (now[0] - before[0]) / (now[1] - before[1])))


def busy_and_all(stat: str) -> tuple[int, int] | None:
    """Return busy and all ticks from /proc/stat's first line, or None where it is not one."""
    words = stat.partition("\n")[0].split()
    if len(words) < 6 or words[0] != "cpu" or not all(word.isdecimal() for word in words[1:]):
        return None
    ticks = [int(word) for word in words[1:9]]
    idle = ticks[3] + ticks[4]
    return sum(ticks) - idle, sum(ticks)


def memory_mib(meminfo: str) -> tuple[int | None, int | None]:
    """Return used and total memory from /proc/meminfo."""
    kib: dict[str, int] = {}
    for line in meminfo.splitlines():
        name, _, rest = line.partition(":")
        amount = rest.split()
        if amount and amount[0].isdecimal():
            kib[name] = int(amount[0])
    total, free = kib.get("MemTotal"), kib.get("MemAvailable")
    if total is None or free is None:
        return None, None
    return (total - free) // 1024, total // 1024


def temperature_deg_c(root: Path) -> float | None:
    """Return the warmest of the thermal zones, or None where there is none."""
    found = []
    for zone in sorted((root / "sys/class/thermal").glob("thermal_zone*")):
        millidegrees = first_number(_text(zone / "temp"))
        if millidegrees is not None and _SANE_DEG_C[0] < millidegrees / 1000 < _SANE_DEG_C[1]:
            found.append(millidegrees / 1000)
    return max(found, default=None)


def disk_mib(folder: Path) -> tuple[int | None, int | None]:
    """Return used and total space of the file system that a folder is on."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return None, None
    return (usage.total - usage.free) // _MIB, usage.total // _MIB


def cpu_count() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def first_number(text: str) -> float | None:
    """Return the number that a text begins with."""
    words = text.split()
    try:
        return float(words[0]) if words else None
    except ValueError:
        return None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:  # not on this machine, or a zone that is switched off
        return ""
