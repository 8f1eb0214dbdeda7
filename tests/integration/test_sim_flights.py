"""Flights in simulated time through the real service: closed loop, with its worker process and its sockets."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from companion.sim.flight import FlightSpec, fly, judged
from companion.sim.scene import empty_room, room_with_wall
from tests.fakes.ray_cast_place import ray_cast_place

ROOM = ray_cast_place("room", partial(empty_room, 14.0, 9.0, 3.0, behind_m=3.0), 4.0)
WALLED = ray_cast_place("walled", partial(room_with_wall, 12.0, 8.0, wall_north_m=4.5, gap_m=0.0), 8.0)


@pytest.mark.slow
def test_two_flights_with_the_same_seed_are_the_same_to_the_bit_answers_included():
    first, again = (fly(FlightSpec(), ROOM) for _ in range(2))
    assert first.record.equals(again.record)
    result = judged(FlightSpec(), ROOM, first)
    assert result.outcome == "reached"
    assert result.decisions == len(first.record.answer_kind) > 20
    # at the rate of the frames, each as old as the detector is said to take
    assert np.diff(first.record.answer_time_s) == pytest.approx(0.2)
    assert first.record.answer_time_s - first.record.answer_frame_time_s == pytest.approx(0.06, abs=0.006)
    assert result.max_setpoint_gap_s == pytest.approx(0.05, abs=0.001)


@pytest.mark.slow
def test_before_a_wall_the_service_turns_where_the_planner_alone_would_collide():
    spec = FlightSpec(time_limit_s=12.0)
    flown = fly(spec, WALLED)
    result = judged(spec, WALLED, flown)
    assert result.outcome == "timeout"
    assert result.collisions == 0
    assert result.min_clearance_m > 0.1
    assert result.states.get("TURN", 0.0) > 0.5
    assert result.free_ratio_median is not None
