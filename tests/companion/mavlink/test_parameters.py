"""The parameter protocol, with pymavlink on the other side."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.framing import Framer
from companion.mavlink.parameters import ParameterServer, read_request

NAMES = tuple(f"P_{place:02}" for place in range(11))


class Store:
    def __init__(self) -> None:
        self.values = dict.fromkeys(NAMES, 1.5)

    def names(self):
        return NAMES

    def number(self, name):
        return self.values[name]

    def set_number(self, name, number, now_ns):
        if number > 10:
            return f"{name}: too much"
        self.values[name] = number
        return None


def request(message, *, v1: bool = False):
    link = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    (frame,) = Framer().feed(bytes(message.pack(link, force_mavlink1=v1)))
    return read_request(frame)


@pytest.fixture
def server():
    return ParameterServer(Store())


def sent(messages):
    """What a ground station reads."""
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    parser = mavlink.MAVLink(None)
    return [parser.decode(bytearray(message.pack(link))) for message in messages]


@pytest.mark.parametrize("v1", [False, True])
def test_requests_are_read_as_they_were_packed(v1):
    got = request(mavlink.MAVLink_param_set_message(1, 191, b"VOID_DET_AGE_HOV", 2.5, 9), v1=v1)
    assert (got.name, got.number, got.type) == ("VOID_DET_AGE_HOV", 2.5, 9)
    assert (got.target_system, got.target_component) == (1, 191)
    got = request(mavlink.MAVLink_param_request_read_message(1, 191, b"P_03", -1), v1=v1)
    assert (got.name, got.index) == ("P_03", -1)
    got = request(mavlink.MAVLink_param_request_read_message(1, 191, b"", 4), v1=v1)
    assert (got.name, got.index) == ("", 4)
    got = request(mavlink.MAVLink_param_request_list_message(1, 0), v1=v1)
    assert (got.target_system, got.target_component) == (1, 0)


def test_a_list_comes_by_and_by_and_complete(server):
    assert server.answer(request(mavlink.MAVLink_param_request_list_message(1, 191)), 0) == ([], None)
    portions = []
    while portion := server.due():
        portions.append(sent(portion))
    values = [value for portion in portions for value in portion]
    assert [(v.param_id, v.param_index, v.param_count, v.param_type) for v in values] == [
        (name, index, len(NAMES), 9) for index, name in enumerate(NAMES)
    ]
    assert max(map(len, portions)) <= 4


def test_a_list_asked_for_again_and_again_comes_to_its_end_for_everybody(server):
    ask = request(mavlink.MAVLink_param_request_list_message(1, 191))
    came = []
    for _ in range(6):
        server.answer(ask, 0)
        came += [value.param_index for value in sent(server.due())]
    assert set(came) == set(range(len(NAMES)))
    while portion := server.due():
        came += [value.param_index for value in sent(portion)]
    last = came[-len(NAMES) - 4 :]  # whoever asked last has everything
    assert set(last) == set(range(len(NAMES)))


def test_one_is_read_by_name_and_by_index(server):
    for ask in (
        mavlink.MAVLink_param_request_read_message(1, 191, b"P_03", -1),
        mavlink.MAVLink_param_request_read_message(1, 191, b"", 3),
    ):
        answers, _ = server.answer(request(ask), 0)
        (value,) = sent(answers)
        assert (value.param_id, value.param_index, value.param_value) == ("P_03", 3, 1.5)


@pytest.mark.parametrize(("name", "index"), [(b"NOPE", -1), (b"", 99), (b"P_0", -1), (b"\xff\xfe", -1)])
def test_what_is_not_there_is_not_answered(server, name, index):
    ask = mavlink.MAVLink_param_request_read_message(1, 191, name, index)
    assert server.answer(request(ask), 0) == ([], None)


def test_a_value_that_is_set_comes_back(server):
    answers, why_not = server.answer(request(mavlink.MAVLink_param_set_message(1, 191, b"P_05", 2.5, 9)), 0)
    assert why_not is None
    assert (sent(answers)[0].param_id, sent(answers)[0].param_value) == ("P_05", 2.5)


@pytest.mark.parametrize(("number", "kind", "why"), [(11.0, 9, "too much"), (2.0, 6, "allowed: 9 (REAL32)")])
def test_a_refused_value_brings_the_one_in_force_and_the_reason(server, number, kind, why):
    ask = mavlink.MAVLink_param_set_message(1, 191, b"P_05", number, kind)
    answers, why_not = server.answer(request(ask), 0)
    assert why in why_not
    assert sent(answers)[0].param_value == 1.5


def test_an_unknown_name_is_not_set(server):
    ask = mavlink.MAVLink_param_set_message(1, 191, b"NOPE", 1.0, 9)
    assert server.answer(request(ask), 0) == ([], None)
