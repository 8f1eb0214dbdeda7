"""What a run has done so far: counts, rates and times, for the status line and the summary."""

from __future__ import annotations

import math
from array import array
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import Any

_RATE_WINDOW_S = 2.0
_KEPT_TIMES = 20_000


class RateMeter:
    """Achieved rate over the last two seconds."""

    def __init__(self) -> None:
        self._times_ns: deque[int] = deque()

    def tick(self, now_ns: int) -> None:
        """Count one event."""
        self._times_ns.append(now_ns)
        self._forget(now_ns)

    def rate_hz(self, now_ns: int) -> float:
        """Return events a second over the window that ends now."""
        self._forget(now_ns)
        return len(self._times_ns) / _RATE_WINDOW_S

    def _forget(self, now_ns: int) -> None:
        while self._times_ns and now_ns - self._times_ns[0] > _RATE_WINDOW_S * 1e9:
            self._times_ns.popleft()


class Newest:
    """The newest so many numbers, in memory that is taken at once: a service that runs for days must not grow by them.

    Parameters
    ----------
    capacity
        How many are kept.
    """

    def __init__(self, capacity: int) -> None:
        self._values = array("d", [0.0]) * capacity
        self._count = 0

    def append(self, value: float) -> None:
        """Add one, in place of the oldest where there is no room."""
        self._values[self._count % len(self._values)] = value
        self._count += 1

    def extend(self, values: Iterable[float]) -> None:
        """Add several."""
        for value in values:
            self.append(value)

    def __len__(self) -> int:
        return min(self._count, len(self._values))

    def __iter__(self) -> Iterator[float]:
        """Yield them in the order in which they came."""
        capacity = len(self._values)
        for number in range(self._count - len(self), self._count):
            yield self._values[number % capacity]


def percentile(values: Iterable[float], share: float) -> float | None:
    """Return the value below which ``share`` (0-1) of the values lie (nearest rank), or None of no values."""
    ordered = sorted(values)
    if not ordered:
        return None
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def percentiles(values: Iterable[float]) -> dict[str, float | None]:
    """Return ``{"p50": ..., "p95": ...}``, rounded to 0.1."""
    kept = list(values)
    found = {"p50": percentile(kept, 0.5), "p95": percentile(kept, 0.95)}
    return {name: None if value is None else round(value, 1) for name, value in found.items()}


class RunStatistics:
    """Counts and times of one run; the newest 20 000 times are kept."""

    def __init__(self) -> None:
        self.frames = RateMeter()
        self.reports = RateMeter()
        self.setpoints = RateMeter()
        self.frames_total = 0
        self.detections: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.detection_ms = Newest(_KEPT_TIMES)
        self.frame_to_setpoint_ms = Newest(_KEPT_TIMES)

    def summary(self) -> dict[str, Any]:
        """Return the totals of the run."""
        return {
            "frames": self.frames_total,
            "detections": dict(self.detections),
            "reasons": dict(self.reasons),
            "detection_ms": percentiles(self.detection_ms),
            "frame_to_setpoint_ms": percentiles(self.frame_to_setpoint_ms),
        }
