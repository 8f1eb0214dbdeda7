"""The fake ArduPilot Copter: modes, setpoints, time-outs and streams, as measured on ArduCopter 4.7-dev."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.sim.ardupilot_controller import ArduPilotController
from companion.sim.ardupilot_modes import CopterMode
from companion.sim.autopilot import FakeAutopilot
from companion.sim.autopilot_endpoint import AutopilotEndpoint
from companion.sim.px4_modes import FlightMode
from companion.sim.vehicle import Vehicle
from companion.sim.wire import FrameReader, FrameWriter

SECOND = 1_000_000_000
TICK = 5_000_000
NAN = math.nan
POSITION, VELOCITY = 3576, 3527


class Bench:
    """An ArduPilot on a bench: time is ours, and there is no socket."""

    def __init__(self, **controller: Any) -> None:
        self.now_ns = 77 * SECOND
        self.controller = ArduPilotController(self.now_ns, **controller)
        self.endpoint = AutopilotEndpoint(self.controller)
        self.writer = FrameWriter(1, 191)
        self._reader = FrameReader()

    @property
    def place(self) -> tuple[float, float, float]:
        return self.controller.estimate.position_ned_m

    @property
    def speed(self) -> float:
        return math.hypot(*self.controller.estimate.velocity_ned_m_s[:2])

    def decode(self, frames: list[bytes]) -> list[Any]:
        return [frame.message for raw in frames for frame in self._reader.read(raw)]

    def send(self, message: Any) -> list[Any]:
        return self.decode(self.endpoint.receive(self.writer.pack(message), self.now_ns))

    def command(self, command: int, *params: float) -> int:
        padded = [*params, *([0.0] * (7 - len(params)))]
        return self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *padded))[0].result

    def setpoint(
        self, p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), *, mask=POSITION, frame=1, yaw=0.0, rate=0.0, a=0.0
    ):
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, frame, mask, *p, *v, a, a, a, yaw, rate
            )
        )
        return self.endpoint.setpoints[-1].refusal

    def run(self, seconds: float) -> list[Any]:
        frames = []
        for _ in range(round(seconds * SECOND / TICK)):
            self.now_ns += TICK
            frames += self.endpoint.advance(self.now_ns)
        return self.decode(frames)


def guided(yaw_rad: float = 0.0) -> Bench:
    vehicle = Vehicle(position_ned_m=(0.0, 0.0, -2.0), yaw_rad=yaw_rad)
    return Bench(vehicle=vehicle, armed=True, mode=CopterMode.GUIDED)


# ---------------------------------------------------------------- what it says


def test_only_the_heartbeat_comes_by_itself_and_every_stream_on_request() -> None:
    bench = guided()
    assert {m.get_type() for m in bench.run(2)} == {"HEARTBEAT"}
    assert bench.command(511, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50_000) == 0
    assert bench.command(511, mavlink.MAVLINK_MSG_ID_ATTITUDE, 20_000) == 0
    counts = Counter(m.get_type() for m in bench.run(2))
    assert counts["LOCAL_POSITION_NED"] == pytest.approx(40, abs=1)
    assert counts["ATTITUDE"] == pytest.approx(100, abs=1)
    assert "GLOBAL_POSITION_INT" not in counts
    bench.command(511, mavlink.MAVLINK_MSG_ID_ATTITUDE, 0)  # 0: its default, which is none
    assert "ATTITUDE" not in {m.get_type() for m in bench.run(1)}


def test_its_heartbeat_is_that_of_an_arducopter() -> None:
    (beat,) = guided().run(0.5)
    assert (beat.autopilot, beat.type, beat.base_mode, beat.custom_mode) == (3, 2, 217, 4)
    (beat,) = Bench().run(0.5)
    assert (beat.base_mode, beat.custom_mode, beat.system_status) == (81, 0, 3)


def test_its_integer_parameters_are_numbers() -> None:
    bench = Bench()
    answer = bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"RTL_ALT", -1))[0]
    assert (answer.param_value, answer.param_type) == (1500.0, 6)
    answer = bench.send(mavlink.MAVLink_param_set_message(1, 1, b"RTL_ALT", 300.0, 6))[0]
    assert answer.param_value == 300.0


# ---------------------------------------------------------------- modes


def test_guided_needs_no_stream_and_takes_off_by_command_alone() -> None:
    bench = Bench()
    assert bench.command(176, 1, 4) == 0
    assert bench.command(400, 1) == 0
    assert bench.command(22, 0, 0, 0, 0, 0, 0, NAN) == 4
    bench.setpoint((0.0, 0.0, -2.0))
    bench.run(2)
    assert bench.place[2] == 0.0, "a setpoint does not lift it"
    assert bench.command(22, 0, 0, 0, 0, 0, 0, 1.5) == 0
    bench.run(6)
    assert bench.place[2] == pytest.approx(-1.5, abs=0.15)
    bench.run(20)
    assert bench.controller.mode is CopterMode.GUIDED, "it holds without a stream"
    assert bench.command(22, 0, 0, 0, 0, 0, 0, 5.0) == 4, "it flies already"


def test_loiter_by_the_pilot_wins_and_guided_is_taken_again() -> None:
    bench = guided()
    bench.setpoint((30.0, 0.0, -2.0))
    bench.run(2)
    bench.controller.request_custom_mode(5, bench.now_ns)
    assert bench.setpoint((30.0, 0.0, -2.0)) == "not in GUIDED"
    bench.run(15)
    there = bench.place
    bench.setpoint((30.0, 0.0, -2.0))
    bench.run(3)
    assert bench.place == pytest.approx(there, abs=0.05)
    assert bench.command(176, 1, 4) == 0
    bench.run(3)
    assert bench.place == pytest.approx(there, abs=0.05), "it does not go back to the old setpoint"


def test_land_comes_down_and_disarms() -> None:
    bench = guided()
    assert bench.command(21) == 0
    bench.run(8)
    assert (bench.place[2], bench.controller.armed) == (0.0, False)


def test_it_returns_and_lands() -> None:
    bench = guided()
    bench.controller.parameters.set("RTL_ALT", 200)
    bench.setpoint((5.0, 0.0, -2.0))
    bench.run(10)
    assert bench.place[0] == pytest.approx(5.0, abs=0.3)
    assert bench.command(20) == 0
    bench.run(25)
    assert math.hypot(*bench.place[:2]) < 0.7
    assert not bench.controller.armed


def test_armed_on_the_ground_it_disarms_after_a_while_and_in_land_it_does_not_arm() -> None:
    bench = Bench(mode=CopterMode.GUIDED)
    bench.command(400, 1)
    bench.run(9)
    assert bench.controller.armed
    bench.run(2)
    assert not bench.controller.armed
    bench.command(176, 1, 9)
    assert bench.command(400, 1) == 4


# ---------------------------------------------------------------- setpoints


def test_a_position_is_flown_to_and_held_for_ever_without_a_stream() -> None:
    bench = guided()
    assert bench.setpoint((8.0, 0.0, -2.0)) is None
    bench.run(60)
    assert bench.place == pytest.approx((8.0, 0.0, -2.0), abs=0.05)
    assert bench.controller.mode is CopterMode.GUIDED


def test_a_velocity_ends_four_seconds_after_the_last_one() -> None:
    bench = guided()
    for _ in range(40):
        bench.setpoint(v=(1.0, 0.0, 0.0), mask=VELOCITY)
        bench.run(0.05)
    assert bench.speed == pytest.approx(1.0, abs=0.1)
    bench.run(2.9)
    assert bench.speed == pytest.approx(1.0, abs=0.05)
    bench.run(1.9)
    assert bench.speed < 0.1
    sharp = guided()
    sharp.controller.parameters.set("GUID_TIMEOUT", 0.5)
    sharp.setpoint(v=(1.0, 0.0, 0.0), mask=VELOCITY)
    sharp.run(0.4)
    assert sharp.speed > 0.2
    sharp.run(3)
    assert sharp.speed < 0.05


@pytest.mark.parametrize(
    ("frame", "expected"),
    [(1, (2.0, 0.0, -3.0)), (7, (6.0, 0.0, -5.0)), (8, (4.0, 2.0, -5.0)), (9, (4.0, 2.0, -5.0))],
)
def test_frames_7_to_9_are_offsets_and_8_and_9_turn_with_the_heading(frame: int, expected: tuple) -> None:
    bench = guided(yaw_rad=math.pi / 2)
    bench.setpoint((4.0, 0.0, -2.0), mask=2552, yaw=math.pi / 2)
    bench.run(15)
    assert bench.place == pytest.approx((4.0, 0.0, -2.0), abs=0.05)
    yaw = 0.0 if frame in (8, 9) else math.pi / 2  # from the heading, or from north
    assert bench.setpoint((2.0, 0.0, -3.0), mask=2552, frame=frame, yaw=yaw) is None
    bench.run(15)
    assert bench.place == pytest.approx(expected, abs=0.1)
    assert bench.controller.estimate.yaw_rad == pytest.approx(math.pi / 2, abs=0.02)


def test_an_offset_that_is_streamed_runs_away() -> None:
    bench = guided()
    for _ in range(100):
        bench.setpoint((1.0, 0.0, -0.3), frame=7)
        bench.run(0.1)
    assert bench.place[0] > 3.0
    assert bench.place[2] < -3.0


def test_without_a_yaw_it_turns_toward_travel() -> None:
    bench = guided()
    bench.setpoint((0.0, 6.0, -2.0))
    bench.run(10)
    assert bench.controller.estimate.yaw_rad == pytest.approx(math.pi / 2, abs=0.1)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"mask": 4095 & ~512 & ~1024, "yaw": 1.0}, "no position and no velocity"),  # yaw alone
        ({"mask": 4095 & ~512 & ~2048, "rate": 1.0}, "no position and no velocity"),
        ({"mask": POSITION | 4}, "no position and no velocity"),
        ({"mask": POSITION & ~448, "a": 1.0}, "position with acceleration"),
        ({"frame": 12}, "coordinate_frame 12"),
        ({"mask": POSITION & ~448 | 512, "a": 1.0}, "force is not supported"),
    ],
)
def test_what_is_not_valid_stops_it(given: dict[str, Any], why: str) -> None:
    bench = guided()
    bench.setpoint((30.0, 0.0, -2.0))
    bench.run(2)
    assert bench.setpoint(**given) == why
    bench.run(15)
    there = bench.place
    assert there[0] < 20.0
    bench.run(2)
    assert bench.place == pytest.approx(there, abs=0.05)


def test_a_setpoint_for_another_system_changes_nothing() -> None:
    bench = guided()
    bench.setpoint((8.0, 0.0, -2.0))
    bench.send(mavlink.MAVLink_set_position_target_local_ned_message(0, 2, 1, 1, 3576, *[0.0] * 11))
    bench.run(12)
    assert bench.place[0] == pytest.approx(8.0, abs=0.1)


def test_a_nan_in_a_used_field_ends_it_and_in_an_ignored_one_does_not() -> None:
    bench = guided()
    assert bench.setpoint((1.0, 0.0, -2.0), v=(NAN, NAN, NAN)) is None
    bench.setpoint((NAN, 0.0, -2.0))
    assert "x" in bench.controller.crashed
    assert bench.run(3) == []
    bench.endpoint.reboot(bench.now_ns)
    assert {m.get_type() for m in bench.run(4)} == {"HEARTBEAT"}


def test_a_jump_of_the_estimate_moves_what_is_held_and_not_the_setpoint() -> None:
    bench = guided()
    bench.controller.jump_estimate((3.0, 0.0, 0.0))
    bench.run(5)
    assert bench.controller.true_state.position_ned_m == pytest.approx((0.0, 0.0, -2.0), abs=0.05)
    bench.setpoint((0.0, 0.0, -2.0))
    bench.run(10)
    assert bench.controller.true_state.position_ned_m[0] == pytest.approx(-3.0, abs=0.1)


async def test_the_personality_is_a_parameter_and_its_modes_are_its_own() -> None:
    async with FakeAutopilot(personality="ardupilot", mode=CopterMode.LOITER) as autopilot:
        assert autopilot.mode is CopterMode.LOITER
        autopilot.change_mode(CopterMode.GUIDED)
        assert (autopilot.mode, autopilot.crashed) == (CopterMode.GUIDED, "")
    with pytest.raises(ValueError, match="ArduPilot has no mode HOLD"):
        FakeAutopilot(personality="ardupilot", mode=FlightMode.HOLD)
    with pytest.raises(ValueError, match="PX4 has no mode GUIDED"):
        FakeAutopilot(mode=CopterMode.GUIDED)
    with pytest.raises(KeyError):
        FakeAutopilot(personality="ardupilot", parameters={"COM_OF_LOSS_T": 1.0})
