"""Cases that cost nothing, with a known best; run as a program it searches in a shared storage."""

from __future__ import annotations

import sys

import numpy as np

from companion.tune import study
from companion.tune.errors import TrialError
from companion.tune.space import dimensions, usual_params

SPACE = dimensions(
    ("round_trip_px", "cauchy_px", "plane_share"),
    usual_params("parallax", "default"),
    spread=4.0,
    with_tables=False,
)
USUAL = {each.name: each.usual for each in SPACE}
BEST_ROUND_TRIP_PX = 1.4


class Toy:
    """The nearer round_trip_px is to the best, the better; cauchy_px hardly matters; high plane_share cannot be judged."""

    def __init__(self, held_out_gain=1.0, refuse_above=2.0, interrupt_at=None):
        self.held_out_gain, self.refuse_above = held_out_gain, refuse_above
        self.interrupt_at = interrupt_at
        self.judged = 0

    def count(self, part):
        return 20

    def scores(self, settings, part, on_case=lambda: None):
        self.judged += 1
        if self.judged == self.interrupt_at:
            raise KeyboardInterrupt
        if settings["plane_share"] > self.refuse_above:
            raise TrialError("plane_share: too much of it")
        worth = (
            1.0 - abs(np.log(settings["round_trip_px"] / BEST_ROUND_TRIP_PX)) + 1e-4 * settings["cauchy_px"]
        )
        gain = self.held_out_gain if part == "held_out" else 1.0
        return np.clip(0.3 + gain * 0.5 * worth + np.linspace(-0.05, 0.05, 20), -1.0, 2.0)

    def about(self):
        return {"toy": True}


def main() -> None:
    storage, trials = sys.argv[1:]
    begun = study.open_study(study.open_storage(storage), "shared", SPACE, Toy().about(), None)
    own = []
    study.search(begun, SPACE, Toy(), int(trials), on_trial=own.append)
    sys.stdout.write(str(len(own)))


if __name__ == "__main__":
    main()
