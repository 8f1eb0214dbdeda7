"""What settings are judged on: something that gives a score for each case, once for those searched on and once for those held out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from companion.tune.space import Settings

Part = Literal["searched", "held_out"]
PARTS: tuple[Part, Part] = ("searched", "held_out")


class Cases(Protocol):
    """Pairs of frames with truth, or flights."""

    def count(self, part: Part) -> int:
        """Return how many cases there are."""
        ...

    def scores(
        self, settings: Settings, part: Part, on_case: Callable[[], None] = ...
    ) -> NDArray[np.float64]:
        """Return what each case is worth with these settings, (N,), the larger the better, always in the same order.

        Raises
        ------
        companion.tune.errors.TrialError
            These settings cannot be judged.
        """
        ...

    def about(self) -> dict[str, Any]:
        """Return plain values that say what the cases are; other values: another search."""
        ...


def held_out_count(count: int, share: float) -> int:
    """Return how many of some cases are held out: the share, at least one where there are two and a share is asked for."""
    if share <= 0.0 or count < 2:
        return 0
    return min(count - 1, max(1, round(share * count)))
