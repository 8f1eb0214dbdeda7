"""The interception with its own component: let go, engaged, tuned, and with the autopilot's clock."""

from __future__ import annotations

import math

from companion.config import CameraConfig, Config, GuidanceConfig
from companion.guidance.engagement import missing
from companion.guidance.setpoint import Drop, Forward, Rewrite
from companion.guidance.substitution import State
from companion.mavlink.identity import MavState
from companion.mavlink.timesync import ClockSync
from tests.companion.test_interception import MS, SEC, Bench, flying


def test_let_go_setpoints_pass_untouched_and_the_heartbeat_says_standby():
    bench = flying()
    assert isinstance(bench.ask(), Rewrite)
    assert bench.flight.mav_state(bench.now) is MavState.ACTIVE
    bench.flight.set_off("not engaged (parameter)", bench.now)
    assert bench.ask() == Forward()
    assert (bench.switch.state, bench.switch.reason) == (State.DISENGAGED, "not engaged (parameter)")
    assert bench.flight.mav_state(bench.now) is MavState.STANDBY
    assert any("not engaged" in text for text in bench.wire.texts())
    bench.flight.set_off(None, bench.now)
    assert isinstance(bench.ask(), Rewrite)


def test_before_the_mode_is_known_nothing_passes_whether_engaged_or_not():
    bench = Bench()
    bench.flight.set_off("not engaged (at start)", bench.now)
    assert isinstance(bench.ask(), Drop)
    bench.heartbeat()
    assert bench.ask() == Forward()


def test_what_is_missing_to_engage_is_named():
    bench = Bench(Config(camera=CameraConfig(hfov_deg=80.0)))
    bench.flight.set_fault("camera", "no frames from the camera", bench.now)
    bench.flight.set_fault("worker", "vision worker starting", bench.now)
    assert missing(bench.flight.inputs(bench.now)) == (
        "no heartbeat from the autopilot",
        "no pose from the autopilot",
        "no frames from the camera",
        "vision worker starting",
    )
    bench.heartbeat()
    bench.telemetry()
    bench.flight.set_fault("camera", None, bench.now)
    bench.flight.set_fault("worker", None, bench.now)
    assert missing(bench.flight.inputs(bench.now)) == ()
    bench.flight.on_estimator(1, bench.now)
    assert missing(bench.flight.inputs(bench.now)) == ("estimator has no velocity and position",)
    bench.now += SEC
    assert "pose too old" in missing(bench.flight.inputs(bench.now))
    bench.now += 5 * SEC  # what the estimator said is then too old to count, and so is the heartbeat
    assert missing(bench.flight.inputs(bench.now)) == ("no heartbeat from the autopilot", "pose too old")


def test_a_field_of_view_that_nobody_gave_is_no_camera_model():
    assert not Bench().flight.inputs(0).camera_model
    assert Bench(Config(camera=CameraConfig(file="cam.toml"))).flight.inputs(0).camera_model


def test_another_longest_step_acts_with_the_next_setpoint():
    bench = flying()
    bench.flight.set_config(Config(guidance=GuidanceConfig(max_step_m=0.4)))
    verdict = bench.ask()
    assert math.hypot(verdict.x, verdict.y) <= 0.4 + 1e-6
    assert bench.switch.state is State.FOLLOW


def test_timesync_makes_poses_as_old_as_they_are():
    bench = Bench()
    bench.heartbeat()
    bench.telemetry()
    late = bench.flight.status(bench.now)["pose_age_ms"]
    offset = bench.now - bench.boot_ms * MS - 40 * MS  # what came now was sent 40 ms ago
    bench.flight.on_clock(ClockSync(offset, 80 * MS, bench.now), bench.now)
    bench.telemetry(0.3)
    assert bench.flight.status(bench.now)["pose_age_ms"] == late + 40


def test_a_clock_that_is_not_the_autopilots_is_not_used_and_said_once():
    bench = flying()
    for _ in range(3):
        bench.flight.on_clock(ClockSync(1_700_000_000 * SEC, MS, bench.now), bench.now)
    assert len(bench.events("clock_refused")) == 1
    bench.telemetry()
    assert bench.flight.status(bench.now)["pose_age_ms"] == 0
