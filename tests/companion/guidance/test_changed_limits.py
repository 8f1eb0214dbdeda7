"""Limits that change in flight: the switch S then acts as one that was made with them."""

from __future__ import annotations

import math

import pytest

from companion.config import GuidanceConfig
from companion.guidance.setpoint import Forward, Rewrite
from companion.guidance.substitution import State, Switch
from tests.fakes.flat_world import SEC, Flight, room, setpoint, wish

OTHER = GuidanceConfig(
    max_step_m=0.7,
    step_margin_m=1.1,
    agree_deg=20.0,
    view_deg=18.0,
    align_deg=10.0,
    yaw_rate_deg_s=12.0,
    commit_distance_m=0.8,
    wall_k=1,
    wall_n=4,
    wall_limit_m=1.5,
    turn_step_deg=20.0,
    probe_step_m=0.3,
    arrive_radius_m=1.0,
    goal_settle_s=2.0,
    redetect_distance_m=0.6,
    detection_max_age_s=1.0,
    planner_timeout_s=2.0,
    give_up_s=15.0,
)


@pytest.mark.parametrize("goal", [(8.0, 0.0), (3.0, 6.0), (-5.0, 1.0)])
def test_a_flight_with_changed_limits_is_that_of_a_switch_made_with_them(goal):
    flown = []
    for made_with, changed_to in ((OTHER, None), (GuidanceConfig(), OTHER), (GuidanceConfig(), None)):
        flight = Flight(walls=room(5.0, 3.0), config=made_with)
        if changed_to is not None:
            flight.switch.set_limits(changed_to)
            flight.config = changed_to
        flight.fly(setpoint(*goal), 25.0)
        flown.append((flight.states(), round(flight.n, 9), round(flight.e, 9), round(flight.yaw, 9)))
    made, changed, before = flown
    assert changed == made
    assert changed != before


def test_state_and_memory_survive_a_change_in_flight():
    flight = Flight(walls=room(40.0, 40.0))
    flight.fly(setpoint(20, 0), 3.0)
    state, pose = flight.switch.state, flight.switch.pose
    assert state is not State.DISENGAGED
    flight.switch.set_limits(OTHER)
    assert (flight.switch.state, flight.switch.pose) == (state, pose)
    verdict = flight.step(setpoint(20, 0))
    assert isinstance(verdict, Rewrite)
    assert math.dist((verdict.x, verdict.y), (pose.north_m, pose.east_m)) <= OTHER.max_step_m + 0.15


def test_what_is_not_engaged_passes_and_says_so():
    switch = Switch(GuidanceConfig())
    switch.on_vehicle(armed=False, offboard=False, now_ns=SEC, off="off: by command")
    assert switch.reason == "disarmed"
    switch.on_vehicle(armed=True, offboard=True, now_ns=2 * SEC, off="off: by command")
    assert (switch.state, switch.reason) == (State.DISENGAGED, "off: by command")
    assert switch.on_setpoint(wish(setpoint(3, 0)), 2 * SEC) == Forward()
    switch.on_vehicle(armed=True, offboard=True, now_ns=3 * SEC)
    assert switch.on_setpoint(wish(setpoint(3, 0)), 3 * SEC) != Forward()
    switch.on_vehicle(armed=True, offboard=True, now_ns=4 * SEC, off="off: by command")
    assert (switch.state, switch.reason) == (State.DISENGAGED, "off: by command")
