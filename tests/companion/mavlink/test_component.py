"""Our own component at the proxy: what is answered, what is passed on, and who is obeyed."""

from __future__ import annotations

import itertools
import time

import pytest
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import common as mavlink

from companion.config import EngagementConfig
from companion.mavlink.commands import CommandServer
from companion.mavlink.component import OwnComponent
from companion.mavlink.framing import Framer
from companion.mavlink.identity import Identity
from companion.mavlink.link import LinkCounters
from companion.mavlink.parameters import ParameterServer
from companion.mavlink.plots import Intervals
from companion.mavlink.proxy import InlineProxy
from companion.mavlink.signing import Signatures
from companion.mavlink.telemetry import Heartbeat

MS = 1_000_000
SEC = 1_000_000_000
KEY = bytes(range(32))


class Side:
    def __init__(self) -> None:
        self.on_frames = None
        self.counters = LinkCounters()
        self.sent = bytearray()
        self._framer = Framer()

    def send(self, datagram: bytes) -> int:
        self.sent += datagram
        return 1

    def hear(self, message, system: int, component: int, sign: Signatures | None = None) -> None:
        link = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        data = bytes(message.pack(link))
        self.on_frames(self._framer.feed(data if sign is None else sign.sign(data)))

    def messages(self):
        parsed = mavlink.MAVLink(None).parse_buffer(bytearray(self.sent)) or []
        self.sent.clear()
        return parsed

    def names(self) -> list[str]:
        return [message.get_type() for message in self.messages()]


class Store:
    value = 1.0

    def names(self):
        return ("ONE",)

    def number(self, name):
        return self.value

    def set_number(self, name, number, now_ns):
        self.value = number
        return


class Handler:
    def on_telemetry(self, message, now_ns):
        pass

    def on_engage_request(self, request, now_ns):
        pass


class Bench:
    def __init__(self, signatures: Signatures | None = None) -> None:
        self.now = 100 * SEC
        self.planner, self.autopilot, self.store = Side(), Side(), Store()
        self.identity = Identity(self.planner, self.autopilot, now_ns=lambda: self.now)
        self.identity.learn(Heartbeat(1, 1, 2, 12, 0, 0, 4))
        self.rc: list[tuple[int, ...]] = []
        self.flags: list[int] = []
        self.clocks: list[int] = []
        self.component = OwnComponent(
            self.identity,
            self,
            parameter_server=ParameterServer(self.store),
            command_server=CommandServer(engage=lambda *_: True, messages={}, streams=Intervals({})),
            produce=lambda now_ns: [],
            engagement=EngagementConfig(),
            timesync_interval_ns=SEC,
            signatures=signatures,
        )
        self.proxy = InlineProxy(
            self.planner, self.autopilot, Handler(), now_ns=lambda: self.now, own=self.component
        )
        for system, component in ((1, 1), (2, 191)):  # who is not known is not routed to
            self.autopilot.hear(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), system, component)
        self.planner.hear(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), 255, 190)
        self.planner.sent.clear()
        self.autopilot.sent.clear()

    def on_rc_channels(self, pulses_us, now_ns):
        self.rc.append(pulses_us)

    def on_estimator(self, flags, now_ns):
        self.flags.append(flags)

    def on_clock(self, sync, now_ns):
        self.clocks.append(sync.offset_ns)


SET = mavlink.MAVLink_param_set_message(1, 191, b"ONE", 2.0, 9)


@pytest.mark.parametrize("side", ["planner", "autopilot"])
def test_what_is_for_us_is_answered_to_both_sides_and_not_passed_on(side):
    bench = Bench()
    getattr(bench, side).hear(SET, 255, 190)
    assert bench.store.value == 2.0
    assert bench.planner.names() == bench.autopilot.names() == ["PARAM_VALUE"]


def test_commands_and_settings_of_others_pass_untouched():
    bench = Bench()
    for target in ((1, 1), (2, 191), (1, 0), (0, 0)):
        bench.planner.hear(
            mavlink.MAVLink_command_long_message(*target, 31010, 0, 1, 0, 0, 0, 0, 0, 0), 255, 190
        )
    bench.planner.hear(mavlink.MAVLink_param_set_message(1, 1, b"ONE", 2.0, 9), 255, 190)
    assert bench.autopilot.names() == ["COMMAND_LONG"] * 4 + ["PARAM_SET"]
    assert bench.planner.names() == []
    assert bench.store.value == 1.0


def test_a_list_asked_of_everybody_is_answered_and_passed_on():
    bench = Bench()
    bench.planner.hear(mavlink.MAVLink_param_request_list_message(1, 0), 255, 190)
    assert bench.autopilot.names() == ["PARAM_REQUEST_LIST"]
    bench.component.tick(bench.now)
    assert "PARAM_VALUE" in bench.planner.names()


def test_the_clock_is_asked_for_and_the_answer_is_ours_alone():
    bench = Bench()
    bench.component.tick(bench.now)
    (question,) = [m for m in bench.autopilot.messages() if m.get_type() == "TIMESYNC"]
    bench.planner.messages()
    assert (question.tc1, question.ts1) == (0, bench.now)
    bench.now += 10 * MS
    bench.autopilot.hear(mavlink.MAVLink_timesync_message(7 * SEC, question.ts1), 1, 1)
    assert bench.clocks == [93 * SEC + 5 * MS]
    assert bench.planner.names() == []
    bench.component.tick(bench.now)
    assert bench.autopilot.names() == []  # once a second
    bench.now += SEC
    bench.component.tick(bench.now)
    assert bench.autopilot.names() == ["TIMESYNC"]


def test_other_clocks_are_others_business():
    bench = Bench()
    bench.autopilot.hear(mavlink.MAVLink_timesync_message(0, 5), 1, 1)
    bench.autopilot.hear(mavlink.MAVLink_timesync_message(7, 12345), 1, 1)
    bench.planner.hear(mavlink.MAVLink_timesync_message(0, 6), 1, 197)
    assert bench.planner.names() == ["TIMESYNC", "TIMESYNC"]
    assert bench.autopilot.names() == ["TIMESYNC"]
    assert bench.clocks == []


def test_remote_control_and_estimator_are_read_of_the_vehicles_autopilot_alone():
    bench = Bench()
    channels = mavlink.MAVLink_rc_channels_message(0, 8, *range(1100, 2000, 50), 255)
    status = mavlink.MAVLink_estimator_status_message(0, 831, *([0.1] * 8))
    ekf = ardupilotmega.MAVLink_ekf_status_report_message(27, *([0.1] * 6))
    for sender in ((1, 1), (2, 1), (1, 154)):
        for message in (channels, status, ekf):
            bench.autopilot.hear(message, *sender)
    assert bench.rc == [tuple(range(1100, 1500, 50))]
    assert bench.flags == [831, 27]
    bench.planner.hear(channels, 1, 1)
    assert len(bench.rc) == 1


def test_with_a_key_only_who_has_it_is_obeyed():
    ours = Signatures(KEY, link_id=200)
    bench = Bench(ours)
    bench.planner.hear(SET, 255, 190)
    bench.planner.hear(SET, 255, 190, sign=Signatures(bytes(reversed(KEY)), link_id=1))
    assert bench.store.value == 1.0
    assert bench.component.refused_requests == 2
    assert "refused" in next(m.text for m in bench.planner.messages() if m.get_type() == "STATUSTEXT")
    bench.planner.hear(mavlink.MAVLink_param_request_read_message(1, 191, b"ONE", -1), 255, 190)
    assert "PARAM_VALUE" in bench.planner.names()  # looking is free
    bench.planner.hear(SET, 255, 190, sign=Signatures(KEY, link_id=1, unix_ns=time.time_ns))
    assert bench.store.value == 2.0
    assert "PARAM_SET" not in bench.autopilot.names()


def test_garbage_in_a_request_does_no_harm():
    bench = Bench()
    for name in (b"\xff" * 16, b"\0" * 16, "\u00fc".encode() * 8):
        bench.planner.hear(mavlink.MAVLink_param_set_message(1, 191, name, float("nan"), 9), 255, 190)
    assert bench.store.value == 1.0
    assert bench.autopilot.names() == []


def asked(bench: Bench) -> list[int]:
    """Ids of the messages that the autopilot was asked for since the last call."""
    bench.component.tick(bench.now)
    return [
        round(m.param1)
        for m in bench.autopilot.messages()
        if m.get_type() == "COMMAND_LONG" and m.command == 511
    ]


def fly(bench: Bench, seconds: float, position_hz: float, attitude_hz: float) -> None:
    """Let the autopilot send its position and attitude."""
    position = mavlink.MAVLink_local_position_ned_message(0, 1, 2, 3, 0, 0, 0)
    attitude = mavlink.MAVLink_attitude_quaternion_message(0, 1, 0, 0, 0, 0, 0, 0)
    for message, rate_hz in ((position, position_hz), (attitude, attitude_hz)):
        for _ in range(round(rate_hz * seconds)):
            bench.autopilot.hear(message, 1, 1)
    bench.now += round(seconds * SEC)


def test_a_stream_that_does_not_come_is_asked_for_and_less_and_less_often():
    bench = Bench()
    assert asked(bench) == []
    fly(bench, 4, 30, 0)
    assert asked(bench) == [30, 230]
    times = []
    for second in range(240):
        fly(bench, 1, 30, 0)
        if 30 in asked(bench):
            times.append(second)
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert gaps == sorted(gaps)
    assert 3 <= gaps[0] < 10
    assert 55 <= gaps[-1] <= 65


def test_what_comes_is_not_asked_for():
    bench = Bench()
    asked(bench)
    for _ in range(20):
        bench.autopilot.hear(mavlink.MAVLink_estimator_status_message(0, 831, *([0.1] * 8)), 1, 1)
        fly(bench, 1, 12, 25)
        assert asked(bench) == []


def test_the_answer_to_our_own_request_is_not_the_planners():
    bench = Bench()
    bench.autopilot.hear(mavlink.MAVLink_command_ack_message(511, 0, 0, 0, 1, 191), 1, 1)
    assert bench.planner.names() == []
    bench.autopilot.hear(mavlink.MAVLink_command_ack_message(511, 0, 0, 0, 255, 190), 1, 1)
    assert bench.planner.names() == ["COMMAND_ACK"]
