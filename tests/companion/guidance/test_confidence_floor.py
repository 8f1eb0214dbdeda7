"""Answers that are not sure enough are not flown by."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from companion.config import GuidanceConfig
from companion.guidance.observation import DetectionReport
from companion.guidance.substitution import State
from tests.fakes.flat_world import Flight, room, setpoint

HALL = room(20, 20)


@dataclass
class UnsureFlight(Flight):
    """Its detector says how sure it is."""

    confidence: float | None = 0.9

    def report(self) -> DetectionReport:
        return replace(super().report(), confidence=self.confidence)


def test_sure_answers_are_flown_by_as_those_of_a_method_that_does_not_say() -> None:
    flight = UnsureFlight(HALL)
    assert flight.fly(setpoint(6, 0), 60, until_m=0.5)


def test_below_the_floor_it_holds_and_says_why() -> None:
    flight = UnsureFlight(HALL)
    flight.fly(setpoint(8, 0), 5)
    assert flight.state is State.FOLLOW
    flight.confidence = 0.1
    flight.fly(setpoint(8, 0), 1.0)
    assert (flight.state, flight.switch.reason) == (State.HOLD, "low_confidence")
    held_at = (flight.n, flight.e)
    # It looks again from a little further on, and holds between.
    flight.fly(setpoint(8, 0), 8)
    assert set(flight.states()) & {"PROBE"}
    assert math.dist(held_at, (flight.n, flight.e)) < 3.0
    flight.confidence = 0.9
    assert flight.fly(setpoint(8, 0), 90, until_m=0.5), "it goes on when it is sure again"


def test_the_floor_is_the_users() -> None:
    flight = UnsureFlight(HALL, confidence=0.1, config=GuidanceConfig(min_confidence=0.0))
    assert flight.fly(setpoint(6, 0), 60, until_m=0.5)


def test_what_an_unsure_answer_saw_nearby_still_counts() -> None:
    flight = UnsureFlight([(3, -20, 3, 20)])
    flight.confidence = 0.1
    flight.fly(setpoint(8, 0), 30)
    assert flight.min_clearance > 0.3
