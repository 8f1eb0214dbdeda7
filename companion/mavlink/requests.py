"""What a planner or ground station asks of the vehicle that makes setpoints count: OFFBOARD or GUIDED, and arming (pure).

The autopilot tells its mode in a HEARTBEAT, once a second. A request that passes tells it at once.
https://mavlink.io/en/messages/common.html#COMMAND_LONG, #COMMAND_INT, #SET_MODE
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from companion.mavlink.framing import RawFrame
from companion.mavlink.telemetry import Heartbeat, is_offboard

SET_MODE: Final = 11
COMMAND_INT: Final = 75
COMMAND_LONG: Final = 76
MESSAGE_IDS: Final = frozenset({SET_MODE, COMMAND_INT, COMMAND_LONG})

_DO_SET_MODE: Final = 176
_COMPONENT_ARM_DISARM: Final = 400
_CUSTOM_MODE_ENABLED: Final = 1
_PARAMS_AND_COMMAND: Final = struct.Struct("<7fHB")
"""param1..param7 (COMMAND_INT: x and y are integers, which are not read), command, target_system."""
_SET_MODE: Final = struct.Struct("<IBB")
_BROADCAST: Final = 0


@dataclass(frozen=True, slots=True)
class EngageRequest:
    """What was asked for; a request for the contrary is none."""

    arm: bool
    offboard: bool


def engage_request(frame: RawFrame, vehicle: Heartbeat) -> EngageRequest | None:
    """Return what a frame asks of the vehicle, or None where it asks for neither.

    Parameters
    ----------
    frame
        One of `MESSAGE_IDS`.
    vehicle
        The autopilot's newest HEARTBEAT: the numbers of its modes depend on its kind.
    """
    if frame.message_id == SET_MODE:
        custom_mode, target, base_mode = _SET_MODE.unpack_from(frame.payload.ljust(_SET_MODE.size, b"\0"))
        asked = bool(base_mode & _CUSTOM_MODE_ENABLED) and is_offboard(vehicle, custom_mode)
        return _request(vehicle, target, arm=False, offboard=asked)
    payload = frame.payload.ljust(_PARAMS_AND_COMMAND.size, b"\0")
    param1, param2, *_, command, target = _PARAMS_AND_COMMAND.unpack_from(payload)
    if command == _COMPONENT_ARM_DISARM:
        return _request(vehicle, target, arm=param1 == 1.0, offboard=False)
    if command == _DO_SET_MODE and 0 <= param1 < 256 and 0 <= param2 < 256:
        # PX4 takes the main mode here, ArduPilot its whole custom mode.
        enabled = bool(int(param1) & _CUSTOM_MODE_ENABLED)
        asked = enabled and (is_offboard(vehicle, int(param2) << 16) or is_offboard(vehicle, int(param2)))
        return _request(vehicle, target, arm=False, offboard=asked)
    return None


def _request(vehicle: Heartbeat, target: int, *, arm: bool, offboard: bool) -> EngageRequest | None:
    if target not in (_BROADCAST, vehicle.system_id) or not (arm or offboard):
        return None
    return EngageRequest(arm, offboard)
