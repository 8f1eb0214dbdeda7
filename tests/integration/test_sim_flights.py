"""Flights in simulated time through the real service: closed loop, with its worker process and its sockets."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

from companion.sim.estimate_errors import EstimateErrors
from companion.sim.flight import FlightSpec, Method, fly, judged, place_of
from companion.sim.scene import room_with_wall
from tests.fakes.ray_cast_place import ray_cast_place

WALLED = ray_cast_place("walled", partial(room_with_wall, 12.0, 8.0, wall_north_m=4.5, gap_m=0.0), 8.0)


@pytest.mark.slow
def test_two_flights_with_the_same_seed_are_the_same_to_the_bit_answers_included():
    spec = FlightSpec(
        world="corridor",
        seed=7,
        time_limit_s=5.0,
        estimate=EstimateErrors(
            position_drift_m_per_sqrt_s=0.02, position_noise_m=0.02, heading_noise_deg=1.0
        ),
    )
    place = place_of(spec)
    first, again = (fly(spec, place) for _ in range(2))
    assert first.record.equals(again.record)
    assert first.frame_to_setpoint_ms == again.frame_to_setpoint_ms
    other = fly(dataclasses.replace(spec, seed=8), place)
    assert not first.record.equals(other.record)
    # Answers come at the rate of the frames, each as old as the detector is said to take.
    record = first.record
    assert len(record.answer_kind) >= 20
    assert np.diff(record.answer_time_s) == pytest.approx(0.2)
    assert record.answer_time_s - record.answer_frame_time_s == pytest.approx(0.06, abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["corridor", "room", "door", "deadend"])
def test_the_service_flies_in_the_rendered_worlds(world: str):
    spec = FlightSpec(world=world, time_limit_s=4.5)
    place = place_of(spec)
    flown = fly(spec, place)
    result = judged(spec, place, flown)
    assert (result.outcome, result.collisions) == ("timeout", 0)
    assert result.decisions == pytest.approx(5 * result.time_s, abs=1)
    assert result.max_setpoint_gap_s < 0.11
    assert sum(result.states.values()) == pytest.approx(result.time_s, abs=0.1)
    planned, sent = flown.record.planned_ned_m, flown.record.sent_ned_m
    assert (np.linalg.norm(sent - planned, axis=1) > 1.0).any(), "the service is in the way"
    # z is the planner's, bit for bit, whatever the service did with the rest
    assert set(sent[:, 2].tolist()) == {float(np.float32(place.goal_ned_m[2]))}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["paper", "parallax"])
def test_a_doorway_that_is_not_on_the_straight_line_is_flown_through(method: Method):
    spec = FlightSpec(world="door", seed=2, method=method, time_limit_s=30.0)
    place = place_of(spec)
    result = judged(spec, place, fly(spec, place))
    assert result.collisions == 0
    assert result.goal_distance_m < 4.0, "the wall with the door is 4.5 m before the goal"
    assert result.free_ratio_median is not None


@pytest.mark.slow
def test_the_same_flight_in_real_time_has_the_service_the_camera_and_the_vehicle_in_processes():
    spec = FlightSpec(world="corridor", time_limit_s=4.0, realtime=True)
    place = place_of(spec)
    flown = fly(spec, place)
    result = judged(spec, place, flown)
    assert (result.outcome, result.collisions) == ("timeout", 0)
    assert result.decisions > 0
    assert result.states
    assert len(flown.record.setpoint_time_s) > 40


@pytest.mark.slow
def test_before_a_wall_the_service_turns_where_the_planner_alone_would_collide():
    spec = FlightSpec(time_limit_s=6.0)
    result = judged(spec, WALLED, fly(spec, WALLED))
    assert (result.outcome, result.collisions) == ("timeout", 0)
    assert result.min_clearance_m > 0.1
    assert result.states.get("TURN", 0.0) > 0.5
    assert fly(dataclasses.replace(spec, method="off"), WALLED).outcome == "collided"
