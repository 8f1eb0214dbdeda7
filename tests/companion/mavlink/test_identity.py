"""What we say as our own component, read back with pymavlink."""

import pytest
from pymavlink.dialects.v20 import common

from companion.mavlink.identity import Identity, MavSeverity, MavState, is_autopilot, text_chunks
from companion.mavlink.telemetry import Heartbeat

PX4 = Heartbeat(7, 1, 2, 12, 81, 6 << 16, 4)
COPTER = Heartbeat(3, 1, 2, 3, 81, 4, 4)


class Recorder:
    def __init__(self):
        self.datagrams = []

    def send(self, datagram):
        self.datagrams.append(datagram)
        return 1

    def messages(self):
        parser = common.MAVLink(None)
        return [parser.decode(bytearray(d)) for d in self.datagrams]


class Bench:
    def __init__(self, **options):
        self.planner, self.autopilot, self.now_ns = Recorder(), Recorder(), 0
        self.identity = Identity(self.planner, self.autopilot, now_ns=lambda: self.now_ns, **options)

    def texts(self):
        return [m.text for m in self.autopilot.messages() if m.get_type() == "STATUSTEXT"]


def test_heartbeat_says_onboard_controller_with_the_vehicles_system_id():
    bench = Bench(component_id=196)
    bench.identity.heartbeat(MavState.BOOT)
    assert bench.identity.learn(PX4)
    bench.identity.heartbeat(MavState.CRITICAL)
    first, second = bench.autopilot.messages()
    assert (first.get_srcSystem(), first.get_srcComponent()) == (1, 196)
    assert (second.get_srcSystem(), second.get_srcComponent()) == (7, 196)
    assert (second.type, second.autopilot, second.base_mode) == (18, 8, 0)
    assert [m.system_status for m in (first, second)] == [1, 5]
    assert [m.get_seq() for m in (first, second)] == [0, 1]
    assert bench.planner.datagrams == bench.autopilot.datagrams


@pytest.mark.parametrize(
    "heartbeat",
    [
        Heartbeat(255, 190, 6, 8, 0, 0, 4),  # a ground station
        Heartbeat(1, 191, 18, 8, 0, 0, 4),  # a companion
        Heartbeat(1, 154, 26, 8, 0, 0, 4),  # a gimbal
        Heartbeat(0, 1, 2, 12, 0, 0, 4),
    ],
)
def test_only_an_autopilot_tells_who_the_vehicle_is(heartbeat):
    assert not is_autopilot(heartbeat)
    bench = Bench()
    assert not bench.identity.learn(heartbeat)
    assert bench.identity.system_id == 1
    assert bench.identity.vehicle is None


def test_the_sequence_counter_wraps():
    bench = Bench()
    for _ in range(257):
        bench.identity.heartbeat(MavState.ACTIVE)
    assert [m.get_seq() for m in bench.autopilot.messages()][254:] == [254, 255, 0]


@pytest.mark.parametrize("length", [1, 50, 51, 100, 149])
def test_long_texts_come_in_chunks_that_join_to_the_whole(length):
    bench = Bench()
    text = "".join(chr(ord("a") + i % 26) for i in range(length))
    bench.identity.status_text(MavSeverity.WARNING, text)
    messages = bench.autopilot.messages()
    assert "".join(m.text for m in messages) == text
    assert [m.chunk_seq for m in messages] == list(range(len(messages)))
    assert len({m.id for m in messages}) == 1
    assert (messages[0].id == 0) == (length <= 50)
    assert len(messages[-1].text) < 50 or length == 50
    assert messages[0].severity == 4


def test_two_long_texts_have_different_ids_and_nulls_and_other_scripts_do_no_harm():
    bench = Bench()
    bench.identity.status_text(MavSeverity.INFO, "a" * 60)
    bench.identity.status_text(MavSeverity.INFO, "b" * 60)
    assert len({m.id for m in bench.autopilot.messages()}) == 2
    assert text_chunks("a\0b") == [b"a b"]
    assert b"".join(text_chunks("ä" * 60)).decode() == "ä" * 60


def test_the_same_text_is_sent_once_a_second():
    bench = Bench()
    for ms in range(0, 2500, 100):
        bench.now_ns = ms * 1_000_000
        bench.identity.status_text(MavSeverity.INFO, "hold")
        bench.identity.status_text(MavSeverity.INFO, f"state {ms}")
    assert bench.texts().count("hold") == 3
    assert len(bench.texts()) == 3 + 25


def test_a_flood_waits_and_what_matters_least_gives_way():
    bench = Bench(max_waiting=3)
    for i in range(6):
        bench.identity.status_text(MavSeverity.INFO, f"info {i}")
    bench.identity.status_text(MavSeverity.CRITICAL, "gave up")
    assert bench.texts() == ["info 0", "info 1", "info 2"]
    assert bench.identity.dropped_texts == 1
    bench.now_ns = 1_000_000_000
    bench.identity.heartbeat(MavState.ACTIVE)
    assert "gave up" in bench.texts()
    assert len(bench.texts()) == 6


def test_hold_is_asked_of_each_autopilot_in_its_own_words():
    bench = Bench()
    assert not bench.identity.request_hold()
    bench.identity.learn(PX4)
    assert bench.identity.request_hold()
    bench.identity.learn(COPTER)
    assert bench.identity.request_hold()
    px4, copter = bench.autopilot.messages()
    assert (px4.command, px4.target_system, px4.target_component) == (176, 7, 1)
    assert (px4.param1, px4.param2, px4.param3) == (1, 4, 3)
    assert (copter.command, copter.target_system, copter.param1, copter.param2) == (176, 3, 1, 17)
    bench.identity.learn(Heartbeat(1, 1, 2, 0, 0, 0, 4))  # a generic autopilot
    assert not bench.identity.request_hold()
