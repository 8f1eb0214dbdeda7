"""Lockstep: an event loop whose time is simulated, so that a flight repeats bit for bit, as fast as the machine.

Everything that takes part lives on one loop: autopilot, planner, camera and the service itself, over real sockets
and with a real worker process. Simulated time stands still while anything happens, and steps to the next timer when

- no callback is ready and no socket has anything to read,
- every datagram that was sent has been received (`LockstepLoop.count_datagrams`), and
- no other process owes an answer that is due (`companion.clock.Clock.answer_owed`).

An answer is due when the work has taken the time that it is said to take. One that is early stays unread until
then; for one that is late simulated time waits, so that its moment does not depend on the machine. Limits that are
counted in simulated time, the worker's deadline among them, therefore pass only as they would with such a worker.
A real limit takes their place: an answer that does not come within `patience_s` ends the simulation.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import Executor
from typing import Any, Final, TypeVar, TypeVarTuple

from companion.clock import Work
from companion.errors import CompanionError

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

_START_NS: Final = 1_000_000_000_000
"""Any time but 0: what mistakes a time for a duration shows."""
_PROBE_S: Final = 1.0


class LockstepError(CompanionError):
    """Simulated time cannot go on: something that was waited for did not come."""


class LockstepClock:
    """Simulated time; implements ``companion.clock.Clock`` for everything on one `LockstepLoop`.

    Parameters
    ----------
    frame_s
        Simulated seconds that the worker takes for a frame. It starts in none.
    """

    def __init__(self, frame_s: float) -> None:
        self._now_ns = _START_NS
        self._takes_ns: dict[Work, int] = {"start": 0, "frame": round(1e9 * frame_s)}
        self._due_ns: dict[int, int] = {}

    def now_ns(self) -> int:
        """Return simulated time in ns."""
        return self._now_ns

    async def sleep_until_ns(self, when_ns: int) -> None:
        """Return when simulated time has come to ``when_ns``."""
        loop = asyncio.get_running_loop()
        woken: asyncio.Future[None] = loop.create_future()
        timer = loop.call_at(when_ns / 1e9, _wake, woken)
        try:
            await woken
        finally:
            timer.cancel()

    def answer_owed(self, fd: int, work: Work) -> None:
        """Let simulated time pass no further than the work takes before ``fd`` has been read."""
        self._due_ns[fd] = self._now_ns + self._takes_ns[work]


def _wake(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


class _Selector(selectors.BaseSelector):
    """Steps the clock where another selector would wait; tells readiness in the order of registration."""

    def __init__(self, clock: LockstepClock, patience_s: float) -> None:
        self._real = selectors.DefaultSelector()
        self._clock = clock
        self._patience_s = patience_s
        self._order: dict[int, int] = {}
        self._registered = 0
        self.datagrams_on_the_way: Callable[[], int] | None = None
        self.failed = False

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        key = self._real.register(fileobj, events, data)
        self._registered += 1
        self._order[key.fd] = self._registered
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        key = self._real.unregister(fileobj)
        del self._order[key.fd]
        self._clock._due_ns.pop(key.fd, None)
        return key

    def modify(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        return self._real.modify(fileobj, events, data)

    def get_map(self) -> Mapping[Any, selectors.SelectorKey]:
        return self._real.get_map()

    def close(self) -> None:
        self._real.close()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready now; where nothing is, step time by ``timeout`` or to the next answer that is due."""
        if ready := self._ready_within(0.0):
            return ready
        if timeout is not None and timeout <= 0.0:
            return []
        if ready := self._wait_for_datagrams():
            return ready
        clock = self._clock
        wake_ns = None if timeout is None else clock._now_ns + max(1, round(1e9 * timeout))
        due_ns = min(clock._due_ns.values(), default=None)
        if due_ns is not None and (wake_ns is None or due_ns <= wake_ns):
            clock._now_ns = max(clock._now_ns, due_ns)
            return self._ready_soon("no answer from the process that was given work")
        if wake_ns is None:
            return self._ready_soon("nothing is left that could happen")
        clock._now_ns = wake_ns
        return []

    def _ready_within(self, real_s: float) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready, answers that are not due yet left out; wait for it in real time."""
        found = [
            event
            for event in self._real.select(real_s)
            if self._clock._due_ns.get(event[0].fd, 0) <= self._clock._now_ns
        ]
        found.sort(key=lambda event: self._order[event[0].fd])
        for key, _ in found:
            self._clock._due_ns.pop(key.fd, None)
        return found

    def _wait_for_datagrams(self) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for datagrams that were sent and have not come out on the other side; loopback loses none."""
        count = self.datagrams_on_the_way
        if count is None or count() == 0:
            return []
        return self._ready_soon(f"{count()} datagrams were sent and not received")

    def _ready_soon(self, otherwise: str) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait in real time until something is ready.

        Raises
        ------
        LockstepError
            When that takes longer than the patience.
        """
        end_s = time.monotonic() + self._patience_s
        while True:
            ready = self._ready_within(_PROBE_S)
            if (
                ready or self.failed
            ):  # having failed, what is left is to clean up, without waiting for anybody
                return ready
            if time.monotonic() > end_s:
                self.failed = True
                self._clock._due_ns.clear()
                self.datagrams_on_the_way = None
                raise LockstepError(f"the simulation stands still: {otherwise} for {self._patience_s:g} s")


class LockstepLoop(asyncio.SelectorEventLoop):
    """An event loop on simulated time.

    Parameters
    ----------
    frame_s
        Simulated seconds from handing the worker a frame to its answer.
    patience_s
        Real seconds that an answer is waited for.
    """

    def __init__(self, *, frame_s: float = 0.06, patience_s: float = 120.0) -> None:
        self.clock = LockstepClock(frame_s)
        self._lockstep = _Selector(self.clock, patience_s)
        super().__init__(self._lockstep)

    def time(self) -> float:
        """Return simulated time in s."""
        return self.clock.now_ns() / 1e9

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[*Ts], T], *args: *Ts
    ) -> asyncio.Future[T]:
        """Call ``func`` in the executor's thread, here where there is none, and wait for it.

        Simulated time would stand still meanwhile, so the loop may as well: nothing then depends on when the thread
        is done.
        """
        future: asyncio.Future[T] = self.create_future()
        try:
            result = func(*args) if executor is None else executor.submit(func, *args).result()
        except Exception as error:  # noqa: BLE001  as a thread would: it is the future's, whatever it is
            future.set_exception(error)
        else:
            future.set_result(result)
        return future

    def count_datagrams(self, on_the_way: Callable[[], int] | None) -> None:
        """Give what tells how many datagrams were sent and not received; None: they are not counted any more."""
        self._lockstep.datagrams_on_the_way = on_the_way


def run_lockstep(
    main: Callable[[LockstepLoop], Coroutine[Any, Any, T]],
    *,
    frame_s: float = 0.06,
    patience_s: float = 120.0,
) -> T:
    """Run a coroutine to its end on a `LockstepLoop` of its own.

    Parameters
    ----------
    main
        Makes the coroutine, given the loop.
    frame_s, patience_s
        As of `LockstepLoop`.

    Raises
    ------
    LockstepError
        When simulated time cannot go on.
    """
    loop = LockstepLoop(frame_s=frame_s, patience_s=patience_s)
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(main(loop))
