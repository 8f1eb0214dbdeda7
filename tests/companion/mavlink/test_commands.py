"""Commands to our component: carried out, refused, and always acknowledged."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.commands import CommandServer, read_command, version_message
from companion.mavlink.framing import Framer
from companion.mavlink.plots import Intervals

ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3


class Bench:
    def __init__(self) -> None:
        self.asked: list[tuple[bool, str]] = []
        self.may_engage = True
        self.intervals = Intervals({251: 500_000, 390: -1})
        self.server = CommandServer(
            engage=self.engage,
            messages={148: lambda now_ns: version_message("1.2.3", 1, 191)},
            streams=self.intervals,
        )

    def engage(self, on: bool, now_ns: int, sender: str) -> bool:
        self.asked.append((on, sender))
        return self.may_engage

    def send(self, number: int, *params: float, as_int: bool = False):
        link = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        p = [*params, *([0.0] * (7 - len(params)))]
        if as_int:
            message = mavlink.MAVLink_command_int_message(1, 191, 0, number, 0, 0, *p[:4], 0, 0, p[6])
        else:
            message = mavlink.MAVLink_command_long_message(1, 191, number, 0, *p)
        (frame,) = Framer().feed(bytes(message.pack(link)))
        answers = self.server.answer(read_command(frame), 0)
        sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        return [mavlink.MAVLink(None).decode(bytearray(answer.pack(sender))) for answer in answers]


@pytest.fixture
def bench():
    return Bench()


@pytest.mark.parametrize("as_int", [False, True])
@pytest.mark.parametrize("number", [92, 31010])
def test_engaging_by_command(bench, number, as_int):
    (ack,) = bench.send(number, 1.0, as_int=as_int)
    assert (ack.command, ack.result, ack.target_system, ack.target_component) == (number, ACCEPTED, 255, 190)
    (ack,) = bench.send(number, 0.0, as_int=as_int)
    assert ack.result == ACCEPTED
    assert bench.asked == [(True, "255/190"), (False, "255/190")]


def test_a_refused_request_is_acknowledged_as_such(bench):
    bench.may_engage = False
    assert bench.send(92, 1.0)[0].result == REJECTED


@pytest.mark.parametrize("wanted", [0.5, 2.0, -1.0, math.nan])
def test_neither_on_nor_off_is_denied(bench, wanted):
    assert bench.send(92, wanted)[0].result == DENIED
    assert bench.asked == []


def test_the_version_comes_behind_the_ack(bench):
    for command in ((512, 148.0), (520, 1.0)):
        ack, version = bench.send(*command)
        assert ack.result == ACCEPTED
        assert version.get_type() == "AUTOPILOT_VERSION"
        assert version.flight_sw_version == 1 << 24 | 2 << 16 | 3 << 8 | 255
        assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST


@pytest.mark.parametrize(
    ("version", "number"),
    [
        ("0.1.0", 0x0001_00FF),
        ("0.1.0.dev3", 0x0001_0000),
        ("2.10.7rc1", 0x020A_0700),
        ("300.0.0", 0xFF00_0000),
    ],
)
def test_versions_as_mavlink_has_them(version, number):
    assert version_message(version, 1, 191).flight_sw_version == number


def test_intervals_are_set_read_and_refused(bench):
    assert bench.send(511, 251.0, 100_000.0)[0].result == ACCEPTED
    ack, interval = bench.send(510, 251.0)
    assert (ack.result, interval.message_id, interval.interval_us) == (ACCEPTED, 251, 100_000)
    assert bench.send(511, 251.0, 0.0)[0].result == ACCEPTED
    assert bench.send(510, 251.0)[1].interval_us == 500_000
    assert bench.send(511, 251.0, -1.0)[0].result == ACCEPTED
    assert not bench.intervals.is_due(251, 0)
    assert bench.send(511, 30.0, 100_000.0)[0].result == UNSUPPORTED
    assert bench.send(511, 251.0, math.nan)[0].result == DENIED
    assert bench.send(511, 251.0, -7.0)[0].result == DENIED
    assert bench.send(510, 30.0)[0].result == UNSUPPORTED


@pytest.mark.parametrize(
    "command", [(176, 1.0), (400, 1.0), (246, 1.0), (16,), (512, 30.0), (512, math.nan), (65535,)]
)
def test_what_is_not_ours_is_unsupported(bench, command):
    (ack,) = bench.send(*command)
    assert (ack.command, ack.result) == (command[0], UNSUPPORTED)
