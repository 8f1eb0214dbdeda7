"""PX4's flight modes as MAVLink shows them.

HEARTBEAT.custom_mode = main << 16 | sub << 24, https://docs.px4.io/main/en/concept/flight_modes.html
"""

from __future__ import annotations

from enum import Enum

_CUSTOM_MODE = 1
_AUTO = 4
_GUIDED = 8
_STABILIZED = 16
_MANUAL_INPUT = 64


class FlightMode(Enum):
    """The modes that the fake autopilot flies: (main mode, sub-mode, base_mode bits without *armed*)."""

    POSCTL = (3, 0, _MANUAL_INPUT | _STABILIZED | _CUSTOM_MODE)
    TAKEOFF = (4, 2, _STABILIZED | _GUIDED | _AUTO | _CUSTOM_MODE)
    HOLD = (4, 3, _STABILIZED | _GUIDED | _AUTO | _CUSTOM_MODE)
    MISSION = (4, 4, _STABILIZED | _GUIDED | _AUTO | _CUSTOM_MODE)
    RTL = (4, 5, _STABILIZED | _GUIDED | _AUTO | _CUSTOM_MODE)
    LAND = (4, 6, _STABILIZED | _GUIDED | _AUTO | _CUSTOM_MODE)
    OFFBOARD = (6, 0, _STABILIZED | _CUSTOM_MODE)

    @property
    def main(self) -> int:
        """PX4's main mode number."""
        return self.value[0]

    @property
    def sub(self) -> int:
        """PX4's sub-mode number, 0 where the main mode has none."""
        return self.value[1]

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode of a disarmed vehicle in this mode."""
        return self.value[2]

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.main << 16 | self.sub << 24


def mode_from_numbers(main: int, sub: int) -> FlightMode | None:
    """Return the mode with PX4's numbers (as in DO_SET_MODE params 2 and 3), or None when it is not flown here."""
    for mode in FlightMode:
        if mode.main == main and mode.sub == sub:
            return mode
    return None


def mode_from_custom(custom_mode: int) -> FlightMode | None:
    """Return the mode of a HEARTBEAT.custom_mode, or None when it is not flown here."""
    return mode_from_numbers(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)
