"""Who says how a flight ended: reached, collided, stuck or timeout. No I/O, no clock."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

from companion.sim.vehicle import Vector3

Outcome = Literal["reached", "collided", "stuck", "timeout"]


@dataclass(frozen=True, slots=True)
class Rules:
    """When a flight ends.

    Attributes
    ----------
    arrive_radius_m
        This near to the goal: reached.
    stuck_s, stuck_radius_m
        Within a circle of this radius for this long: stuck. A turn on the spot takes less.
    time_limit_s
        After this long: timeout.
    """

    time_limit_s: float
    arrive_radius_m: float = 0.5
    stuck_s: float = 40.0
    stuck_radius_m: float = 0.5


class Referee:
    """Watches one flight.

    Parameters
    ----------
    goal_ned_m
        Where it is to go.
    rules
        When it ends.
    """

    def __init__(self, goal_ned_m: Vector3, rules: Rules) -> None:
        self._goal_ned_m = goal_ned_m
        self._rules = rules
        self._track: deque[tuple[float, Vector3]] = deque()

    def judge(self, time_s: float, position_ned_m: Vector3, clearance_m: float) -> Outcome | None:
        """Return the outcome, or None while the flight goes on.

        Parameters
        ----------
        time_s
            Since the flight began; calls come in order.
        position_ned_m
            Where the vehicle really is.
        clearance_m
            From its hull to the nearest thing; 0 and less touches it.
        """
        rules = self._rules
        if clearance_m <= 0.0:
            return "collided"
        if math.dist(position_ned_m, self._goal_ned_m) <= rules.arrive_radius_m:
            return "reached"
        if time_s >= rules.time_limit_s:
            return "timeout"
        self._track.append((time_s, position_ned_m))
        # The first place left is near to here and was near to every place since, so it has not been left.
        while math.dist(self._track[0][1], position_ned_m) > rules.stuck_radius_m:
            self._track.popleft()
        return "stuck" if time_s - self._track[0][0] >= rules.stuck_s else None
