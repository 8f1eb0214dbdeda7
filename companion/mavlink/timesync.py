"""TIMESYNC: what the autopilot's clock is against ours, and how long a message takes there and back (pure).

We ask with our time in ts1, the autopilot answers with its own in tc1 and ts1 as it was. PX4 and ArduPilot answer with
their time since boot. https://mavlink.io/en/services/timesync.html
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

_KEPT_NS: Final = 30_000_000_000
_LONGEST_ROUND_TRIP_NS: Final = 1_000_000_000
_MOST_ASKED: Final = 16
_REBOOT_NS: Final = 1_000_000_000
_DRIFT: Final = 200e-6
"""Greatest relative drift of two quartz clocks: what an older measurement is worse by."""


@dataclass(frozen=True, slots=True)
class ClockSync:
    """One measurement.

    Attributes
    ----------
    offset_ns
        Our time less the autopilot's time since boot; wrong by at most half of the round trip.
    round_trip_ns
        From question to answer.
    at_ns
        When the answer came, our time.
    """

    offset_ns: int
    round_trip_ns: int
    at_ns: int


class TimeSync:
    """Asks, and keeps the best of the last half minute: the one with the shortest round trip."""

    def __init__(self) -> None:
        self._asked: deque[int] = deque(maxlen=_MOST_ASKED)
        self._kept: deque[ClockSync] = deque()
        self._last_boot_ns: int | None = None
        self.refused = 0

    def ask(self, now_ns: int) -> int:
        """Return the ts1 of a question that is sent now."""
        self._asked.append(now_ns)
        return now_ns

    def is_ours(self, ts1: int) -> bool:
        """Whether an answer is to a question of ours."""
        return ts1 in self._asked

    def on_answer(self, tc1: int, ts1: int, now_ns: int) -> ClockSync | None:
        """Take an answer; return the best measurement, or None where this one is not used.

        A repeated answer, one to a question that was not asked or took longer than a second, is not.
        """
        round_trip_ns = now_ns - ts1
        if ts1 not in self._asked or tc1 <= 0 or not 0 <= round_trip_ns <= _LONGEST_ROUND_TRIP_NS:
            self.refused += 1
            return None
        self._asked.remove(ts1)
        if self._last_boot_ns is not None and tc1 < self._last_boot_ns - _REBOOT_NS:
            self._kept.clear()  # another boot, another clock
        self._last_boot_ns = tc1
        self._kept.append(ClockSync(ts1 + round_trip_ns // 2 - tc1, round_trip_ns, now_ns))
        return self.best(now_ns)

    def best(self, now_ns: int) -> ClockSync | None:
        """Return the best measurement of the last half minute; None where there is none."""
        while self._kept and now_ns - self._kept[0].at_ns > _KEPT_NS:
            self._kept.popleft()
        return min(
            self._kept,
            key=lambda sync: sync.round_trip_ns // 2 + int(_DRIFT * (now_ns - sync.at_ns)),
            default=None,
        )
