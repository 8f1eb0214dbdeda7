"""The switch S, one rule at a time: what is sent, and what is never used."""

from __future__ import annotations

import dataclasses
import math

import pytest

from companion.config import GuidanceConfig
from companion.guidance.coordinates import quaternion_from_euler, wrap_rad
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.guidance.setpoint import Drop, Forward, LocalSetpoint, Rewrite
from companion.guidance.substitution import State, StateChanged, Switch
from tests.fakes.flat_world import SEC, setpoint, wish

MS = 1_000_000
CONFIG = GuidanceConfig()


class Bench:
    """A switch whose inputs are given by hand; the vehicle stays where it is put."""

    def __init__(self, config: GuidanceConfig = CONFIG, *, camera_yaw_rad: float = 0.0) -> None:
        self.now = 100 * SEC
        self.camera_yaw = camera_yaw_rad
        self.switch = Switch(config, camera_yaw_rad=camera_yaw_rad)
        self.n = self.e = self.yaw = self.speed = self.roll = self.pitch = 0.0
        self.seq = 0
        self.changes: list[StateChanged] = []
        self.switch.on_vehicle(armed=True, offboard=True, now_ns=self.now)

    @property
    def state(self) -> State:
        return self.switch.state

    def pose(self) -> Pose:
        return Pose(self.now, self.n, self.e, -1.0, quaternion_from_euler(self.roll, self.pitch, self.yaw))

    def report(self, kind: str, azimuth: float | None = None, **fields) -> DetectionReport:
        """A report of a frame taken now, about a direction given in local NED."""
        self.seq += 1
        self.now += MS
        ray = None
        if azimuth is not None:
            body = azimuth - self.yaw
            ray = (math.cos(body), math.sin(body), 0.0)
        values = {"ray_body": ray, "pose": self.pose(), "earlier_frame_ns": self.now - SEC // 5, **fields}
        report = DetectionReport(self.seq, self.now, kind, **values)
        self.switch.on_report(report, self.now)
        return report

    def void(self, azimuth: float, ranges: dict[float, float] | None = None, **fields) -> DetectionReport:
        bearings = tuple(BearingRange(a, m, 0.0, 9) for a, m in (ranges or {}).items())
        return self.report("lowest_flow", azimuth, bearings=bearings, **fields)

    def wall(self, distance_m: float | None) -> DetectionReport:
        return self.report("single_plane", distance_m=distance_m)

    def ask(self, goal: LocalSetpoint, dt_s: float = 0.05):
        self.now += int(dt_s * SEC)
        self.switch.on_pose(self.pose(), self.speed)
        verdict = self.switch.on_setpoint(wish(goal), self.now)
        self.changes += [e for e in self.switch.drain_events() if isinstance(e, StateChanged)]
        return verdict

    def reach(self, verdict) -> float:
        return math.dist((verdict.x, verdict.y), (self.n, self.e))


def started(**given) -> Bench:
    bench = Bench(**given)
    bench.switch.on_pose(bench.pose(), 0.0)
    bench.report("none", reason="no_motion")
    return bench


AHEAD = setpoint(8, 0)


# ---------------------------------------------------------------- what is used as good


def test_a_report_without_a_pose_is_no_answer():
    bench = started()
    bench.void(0.0, pose=None)
    bench.ask(AHEAD)
    assert bench.state is State.HOLD


def test_a_frame_of_the_future_is_refused_and_does_not_make_later_ones_old():
    bench = started()
    late = DetectionReport(99, bench.now + SEC, "lowest_flow", ray_body=(1, 0, 0), pose=bench.pose())
    bench.switch.on_report(late, bench.now)
    bench.ask(AHEAD)
    assert bench.state is State.HOLD
    bench.void(0.0)
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW


def test_an_answer_at_rest_outlives_one_while_moving_and_neither_is_kept_for_ever():
    bench = started()
    bench.void(0.0)
    for _ in range(14):
        bench.ask(AHEAD, 0.5)
        bench.report("none", reason="no_motion")
    assert bench.state is State.FOLLOW
    bench.speed = 1.0
    bench.ask(AHEAD)
    assert bench.state is State.HOLD
    bench.speed = 0.0
    for _ in range(7):
        bench.ask(AHEAD, 0.5)
        bench.report("none", reason="no_motion")
    assert bench.state is not State.FOLLOW


def test_an_answer_is_used_up_by_distance_and_by_turning():
    moved, turned = started(), started()
    for bench in (moved, turned):
        bench.void(0.0)
        bench.ask(AHEAD)
        assert bench.state is State.FOLLOW
    moved.n = CONFIG.redetect_distance_m + 0.1
    moved.ask(AHEAD)
    assert (moved.state, moved.switch.reason) == (State.HOLD, "last answer used up")
    turned.yaw = math.radians(CONFIG.redetect_yaw_deg + 1)
    turned.ask(AHEAD)
    assert turned.state is not State.FOLLOW


def test_pictures_without_texture_end_the_last_answer_and_no_motion_does_not():
    bench = started()
    bench.void(0.0)
    for _ in range(10):
        bench.report("none", reason="no_motion")
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW
    for _ in range(CONFIG.bad_reports_to_hold):
        bench.report("none", reason="blurred")
    bench.ask(AHEAD)
    assert (bench.state, bench.switch.reason) == (State.HOLD, "blurred")


def test_a_fault_drops_what_was_seen_also_when_it_is_gone_before_the_next_setpoint():
    bench = started()
    bench.void(0.0, {0.0: 5.0})
    bench.ask(AHEAD)
    bench.switch.set_fault("camera", "camera gone", bench.now)
    bench.switch.set_fault("camera", None, bench.now)
    bench.ask(AHEAD)
    assert bench.state is State.HOLD


def test_a_pair_that_reaches_back_across_an_estimator_reset_is_refused():
    bench = started()
    bench.switch.on_estimator_reset(bench.now, "reset counter")
    bench.now += SEC
    bench.ask(AHEAD)
    bench.void(0.0, earlier_frame_ns=bench.now - 2 * SEC)
    bench.ask(AHEAD)
    assert bench.state is State.HOLD
    bench.void(0.0, earlier_frame_ns=None)  # not said: it may have
    bench.ask(AHEAD)
    assert bench.state is State.HOLD
    bench.void(0.0, earlier_frame_ns=bench.now - SEC // 2)
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW


def test_only_answers_from_after_its_beginning_end_a_probe():
    bench = started()
    before = bench.now
    for _ in range(30):
        bench.ask(AHEAD, 0.1)
        bench.report("none", reason="no_motion")
    assert bench.state is State.PROBE
    began = next(c.time_ns for c in bench.changes if c.state is State.PROBE)
    stale = DetectionReport(
        999, bench.now, "lowest_flow", ray_body=(1, 0, 0), pose=bench.pose(), earlier_frame_ns=before
    )
    bench.switch._evidence.newest_frame_ns = 0
    bench.switch.on_report(dataclasses.replace(stale, frame_ns=began - MS), bench.now)
    bench.ask(AHEAD)
    assert bench.state is State.PROBE
    bench.void(0.0)
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW


def test_walls_seen_before_a_turn_do_not_count_after_it():
    bench = started()
    for _ in range(3):
        bench.wall(1.0)
    bench.ask(AHEAD)
    assert bench.state is State.TURN
    bench.yaw = math.radians(20)  # less than what uses a vote up
    for _ in range(200):
        bench.ask(AHEAD)
        bench.report("none", reason="no_motion")
        if bench.state is State.PROBE:
            break
        bench.yaw = wrap_rad(bench.yaw + math.radians(0.5))
    assert bench.state is State.PROBE
    assert not any(bench.switch._evidence.votes)


# ---------------------------------------------------------------- steps and their caps


@pytest.mark.parametrize("free_m", [0.5, 1.2, 1.9, 10.0])
def test_a_step_ends_before_what_was_measured_on_the_way(free_m):
    bench = started()
    bench.void(0.0, {0.0: free_m})
    verdict = bench.ask(AHEAD)
    assert bench.reach(verdict) <= max(0.0, min(CONFIG.max_step_m, free_m - CONFIG.step_margin_m)) + 1e-9


def test_where_only_the_void_was_measured_it_limits_the_step_too():
    bench = started()
    bench.void(math.radians(10), {math.radians(10): 1.3})
    verdict = bench.ask(AHEAD)
    assert bench.state is State.FOLLOW
    assert bench.reach(verdict) == pytest.approx(0.5)


def test_a_way_that_is_neither_measured_nor_at_the_void_is_not_flown_while_looking_again():
    bench = started()
    bench.void(0.0)
    assert bench.reach(bench.ask(AHEAD)) == pytest.approx(CONFIG.max_step_m)
    bench.void(math.radians(22), {math.radians(22): 0.5})  # the void is elsewhere, and near: no way is open
    assert bench.reach(bench.ask(AHEAD)) == 0.0


def test_steering_stops_while_no_way_is_open():
    bench = started()
    bench.void(math.radians(18))
    bench.ask(AHEAD)
    assert bench.state is State.STEER
    bench.void(math.radians(8), {0.0: 0.4})  # the void agrees with a bearing that is blocked
    verdict = bench.ask(AHEAD)
    assert bench.reach(verdict) == 0.0


def test_a_height_is_held_wherever_no_step_is_made_and_nowhere_else():
    bench = started()
    assert bench.ask(AHEAD).down_m == -1.0  # HOLD
    bench.void(0.0)
    assert bench.ask(AHEAD).down_m is None  # FOLLOW, moving on
    bench.void(math.radians(22), {math.radians(22): 0.5})
    assert (bench.reach(bench.ask(AHEAD)), bench.ask(AHEAD).down_m) == (0.0, -1.0)  # looking again
    bench = started()
    bench.void(math.radians(CONFIG.align_deg + 3))
    assert (bench.reach(bench.ask(AHEAD)), bench.ask(AHEAD).down_m) == (0.0, -1.0)  # STEER, not in sight yet
    bench.yaw = math.radians(10)
    assert bench.ask(AHEAD).down_m is None


def test_losing_the_answer_while_steering_never_leads_back_to_an_old_anchor():
    bench = started()
    bench.ask(AHEAD)
    assert bench.state is State.HOLD  # anchored at 0, 0
    bench.void(math.radians(20))
    bench.ask(AHEAD)
    assert bench.state is State.STEER
    bench.n, bench.e = 0.9, 0.8
    bench.void(math.radians(20))
    bench.ask(AHEAD)
    bench.n, bench.e, bench.speed = 1.0, 1.3, 1.0
    goal = setpoint(1.0, -6.0)  # out of view, and in no direction found blocked
    for _ in range(80):
        verdict = bench.ask(goal)
        bench.report("none", reason="no_motion")
        assert bench.reach(verdict) <= CONFIG.max_step_m + 1e-9
        assert math.hypot(verdict.x, verdict.y) > 0.9
    assert bench.state is not State.STEER


def test_the_camera_looks_where_it_steers_before_it_flies_there():
    bench = started()
    bench.void(math.radians(CONFIG.align_deg + 3))
    verdict = bench.ask(AHEAD)
    assert bench.state is State.STEER
    assert bench.reach(verdict) == 0.0
    bench.yaw = math.radians(10)
    assert bench.reach(bench.ask(AHEAD)) > 1.0


@pytest.mark.parametrize("goal", [(1e30, -1e30), (-3e38, 3e38), (1e-30, 0.0), (5e-324, -5e-324)])
def test_extreme_goals_give_finite_steps_within_the_cap(goal):
    bench = started()
    for azimuth in (0.0, math.atan2(goal[1], goal[0])):
        bench.yaw = azimuth
        bench.void(azimuth)
        for _ in range(5):
            verdict = bench.ask(setpoint(*goal))
            if isinstance(verdict, Forward):
                continue
            assert math.isfinite(verdict.x)
            assert math.isfinite(verdict.y)
            assert bench.reach(verdict) <= CONFIG.max_step_m + 1e-9


def test_a_goal_within_a_large_arrival_radius_is_still_reached_step_by_step():
    bench = started(config=GuidanceConfig(arrive_radius_m=6.0))
    for _ in range(40):
        verdict = bench.ask(setpoint(5, 0, yaw=0.0))
    assert bench.switch.reason == "at the goal"
    assert bench.reach(verdict) <= CONFIG.max_step_m + 1e-9


def test_something_measured_nearer_than_a_close_goal_is_not_flown_into():
    bench = started()
    goal = setpoint(0.5, 0, yaw=0.0)
    for _ in range(40):
        bench.ask(goal)
    assert bench.switch.reason == "at the goal"
    bench.void(0.0, {0.0: 0.3})
    assert bench.reach(bench.ask(goal)) == 0.0


def test_a_hovering_vehicle_that_wanders_does_not_turn_to_look_at_its_goal():
    bench = started()
    goal = setpoint(0, 0, yaw=0.0)
    for i in range(200):
        bench.e = 0.8 * math.sin(max(0, i - 40) / 10)
        bench.report("none", reason="no_motion")
        bench.ask(goal)
    assert {c.state for c in bench.changes} <= {State.HOLD, State.FOLLOW}
    assert len(bench.changes) <= 2


def test_velocity_yaw_rate_and_acceleration_terms_pass_only_where_they_cannot_carry_away():
    bench = started()
    for _ in range(40):
        bench.report("none", reason="no_motion")
        bench.ask(setpoint(0, 0))
    slow = math.radians(CONFIG.yaw_rate_deg_s)
    for mask, rate, forwarded in ((1528, 0.9 * slow, True), (1528, 2 * slow, False), (3520, 0.0, False)):
        goal = dataclasses.replace(setpoint(0, 0, mask=mask), yaw_rate=rate, vx=3.0)
        assert isinstance(bench.ask(goal), Forward) == forwarded, mask


# ---------------------------------------------------------------- yaw


@pytest.mark.parametrize("dt_s", [0.01, 0.05, 0.2, 0.5, 0.7])
def test_the_commanded_yaw_is_slewed_at_any_rate_of_setpoints_and_gets_there(dt_s):
    bench = started()
    goal = setpoint(-8, 0.1)
    last, turned = bench.yaw, 0.0
    for _ in range(int(60 / dt_s)):
        bench.report("none", reason="no_motion")
        verdict = bench.ask(goal, dt_s)
        step = wrap_rad(verdict.yaw - last)
        since_s = min(dt_s + 0.001, 0.2)  # a report takes the bench a millisecond
        assert abs(step) <= math.radians(CONFIG.yaw_rate_deg_s) * since_s + 1e-9
        last, bench.yaw = verdict.yaw, verdict.yaw
        turned += abs(step)
        if abs(wrap_rad(bench.yaw - math.pi)) < math.radians(CONFIG.view_deg) / 2:
            break
    else:
        pytest.fail("it never looked there")
    assert turned < math.radians(200), "it went there, not round and round"


def test_a_vehicle_that_cannot_turn_is_not_commanded_far_ahead_of_its_heading():
    bench = started()
    for _ in range(400):
        bench.report("none", reason="no_motion")
        verdict = bench.ask(setpoint(-8, 0.1))
        assert abs(wrap_rad(verdict.yaw - bench.yaw)) <= math.radians(33)


def test_a_planners_yaw_that_jumps_to_and_fro_stays_within_the_rate():
    bench = started()
    last = None
    for i in range(200):
        verdict = bench.ask(setpoint(0, 0, yaw=3.0 if i % 2 else -1.0))
        yaw = verdict.yaw if isinstance(verdict, Rewrite) else 3.0 if i % 2 else -1.0
        if last is not None:
            assert abs(wrap_rad(yaw - last)) <= math.radians(CONFIG.yaw_rate_deg_s) * 0.05 + 1e-9
        last = bench.yaw = yaw


@pytest.mark.parametrize("camera_yaw", [math.pi / 2, -0.7, math.pi])
def test_a_camera_mounted_at_an_angle_is_what_looks_along_the_way(camera_yaw):
    bench = started(camera_yaw_rad=camera_yaw)
    bench.report("none", reason="no_motion")
    for _ in range(400):
        verdict = bench.ask(AHEAD)
        bench.yaw = verdict.yaw
        bench.report("none", reason="no_motion")
        if bench.state is State.HOLD and abs(wrap_rad(bench.yaw + camera_yaw)) < 0.4:
            break
    assert abs(wrap_rad(bench.yaw + camera_yaw)) < math.radians(CONFIG.view_deg)
    bench.void(0.0)
    verdict = bench.ask(AHEAD)
    assert bench.state is State.FOLLOW
    assert verdict.x > 1.0
    for _ in range(100):
        verdict = bench.ask(AHEAD)
        bench.yaw = verdict.yaw
    assert abs(wrap_rad(bench.yaw + camera_yaw)) < 1e-6
    for _ in range(3):
        bench.wall(1.0)
    for _ in range(40):
        verdict = bench.ask(AHEAD)
        if bench.state is not State.TURN:
            break
        bench.yaw = verdict.yaw
    assert abs(wrap_rad(bench.yaw + camera_yaw)) == pytest.approx(
        math.radians(CONFIG.turn_step_deg), abs=math.radians(5)
    )


@pytest.mark.parametrize(("roll", "pitch"), [(0.3, 0.0), (0.0, -0.35), (-0.25, 0.25)])
def test_a_tilted_vehicle_still_flies_along_a_level_way(roll, pitch):
    bench = started()
    bench.roll, bench.pitch = roll, pitch
    level = (math.cos(-pitch), 0.0, math.sin(-pitch)) if roll == 0 else None
    bench.report("lowest_flow", 0.0, ray_body=level or (1.0, 0.0, 0.0))
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW


def test_a_ray_that_points_up_has_no_azimuth_and_is_no_answer():
    bench = started()
    bench.report("lowest_flow", ray_body=(0.05, 0.0, -1.0))
    bench.ask(AHEAD)
    assert bench.state is State.HOLD


# ---------------------------------------------------------------- walls and turns


@pytest.mark.parametrize(
    ("distance_m", "turns"), [(None, True), (1.0, True), (2.4, True), (2.6, False), (20.0, False)]
)
def test_a_plane_is_a_wall_nearer_than_its_limit_or_where_its_range_is_not_known(distance_m, turns):
    bench = started()
    for _ in range(3):
        bench.wall(distance_m)
    bench.ask(AHEAD)
    assert (bench.state is State.TURN) == turns


def test_a_plane_behind_the_goal_is_no_wall():
    bench = started()
    for _ in range(3):
        bench.wall(2.0)
    bench.ask(setpoint(1.0, 0))
    assert bench.state is not State.TURN


def test_one_wall_among_three_answers_does_not_turn_and_two_do():
    bench = started()
    for kind in ("void", "wall", "void"):
        bench.void(0.0) if kind == "void" else bench.wall(1.0)
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW
    bench.wall(1.0)
    bench.ask(AHEAD)
    assert bench.state is State.TURN


@pytest.mark.parametrize(("goal_e", "side"), [(0.0, 1), (2.0, 1), (-2.0, -1)])
def test_a_turn_goes_to_the_goals_side_and_to_the_right_where_it_is_dead_ahead(goal_e, side):
    bench = started()
    for _ in range(3):
        bench.wall(1.0)
    for _ in range(10):
        verdict = bench.ask(setpoint(8, goal_e))
        bench.yaw = verdict.yaw
    assert math.copysign(1, bench.yaw) == side


def test_a_full_sweep_ends_in_no_way_out_and_a_new_goal_ends_that():
    bench = started(config=GuidanceConfig(bootstrap_probe=False, give_up_s=600))
    for _ in range(3):
        bench.wall(1.0)
    swept, last = 0.0, 0.0
    for _ in range(2000):
        bench.report("none", reason="no_motion")
        verdict = bench.ask(AHEAD)
        assert (verdict.x, verdict.y) == (0.0, 0.0)
        bench.yaw = verdict.yaw
        swept, last = swept + wrap_rad(bench.yaw - last), bench.yaw
        if bench.state is State.HOLD:
            break
    assert (bench.state, bench.switch.reason) == (State.HOLD, "no way out")
    assert math.degrees(swept) == pytest.approx(360, abs=35)
    before = len(bench.changes)
    bench.ask(setpoint(0, 9))
    assert bench.state is not State.HOLD or len(bench.changes) > before


def test_a_goal_that_moves_steadily_is_not_a_new_one_at_each_setpoint():
    bench = started(config=GuidanceConfig(bootstrap_probe=False))
    for _ in range(3):
        bench.wall(1.0)
    for i in range(300):  # two setpoints a second, 1.5 m/s: 0.75 m from one to the next
        bench.report("none", reason="no_motion")
        bench.yaw = bench.ask(setpoint(8 + 0.75 * i, 0), 0.5).yaw
    assert bench.switch.reason in ("no way out", "gave up: no way out")


def test_two_planners_that_take_turns_do_not_keep_it_from_giving_up():
    bench = started(config=GuidanceConfig(give_up_s=5.0))
    bench.switch.set_fault("camera", "camera gone", bench.now)
    for i in range(200):
        verdict = bench.ask(setpoint(8, 0) if i % 2 else setpoint(-3, 4))
        assert (verdict.x, verdict.y) == (0.0, 0.0)
    assert bench.switch.reason == "gave up: camera gone"


def test_a_new_goal_while_turning_goes_on_turning_before_the_same_wall():
    bench = started()
    for _ in range(3):
        bench.wall(1.0)
    bench.ask(AHEAD)
    bench.ask(setpoint(9, 1))
    assert bench.state is State.TURN
    for _ in range(60):
        bench.report("none", reason="no_motion")
        bench.yaw = bench.ask(setpoint(9, 1)).yaw
        if bench.state is State.PROBE:
            break
    assert bench.state is State.PROBE


def test_a_probe_takes_the_way_seen_free_else_back_along_the_track_else_once_ahead():
    for name in ("seen", "track", "ahead", "none"):
        bench = started(config=GuidanceConfig(bootstrap_probe=name != "none"))
        if name == "track":
            bench.e = 1.0
            for _ in range(12):
                bench.ask(AHEAD)
                bench.e -= 0.1
            bench.e = 0.0
        if name == "seen":
            bench.void(0.0, {0.6: 5.0, 0.0: 0.9})
            bench.switch._evidence.answer = None
        sent = None
        for _ in range(60):
            bench.report("none", reason="no_motion")
            verdict = bench.ask(AHEAD)
            if bench.state is State.PROBE:
                sent = math.atan2(verdict.y - bench.e, verdict.x - bench.n)
                assert bench.reach(verdict) == pytest.approx(CONFIG.probe_step_m)
                break
        expected = {"seen": 0.6, "track": math.pi / 2, "ahead": 0.0, "none": None}[name]
        assert sent == (None if expected is None else pytest.approx(expected)), name


def test_a_bearing_whose_neighbour_is_blocked_is_not_probed():
    bench = started(config=GuidanceConfig(bootstrap_probe=False))
    bench.void(0.0, {0.30: 5.0, 0.34: 0.4})
    bench.switch._evidence.answer = None
    for _ in range(60):
        bench.report("none", reason="no_motion")
        bench.ask(AHEAD)
        assert bench.state is not State.PROBE


# ---------------------------------------------------------------- what is announced, and the rest of the table


def test_reasons_that_change_with_every_picture_are_not_announced_with_every_picture():
    bench = started()
    reasons = ("too_few_features_later", "blurred", "too_few_features_earlier")
    for i in range(200):
        bench.report("none", reason=reasons[i % 3])
        bench.ask(AHEAD)
    assert bench.state is State.HOLD
    assert len(bench.changes) <= 8  # in ten seconds


def test_noisy_ranges_at_the_limit_do_not_flap():
    bench = started()
    at_limit = CONFIG.max_step_m + CONFIG.step_margin_m
    for i in range(100):
        bench.void(math.radians(20), {0.0: at_limit + (0.1 if i % 2 else -0.1), math.radians(20): 6.0})
        bench.ask(AHEAD, 0.1)
    assert len(bench.changes) <= 3


def test_before_a_pose_nothing_is_sent_and_after_a_reset_the_new_place_is_held():
    bench = Bench()
    assert isinstance(bench.switch.on_setpoint(wish(AHEAD), bench.now), Drop)
    bench = started()
    bench.void(0.0)
    bench.ask(AHEAD)
    bench.switch.on_estimator_reset(bench.now, "test")
    assert isinstance(bench.switch.on_setpoint(wish(AHEAD), bench.now), Drop)
    bench.n, bench.e, bench.yaw = 30.0, -4.0, 2.0
    verdict = bench.ask(AHEAD)
    assert (verdict.x, verdict.y) == (30.0, -4.0)
    assert abs(wrap_rad(verdict.yaw - 2.0)) < 0.2


def test_disarming_in_flight_disengages_and_forgets():
    bench = started()
    bench.void(0.0)
    bench.ask(AHEAD)
    bench.switch.on_vehicle(armed=False, offboard=True, now_ns=bench.now)
    assert bench.state is State.DISENGAGED
    assert bench.switch.reason == "disarmed"
    assert bench.ask(AHEAD) == Forward()
    bench.switch.on_vehicle(armed=True, offboard=True, now_ns=bench.now)
    bench.ask(AHEAD)
    assert bench.state is State.HOLD, "the answer from before is forgotten"


def test_not_finite_is_dropped_in_every_state():
    bench = started()
    assert isinstance(bench.ask(setpoint(math.nan, 0)), Drop)
    bench.switch.on_vehicle(armed=False, offboard=False, now_ns=bench.now)
    assert isinstance(bench.ask(setpoint(0, math.inf)), Drop)


def test_a_reached_goal_needs_no_detection_and_a_moving_one_does():
    still, moving = started(), started()
    for i in range(60):
        still.report("none", reason="blurred")
        still.ask(setpoint(0.2, 0, yaw=0.0))
        moving.report("none", reason="blurred")
        moving.ask(setpoint(0.2 + 0.3 * (i % 2), 0, yaw=0.0))
    assert still.state is State.FOLLOW
    assert moving.state is State.HOLD


def test_a_silent_planners_goal_is_forgotten():
    bench = started(config=GuidanceConfig(give_up_s=3.0))
    bench.switch.set_fault("camera", "camera gone", bench.now)
    for _ in range(80):
        bench.ask(AHEAD)
    assert bench.switch.reason == "gave up: camera gone"
    bench.ask(AHEAD, 1.5)
    assert bench.switch.reason == "camera gone"


def test_agreement_is_lost_later_than_it_is_found():
    limit = math.radians(CONFIG.agree_deg)
    within = limit + math.radians(CONFIG.agree_hysteresis_deg) / 2
    bench = started()
    bench.void(within)
    bench.ask(AHEAD)
    assert bench.state is State.STEER
    bench = started()
    bench.void(0.9 * limit)
    bench.ask(AHEAD)
    bench.void(within)
    bench.ask(AHEAD)
    assert bench.state is State.FOLLOW


def test_single_bad_pictures_between_good_answers_do_not_add_up():
    bench = started()
    for _ in range(2 * CONFIG.bad_reports_to_hold):
        bench.void(0.0)
        bench.report("none", reason="blurred")
        bench.ask(AHEAD)
        assert bench.state is State.FOLLOW


@pytest.mark.parametrize("why", ["fault", "mode left", "estimator reset"])
def test_bearings_seen_free_and_the_track_are_not_used_after(why):
    bench = started(config=GuidanceConfig(bootstrap_probe=False))
    for _ in range(10):
        bench.ask(AHEAD)
        bench.n += 0.1
    bench.void(0.0, {0.5: 6.0})
    match why:
        case "fault":
            bench.switch.set_fault("camera", "camera gone", bench.now)
            bench.switch.set_fault("camera", None, bench.now)
        case "mode left":
            bench.switch.on_vehicle(armed=True, offboard=False, now_ns=bench.now)
            bench.switch.on_vehicle(armed=True, offboard=True, now_ns=bench.now)
        case "estimator reset":
            bench.switch.on_estimator_reset(bench.now, "test")
    sent = None
    for _ in range(60):
        bench.report("none", reason="no_motion")
        verdict = bench.ask(setpoint(9, 1))
        if bench.state is State.PROBE:
            sent = wrap_rad(math.atan2(verdict.y - bench.e, verdict.x - bench.n))
            break
    # after a fault the track is still a way that was flown; after the others it is not known
    assert sent == (pytest.approx(math.pi) if why == "fault" else None)


def test_steering_turns_the_camera_and_not_the_nose_to_the_void():
    bench = started(camera_yaw_rad=0.8)
    bench.yaw = -0.8
    azimuth = math.radians(18)
    bench.void(azimuth)
    for _ in range(60):
        bench.report("none", reason="no_motion")
        bench.yaw = bench.ask(AHEAD).yaw
    assert bench.state is State.STEER
    assert wrap_rad(bench.yaw + 0.8) == pytest.approx(azimuth)


def test_a_void_and_a_bearing_that_are_both_measured_near_count_as_a_wall():
    bench = started()
    for _ in range(CONFIG.wall_k):
        bench.ask(AHEAD)
        bench.void(math.radians(20), {0.0: 0.5, math.radians(20): 0.6})
    bench.ask(AHEAD)
    assert (bench.state, bench.switch.reason) == (State.TURN, "no way ahead")


def test_a_vehicle_that_does_not_turn_is_announced_and_a_turn_goes_on_by_time():
    bench = started()
    for _ in range(200):
        bench.report("none", reason="no_motion")
        bench.ask(setpoint(-8, 1), 0.1)
    assert "the vehicle does not turn" in [c.reason for c in bench.changes]
    bench = started()
    for _ in range(3):
        bench.wall(1.0)
    for _ in range(80):
        bench.report("none", reason="no_motion")
        bench.ask(AHEAD, 0.1)
    assert State.PROBE in [c.state for c in bench.changes]


def test_after_the_committed_distance_it_looks_towards_the_goal_again_and_not_before():
    bench = started(config=GuidanceConfig(redetect_distance_m=5.0, episode_distance_m=1.0))
    bench.void(math.radians(18))
    goal = setpoint(3, 0)
    bench.ask(goal)
    assert bench.state is State.STEER
    bench.n, bench.e, bench.yaw = 1.2, 0.6, 0.35
    bench.void(0.5)
    bench.ask(setpoint(3, -1.0))
    assert bench.state is State.STEER
    bench.n, bench.e = 1.5, 0.9
    bench.void(0.5)
    bench.ask(setpoint(3, -1.0))
    assert (bench.state, bench.switch.reason) == (State.ALIGN, "looking towards the goal again")


def test_without_a_way_on_there_is_no_commitment():
    bench = started(config=GuidanceConfig(redetect_distance_m=5.0, episode_distance_m=1.0))
    bench.void(math.radians(18))
    bench.ask(setpoint(3, 0))
    bench.n, bench.e, bench.yaw = 1.2, 0.6, 0.35
    bench.void(0.5, {0.5: 0.6})
    bench.ask(setpoint(3, -1.0))
    assert (bench.state, bench.switch.reason) == (State.ALIGN, "goal out of view")


def test_a_bearing_found_blocked_is_not_looked_at_again_in_its_episode():
    bench = started()
    bench.void(math.radians(20))
    bench.ask(AHEAD)
    assert bench.state is State.STEER
    bench.n, bench.e, bench.yaw = 1.0, 1.4, math.radians(40)  # further than what one is committed to
    bench.void(math.radians(40))
    bench.ask(AHEAD)
    assert bench.state is State.STEER


def test_a_blind_step_is_made_once_at_a_heading():
    bench = started(config=GuidanceConfig(give_up_s=600))
    headings: list[float] = []
    for _ in range(3000):
        bench.report("none", reason="no_motion")
        verdict = bench.ask(AHEAD)
        if verdict.yaw is not None:
            bench.yaw = verdict.yaw
        if bench.state is State.PROBE and (not headings or headings[-1] != bench.switch._plan.probe_yaw_rad):
            headings.append(bench.switch._plan.probe_yaw_rad)
    assert len(headings) >= 6
    least = math.radians(CONFIG.turn_step_deg) / 2
    for i, one in enumerate(headings):
        assert all(abs(wrap_rad(one - other)) > least - 1e-6 for other in headings[:i])


def test_a_far_plane_comes_nearer_as_it_is_flown_to():
    bench = started()
    bench.wall(2.7)
    assert bench.reach(bench.ask(AHEAD)) == pytest.approx(CONFIG.max_step_m)
    bench.n = 0.8
    assert bench.reach(bench.ask(AHEAD)) == pytest.approx(2.7 - 0.8 - CONFIG.step_margin_m)


def test_a_remembered_obstacle_far_ahead_does_not_make_the_way_to_it_measured():
    bench = started()
    for _ in range(3):
        bench.void(math.radians(20), {math.radians(20): 6.0}, obstacles=((4.0, 0.0),))
    verdict = bench.ask(AHEAD)
    assert bench.state is State.STEER
    assert verdict.y > 0.0


def test_what_stands_nearby_is_not_forgotten_over_a_fault():
    bench = started()
    for _ in range(3):
        bench.void(0.0, obstacles=((1.5, 0.0),))
    bench.switch.set_fault("camera", "camera gone", bench.now)
    bench.switch.set_fault("camera", None, bench.now)
    bench.void(0.0)
    assert bench.reach(bench.ask(AHEAD)) <= 1.5 - CONFIG.step_margin_m + 1e-9
