"""Who sends setpoints: autopilots do not arbitrate, two sources at once leave the vehicle hanging between them (pure)."""

from __future__ import annotations

from collections import deque
from typing import Final

Source = tuple[int, int]
"""System and component id of a sender."""

_WINDOW_NS: Final = 2_000_000_000
_CHANGES: Final = 3
"""Changes of the sender within the window that are a fight; a handover is one, to and fro by a pilot two."""
_ANNOUNCE_EVERY_NS: Final = 5_000_000_000


class SetpointSources:
    """Notices that two senders fight over the vehicle, and says so at most every five seconds.

    Senders are told apart by their ids: two programs that use the same ones look like one.
    """

    def __init__(self) -> None:
        self._last: Source | None = None
        self._changes: deque[tuple[int, Source, Source]] = deque(maxlen=_CHANGES)
        self._announced_ns = -(1 << 62)

    def note(self, source: Source, now_ns: int) -> tuple[Source, ...]:
        """Take the sender of one setpoint; return the rivals, in order, where it is time to announce them."""
        last, self._last = self._last, source
        if last is None or last == source:
            return ()
        self._changes.append((now_ns, last, source))
        if len(self._changes) < _CHANGES or now_ns - self._changes[0][0] > _WINDOW_NS:
            return ()
        if now_ns - self._announced_ns < _ANNOUNCE_EVERY_NS:
            return ()
        self._announced_ns = now_ns
        return tuple(sorted({rival for _, before, after in self._changes for rival in (before, after)}))
