"""Setpoints as values, and what is decided about one of them.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED,
https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_GLOBAL_INT
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, IntFlag


class TypeMask(IntFlag):
    """POSITION_TARGET_TYPEMASK: a set bit means *ignore this field*."""

    X_IGNORE = 1
    Y_IGNORE = 2
    Z_IGNORE = 4
    VX_IGNORE = 8
    VY_IGNORE = 16
    VZ_IGNORE = 32
    AX_IGNORE = 64
    AY_IGNORE = 128
    AZ_IGNORE = 256
    FORCE_SET = 512
    YAW_IGNORE = 1024
    YAW_RATE_IGNORE = 2048

    POSITION_IGNORE = X_IGNORE | Y_IGNORE | Z_IGNORE
    VELOCITY_IGNORE = VX_IGNORE | VY_IGNORE | VZ_IGNORE
    ACCELERATION_IGNORE = AX_IGNORE | AY_IGNORE | AZ_IGNORE


class MavFrame(IntEnum):
    """The MAV_FRAME values that setpoints carry."""

    GLOBAL = 0
    LOCAL_NED = 1
    GLOBAL_RELATIVE_ALT = 3
    GLOBAL_INT = 5
    GLOBAL_RELATIVE_ALT_INT = 6
    LOCAL_OFFSET_NED = 7
    BODY_NED = 8
    BODY_OFFSET_NED = 9
    GLOBAL_TERRAIN_ALT = 10
    GLOBAL_TERRAIN_ALT_INT = 11


_BITS = (8, 16, 32, 64, 128, 256, 1024, 2048)
_NAMES = ("vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")


@dataclass(frozen=True, slots=True)
class LocalSetpoint:
    """The fields of SET_POSITION_TARGET_LOCAL_NED, as on the wire (m, m/s, m/s^2, rad, rad/s)."""

    time_boot_ms: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    afx: float
    afy: float
    afz: float
    yaw: float
    yaw_rate: float
    type_mask: int
    target_system: int
    target_component: int
    coordinate_frame: int

    def used_fields(self) -> dict[str, float]:
        """Return the float fields that type_mask does not ignore, by name."""
        return _used(self, ("x", "y", "z", *_NAMES), (1, 2, 4, *_BITS))

    def nonfinite_used_fields(self) -> tuple[str, ...]:
        """Return the names of used fields that are NaN or infinite."""
        return tuple(name for name, value in self.used_fields().items() if not math.isfinite(value))


@dataclass(frozen=True, slots=True)
class GlobalSetpoint:
    """The fields of SET_POSITION_TARGET_GLOBAL_INT, as on the wire (1e-7 deg, m, m/s, m/s^2, rad, rad/s)."""

    time_boot_ms: int
    lat_int: int
    lon_int: int
    alt: float
    vx: float
    vy: float
    vz: float
    afx: float
    afy: float
    afz: float
    yaw: float
    yaw_rate: float
    type_mask: int
    target_system: int
    target_component: int
    coordinate_frame: int

    def used_fields(self) -> dict[str, float]:
        """Return the float fields that type_mask does not ignore, by name; latitude and longitude are integers."""
        return _used(self, ("alt", *_NAMES), (4, *_BITS))

    def nonfinite_used_fields(self) -> tuple[str, ...]:
        """Return the names of used fields that are NaN or infinite."""
        return tuple(name for name, value in self.used_fields().items() if not math.isfinite(value))


Setpoint = LocalSetpoint | GlobalSetpoint


def _used(setpoint: Setpoint, names: tuple[str, ...], bits: tuple[int, ...]) -> dict[str, float]:
    mask = setpoint.type_mask
    return {name: getattr(setpoint, name) for name, bit in zip(names, bits, strict=True) if not mask & bit}


@dataclass(frozen=True, slots=True)
class Forward:
    """Send the planner's setpoint on, byte for byte."""


@dataclass(frozen=True, slots=True)
class Rewrite:
    """Send the planner's setpoint on with these fields replaced.

    z is not here: it always stays the planner's, bit for bit. Velocity, acceleration and yaw_rate
    are ignored through ``type_mask``; ignored fields are written as 0.

    Attributes
    ----------
    x, y
        Local NED, m.
    yaw
        rad in (-pi, pi], or None: the heading is not commanded.
    action
        Which counter it goes to: ``substituted``, ``held`` or ``turned``.
    down_m
        The height (local NED) to stay at where the vehicle does not move on toward the planner's goal. Only a
        setpoint whose z is an offset needs it: repeated, that offset would lift the vehicle without end. None: it
        moves on.
    """

    x: float
    y: float
    yaw: float | None
    action: str
    down_m: float | None = None


@dataclass(frozen=True, slots=True)
class Stay:
    """Stay where the vehicle is, wherever that is: no pose is known.

    Only a setpoint that is relative to the vehicle can say so.

    Attributes
    ----------
    action
        Which counter it goes to.
    """

    action: str


@dataclass(frozen=True, slots=True)
class Drop:
    """Send nothing in place of the planner's setpoint, and count it under ``reason``."""

    reason: str


Decision = Forward | Rewrite | Stay | Drop
"""What the switch S says, in local NED."""


@dataclass(frozen=True, slots=True)
class RewriteOffset:
    """Replace the position of a setpoint that gives it as an offset from the vehicle.

    Attributes
    ----------
    x, y
        In the frame of the message (north and east, or forward and right), m.
    z
        Offset downward, m; None: the planner's, bit for bit.
    yaw
        As the autopilot reads it in that frame, rad; None: not commanded.
    action
        Which counter it goes to.
    """

    x: float
    y: float
    z: float | None
    yaw: float | None
    action: str


@dataclass(frozen=True, slots=True)
class RewriteVelocity:
    """Replace the horizontal velocity; vz, and z where it is used, stay the planner's, bit for bit.

    Attributes
    ----------
    vx, vy
        In the frame of the message (north and east, or forward and right), m/s.
    yaw
        As the autopilot reads it in that frame, rad; None: not commanded.
    action
        Which counter it goes to.
    """

    vx: float
    vy: float
    yaw: float | None
    action: str


@dataclass(frozen=True, slots=True)
class RewriteGlobal:
    """Replace latitude and longitude; the altitude stays the planner's, bit for bit.

    Attributes
    ----------
    lat_int, lon_int
        1e-7 deg.
    yaw
        rad in (-pi, pi], or None: the heading is not commanded.
    action
        Which counter it goes to.
    """

    lat_int: int
    lon_int: int
    yaw: float | None
    action: str


@dataclass(frozen=True, slots=True)
class Unprotected:
    """Send the planner's setpoint on untouched although it may move the vehicle; say so.

    Attributes
    ----------
    reason
        Why it is not treated; the same words for the same kind.
    """

    reason: str


Replacement = Rewrite | RewriteOffset | RewriteVelocity | RewriteGlobal
Verdict = Forward | Replacement | Drop | Unprotected
"""What happens to one setpoint on the wire."""
