"""What asks for OFFBOARD, GUIDED or arming, and what does not."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.framing import Framer
from companion.mavlink.requests import EngageRequest, engage_request
from companion.mavlink.telemetry import Heartbeat

PX4 = Heartbeat(1, 1, 2, 12, 1, 4 << 16, 4)
COPTER = Heartbeat(1, 1, 2, 3, 1, 5, 4)
ROVER = Heartbeat(1, 1, 10, 3, 1, 5, 4)


def asked(message, vehicle, *, v1=False):
    sender = mavlink.MAVLink(None, srcSystem=245, srcComponent=190)
    (frame,) = Framer().feed(bytes(message.pack(sender, force_mavlink1=v1)))
    return engage_request(frame, vehicle)


def command(number, *params, target=1):
    return mavlink.MAVLink_command_long_message(target, 1, number, 0, *params, *[0] * (7 - len(params)))


def command_int(number, *params):
    return mavlink.MAVLink_command_int_message(
        1, 1, 0, number, 0, 0, *params, *[0] * (4 - len(params)), 7, -9, 0
    )


@pytest.mark.parametrize("v1", [False, True])
@pytest.mark.parametrize("make", [command, command_int])
def test_offboard_of_px4_and_guided_of_copter_are_requests(make, v1):
    assert asked(make(176, 1, 6), PX4, v1=v1) == EngageRequest(arm=False, offboard=True)
    assert asked(make(176, 1, 4), COPTER, v1=v1) == EngageRequest(arm=False, offboard=True)
    assert asked(make(400, 1), PX4, v1=v1) == EngageRequest(arm=True, offboard=False)


@pytest.mark.parametrize("v1", [False, True])
def test_set_mode_is_a_request_too(v1):
    assert asked(mavlink.MAVLink_set_mode_message(1, 1, 6 << 16), PX4, v1=v1).offboard
    assert asked(mavlink.MAVLink_set_mode_message(1, 1, 4), COPTER, v1=v1).offboard
    assert asked(mavlink.MAVLink_set_mode_message(1, 0, 6 << 16), PX4, v1=v1) is None
    assert asked(mavlink.MAVLink_set_mode_message(1, 1, 4 << 16), PX4, v1=v1) is None


def test_other_modes_other_vehicles_disarming_and_other_commands_are_none():
    assert asked(command(176, 1, 4, 3), PX4) is None
    assert asked(command(176, 0, 6), PX4) is None
    assert asked(command(176, 1, 6), COPTER) is None
    assert asked(command(176, 1, 4), ROVER) is None
    assert asked(command(176, 1, 6, target=2), PX4) is None
    assert asked(command(176, 1, 6, target=0), PX4) == EngageRequest(arm=False, offboard=True)
    assert asked(command(400, 0), PX4) is None
    assert asked(command(21), PX4) is None
    assert asked(command(176, float("nan"), float("inf")), PX4) is None
    assert asked(command(176, 1, -6), PX4) is None
