"""The one place where time comes from. Everything else is given ``now_ns``."""

from __future__ import annotations

import asyncio
import time
from typing import Literal, Protocol

Work = Literal["start", "frame"]
"""What another process can be busy with for us: starting, or looking at a frame."""


class Clock(Protocol):
    """Monotonic time and waiting, injected by the service.

    A simulator gives its own, which steps time when every loop is idle (``companion.sim.lockstep``).
    """

    def now_ns(self) -> int:
        """Return monotonic time in ns, comparable across the processes of one machine."""
        ...

    async def sleep_until_ns(self, when_ns: int) -> None:
        """Return at or after ``when_ns``; at once when that has passed."""
        ...

    def answer_owed(self, fd: int, work: Work) -> None:
        """Hear that another process has been given work, and that its answer makes ``fd`` readable.

        Simulated time passes no further than the work is said to take, however long it really takes.
        """
        ...


class RealClock:
    """CLOCK_MONOTONIC of this machine."""

    def now_ns(self) -> int:
        """Return monotonic time in ns."""
        return time.monotonic_ns()

    async def sleep_until_ns(self, when_ns: int) -> None:
        """Sleep on the event loop until ``when_ns``."""
        await asyncio.sleep(max(0, when_ns - time.monotonic_ns()) / 1e9)

    def answer_owed(self, fd: int, work: Work) -> None:
        """Do nothing: real time waits for nobody."""
