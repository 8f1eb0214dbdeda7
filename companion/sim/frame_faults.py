"""Frames that are lost or late on their way from the camera, the same for the same seed. No clock, no I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """What becomes of a camera's frames before anybody gets them.

    Attributes
    ----------
    drop_rate
        Share of frames that never come, in [0, 1].
    latency_s, jitter_s
        From exposure to hand-over: ``latency_s`` and up to ``jitter_s`` more, evenly spread.
    seed
        Same seed: the same fate of the same frame, whatever became of those before it.
    """

    drop_rate: float = 0.0
    latency_s: float = 0.0
    jitter_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.drop_rate <= 1.0:
            raise ValueError(f"drop_rate must be in [0, 1], got {self.drop_rate}")
        for name in ("latency_s", "jitter_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative, got {value}")
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")

    @property
    def longest_delay_s(self) -> float:
        """No frame is later than this."""
        return self.latency_s + self.jitter_s

    def delay_ns(self, frame: int) -> int | None:
        """Return how late a frame comes, by its number from 0; None where it never does."""
        lost, late = np.random.default_rng([self.seed, frame]).random(2)
        if lost < self.drop_rate:
            return None
        return round(1e9 * (self.latency_s + float(late) * self.jitter_s))
