"""A bad link on demand: loss, delay and flipped bytes, the same for the same seed."""

from __future__ import annotations

import random
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """How bad the link is.

    Attributes
    ----------
    drop_rate, corrupt_rate, duplicate_rate
        Share of datagrams, in [0, 1]: not delivered; delivered with one byte changed; delivered twice.
    delay_s, jitter_s
        Delay of each datagram: ``delay_s`` and up to ``jitter_s`` more, evenly spread. Jitter reorders.
    seed
        Same seed and same traffic: same faults.
    """

    drop_rate: float = 0.0
    corrupt_rate: float = 0.0
    duplicate_rate: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("drop_rate", "corrupt_rate", "duplicate_rate"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {value}")
        for name in ("delay_s", "jitter_s"):
            value = getattr(self, name)
            if not 0.0 <= value < float("inf"):
                raise ValueError(f"{name} must be finite and not negative, got {value}")


class FaultyLink:
    """Applies ``LinkFaults`` to one direction of a link and counts what it did.

    Parameters
    ----------
    faults
        How bad; the default changes nothing.
    """

    def __init__(self, faults: LinkFaults | None = None) -> None:
        self.faults = faults if faults is not None else LinkFaults()
        self._random = random.Random(self.faults.seed)  # noqa: S311 - repeatable faults, not secrets
        self.dropped = 0
        self.corrupted = 0
        self.duplicated = 0

    def pass_on(self, datagram: bytes) -> list[tuple[float, bytes]]:
        """Return what arrives of one datagram: pairs of a delay in seconds and the bytes."""
        faults = self.faults
        if self._happens(faults.drop_rate):
            self.dropped += 1
            return []
        if self._happens(faults.corrupt_rate) and datagram:
            self.corrupted += 1
            place = self._random.randrange(len(datagram))
            changed = datagram[place] ^ self._random.randrange(1, 256)
            datagram = datagram[:place] + bytes([changed]) + datagram[place + 1 :]
        copies = 1
        if self._happens(faults.duplicate_rate):
            self.duplicated += 1
            copies = 2
        return [(self._delay_s(), datagram) for _ in range(copies)]

    def _happens(self, rate: float) -> bool:
        return rate > 0.0 and self._random.random() < rate

    def _delay_s(self) -> float:
        jitter_s = self.faults.jitter_s
        return self.faults.delay_s + (self._random.uniform(0.0, jitter_s) if jitter_s > 0.0 else 0.0)
