"""The few parameters that the fake autopilots have, and how they are put into PARAM_VALUE.

https://mavlink.io/en/services/parameter.html (PX4 encodes integers byte-wise, ArduPilot as numbers)
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

MAV_PARAM_TYPE_INT32 = 6
MAV_PARAM_TYPE_REAL32 = 9

_DEFAULTS: dict[str, int | float] = {
    "BAT1_N_CELLS": 4,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_RC_OVERRIDE": 1,
    "MAV_COMP_ID": 1,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_LAND_SPEED": 0.7,
    "MPC_TKO_SPEED": 1.5,
    "MPC_XY_CRUISE": 5.0,
    "RTL_RETURN_ALT": 5.0,
    "SYS_AUTOSTART": 4001,
}

COPTER_DEFAULTS: dict[str, int | float] = {
    "DISARM_DELAY": 10,
    "FRAME_CLASS": 1,
    "GUID_TIMEOUT": 3.0,
    "MAV_SYSID": 1,
    "RTL_ALT": 1500,
    "WPNAV_SPEED": 1000,
}
"""As ArduCopter 4.7-dev's."""


class ParameterTable:
    """Names in alphabetical order, values of int (INT32) or float (REAL32).

    Parameters
    ----------
    changed
        Values that differ from the defaults.
    defaults
        All there are; None: PX4's.
    bytewise
        Whether an integer is put into the float byte by byte (PX4), or as the number that it is (ArduPilot).

    Raises
    ------
    KeyError
        When ``changed`` names a parameter that is not there.
    """

    def __init__(
        self,
        changed: Mapping[str, int | float] | None = None,
        *,
        defaults: Mapping[str, int | float] | None = None,
        bytewise: bool = True,
    ) -> None:
        self._values = dict(_DEFAULTS if defaults is None else defaults)
        self._bytewise = bytewise
        for name, value in (changed or {}).items():
            self.set(name, value)

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __getitem__(self, name: str) -> int | float:
        return self._values[name]

    def names(self) -> tuple[str, ...]:
        """Return all names; the place in it is the parameter's index."""
        return tuple(self._values)

    def set(self, name: str, value: float) -> None:
        """Set a value, kept in the parameter's own type.

        Raises
        ------
        KeyError
            When there is no such parameter.
        """
        kind = type(self._values[name])
        self._values[name] = kind(value)

    def wire_value(self, name: str) -> tuple[float, int]:
        """Return PARAM_VALUE's ``param_value`` and ``param_type``."""
        value = self._values[name]
        if isinstance(value, int):
            if not self._bytewise:
                return float(value), MAV_PARAM_TYPE_INT32
            return struct.unpack("<f", struct.pack("<i", value))[0], MAV_PARAM_TYPE_INT32
        return value, MAV_PARAM_TYPE_REAL32

    def set_from_wire(self, name: str, wire_value: float, wire_type: int) -> bool:
        """Take PARAM_SET's value; return False, changing nothing, when name, type or value do not fit."""
        if name not in self._values:
            return False
        if isinstance(self._values[name], int):
            if not self._bytewise:
                if not math.isfinite(wire_value):
                    return False
                self._values[name] = round(wire_value)
                return True
            if wire_type != MAV_PARAM_TYPE_INT32:
                return False
            self._values[name] = struct.unpack("<i", struct.pack("<f", wire_value))[0]
            return True
        if wire_type != MAV_PARAM_TYPE_REAL32 or not math.isfinite(wire_value):
            return False
        self._values[name] = wire_value
        return True
