from __future__ import annotations

import math
import random
import struct
from collections import Counter
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink import telemetry
from companion.mavlink.framing import Framer
from companion.sim.autopilot_endpoint import AutopilotEndpoint
from companion.sim.flight_controller import FlightController
from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode, mode_from_custom
from companion.sim.vehicle import Vehicle
from companion.sim.wire import FrameReader, FrameWriter

SECOND = 1_000_000_000
TICK = 5_000_000
NAN = math.nan


class Bench:
    """An autopilot on a bench: time is ours, and there is no socket."""

    def __init__(self, **controller: Any) -> None:
        self.now_ns = 77 * SECOND
        parameters = ParameterTable({"COM_OBL_RC_ACT": 5})
        self.controller = FlightController(self.now_ns, parameters=parameters, **controller)
        self.endpoint = AutopilotEndpoint(self.controller, keep_frames=True)
        self.writer = FrameWriter(1, 191)
        self._reader = FrameReader()

    def decode(self, frames: list[bytes]) -> list[Any]:
        """The messages that the dialect knows."""
        found = [frame.message for raw in frames for frame in self._reader.read(raw)]
        return [message for message in found if message is not None]

    def send(self, message: Any) -> list[Any]:
        return self.decode(self.endpoint.receive(self.writer.pack(message), self.now_ns))

    def command(self, command: int, *params: float) -> list[Any]:
        padded = [*params, *([0.0] * (7 - len(params)))]
        return self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *padded))

    def setpoint(
        self, x: float, y: float, z: float, *, mask: int = 3576, frame: int = 1, target: int = 1
    ) -> None:
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, target, 1, frame, mask, x, y, z, 0, 0, 0, 0, 0, 0, 0, 0
            )
        )

    def run(self, seconds: float, **setpoint: float) -> list[Any]:
        """Let time pass, streaming a setpoint at 20 Hz where one is given."""
        frames = []
        for tick in range(round(seconds * SECOND / TICK)):
            if setpoint and tick % 10 == 0:
                self.setpoint(**setpoint)
            self.now_ns += TICK
            frames += self.endpoint.advance(self.now_ns)
        return self.decode(frames)


def hovering() -> Bench:
    return Bench(vehicle=Vehicle(position_ned_m=(0.0, 0.0, -2.0)), armed=True)


def offboard() -> Bench:
    bench = hovering()
    bench.setpoint(0.0, 0.0, -2.0)
    assert bench.command(176, 1, 6, 0)[0].result == 0
    return bench


def test_rates_are_those_of_px4() -> None:
    seconds = 4
    counts = Counter(message.get_type() for message in Bench().run(seconds))
    expected = {
        "HEARTBEAT": 1,
        "ATTITUDE": 100,
        "ATTITUDE_QUATERNION": 50,
        "LOCAL_POSITION_NED": 30,
        "POSITION_TARGET_LOCAL_NED": 10,
        "EXTENDED_SYS_STATE": 5,
        "GLOBAL_POSITION_INT": 50,
        "ODOMETRY": 30,
    }
    for name, rate_hz in expected.items():
        assert counts[name] == pytest.approx(rate_hz * seconds, abs=max(1, 0.02 * rate_hz * seconds)), name


def test_times_since_boot_increase_and_agree() -> None:
    messages = Bench().run(2)
    for name in ("ATTITUDE", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"):
        times = [m.time_boot_ms for m in messages if m.get_type() == name]
        assert times == sorted(set(times))
        assert 1950 <= times[-1] <= 2000


def test_the_heartbeat_says_px4_mode_and_arming() -> None:
    bench = offboard()
    beats = [m for m in bench.run(1.1, x=0.0, y=0.0, z=-2.0) if m.get_type() == "HEARTBEAT"]
    assert beats[-1].autopilot == 12
    assert beats[-1].base_mode == 145
    assert mode_from_custom(beats[-1].custom_mode) is FlightMode.OFFBOARD


def test_current_mode_comes_every_two_seconds_and_as_often_as_it_is_asked_for() -> None:
    bench = offboard()
    reader = Framer()

    def modes(seconds: float) -> list[int]:
        before = len(bench.endpoint.sent_frames)
        bench.run(seconds, x=0.0, y=0.0, z=-2.0)
        frames = reader.feed(b"".join(bench.endpoint.sent_frames[before:]))
        found = [telemetry.decode(f) for f in frames if f.message_id == 436 and f.verified]
        return [m.custom_mode for m in found if isinstance(m, telemetry.CurrentMode)]

    assert modes(4) == [FlightMode.OFFBOARD.custom_mode] * 2
    assert bench.command(511, 436, 50_000)[0].result == 0
    assert len(modes(1)) == pytest.approx(20, abs=1)
    bench.command(176, 1, 4, 3)
    assert set(modes(0.2)) == {FlightMode.HOLD.custom_mode}


def test_offboard_is_refused_without_a_stream_and_kept_with_one() -> None:
    bench = hovering()
    assert bench.command(176, 1, 6, 0)[0].result == 1
    bench = offboard()
    bench.run(3, x=3.0, y=1.0, z=-2.5)
    assert bench.controller.mode is FlightMode.OFFBOARD
    bench.run(4, x=3.0, y=1.0, z=-2.5)
    assert bench.controller.estimate.position_ned_m == pytest.approx((3.0, 1.0, -2.5), abs=0.1)


@pytest.mark.parametrize(
    "wrong",
    [{"frame": 8}, {"frame": 7}, {"target": 2}, {"x": NAN, "y": NAN, "z": NAN}, {"mask": 4095 & ~512}],
)
def test_refused_setpoints_do_not_keep_offboard(wrong: dict[str, Any]) -> None:
    bench = offboard()
    texts = [
        m.text
        for m in bench.run(1.2, **{"x": 1.0, "y": 0.0, "z": -2.0, **wrong})
        if m.get_type() == "STATUSTEXT"
    ]
    assert bench.controller.mode is FlightMode.HOLD
    assert "No offboard signal" in texts
    assert bench.endpoint.setpoints[-1].refusal is not None
    bench.setpoint(0.0, 0.0, -2.0)
    bench.run(0.01)
    assert bench.controller.mode is FlightMode.OFFBOARD


def test_a_hole_in_the_position_stops_it_without_leaving_offboard() -> None:
    bench = offboard()
    bench.run(4, x=NAN, y=0.0, z=-6.0)
    assert bench.controller.mode is FlightMode.OFFBOARD
    assert bench.controller.estimate.position_ned_m == pytest.approx((0.0, 0.0, -2.0), abs=0.05)


def test_two_sources_pull_it_to_and_fro() -> None:
    bench = offboard()
    for _ in range(100):
        bench.setpoint(5.0, 0.0, -2.0)
        bench.run(0.025)
        bench.setpoint(-5.0, 0.0, -2.0)
        bench.run(0.025)
    assert abs(bench.controller.estimate.position_ned_m[0]) < 1.0
    assert len(bench.endpoint.setpoints) == 201


def test_without_a_pilot_posctl_sinks() -> None:
    bench = hovering()
    bench.controller.parameters.set("COM_OBL_RC_ACT", 0)
    bench.setpoint(0.0, 0.0, -2.0)
    bench.command(176, 1, 6, 0)
    bench.run(3.0)
    assert bench.controller.mode is FlightMode.POSCTL
    assert -1.4 < bench.controller.estimate.position_ned_m[2] < -0.9


def test_position_target_is_nan_on_the_ground_and_the_target_in_flight() -> None:
    ground = [m for m in Bench().run(0.2) if m.get_type() == "POSITION_TARGET_LOCAL_NED"][-1]
    assert ground.type_mask == 63
    assert all(math.isnan(v) for v in (ground.x, ground.y, ground.z, ground.vx, ground.vy, ground.vz))
    bench = offboard()
    echo = [m for m in bench.run(0.3, x=1.0, y=2.0, z=-2.0) if m.get_type() == "POSITION_TARGET_LOCAL_NED"][
        -1
    ]
    assert (echo.type_mask, echo.x, echo.y, echo.z) == (0, 1.0, 2.0, -2.0)


def test_take_off_hold_return_and_land() -> None:
    bench = Bench()
    assert bench.command(400, 1)[0].result == 0
    assert bench.command(22)[0].result == 0
    states = [m.landed_state for m in bench.run(6) if m.get_type() == "EXTENDED_SYS_STATE"]
    assert states[0] in (1, 3)
    assert 3 in states
    assert states[-1] == 2
    assert bench.controller.mode is FlightMode.HOLD
    assert bench.controller.estimate.position_ned_m[2] == pytest.approx(-2.5, abs=0.2)
    bench.setpoint(4.0, 0.0, -2.5)
    bench.command(176, 1, 6, 0)
    bench.run(4, x=4.0, y=0.0, z=-2.5)
    assert bench.command(20)[0].result == 0
    states = [m.landed_state for m in bench.run(25) if m.get_type() == "EXTENDED_SYS_STATE"]
    assert 4 in states
    assert states[-1] == 1
    assert not bench.controller.armed
    north, east, down = bench.controller.estimate.position_ned_m
    assert math.hypot(north, east) < 0.6
    assert down == 0.0


def test_commands_that_it_does_not_know_are_answered_too() -> None:
    bench = Bench()
    ack = bench.command(2500)[0]
    assert (ack.get_type(), ack.result, ack.command) == ("COMMAND_ACK", 3, 2500)
    assert (ack.target_system, ack.target_component) == (1, 191)
    assert bench.command(512, 395)[0].result == 3
    assert bench.command(176, 1, 4, 9)[0].result == 1


@pytest.mark.parametrize("message_id", [148, 242, 49])
def test_requested_messages_come_with_their_acknowledgement(message_id: int) -> None:
    ack, message = Bench().command(512, message_id)
    assert ack.result == 0
    assert message.get_msgId() == message_id


def test_message_intervals_can_be_set_asked_and_reset() -> None:
    bench = Bench()

    def rate() -> int:
        return sum(m.get_type() == "ATTITUDE" for m in bench.run(1))

    assert bench.command(511, 30, 100_000)[0].result == 0
    assert rate() == pytest.approx(10, abs=1)
    assert bench.command(510, 30)[1].interval_us == 100_000
    bench.command(511, 30, -1)
    assert rate() == 0
    bench.command(511, 30, 0)
    assert rate() == pytest.approx(100, abs=2)
    assert bench.command(511, 9999, 1000)[0].result == 3
    assert bench.command(511, 30, NAN)[0].result == 3


def test_parameters_are_listed_read_and_set() -> None:
    bench = Bench()
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1))
    listed = [m for m in bench.run(0.1) if m.get_type() == "PARAM_VALUE"]
    assert [m.param_index for m in listed] == list(range(listed[0].param_count))
    (value,) = bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"MIS_TAKEOFF_ALT", -1))
    assert (value.param_value, value.param_type) == (2.5, 9)
    four = struct.unpack("<f", struct.pack("<i", 4))[0]
    (value,) = bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", four, 6))
    assert bench.controller.parameters["COM_OBL_RC_ACT"] == 4
    (value,) = bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", NAN, 9))
    assert value.param_value == 1.0
    assert bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1)) == []
    assert bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", 999)) == []


def test_missions_files_and_time_are_answered() -> None:
    bench = Bench()
    (count,) = bench.send(mavlink.MAVLink_mission_request_list_message(1, 1, 2))
    assert (count.count, count.mission_type) == (0, 2)
    (ack,) = bench.send(mavlink.MAVLink_mission_count_message(1, 1, 3, 0))
    assert ack.type == mavlink.MAV_MISSION_UNSUPPORTED
    (reply,) = bench.send(mavlink.MAVLink_timesync_message(0, 123))
    assert reply.ts1 == 123
    (nak,) = bench.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [1, 0, 0, 4, *([0] * 247)]))
    assert bytes(nak.payload)[:6] == bytes([2, 0, 0, 129, 1, 4])


def test_messages_for_others_are_left_alone() -> None:
    bench = Bench()
    message = mavlink.MAVLink_command_long_message(1, 191, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    assert bench.send(message) == []
    assert not bench.controller.armed
    assert bench.endpoint.frame_counts["COMMAND_LONG"] == 1


def test_a_jump_of_the_estimate_shows_and_hold_moves_with_it() -> None:
    bench = hovering()
    bench.run(0.5)
    bench.controller.jump_estimate((3.0, 0.0, 0.0))
    messages = bench.run(1)
    assert bench.controller.estimate.position_ned_m == pytest.approx((3.0, 0.0, -2.0), abs=0.01)
    assert bench.controller.true_state.position_ned_m == pytest.approx((0.0, 0.0, -2.0), abs=0.01)
    assert [m for m in messages if m.get_type() == "ODOMETRY"][-1].reset_counter == 1
    bench.setpoint(0.0, 0.0, -2.0)
    bench.command(176, 1, 6, 0)
    bench.run(8, x=0.0, y=0.0, z=-2.0)
    assert bench.controller.true_state.position_ned_m == pytest.approx((-3.0, 0.0, -2.0), abs=0.1)


def test_a_reboot_is_silent_then_starts_at_zero_disarmed() -> None:
    bench = Bench()
    bench.run(3)
    assert bench.command(246, 1)[0].result == 0
    assert bench.run(1.9) == []
    assert bench.command(512, 148) == []
    after = bench.run(0.3)
    times = [m.time_boot_ms for m in after if m.get_type() == "ATTITUDE"]
    assert 1900 < times[0] < 2100
    assert not bench.controller.armed
    bench = hovering()
    assert bench.command(246, 1)[0].result == 2
    bench.endpoint.reboot(bench.now_ns)
    bench.run(1)
    assert bench.controller.true_state.on_ground


def test_the_record_keeps_the_bytes_and_decodes_them() -> None:
    bench = Bench()
    raw = bench.writer.pack(
        mavlink.MAVLink_set_position_target_local_ned_message(
            9, 1, 1, 1, 2552, 1, 2, -3, 0, 0, 0, 0, 0, 0, 0.5, 0
        )
    )
    bench.endpoint.receive(raw, 5, ("127.0.0.1", 9))
    (record,) = bench.endpoint.setpoints
    assert record.raw == raw
    assert (record.time_ns, record.seq, record.system_id, record.component_id) == (5, 0, 1, 191)
    assert record.sender == ("127.0.0.1", 9)
    assert (record.setpoint.x, record.setpoint.z, record.setpoint.yaw) == (1.0, -3.0, 0.5)
    assert record.refusal is None
    assert bench.endpoint.received_frames == [raw]


def test_old_and_unknown_frames_are_counted_and_kept() -> None:
    bench = Bench()
    v1 = mavlink.MAVLink_ping_message(1, 2, 3, 4).pack(mavlink.MAVLink(None, 7, 8), force_mavlink1=True)
    unknown = bytes([0xFD, 2, 0, 0, 5, 1, 1, 0xB4, 1, 0, 9, 9, 0, 0])
    bench.endpoint.receive(v1 + unknown, 0)
    assert bench.endpoint.frame_counts == {"PING": 1, "UNKNOWN_436": 1}
    assert bench.endpoint.received_frames == [v1, unknown]


def test_sound_frames_between_stray_bytes_are_found() -> None:
    bench = Bench()
    beat = bench.writer.pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    bench.endpoint.receive(b"\xfd" * 40 + beat + b"\xfe\xfd\x00" + beat, 0)
    assert bench.endpoint.frame_counts["HEARTBEAT"] == 2
    assert bench.endpoint.bad_bytes >= 43


def test_malformed_input_never_raises() -> None:
    bench = hovering()
    rng = random.Random(1)
    messages = [
        mavlink.MAVLink_command_long_message(1, 1, rng.choice([176, 400, 511, 512, 22, 510]), 0, *([v] * 7))
        for v in (0.0, 1.0, NAN, math.inf, -math.inf, 3e38, -3e38)
        for _ in range(6)
    ]
    messages += [
        mavlink.MAVLink_set_position_target_local_ned_message(
            rng.getrandbits(32),
            1,
            1,
            rng.choice([1, 8]),
            rng.getrandbits(16),
            *(rng.choice([0.0, NAN, math.inf, 3e38, -3e38]) for _ in range(11)),
        )
        for _ in range(200)
    ]
    for message in messages:
        bench.send(message)
        bench.run(0.02)
    sound = [bench.writer.pack(m) for m in messages]
    for _ in range(3000):
        raw = bytearray(rng.choice(sound))
        for _ in range(rng.randrange(4)):
            raw[rng.randrange(len(raw))] = rng.getrandbits(8)
        bench.endpoint.receive(bytes(raw[: rng.randrange(len(raw) + 1)]), bench.now_ns)
        bench.endpoint.receive(rng.randbytes(rng.randrange(80)), bench.now_ns)
    for message_id in mavlink.mavlink_map:
        payload = rng.randbytes(rng.randrange(1, 256))
        header = struct.pack(
            "<BBBBBBHB", len(payload), 0, 0, 1, 1, 191, message_id & 0xFFFF, message_id >> 16
        )
        crc = mavlink.x25crc(header + payload + bytes([mavlink.mavlink_map[message_id].crc_extra])).crc
        bench.endpoint.receive(b"\xfd" + header + payload + struct.pack("<H", crc), bench.now_ns)
    assert len(bench.endpoint.frame_counts) > 100
    assert bench.run(3)
    assert all(map(math.isfinite, bench.controller.estimate.position_ned_m))
