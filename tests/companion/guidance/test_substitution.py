"""The switch S, scenario by scenario, and its properties under random events."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import GuidanceConfig
from companion.guidance.coordinates import wrap_rad
from companion.guidance.observation import DetectionReport
from companion.guidance.setpoint import Drop, Forward, Rewrite
from companion.guidance.substitution import State
from tests.fakes.flat_world import SEC, Flight, room, sent_xy, setpoint, wish

HALL = room(40.0, 40.0)


def test_an_open_hall_is_crossed_to_the_goal():
    flight = Flight(HALL)
    assert flight.fly(setpoint(6, 0), 40, until_m=0.3)
    assert "TURN" not in flight.states()


def test_a_goal_to_the_side_is_looked_at_before_it_is_flown_to():
    flight = Flight(HALL)
    reached = flight.fly(setpoint(0.5, -6), 60, until_m=0.3)
    assert reached
    assert "ALIGN" in flight.states()
    # it flew with the camera towards the goal
    assert abs(wrap_rad(flight.yaw + math.pi / 2)) < math.radians(35)


def test_flying_backwards_is_turned_into_flying_forwards():
    flight = Flight(HALL)
    assert flight.fly(setpoint(-5, 0, yaw=0.0), 60, until_m=0.4)
    assert abs(wrap_rad(flight.yaw - math.pi)) < math.radians(35)


def test_take_off_inside_offboard_keeps_climbing_whatever_the_camera_says():
    flight = Flight(HALL, d=0.0)
    for _ in range(60):
        verdict = flight.step(setpoint(0, 0, -1.2))
        assert not isinstance(verdict, Drop)
    assert flight.d == pytest.approx(-1.2, abs=0.05)
    assert math.hypot(flight.n, flight.e) < 0.3


def test_a_minute_of_hover_at_the_goal_stays_there_and_forwards():
    flight = Flight(HALL)
    assert flight.fly(setpoint(4, 0), 40, until_m=0.2)
    flight.fly(setpoint(4, 0), 60)
    assert math.dist((flight.n, flight.e), (4, 0)) < 0.3
    assert flight.state is State.FOLLOW
    assert isinstance(flight.verdicts[-1][1], Forward)


def test_pure_yaw_at_the_goal_reaches_the_commanded_heading_at_the_capped_rate():
    flight = Flight(HALL)
    flight.fly(setpoint(0, 0, yaw=0.0), 3)
    before = flight.now
    while abs(wrap_rad(flight.yaw - 2.5)) > 0.05:
        flight.step(setpoint(0, 0, yaw=2.5))
        assert flight.now - before < 10 * SEC
    cap = math.radians(flight.config.yaw_rate_deg_s)
    assert (flight.now - before) / SEC >= 0.9 * (2.5 - 0.05) / cap


def test_a_wall_across_the_way_turns_the_vehicle_and_it_never_touches():
    flight = Flight([(5, -20, 5, 20)])
    flight.fly(setpoint(10, 0), 40)
    assert "TURN" in flight.states()
    assert flight.min_clearance > 0.3


def test_a_door_two_metres_to_the_side_is_found():
    walls = [*room(16, 10), (4, -5, 4, 1.2), (4, 3.2, 4, 5)]
    flight = Flight(walls, n=-4.0)
    reached = flight.fly(setpoint(6.5, 0), 240, until_m=0.7)
    assert flight.min_clearance > 0.25
    assert reached, flight.states()[-20:]


def test_a_dead_end_is_never_hit_and_ends_in_an_announced_hold():
    walls = [(-6, -1, 4, -1), (-6, 1, 4, 1), (4, -1, 4, 1), (-6, -1, -6, 1)]
    flight = Flight(walls, n=-3.0)
    flight.fly(setpoint(10, 0), 400)
    assert "TURN" in flight.states()
    assert flight.min_clearance > 0.25
    progress = [c for c in flight.changes if c.time_ns > flight.now - 100 * SEC]
    assert progress or flight.gave_up


def test_far_wall_of_an_open_hall_is_not_a_wall_yet():
    flight = Flight(room(60, 60))
    flight.fly(setpoint(10, 0), 8)
    assert "TURN" not in flight.states()
    assert flight.n > 2


def test_a_dead_worker_one_metre_from_a_wall_holds_at_once():
    flight = Flight([(6, -20, 6, 20)])
    flight.fly(setpoint(4.5, 0), 15, until_m=1.0)
    flight.switch.set_fault("worker", "vision worker restarting", flight.now)
    held_at = None
    for _ in range(200):
        verdict = flight.step(setpoint(4.5, 0))
        assert isinstance(verdict, Rewrite)
        assert verdict.action == "held"
        held_at = held_at or (verdict.x, verdict.y)
        assert (verdict.x, verdict.y) == held_at
    assert flight.state is State.HOLD
    assert flight.switch.reason == "vision worker restarting"
    flight.switch.set_fault("worker", None, flight.now)
    assert flight.fly(setpoint(4.5, 0), 60, until_m=0.4), "detection resumes by itself"


def test_silence_of_the_worker_is_noticed_without_being_told():
    flight = Flight(HALL)
    flight.fly(setpoint(8, 0), 5)
    flight.camera_alive = False
    flight.fly(setpoint(8, 0), 2.5)
    assert (flight.state, flight.switch.reason) == (State.HOLD, "vision silent")


def test_an_old_pose_holds_and_no_pose_ever_sends_nothing():
    flight = Flight(HALL)
    flight.fly(setpoint(8, 0), 5)
    flight.poses_alive = False
    flight.fly(setpoint(8, 0), 1)
    assert (flight.state, flight.switch.reason) == (State.HOLD, "pose too old")
    assert isinstance(flight.verdicts[-1][1], Rewrite)

    blind = Flight(HALL, poses_alive=False)
    verdict = blind.step(setpoint(8, 0))
    assert isinstance(verdict, Drop)
    assert "no pose" in verdict.reason


def test_too_little_texture_holds_and_is_never_free():
    flight = Flight(HALL)
    flight.fly(setpoint(8, 0), 5)
    flight.texture = False
    flight.fly(setpoint(8, 0), 5)
    assert (flight.state, flight.switch.reason) == (State.HOLD, "too_few_features_later")
    at = (flight.n, flight.e)
    flight.fly(setpoint(8, 0), 20)
    assert math.dist(at, (flight.n, flight.e)) < 0.3


def test_an_estimator_jump_drops_the_past_and_anchors_the_hold_anew():
    flight = Flight(HALL)
    flight.fly(setpoint(10, 0), 5)
    flight.offset = (3.0, 0.0)
    flight.switch.on_estimator_reset(flight.now, "position jump")
    verdict = flight.step(setpoint(10, 0))
    assert flight.state is State.HOLD
    assert isinstance(verdict, Rewrite)
    assert math.dist((verdict.x, verdict.y), (flight.n + 3.0, flight.e)) < 0.3
    assert flight.fly(setpoint(10, 0), 40, until_m=3.3)


def test_the_pilot_takes_the_mode_and_gives_it_back():
    flight = Flight(HALL)
    flight.fly(setpoint(8, 0), 4)
    flight.offboard = False
    flight.fly(setpoint(8, 0), 2)
    assert flight.state is State.DISENGAGED
    assert all(isinstance(v, Forward) for t, v in flight.verdicts if t > flight.now - SEC)
    flight.offboard = True
    flight.fly(setpoint(8, 0), 0.2)
    assert flight.state is not State.DISENGAGED
    assert flight.fly(setpoint(8, 0), 40, until_m=0.4)


def test_before_the_first_heartbeat_nothing_unprotected_gets_through():
    flight = Flight(HALL)
    flight.switch.on_pose(flight.pose(), 0.0)
    verdict = flight.switch.on_setpoint(wish(setpoint(8, 0)), flight.now)
    assert isinstance(verdict, Rewrite)
    assert verdict.action == "held"


def test_not_ready_forwards_only_where_the_user_allowed_it():
    held = Flight(HALL, camera_alive=False)
    held.fly(setpoint(8, 0), 1)
    assert held.state is State.HOLD
    assert held.switch.reason == "no detection report yet"
    allowed = Flight(HALL, GuidanceConfig(allow_unprotected=True), camera_alive=False)
    allowed.fly(setpoint(8, 0), 1)
    assert allowed.state is State.DISENGAGED
    assert isinstance(allowed.verdicts[-1][1], Forward)
    assert [c.reason for c in allowed.changes].count("unprotected: no detection report yet") == 1


def test_it_gives_up_with_a_reason_and_asks_the_autopilot_only_if_told_to():
    for choice, asks in (("stay", False), ("autopilot_hold", True)):
        flight = Flight(HALL, GuidanceConfig(give_up_s=5.0, give_up=choice), camera_alive=False)
        flight.fly(setpoint(8, 0), 20)
        assert [(e.reason, e.ask_autopilot) for e in flight.gave_up] == [("no detection report yet", asks)]
        assert flight.switch.reason == "gave up: no detection report yet"
        flight.camera_alive = True
        assert flight.fly(setpoint(8, 0), 60, until_m=0.5), "a cleared fault is no reason to give up"


def test_velocity_terms_are_not_left_pointing_anywhere():
    flight = Flight(HALL)
    flight.fly(setpoint(8, 0), 5)
    assert flight.state is State.FOLLOW
    verdict = flight.step(setpoint(flight.n + 1, 0, mask=0))
    assert isinstance(verdict, Rewrite)


def test_a_single_wall_answer_among_others_does_not_turn():
    flight = Flight(HALL)
    flight.fly(setpoint(10, 0), 5)
    flight.now += 10_000_000
    flight.switch.on_report(
        DetectionReport(9999, flight.now, "single_plane", pose=flight.pose(), distance_m=1.0), flight.now
    )
    flight.fly(setpoint(10, 0), 1)
    assert "TURN" not in flight.states()


def test_an_older_frame_than_the_last_is_ignored():
    flight = Flight(HALL)
    flight.fly(setpoint(10, 0), 5)
    before = flight.switch._evidence.answer
    flight.switch.on_report(
        DetectionReport(1, flight.now - 3 * SEC, "lowest_flow", pose=flight.pose(), ray_body=(0, 1, 0)),
        flight.now,
    )
    assert flight.switch._evidence.answer is before


@pytest.mark.parametrize("start", [0.0, 1.5, 3.1, -2.0])
def test_an_open_world_converges_from_any_start(start):
    flight = Flight(HALL, yaw=start, n=-3, e=2)
    assert flight.fly(setpoint(5, -4), 90, until_m=0.4)


steps = st.lists(
    st.one_of(
        st.tuples(st.just("fly"), st.integers(1, 30)),
        st.tuples(st.just("goal"), st.tuples(st.floats(-8, 8), st.floats(-8, 8))),
        st.tuples(st.just("yaw"), st.floats(-3, 3)),
        st.tuples(st.just("camera"), st.booleans()),
        st.tuples(st.just("texture"), st.booleans()),
        st.tuples(st.just("poses"), st.booleans()),
        st.tuples(st.just("mode"), st.booleans()),
        st.tuples(st.just("fault"), st.booleans()),
        st.tuples(st.just("reset"), st.just(None)),
        st.tuples(st.just("silence"), st.integers(1, 40)),
    ),
    max_size=40,
)


@settings(max_examples=150, deadline=None)
@given(steps)
def test_whatever_happens_steps_yaw_and_hold_stay_within_their_caps(events):
    config = GuidanceConfig()
    flight = Flight([*room(20, 20), (4, -10, 4, 3)], config)
    goal = setpoint(6, 0)
    last_yaw: tuple[int, float] | None = None
    anchor: tuple[float, float] | None = None
    for name, value in events:
        count = 1
        match name:
            case "fly":
                count = value
            case "goal":
                goal = setpoint(*value)
            case "yaw":
                goal = setpoint(goal.x, goal.y, yaw=value)
            case "camera":
                flight.camera_alive = value
            case "texture":
                flight.texture = value
            case "poses":
                flight.poses_alive = value
            case "mode":
                flight.offboard = value
            case "fault":
                flight.switch.set_fault("camera", "camera gone" if value else None, flight.now)
            case "reset":
                flight.switch.on_estimator_reset(flight.now, "test")
                anchor = None
            case "silence":
                for _ in range(value):
                    flight.step(None)
        for _ in range(count):
            state_before = flight.state
            known = flight.switch._evidence.pose if not flight.poses_alive else flight.pose()
            verdict = flight.step(goal)
            if not flight.offboard:
                assert flight.state is State.DISENGAGED
                assert isinstance(verdict, Forward)
                last_yaw = anchor = None
                continue
            known = flight.switch._evidence.pose
            target = sent_xy(verdict, goal)
            if target is None:
                assert known is None
                continue
            assert known is not None
            # steps
            if flight.state in (State.FOLLOW, State.STEER):
                reach = math.dist(target, (known.north_m, known.east_m))
                assert reach <= config.max_step_m + 1e-6
                assert flight.switch.not_ready(flight.now) is None
            if flight.state is State.PROBE:
                assert math.dist(target, (known.north_m, known.east_m)) <= config.probe_step_m + 1.0
            # hold drift
            if flight.state in (State.HOLD, State.ALIGN, State.TURN):
                if state_before in (State.HOLD, State.ALIGN, State.TURN) and anchor is not None:
                    assert target == anchor
                anchor = target
            else:
                anchor = None
            # yaw rate of what is commanded
            if isinstance(verdict, Rewrite) and verdict.yaw is not None:
                if last_yaw is not None and flight.now - last_yaw[0] <= 0.06 * SEC:
                    turned = abs(wrap_rad(verdict.yaw - last_yaw[1]))
                    cap = math.radians(config.yaw_rate_deg_s) * (flight.now - last_yaw[0]) / SEC
                    # a hold stops a turn: it commands the heading of the moment, which is never far behind
                    stops = flight.state is State.HOLD and turned <= math.radians(33)
                    assert turned <= cap + 1e-6 or stops
                last_yaw = (flight.now, verdict.yaw)
            else:
                last_yaw = None
    flight.offboard = False
    flight.step(goal)
    assert flight.state is State.DISENGAGED


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(-3, 3), st.floats(-7, 7), st.floats(-7, 7))
def test_with_good_inputs_an_empty_room_is_crossed_from_anywhere_to_anywhere(yaw, goal_n, goal_e):
    flight = Flight(room(18, 18), yaw=yaw)
    assert flight.fly(setpoint(goal_n, goal_e), 200, until_m=flight.config.arrive_radius_m)
    assert flight.min_clearance > 0.3


@pytest.mark.parametrize("yaw", [0.0, 1.5, -2.5])
@pytest.mark.parametrize("goal", [(6.0, -3.0), (5.0, 6.0), (1.0, 1.0), (7.0, 0.0)])
def test_with_good_inputs_no_state_but_the_announced_give_up_absorbs(yaw, goal):
    flight = Flight([*room(18, 18), (2, -9, 2, 4)], yaw=yaw)
    reached = flight.fly(setpoint(*goal), 120, until_m=flight.config.arrive_radius_m)
    changed_lately = flight.changes and flight.changes[-1].time_ns > flight.now - 20 * SEC
    assert reached or changed_lately or flight.gave_up
    changes_per_s = len(flight.changes) / (flight.now / SEC - 10)
    assert changes_per_s < 2
    assert flight.min_clearance > 0.3
