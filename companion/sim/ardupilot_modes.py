"""ArduPilot Copter's flight modes as MAVLink shows them: HEARTBEAT.custom_mode is the mode's number.

https://ardupilot.org/copter/docs/parameters.html#fltmode1; base_mode as recorded from ArduCopter 4.7-dev.
"""

from __future__ import annotations

from enum import Enum

_CUSTOM_MODE = 1
_GUIDED = 8
_STABILIZED = 16
_MANUAL_INPUT = 64
_WITH_POSITION = _CUSTOM_MODE | _GUIDED | _STABILIZED | _MANUAL_INPUT


class CopterMode(Enum):
    """The modes that the fake autopilot flies: (number, base_mode bits without *armed*)."""

    STABILIZE = (0, _CUSTOM_MODE | _STABILIZED | _MANUAL_INPUT)
    AUTO = (3, _WITH_POSITION)
    GUIDED = (4, _WITH_POSITION)
    LOITER = (5, _WITH_POSITION)
    RTL = (6, _WITH_POSITION)
    LAND = (9, _WITH_POSITION)
    BRAKE = (17, _WITH_POSITION)

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.value[0]

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode of a disarmed vehicle in this mode."""
        return self.value[1]


def mode_from_number(number: int) -> CopterMode | None:
    """Return the mode of a number, or None when it is not flown here."""
    for mode in CopterMode:
        if mode.custom_mode == number:
            return mode
    return None
