"""Messages that wait, bounded by kind: the newest win, what is dropped is counted.

No lock: adding is safe from any thread (a ``deque`` and a counter are), taking is for one.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from typing import Final, Generic, TypeVar

from companion.io.messages import Kind

T = TypeVar("T")

LIMITS: Final[Mapping[Kind, int]] = {
    Kind.FRAME: 6,
    Kind.POSE: 500,
    Kind.SETPOINT: 500,
    Kind.DETECTION: 100,
    Kind.DETAILS: 2,
    Kind.STATE: 500,
    Kind.STATUS: 4,
    Kind.LINK: 200,
    Kind.LOG: 1000,
    Kind.MAVLINK: 4000,
    Kind.LOOP: 500,
    Kind.CONFIG: 20,
    Kind.CONTROL: 50,
    Kind.ANSWER: 50,
    Kind.RING: 4,
}
"""Messages of a kind that may wait. A frame that waits longer than the ring is deep is gone anyway."""


class KindQueues(Generic[T]):
    """One bounded queue for each kind.

    Parameters
    ----------
    limits
        Messages of each kind that may wait.
    """

    def __init__(self, limits: Mapping[Kind, int] = LIMITS) -> None:
        self._queues: dict[Kind, deque[tuple[int, T]]] = {
            kind: deque(maxlen=limit) for kind, limit in limits.items()
        }
        self.dropped: Counter[Kind] = Counter()
        """What was dropped so far, by kind."""

    def put(self, kind: Kind, order: int, item: T) -> None:
        """Add an item; where its kind is full, the oldest of that kind is dropped."""
        waiting = self._queues[kind]
        if len(waiting) == waiting.maxlen:
            self.dropped[kind] += 1
        waiting.append((order, item))

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def clear(self) -> None:
        """Forget what waits."""
        for waiting in self._queues.values():
            waiting.clear()

    def take_all(self) -> Iterator[T]:
        """Take what waits now, in its order. What is not iterated over is gone."""
        taken: list[tuple[int, T]] = []
        for waiting in self._queues.values():
            for _ in range(len(waiting)):
                try:
                    taken.append(waiting.popleft())
                except IndexError:  # dropped meanwhile by another thread's newer one
                    break
        taken.sort(key=lambda entry: entry[0])
        return (item for _, item in taken)
