"""A step ends where the vehicle's width was not looked through any further."""

from __future__ import annotations

import math

import pytest

from companion.guidance.observation import DetectionReport, Pose
from companion.guidance.setpoint import Rewrite
from companion.guidance.substitution import State
from companion.guidance.swept import SeenWays
from tests.companion.guidance.test_switch_rules import Bench
from tests.fakes.flat_world import setpoint

WAYS = 120


def pose(north: float = 0.0, east: float = 0.0) -> Pose:
    return Pose(0, north, east, -1.2, (1.0, 0.0, 0.0, 0.0))


def reaching(within_deg: dict[tuple[float, float], float], otherwise_m: float = 0.0) -> tuple[float, ...]:
    """Reach by azimuth: within each range of degrees what is given there."""
    reach = []
    for way in range(WAYS):
        azimuth = (way * 360.0 / WAYS + 180.0) % 360.0 - 180.0
        inside = [m for (low, high), m in within_deg.items() if low <= azimuth <= high]
        reach.append(inside[0] if inside else otherwise_m)
    return tuple(reach)


def ways(swept_m: tuple[float, ...]) -> SeenWays:
    found = SeenWays()
    found.add(DetectionReport(0, 0, "gap", pose=pose(), swept_m=swept_m))
    return found


def test_a_method_that_does_not_say_limits_nothing():
    assert SeenWays().reach_m(0.0, pose()) == math.inf
    found = SeenWays()
    found.add(DetectionReport(0, 0, "lowest_flow", pose=pose()))
    assert found.reach_m(0.0, pose()) == math.inf
    assert found.further(0.3, pose()) == 0.3


def test_the_least_of_what_the_vehicle_may_drift_into_counts():
    found = ways(reaching({(-15, 2): 2.0, (3, 180): 0.4}, 2.0))
    assert found.reach_m(math.radians(-9), pose()) == 2.0
    assert found.reach_m(0.0, pose()) == 0.4


def test_the_way_flown_since_is_taken_off_and_crumbs_are_nothing():
    found = ways(reaching({}, 1.0))
    assert found.reach_m(0.0, pose(north=0.4)) == pytest.approx(0.6)
    assert found.reach_m(math.pi, pose(north=0.4)) == pytest.approx(1.4)
    assert found.reach_m(0.0, pose(north=0.8)) == 0.0
    assert found.reach_m(0.0, pose(north=3.0)) == 0.0


def test_across_north_nothing_jumps():
    found = ways(reaching({(-30, 30): 1.5}))
    assert found.reach_m(math.radians(-1), pose()) == found.reach_m(math.radians(1), pose()) == 1.5
    assert found.reach_m(math.radians(359), pose()) == 1.5


def test_a_little_aside_is_taken_where_it_leads_clearly_further():
    found = ways(reaching({(6, 40): 2.0}))
    aside = math.degrees(found.further(0.0, pose()))
    assert 9.0 <= aside <= 21.0
    assert found.further(math.radians(20), pose()) == math.radians(20), "looked through far enough"
    assert found.further(math.radians(-90), pose()) == math.radians(-90), "nothing near it leads on"


def test_a_step_toward_the_goal_ends_where_nothing_was_looked_through():
    bench = Bench()
    bench.speed = 0.5
    ranges = {math.radians(a): 6.0 for a in range(-30, 31, 3)}
    bench.void(0.0, ranges, swept_m=reaching({}, 0.6))
    decision = bench.ask(setpoint(5.0, 0.0))
    assert isinstance(decision, Rewrite)
    assert math.hypot(decision.x, decision.y) == pytest.approx(0.6)
    bench.void(0.0, ranges, swept_m=reaching({}, 2.0))
    decision = bench.ask(setpoint(5.0, 0.0))
    assert isinstance(decision, Rewrite)
    assert math.hypot(decision.x, decision.y) == pytest.approx(1.5)


def test_at_rest_a_way_not_looked_through_is_held_for_and_then_stepped_back_from():
    bench = Bench()
    for north in range(-10, 1):  # it came from the south
        bench.n = north / 10.0
        bench.switch.on_pose(bench.pose(), 0.5)
    ranges = {math.radians(a): 6.0 for a in range(-30, 31, 3)}
    bench.void(0.0, ranges, swept_m=reaching({}, 0.1))
    decision = bench.ask(setpoint(5.0, 0.0))
    assert (bench.state, bench.switch.reason) == (State.HOLD, "way not looked through")
    assert isinstance(decision, Rewrite)
    assert math.hypot(decision.x, decision.y) == pytest.approx(0.0, abs=0.01)
    for _ in range(30):
        decision = bench.ask(setpoint(5.0, 0.0))
        if bench.state is State.PROBE:
            break
    assert bench.state is State.PROBE
    assert isinstance(decision, Rewrite)
    assert decision.x <= -0.35


def blind_step(bench: Bench) -> None:
    """Have no parallax until a step along the camera's axis is begun."""
    for _ in range(100):
        bench.report("none", reason="no_motion")
        bench.ask(setpoint(5.0, 0.0))
        if bench.state is State.PROBE:
            assert bench.switch._plan.probed == "camera axis"
            return
    raise AssertionError("no blind step was made")


def test_a_blind_step_that_a_glimpse_cut_short_is_made_again():
    bench = Bench()
    bench.switch.on_pose(bench.pose(), 0.0)
    blind_step(bench)
    bench.n = 0.02
    ranges = {math.radians(a): 6.0 for a in range(-30, 31, 3)}
    bench.void(0.0, ranges, swept_m=reaching({}, 0.6))
    bench.ask(setpoint(5.0, 0.0))
    assert bench.state is State.FOLLOW
    bench.void(0.0, ranges, swept_m=reaching({}, 0.1))
    bench.ask(setpoint(5.0, 0.0))
    assert (bench.state, bench.switch.reason) == (State.HOLD, "way not looked through")
    blind_step(bench)


def test_a_probe_goes_on_where_the_way_it_shows_was_not_looked_through():
    bench = Bench()
    bench.switch.on_pose(bench.pose(), 0.0)
    blind_step(bench)
    bench.n, bench.speed = 0.1, 0.3
    ranges = {math.radians(a): 6.0 for a in range(-30, 31, 3)}
    bench.void(0.0, ranges, swept_m=reaching({}, 0.1))
    bench.ask(setpoint(5.0, 0.0))
    assert bench.state is State.PROBE
    bench.void(0.0, ranges, swept_m=reaching({}, 1.0))
    bench.ask(setpoint(5.0, 0.0))
    assert bench.state is State.FOLLOW
