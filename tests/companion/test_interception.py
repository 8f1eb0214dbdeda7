"""From telemetry and reports to verdicts: poses by time, resets, what is announced, and how often."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink
from structlog.testing import CapturingLogger

from companion.config import Config, GuidanceConfig, LinkConfig
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport
from companion.guidance.setpoint import (
    Drop,
    Forward,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Unprotected,
)
from companion.guidance.substitution import State
from companion.interception import Interception
from companion.mavlink.identity import Identity, MavState
from companion.mavlink.requests import EngageRequest
from companion.mavlink.telemetry import (
    Attitude,
    AttitudeQuaternion,
    CurrentMode,
    GlobalOrigin,
    GlobalPosition,
    Heartbeat,
    LocalPosition,
    Odometry,
    Unusable,
)
from tests.fakes.flat_world import SEC, setpoint
from tests.fakes.wire_flight import glob, local

MS = 1_000_000
OFFBOARD = 6 << 16
HOLD_MODE = 4 << 16 | 3 << 24


class Wire:
    """Keeps what our own component sends."""

    def __init__(self) -> None:
        self.messages: list[mavlink.MAVLink_message] = []
        self._parser = mavlink.MAVLink(None)

    def send(self, datagram: bytes) -> int:
        self.messages.extend(self._parser.parse_buffer(bytearray(datagram)) or [])
        return 1

    def texts(self) -> list[str]:
        return [m.text for m in self.messages if m.get_type() == "STATUSTEXT"]


class Bench:
    """An interception with a vehicle whose telemetry is given step by step."""

    def __init__(self, config: Config | None = None) -> None:
        self.now = 50 * SEC
        self.boot_ms = 1000
        self.wire = Wire()
        self.log = CapturingLogger()
        identity = Identity(self.wire, Wire(), now_ns=lambda: self.now)
        self.flight = Interception(config or Config(), identity=identity, log=self.log)
        self.yaw = 0.0
        self.position = (0.0, 0.0, -1.2)
        self.velocity = (0.0, 0.0, 0.0)
        self.seq = 0

    @property
    def switch(self):
        return self.flight.switch

    def heartbeat(self, *, mode: int = OFFBOARD, armed: bool = True, autopilot: int = 12) -> None:
        base = 1 | (128 if armed else 0)
        self.flight.on_telemetry(Heartbeat(1, 1, 2, autopilot, base, mode, 4), self.now)

    def telemetry(self, seconds: float = 0.1) -> None:
        """Move on, with attitude and position every 20 ms."""
        for _ in range(round(seconds / 0.02)):
            self.now += 20 * MS
            self.boot_ms += 20
            self.position = tuple(p + 0.02 * v for p, v in zip(self.position, self.velocity, strict=True))
            self.flight.on_telemetry(Attitude(self.boot_ms, 0, 0, self.yaw, 0, 0, 0), self.now)
            self.flight.on_telemetry(LocalPosition(self.boot_ms, *self.position, *self.velocity), self.now)

    def report(self, kind: str = "lowest_flow", **fields) -> DetectionReport:
        """A report about a frame of now, with the pose that the interception knows for it."""
        self.seq += 1
        frame = Frame(np.zeros((4, 4), np.uint8), self.now, self.seq)
        pose = self.flight.pose_of(frame, self.now)
        values = {"pose": pose, "ray_body": (1.0, 0.0, 0.0), "earlier_frame_ns": self.now - SEC // 5}
        report = DetectionReport(self.seq, self.now, kind, **{**values, **fields})
        self.flight.on_report(report, self.now)
        return report

    def ask(self, x: float = 8.0, y: float = 0.0):
        return self.flight.on_setpoint(setpoint(x, y), 255, 190, self.now)

    def send(self, given, sender: tuple[int, int] = (255, 190)):
        """The verdict on a setpoint of any kind."""
        return self.flight.on_setpoint(given, *sender, self.now)

    def events(self, name: str) -> list[dict]:
        return [call.kwargs for call in self.log.calls if call.args == (name,)]


def flying() -> Bench:
    bench = Bench()
    bench.heartbeat()
    bench.telemetry()
    bench.report()
    return bench


def test_telemetry_and_a_report_lead_to_a_protected_step():
    bench = flying()
    verdict = bench.ask()
    assert bench.switch.state is State.FOLLOW
    assert isinstance(verdict, Rewrite)
    assert (verdict.x, verdict.y) == pytest.approx((Config().guidance.max_step_m, 0.0))


def test_a_report_turns_with_the_attitude_of_its_own_frame():
    bench = Bench()
    bench.yaw = math.pi / 2
    bench.heartbeat()
    bench.telemetry()
    assert isinstance(bench.ask(0.0, 8.0), Rewrite)
    report = bench.report()
    assert report.pose.time_ns == bench.now
    verdict = bench.ask(0.0, 8.0)
    assert bench.switch.state is State.FOLLOW
    assert (verdict.x, verdict.y) == pytest.approx((0.0, 1.5), abs=1e-6)


def test_a_quaternion_serves_as_well_as_angles():
    bench = Bench()
    bench.heartbeat()
    half = math.sqrt(0.5)
    bench.flight.on_telemetry(AttitudeQuaternion(1000, (half, 0, 0, half), 0, 0, 0), bench.now)
    bench.flight.on_telemetry(LocalPosition(1000, 1, 2, -1, 0, 0, 0), bench.now)
    status = bench.flight.status(bench.now)
    assert status["pose"] == [1, 2, -1]
    assert status["heading_deg"] == 90.0


def test_a_frame_whose_time_no_pose_reaches_has_none_and_is_counted():
    bench = flying()
    assert (
        bench.flight.pose_of(Frame(np.zeros((4, 4), np.uint8), bench.now + SEC, 9), bench.now + SEC) is None
    )
    assert bench.flight.statistics.frames_total == 2


def test_telemetry_that_stops_holds_at_the_last_pose():
    bench = flying()
    bench.ask()
    bench.now += SEC
    verdict = bench.ask()
    assert (bench.switch.state, bench.switch.reason) == (State.HOLD, "pose too old")
    assert (verdict.x, verdict.y, verdict.action) == (0.0, 0.0, "held")


def test_position_without_attitude_is_no_pose():
    bench = Bench()
    bench.heartbeat()
    bench.flight.on_telemetry(LocalPosition(1000, 0, 0, 0, 0, 0, 0), bench.now)
    assert isinstance(bench.ask(), Drop)


def test_nothing_unprotected_passes_before_the_mode_is_known_and_everything_after_it_was_left():
    bench = Bench()
    bench.telemetry()
    assert bench.ask().action == "held"
    bench.heartbeat(mode=HOLD_MODE)
    assert bench.ask() == Forward()
    assert bench.switch.state is State.DISENGAGED


@pytest.mark.parametrize("how", ["jump", "vertical jump", "reset counter", "reboot", "jump in a silence"])
def test_an_estimator_reset_drops_what_was_known_and_holds_at_the_new_place(how):
    bench = flying()
    bench.flight.on_telemetry(Odometry(0, 3), bench.now)
    assert bench.ask().x > 1.0
    north, east, down = bench.position
    match how:
        case "jump":
            bench.position = (north + 3.0, east, down)
        case "vertical jump":
            bench.position = (north, east, down - 3.0)
        case "reset counter":
            bench.flight.on_telemetry(Odometry(0, 4), bench.now)
        case "reboot":
            bench.boot_ms = 0
            bench.now += 300 * MS
        case "jump in a silence":
            bench.now += 2 * SEC
            bench.boot_ms += 2000
            bench.ask()  # held where it was: that place has another name now
            bench.position = (north + 3.0, east, down)
    bench.telemetry(0.06)
    verdict = bench.ask()
    assert bench.switch.state is State.HOLD
    assert (verdict.x, verdict.y) == pytest.approx(bench.position[:2])
    assert len(bench.events("estimator_reset")) == 1
    assert any("estimator reset" in text for text in bench.wire.texts())
    # a pair that reaches back across the reset says nothing; one from after it does
    bench.report()
    bench.ask()
    assert bench.switch.state is State.HOLD
    bench.telemetry(0.4)
    bench.report()
    bench.ask()
    assert bench.switch.state is State.FOLLOW


def test_a_steady_reset_counter_is_no_reset():
    bench = flying()
    for _ in range(3):
        bench.flight.on_telemetry(Odometry(0, 7), bench.now)
    assert bench.events("estimator_reset") == []


def test_an_unprotected_kind_is_announced_once():
    bench = flying()
    for _ in range(5):
        bench.now += 2 * SEC
        bench.flight.on_unprotected("SET_POSITION_TARGET_LOCAL_NED", "coordinate_frame 8")
    bench.flight.on_unprotected("SET_ATTITUDE_TARGET", "not handled")
    assert len(bench.events("setpoint_unprotected")) == 2
    assert sum("UNPROTECTED" in text and "LOCAL_NED" in text for text in bench.wire.texts()) == 1


def test_unusable_telemetry_is_logged_once_for_each_kind():
    bench = flying()
    for _ in range(4):
        bench.flight.on_telemetry(Unusable(32, "not finite"), bench.now)
    assert len(bench.events("telemetry_unusable")) == 1


def test_giving_up_asks_the_autopilot_once():
    config = Config(guidance=GuidanceConfig(give_up_s=2.0, give_up="autopilot_hold"))
    bench = Bench(config)
    bench.heartbeat()
    for _ in range(60):
        bench.telemetry(0.1)
        bench.ask()
    asked = [m for m in bench.wire.messages if m.get_type() == "COMMAND_LONG"]
    assert [(m.command, m.param2, m.param3) for m in asked] == [(176, 4.0, 3.0)]
    assert [e["ask_autopilot"] for e in bench.events("gave_up")] == [True]
    assert bench.switch.state is State.HOLD


def test_giving_up_by_default_asks_nobody():
    bench = Bench(Config(guidance=GuidanceConfig(give_up_s=2.0)))
    bench.heartbeat()
    for _ in range(60):
        bench.telemetry(0.1)
        bench.ask()
    assert len(bench.events("gave_up")) == 1
    assert [m for m in bench.wire.messages if m.get_type() == "COMMAND_LONG"] == []


def test_a_heartbeat_that_is_lost_keeps_protection_and_is_said_once():
    bench = flying()
    bench.ask()
    for _ in range(50):
        bench.telemetry(0.1)
        bench.report()
        bench.flight.check_links(bench.now)
    assert len(bench.events("autopilot_heartbeat_lost")) == 1
    assert bench.flight.mav_state(bench.now) is MavState.BOOT  # it was never asked while all was good
    assert isinstance(bench.ask(), Rewrite)
    bench.heartbeat()
    bench.flight.check_links(bench.now)
    assert len(bench.events("autopilot_heartbeat_back")) == 1


def test_mav_state_is_boot_until_all_was_good_once_then_active_or_critical():
    bench = Bench()
    assert bench.flight.mav_state(bench.now) is MavState.BOOT
    bench.report("none", reason="no_motion")  # vision works, but there is no pose yet
    assert bench.flight.mav_state(bench.now) is MavState.BOOT
    bench.heartbeat()
    bench.telemetry()
    bench.report()
    assert bench.flight.mav_state(bench.now) is MavState.ACTIVE
    bench.flight.set_fault("camera", "camera gone", bench.now)
    assert bench.flight.mav_state(bench.now) is MavState.CRITICAL
    bench.flight.set_fault("camera", None, bench.now)
    bench.report()
    assert bench.flight.mav_state(bench.now) is MavState.ACTIVE
    for _ in range(50):
        bench.telemetry(0.1)
        bench.report()
    bench.flight.check_links(bench.now)
    assert bench.flight.mav_state(bench.now) is MavState.CRITICAL


def test_every_change_of_state_is_one_line_and_one_text():
    bench = flying()
    bench.ask()
    bench.ask()
    bench.flight.set_fault("worker", "vision worker backoff", bench.now)
    bench.ask()
    bench.heartbeat(armed=False)
    lines = [(e["previous"], e["state"]) for e in bench.events("state")]
    assert lines == [("DISENGAGED", "FOLLOW"), ("FOLLOW", "HOLD"), ("HOLD", "DISENGAGED")]
    assert [text.split()[1] for text in bench.wire.texts()] == ["FOLLOW", "HOLD", "DISENGAGED"]


def test_statistics_count_frames_reports_reasons_and_waiting_times():
    bench = flying()
    bench.report("none", reason="no_motion", detector_s=0.02)
    bench.now += 30 * MS
    bench.ask()
    bench.ask()
    summary = bench.flight.statistics.summary()
    assert summary["frames"] == 2
    assert summary["detections"] == {"lowest_flow": 1, "none": 1}
    assert summary["reasons"] == {"no_motion": 1}
    assert list(bench.flight.statistics.frame_to_setpoint_ms) == [30.0]
    assert summary["detection_ms"]["p95"] == 20.0
    status = bench.flight.status(bench.now)
    assert status["setpoint"]["action"] == "substituted"
    assert status["report"]["age_ms"] == 30


def test_protection_begins_with_the_request_for_offboard_not_with_the_next_heartbeat():
    bench = Bench()
    bench.heartbeat(mode=HOLD_MODE)
    bench.telemetry(0.5)
    assert isinstance(bench.flight.on_setpoint(setpoint(5, 0), 245, 190, bench.now), Forward)
    bench.flight.on_engage_request(EngageRequest(arm=False, offboard=True), bench.now)
    verdict = bench.flight.on_setpoint(setpoint(5, 0), 245, 190, bench.now)
    assert isinstance(verdict, Rewrite)
    # a heartbeat that was on its way does not end it, and the one that confirms it changes nothing
    bench.telemetry(0.2)
    bench.heartbeat(mode=HOLD_MODE)
    assert bench.switch.state is not State.DISENGAGED
    bench.heartbeat()
    bench.telemetry(3.0)
    bench.heartbeat()
    assert bench.switch.state is not State.DISENGAGED


def test_a_request_that_was_refused_counts_for_a_second_and_a_half():
    bench = Bench()
    bench.heartbeat(mode=HOLD_MODE, armed=False)
    bench.telemetry(0.5)
    bench.flight.on_engage_request(EngageRequest(arm=False, offboard=True), bench.now)
    assert isinstance(bench.flight.on_setpoint(setpoint(5, 0), 245, 190, bench.now), Forward), "not armed"
    bench.flight.on_engage_request(EngageRequest(arm=True, offboard=False), bench.now)
    assert isinstance(bench.flight.on_setpoint(setpoint(5, 0), 245, 190, bench.now), Rewrite)
    bench.telemetry(1.6)
    bench.heartbeat(mode=HOLD_MODE, armed=False)
    assert bench.switch.state is State.DISENGAGED
    assert isinstance(bench.flight.on_setpoint(setpoint(5, 0), 245, 190, bench.now), Forward)


def test_a_mode_changed_by_the_pilots_switch_is_known_with_the_next_current_mode():
    bench = flying()
    bench.ask()
    bench.flight.on_telemetry(CurrentMode(3 << 16), bench.now)
    assert (bench.switch.state, bench.switch.reason) == (State.DISENGAGED, "not in OFFBOARD")
    bench.flight.on_telemetry(CurrentMode(OFFBOARD), bench.now)
    bench.report()
    assert isinstance(bench.ask(), Rewrite)
    bench.flight.on_telemetry(CurrentMode(4), bench.now)  # GUIDED of a copter, which this is not
    assert bench.ask() == Forward()


def test_current_mode_says_nothing_of_arming_and_nothing_before_the_first_heartbeat():
    bench = Bench()
    bench.telemetry()
    bench.flight.on_telemetry(CurrentMode(3 << 16), bench.now)
    assert bench.ask().action == "held", "the mode is not known yet"
    bench.heartbeat(mode=HOLD_MODE, armed=False)
    bench.flight.on_telemetry(CurrentMode(OFFBOARD), bench.now)
    assert (bench.ask(), bench.switch.reason) == (Forward(), "disarmed")


def test_the_pilot_wins_at_once_also_just_after_a_request_that_was_carried_out():
    bench = Bench()
    bench.heartbeat(mode=HOLD_MODE)
    bench.telemetry(0.5)
    bench.flight.on_engage_request(EngageRequest(arm=False, offboard=True), bench.now)
    bench.flight.on_telemetry(CurrentMode(HOLD_MODE), bench.now)  # was on its way
    assert isinstance(bench.ask(), Rewrite)
    bench.telemetry(0.1)
    bench.flight.on_telemetry(CurrentMode(OFFBOARD), bench.now)
    assert isinstance(bench.ask(), Rewrite)
    bench.telemetry(0.1)
    bench.flight.on_telemetry(CurrentMode(3 << 16), bench.now)
    assert bench.ask() == Forward()


def test_a_disarm_just_after_an_arming_that_was_carried_out_counts_at_once():
    bench = Bench()
    bench.heartbeat(armed=False)
    bench.telemetry(0.5)
    bench.flight.on_engage_request(EngageRequest(arm=True, offboard=False), bench.now)
    assert isinstance(bench.ask(), Rewrite)
    bench.heartbeat(armed=True)
    bench.telemetry(0.2)
    bench.heartbeat(armed=False)
    assert bench.ask() == Forward()


# ---------------------------------------------------------------- kinds of setpoints, and whose


def flying_copter() -> Bench:
    bench = Bench()
    bench.heartbeat(mode=4, autopilot=3)
    bench.telemetry()
    bench.report()
    return bench


def test_each_autopilot_gets_what_it_understands():
    px4, copter = flying(), flying_copter()
    offset = local(3576, 9, p=(8, 0, 0))
    assert px4.send(offset) == Unprotected("coordinate_frame 9")
    verdict = copter.send(offset)
    assert isinstance(verdict, RewriteOffset)
    assert (verdict.x, verdict.y) == pytest.approx((1.5, 0.0))
    for bench in (px4, copter):
        verdict = bench.send(local(3527, 8, v=(0.3, 0, -0.2)))
        assert isinstance(verdict, RewriteVelocity)
        assert (verdict.vx, verdict.vy) == pytest.approx((0.3, 0.0))
        assert bench.send(local(3135)) == Unprotected("acceleration only")


def test_a_hold_by_velocity_flies_back_only_as_long_as_the_pose_is_fresh():
    bench = flying()
    bench.flight.set_fault("camera", "camera gone", bench.now)
    moving = local(3527, 1, v=(0.5, 0, 0))
    assert bench.send(moving).vx == 0.0
    bench.velocity = (0.5, 0.0, 0.0)  # a gust
    bench.telemetry(1.0)
    assert bench.send(moving).vx < -0.1
    bench.now += SEC
    verdict = bench.send(moving)
    assert (verdict.vx, verdict.vy, verdict.yaw, verdict.action) == (0.0, 0.0, None, "held")


def test_a_copters_yaw_in_a_body_frame_is_from_the_heading_and_px4s_is_not():
    for bench, expected in ((flying_copter(), 0.0), (flying(), 1.0)):
        bench.yaw = 1.0
        bench.telemetry(0.5)
        bench.report()
        for _ in range(40):
            bench.telemetry(0.06)
            bench.report()
            verdict = bench.send(local(3527, 8, v=(0.5, 0, 0)))
        assert verdict.yaw == pytest.approx(expected, abs=0.01)


def test_before_the_autopilot_is_known_what_depends_on_it_is_dropped():
    bench = Bench()
    bench.telemetry()
    assert bench.send(local(3576, 9, p=(8, 0, 0))) == Drop("autopilot not known")
    held = bench.send(local(3527, 1, v=(2, 0, 0)))
    assert (held.vx, held.vy, held.action) == (0.0, 0.0, "held")


def test_global_positions_need_a_reference_and_find_it_in_telemetry():
    bench = flying()
    place = (473977420 + 900, 85455940)  # ten metres north
    assert bench.send(glob(3576, at=place)) == Drop("no global reference")
    bench.flight.on_telemetry(GlobalOrigin(473977420, 85455940), bench.now)
    bench.telemetry()
    bench.report()
    verdict = bench.send(glob(3576, at=place))
    assert isinstance(verdict, RewriteGlobal)
    assert verdict.lat_int - 473977420 == pytest.approx(1.5 / 0.01112, abs=1.5)
    assert verdict.lon_int == 85455940
    # the pair that is seen later is nearer to the truth than the origin
    bench.telemetry()
    bench.flight.on_telemetry(GlobalPosition(bench.boot_ms, 473978420, 85455940), bench.now)
    bench.report()
    assert bench.send(glob(3576, at=(place[0] + 1000, place[1]))).lat_int > 473978420
    bench.flight.on_telemetry(Odometry(0, 3), bench.now)
    bench.flight.on_telemetry(Odometry(0, 4), bench.now)  # another local frame
    bench.telemetry()
    assert bench.send(glob(3576, at=place)) == Drop("no global reference")


def test_velocity_forward_passes_untouched_and_says_so():
    bench = Bench(Config(guidance=GuidanceConfig(velocity="forward")))
    bench.heartbeat()
    bench.telemetry()
    assert bench.send(local(3527, 1, v=(2, 0, 0))) == Unprotected("velocity only")
    assert isinstance(bench.send(local(3576, 1, p=(8, 0, -1))), Rewrite)


@pytest.mark.parametrize(
    ("link", "treated", "untreated"),
    [
        ({}, [(255, 190), (1, 1)], []),
        ({"planner_system_id": 245}, [(245, 190), (245, 1)], [(255, 190)]),
        ({"planner_system_id": 245, "planner_component_id": 190}, [(245, 190)], [(245, 1), (255, 190)]),
    ],
)
def test_only_the_planners_setpoints_are_treated(link, treated, untreated):
    bench = Bench(Config(link=LinkConfig(**link)))
    bench.heartbeat()
    bench.telemetry()
    for sender in treated:
        assert isinstance(bench.send(setpoint(8, 0), sender), Rewrite)
    for sender in untreated:
        verdict = bench.send(setpoint(8, 0), sender)
        assert verdict == Unprotected(f"from {sender[0]}/{sender[1]}, not the planner")


def test_rivals_are_announced():
    bench = flying()
    bench.flight.on_rivals(((245, 190), (255, 190)), bench.now)
    assert bench.events("rival_setpoints")[0]["sources"] == ["245/190", "255/190"]
    assert "void: setpoints from 245/190 and 255/190" in bench.wire.texts()


def test_a_refused_signature_is_announced_once_for_each_sender_and_not_for_ever():
    bench = flying()
    for _ in range(3):
        bench.flight.on_refused_signature((245, 190), "replayed")
    bench.flight.on_refused_signature((245, 190), "wrong signature")
    assert [e["reason"] for e in bench.events("setpoint_signature_refused")] == [
        "replayed",
        "wrong signature",
    ]
    assert any("245/190 dropped, replayed" in text for text in bench.wire.texts())
    for system_id in range(1, 200):
        bench.flight.on_refused_signature((system_id, 1), "wrong signature")
    assert len(bench.events("setpoint_signature_refused")) == 32


def test_the_status_says_what_was_asked_for_and_what_is_sent_for_every_kind():
    bench = flying()
    bench.send(local(3527, 1, v=(0.5, 0, -0.25)))
    shown = bench.flight.status(bench.now)["setpoint"]
    assert (shown["planned"], shown["sent"], shown["action"]) == (
        [0.5, 0, -0.25],
        [0.5, 0.0, -0.25],
        "substituted",
    )
    bench.send(glob(3576, at=(1, 2)))
    assert bench.flight.status(bench.now)["setpoint"]["dropped"] == "no global reference"
