"""Setpoints of every kind through the switch S: what the autopilot makes of the bytes that leave."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import GuidanceConfig
from companion.guidance.coordinates import wrap_rad
from companion.guidance.dialect import Autopilot, Motion, Reading, understand
from companion.guidance.geodesy import to_global
from companion.guidance.setpoint import (
    Drop,
    Forward,
    GlobalSetpoint,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Setpoint,
)
from companion.guidance.substitution import State
from companion.mavlink import codec
from tests.fakes.flat_world import SEC, room
from tests.fakes.wire_flight import ORIGIN, WireFlight, frame_of, glob, local

PX4, ARDUPILOT = Autopilot.PX4, Autopilot.ARDUPILOT
POSITION, VELOCITY, POSVEL = 3576, 3527, 3520
HALL = room(40.0, 40.0)
HORIZON_S = {PX4: 1.5, ARDUPILOT: 4.1}
"""From the last velocity to standing still, as measured."""
WALL = [(5.0, -20.0, 5.0, 20.0)]


def at(north: float, east: float, autopilot: Autopilot) -> tuple[int, int]:
    return to_global(ORIGIN, north, east, autopilot)


# ---------------------------------------------------------------- each kind flies where it may


@pytest.mark.parametrize(
    ("autopilot", "setpoint"),
    [
        (PX4, local(VELOCITY, 1, v=(0.8, 0.0, 0.0))),
        (PX4, local(VELOCITY, 8, v=(0.8, 0.0, 0.0))),
        (PX4, local(3555, 1, p=(0, 0, -1.2), v=(0.8, 0.0, 0.0))),
        (PX4, glob(VELOCITY, v=(0.8, 0.0, 0.0))),
        (PX4, local(POSVEL, 1, p=(6, 0, -1.2), v=(0.5, 0, 0))),
        (PX4, glob(POSITION, at=at(6, 0, PX4))),
        (ARDUPILOT, local(VELOCITY, 7, v=(0.8, 0.0, 0.0))),
        (ARDUPILOT, local(VELOCITY, 9, v=(0.8, 0.0, 0.0))),
        (ARDUPILOT, local(POSITION, 7, p=(3, 0, 0))),
        (ARDUPILOT, local(POSITION, 8, p=(3, 0, 0))),
        (ARDUPILOT, local(POSITION, 9, p=(3, 0, 0))),
        (ARDUPILOT, glob(POSITION, 5, at=at(6, 0, ARDUPILOT), alt=489.2)),
    ],
)
def test_an_open_hall_is_crossed_by_any_kind(autopilot, setpoint):
    flight = WireFlight(HALL, autopilot=autopilot)
    flight.stream(setpoint, 12)
    assert flight.n > 3.0
    assert abs(flight.e) < 1.0
    assert flight.d == pytest.approx(-1.2, abs=0.05)
    assert "TURN" not in flight.states()


@pytest.mark.parametrize("speed", [0.3, 1.0, 5.0])
@pytest.mark.parametrize(
    ("autopilot", "frame"), [(PX4, 1), (PX4, 8), (ARDUPILOT, 1), (ARDUPILOT, 7), (ARDUPILOT, 9)]
)
def test_a_velocity_toward_a_wall_turns_and_never_touches(autopilot, frame, speed):
    flight = WireFlight([*room(16, 16), *WALL], autopilot=autopilot)
    flight.stream(local(VELOCITY, frame, v=(speed, 0.0, 0.0)), 40)
    assert flight.min_clearance > 0.3
    assert "TURN" in flight.states() or "STEER" in flight.states()


@pytest.mark.parametrize(
    ("autopilot", "setpoint"),
    [
        (ARDUPILOT, local(POSITION, 7, p=(4, 0, 0))),
        (ARDUPILOT, local(POSITION, 9, p=(4, 0, 0))),
        (PX4, glob(POSITION, at=at(9, 0, PX4))),
        (PX4, local(POSVEL, 1, p=(9, 0, -1.2), v=(3, 0, 0))),
    ],
)
def test_no_kind_of_position_touches_a_wall(autopilot, setpoint):
    flight = WireFlight([*room(24, 16), *WALL], autopilot=autopilot)
    flight.stream(setpoint, 40)
    assert flight.min_clearance > 0.3
    assert "TURN" in flight.states()


def test_the_speed_is_kept_where_the_caps_allow_it_and_cut_where_not():
    for wanted, expected in ((0.4, 0.4), (3.0, 1.0)):
        flight = WireFlight(HALL)
        flight.stream(local(VELOCITY, v=(wanted, 0.0, 0.0)), 10)
        assert math.hypot(flight.vn, flight.ve) == pytest.approx(expected, rel=0.02)
    for autopilot, horizon_s, expected in (
        (ARDUPILOT, 0.0, 1.5 / 4.1),
        (ARDUPILOT, 2.0, 0.75),
        (PX4, 3.0, 0.5),
    ):
        flight = WireFlight(HALL, GuidanceConfig(velocity_horizon_s=horizon_s), autopilot=autopilot)
        flight.stream(local(VELOCITY, v=(3.0, 0.0, 0.0)), 12)
        assert math.hypot(flight.vn, flight.ve) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
def test_a_velocity_whose_setpoints_end_stops_within_its_step(autopilot):
    flight = WireFlight(HALL, autopilot=autopilot)
    flight.stream(local(VELOCITY, v=(3.0, 0.0, 0.0)), 12)
    last = flight.n
    for _ in range(200):
        flight.send(None)
    assert flight.vn < 0.01
    assert 0.0 < flight.n - last <= flight.config.max_step_m


def test_small_offsets_that_are_streamed_are_a_way_and_not_an_arrival():
    flight = WireFlight(HALL, autopilot=ARDUPILOT)
    flight.stream(local(POSITION, 7, p=(0.4, 0.0, 0.0)), 15)
    assert flight.n > 1.0
    assert "at the goal" not in [c.reason for c in flight.changes]


def test_vz_is_the_planners_in_every_state():
    flight = WireFlight(HALL, d=0.0)
    flight.camera_alive = False  # held, all the way
    flight.stream(local(VELOCITY, v=(0.5, 0.0, -0.5)), 4)
    assert flight.state is State.HOLD
    assert flight.d == pytest.approx(-2.0, abs=0.1)
    assert math.hypot(flight.n, flight.e) < 0.05


def test_a_velocity_of_zero_passes_and_the_smallest_one_does_not():
    flight = WireFlight(HALL)
    flight.stream(local(VELOCITY, v=(0.0, 0.0, -0.1)), 1)
    assert isinstance(flight.verdicts[-1][1], Forward)
    for frame, autopilot in ((1, PX4), (7, ARDUPILOT)):
        creeping = WireFlight(HALL, autopilot=autopilot)
        creeping.stream(local(VELOCITY, frame, v=(0.009, 0.0, 0.0)), 20)
        assert creeping.n == 0.0
    offset = WireFlight(HALL, autopilot=ARDUPILOT)
    offset.stream(local(POSITION, 7, p=(0.009, 0.0, 0.0)), 20)
    assert offset.n == 0.0


@pytest.mark.parametrize(("autopilot", "frame"), [(PX4, 8), (ARDUPILOT, 8), (ARDUPILOT, 9)])
@pytest.mark.parametrize(("rate", "expected_deg_s"), [(0.2, 11.46), (-0.2, -11.46), (2.0, 30.0)])
def test_a_planner_that_steers_by_yaw_rate_flies_curves_at_the_capped_rate(
    autopilot, frame, rate, expected_deg_s
):
    flight = WireFlight(HALL, autopilot=autopilot)
    curve = local(1479, frame, v=(0.5, 0.0, 0.0), rate=rate)
    flight.stream(curve, 4)
    before, turned = flight.yaw, 0.0
    for _ in range(60):
        flight.send(curve)
        turned, before = turned + wrap_rad(flight.yaw - before), flight.yaw
        assert abs(wrap_rad(math.atan2(flight.ve, flight.vn) - flight.yaw)) < 0.6, "it flies where it looks"
    assert flight.state is State.FOLLOW
    assert math.degrees(turned) / 3.0 == pytest.approx(expected_deg_s, rel=0.1)


@pytest.mark.parametrize("rate", [0.3, 3.0])
def test_turning_on_the_spot_by_rate_is_granted_up_to_the_cap(rate):
    flight = WireFlight(HALL)
    flight.stream(local(1479, 8, rate=rate), 1)
    start, last = 0.0, flight.yaw
    for _ in range(60):
        verdict = flight.send(local(1479, 8, rate=rate))
        start, last = start + wrap_rad(flight.yaw - last), flight.yaw
    assert isinstance(verdict, Forward) == (rate < math.radians(30))
    assert start / 3.0 == pytest.approx(min(rate, math.radians(30)), rel=0.1)
    assert math.hypot(flight.n, flight.e) < 0.01


# ---------------------------------------------------------------- what is configured


def test_velocity_hold_never_moves_sideways_and_says_why():
    flight = WireFlight(HALL, GuidanceConfig(velocity="hold"))
    flight.stream(local(VELOCITY, v=(0.8, 0.3, -0.1)), 8)
    assert math.hypot(flight.n, flight.e) < 0.02
    assert flight.d == pytest.approx(-1.2 - 0.8, abs=0.1)
    assert (flight.state, flight.switch.reason) == (State.HOLD, "velocity setpoints are held")
    flight.stream(local(POSITION, p=(4, 0, -2.0)), 20)
    assert flight.n > 3.0, "positions fly"


def test_velocity_hold_gives_up_once_and_stays_so():
    flight = WireFlight(HALL, GuidanceConfig(velocity="hold", give_up_s=5.0))
    flight.stream(local(VELOCITY, v=(0.8, 0.0, 0.0)), 12)
    assert [e.reason for e in flight.gave_up] == ["velocity setpoints are held"]
    assert flight.switch.reason == "gave up: velocity setpoints are held"
    assert len(flight.changes) <= 4


def test_a_hold_brings_a_drifting_vehicle_back_slowly():
    flight = WireFlight(HALL)
    flight.stream(local(VELOCITY, v=(0.8, 0.0, 0.0)), 6)
    flight.switch.set_fault("camera", "camera gone", flight.now)
    flight.send(local(VELOCITY, v=(0.8, 0.0, 0.0)))
    anchor = (flight.switch._plan.anchor[0], flight.switch._plan.anchor[1])
    flight.e += 2.0  # a gust
    for _ in range(400):
        verdict = flight.send(local(VELOCITY, v=(0.8, 0.0, 0.0)))
        assert isinstance(verdict, RewriteVelocity)
        assert math.hypot(verdict.vx, verdict.vy) <= 0.5 + 1e-9
    assert math.dist((flight.n, flight.e), anchor) < 0.05


# ---------------------------------------------------------------- what is not known


def test_without_a_pose_what_is_relative_stays_and_what_is_not_is_dropped():
    for setpoint, autopilot, expected in (
        (local(VELOCITY, v=(1, 0, -0.3)), PX4, RewriteVelocity(0.0, 0.0, None, "held")),
        (local(POSITION, 7, p=(3, 0, -1)), ARDUPILOT, RewriteOffset(0.0, 0.0, 0.0, None, "held")),
    ):
        flight = WireFlight(HALL, poses_alive=False, autopilot=autopilot)
        assert flight.send(setpoint) == expected
    for setpoint in (local(POSITION, p=(3, 0, -1)), glob(POSITION, at=at(3, 0, PX4))):
        flight = WireFlight(HALL, poses_alive=False)
        assert isinstance(flight.send(setpoint), Drop)


def test_what_is_relative_stays_where_the_pose_is_too_old_to_measure_from():
    for setpoint, autopilot in (
        (local(VELOCITY, 8, v=(1, 0, 0)), PX4),
        (local(POSITION, 9, p=(3, 0, 0)), ARDUPILOT),
    ):
        flight = WireFlight(HALL, autopilot=autopilot)
        flight.stream(setpoint, 4)
        flight.poses_alive = False
        flight.stream(setpoint, 1)
        assert flight.switch.reason == "pose too old"
        sent = flight.wire[-1][2]
        assert (
            (sent.vx, sent.vy) == (0.0, 0.0) if autopilot is PX4 else (sent.x, sent.y, sent.z) == (0.0,) * 3
        )


def test_without_a_reference_a_global_position_is_dropped_and_said_so_and_a_velocity_flies():
    flight = WireFlight(HALL, anchor=None)
    flight.stream(glob(POSITION, at=at(6, 0, PX4)), 1)
    assert flight.verdicts[-1][1] == Drop("no global reference")
    assert (flight.state, flight.switch.reason) == (State.HOLD, "no global reference")
    flight.stream(glob(VELOCITY, v=(0.8, 0, 0)), 8)
    assert flight.n > 2.0
    flight.anchor = ORIGIN
    flight.stream(glob(POSITION, at=at(8, 0, PX4)), 10)
    assert flight.n > 5.0
    assert all(isinstance(v, RewriteGlobal | Forward) for t, v in flight.verdicts if t > flight.now - SEC)


# ---------------------------------------------------------------- offsets in z, body frames


@pytest.mark.parametrize("frame", [7, 8, 9])
def test_a_hold_in_an_offset_frame_does_not_repeat_its_z_offset(frame):
    flight = WireFlight(HALL, autopilot=ARDUPILOT)
    climbing = local(POSITION, frame, p=(3.0, 0.0, -0.5))
    flight.stream(climbing, 4)
    assert flight.d < -2.0, "moving on, the offset acts each time"
    flight.switch.set_fault("camera", "camera gone", flight.now)
    flight.send(climbing)
    held = flight.d
    flight.stream(climbing, 30)
    assert flight.d == pytest.approx(held, abs=0.1)
    assert math.dist((flight.n, flight.e), flight.switch._plan.anchor) < 0.3


@pytest.mark.parametrize("frame", [8, 9])
def test_a_yaw_from_the_heading_that_asks_for_none_passes(frame):
    flight = WireFlight(HALL, autopilot=ARDUPILOT, yaw=1.0)
    flight.stream(local(2552, frame, yaw=0.0), 1)
    assert isinstance(flight.verdicts[-1][1], Forward)
    flight.stream(local(2552, frame, yaw=0.5), 1)  # repeated, it turns without end: at the capped rate
    assert flight.yaw == pytest.approx(1.0 + math.radians(30), abs=0.1)


def test_a_climb_alone_in_an_offset_frame_passes():
    flight = WireFlight(HALL, autopilot=ARDUPILOT, d=0.0)
    flight.stream(local(POSITION, 7, p=(0.0, 0.0, -0.5)), 4)
    assert flight.d < -1.0
    assert isinstance(flight.verdicts[-1][1], Forward)


def test_a_direction_that_turns_with_the_vehicle_does_not_make_it_spin():
    for autopilot, setpoint in (
        (PX4, local(VELOCITY, 8, v=(0.0, 0.8, 0.0))),
        (PX4, local(VELOCITY, 8, v=(-0.8, 0.0, 0.0))),
        (ARDUPILOT, local(POSITION, 9, p=(0.0, 3.0, 0.0))),
    ):
        flight = WireFlight(HALL, autopilot=autopilot)
        turned, last = 0.0, flight.yaw
        for _ in range(1200):
            flight.send(setpoint)
            turned, last = turned + abs(wrap_rad(flight.yaw - last)), flight.yaw
        assert math.degrees(turned) < 220
        assert (flight.state, flight.switch.reason) == (State.HOLD, "the goal turns with the vehicle")
        assert math.hypot(flight.n, flight.e) < 1.0
        flight.stream(local(VELOCITY, 8 if autopilot is PX4 else 9, v=(0.8, 0.0, 0.0)), 12)
        assert math.hypot(flight.n, flight.e) > 2.0, "forward flies"


def test_a_planner_that_turns_its_goal_into_the_body_frame_is_aligned_as_ever():
    flight = WireFlight(HALL)
    goal = (-1.0, 7.0)
    for _ in range(700):
        north, east = goal[0] - flight.n, goal[1] - flight.e
        scale = 0.8 / max(0.8, math.hypot(north, east))
        cos, sin = math.cos(flight.yaw), math.sin(flight.yaw)
        forward, right = (north * cos + east * sin) * scale, (east * cos - north * sin) * scale
        flight.send(local(VELOCITY, 8, v=(forward, right, 0.0)))
    assert math.dist((flight.n, flight.e), goal) < 0.8
    assert "the goal turns with the vehicle" not in [c.reason for c in flight.changes]


# ---------------------------------------------------------------- whatever happens

small = st.floats(-8, 8)
number = st.floats(-3, 3)


def kinds(autopilot: Autopilot) -> st.SearchStrategy[Setpoint]:
    """All setpoints that the autopilot reads, with every mixture of further terms."""
    frames = {local: (1, 8) if autopilot is PX4 else (1, 7, 8, 9), glob: (5, 6, 11)}
    read = {
        make: [
            (mask, frame)
            for frame in frames[make]
            for mask in range(0, 4096, 1)
            if isinstance(understand(make(mask, frame), autopilot), Reading)
        ]
        for make in (local, glob)
    }
    locals_ = st.builds(
        lambda kind, p, v, a, yaw, rate: local(*kind, p, v, a, yaw, rate),
        st.sampled_from(read[local]),
        st.tuples(small, small, st.floats(-3, 0)),
        st.tuples(number, number, st.floats(-0.5, 0.5)),
        st.tuples(number, number, number),
        number,
        number,
    )
    globals_ = st.builds(
        lambda kind, n, e, v, yaw, rate: glob(*kind, at(n, e, autopilot), 1.2, v, yaw, rate),
        st.sampled_from(read[glob]),
        small,
        small,
        st.tuples(number, number, st.floats(-0.5, 0.5)),
        number,
        number,
    )
    return st.one_of(locals_, globals_)


def events(autopilot: Autopilot) -> st.SearchStrategy:
    return st.lists(
        st.one_of(
            st.tuples(st.just("fly"), st.integers(1, 25)),
            st.tuples(st.just("setpoint"), kinds(autopilot)),
            st.tuples(st.just("setpoint"), kinds(autopilot)),
            st.tuples(
                st.sampled_from(("camera", "texture", "poses", "mode", "fault", "reference")), st.booleans()
            ),
            st.tuples(st.just("reset"), st.just(True)),
            st.tuples(st.just("silence"), st.integers(1, 40)),
        ),
        max_size=25,
    )


EVENTS = {autopilot: events(autopilot) for autopilot in (PX4, ARDUPILOT)}


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
def test_whatever_happens_every_kind_keeps_the_caps(autopilot):
    @settings(max_examples=150)
    @given(EVENTS[autopilot])
    def holds(happens):
        fly_through(autopilot, happens)

    holds()


def fly_through(autopilot: Autopilot, happens: list[tuple[str, object]]) -> None:
    config = GuidanceConfig()
    flight = WireFlight([*room(20, 20), (4, -10, 4, 3)], config, autopilot=autopilot)
    setpoint: Setpoint = local(VELOCITY, v=(0.75, 0.0, 0.0))
    yaws: list[tuple[int, float]] = []
    for name, value in happens:
        count = 1
        match name:
            case "fly":
                count = value
            case "setpoint":
                setpoint = codec.unpack(frame_of(value))  # in the precision of the wire
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
            case "reference":
                flight.anchor = ORIGIN if value else None
            case "reset":
                flight.switch.on_estimator_reset(flight.now, "test")
            case "silence":
                for _ in range(value):
                    flight.send(None)
        for _ in range(count):
            check(flight, setpoint, config, yaws)


def check(
    flight: WireFlight, setpoint: Setpoint, config: GuidanceConfig, yaws: list[tuple[int, float]]
) -> None:
    verdict = flight.send(setpoint)
    sent = flight.wire[-1][2]
    if not flight.offboard:
        assert isinstance(verdict, Forward)
        yaws.clear()
        return
    if sent is None:
        yaws.clear()
        return
    fields = [getattr(sent, name) for name in type(sent).__slots__]
    assert all(math.isfinite(v) for v in fields)
    reading = understand(sent, flight.autopilot)
    assert isinstance(reading, Reading)
    assert reading == understand(setpoint, flight.autopilot), "another kind than it was"
    known = flight.switch.pose
    target = flight.target
    north, east, down = target.position_ned_m
    held = flight.state in (State.HOLD, State.ALIGN, State.TURN)
    if reading.motion is Motion.VELOCITY:
        speed = math.hypot(*target.velocity_ned_m_s[:2])
        assert speed * HORIZON_S[flight.autopilot] <= config.max_step_m + 1e-5
        assert speed <= math.hypot(setpoint.vx, setpoint.vy) + (
            0.5 if held or flight.state is State.PROBE else 1e-5
        )
        assert (sent.vz, sent.type_mask & 39) == (
            setpoint.vz if not setpoint.type_mask & 32 else 0.0,
            setpoint.type_mask & 39,
        )
    else:
        assert target.velocity_ned_m_s[:2] == (0.0, 0.0), "a term that points somewhere"
        if known is not None and flight.state in (State.FOLLOW, State.STEER):
            slack = 0.02 if isinstance(sent, GlobalSetpoint) else 0.0  # 1e-7 deg are a centimetre
            if reading.motion is Motion.OFFSET:  # measured from the vehicle itself
                assert math.hypot(sent.x, sent.y) <= config.max_step_m + 1e-5
            else:
                reach = math.dist((north, east), (known.north_m, known.east_m))
                assert reach <= config.max_step_m + slack + 1e-5
        if reading.motion is Motion.POSITION:
            z, planned = (
                (sent.alt, setpoint.alt) if isinstance(sent, GlobalSetpoint) else (sent.z, setpoint.z)
            )
            if not setpoint.type_mask & 4:
                assert z == planned
        elif held and known is not None and flight.poses_alive:
            assert down == pytest.approx(flight.switch._plan.anchor_down_m, abs=1e-5)
    if isinstance(verdict, Forward):
        yaws.clear()
        return
    assert sent.type_mask & 2048, "a bare yaw rate spins for ever"
    if target.yaw_rad is None or sent.type_mask & 1024:
        yaws.clear()
        return
    if yaws and flight.now - yaws[-1][0] <= 0.06 * SEC and flight.poses_alive:
        turned = abs(wrap_rad(target.yaw_rad - yaws[-1][1]))
        cap = math.radians(config.yaw_rate_deg_s) * (flight.now - yaws[-1][0]) / SEC
        # a hold stops a turn at the heading of the moment, which is never far behind
        assert turned <= cap + 1e-5 or (flight.state is State.HOLD and turned <= math.radians(33))
    yaws.append((flight.now, target.yaw_rad))


@pytest.mark.parametrize("mask", [2496, 504, 2552 & ~64])
def test_further_terms_do_not_pass_although_the_step_and_the_yaw_are_granted(mask):
    """The velocity of a trajectory, a yaw rate beside a yaw, an acceleration."""
    flight = WireFlight(HALL)
    flight.stream(local(2552, p=(9.0, 0.0, -1.2)), 6)
    assert flight.state is State.FOLLOW
    near = (flight.n + 0.7, flight.e, -1.2)
    assert isinstance(flight.send(local(2552, p=near)), Forward)
    verdict = flight.send(local(mask, p=near, v=(2.0, 1.0, 0.0), a=(1.0, 1.0, 0.0), rate=0.1))
    assert not isinstance(verdict, Forward)
    sent = flight.wire[-1][2]
    assert (sent.type_mask, sent.vx, sent.vy, sent.afx, sent.yaw_rate) == (2552, 0.0, 0.0, 0.0, 0.0)


def test_acceleration_terms_never_pass_while_protected():
    flight = WireFlight(HALL)
    accelerating = dataclasses.replace(local(VELOCITY & ~448, v=(0.5, 0, 0)), afx=3.0, afy=1.0)
    flight.stream(accelerating, 5)
    sent = flight.wire[-1][2]
    assert (sent.afx, sent.afy, sent.afz, sent.type_mask & 448) == (0.0, 0.0, 0.0, 448)
    assert flight.n > 1.0
