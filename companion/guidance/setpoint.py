"""SET_POSITION_TARGET_LOCAL_NED as a value: fields, type_mask, frames, and what we handle.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED
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
    """The MAV_FRAME values a local setpoint may carry."""

    LOCAL_NED = 1
    LOCAL_OFFSET_NED = 7
    BODY_NED = 8
    BODY_OFFSET_NED = 9


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

    def unprotected_reason(self) -> str | None:
        """Return why this setpoint is of a kind that is not handled, or None when it is handled.

        Handled: a position setpoint (x, y and z all used) in LOCAL_NED, with or without further terms.
        """
        if self.coordinate_frame != MavFrame.LOCAL_NED:
            return f"coordinate_frame {self.coordinate_frame}"
        if self.type_mask & TypeMask.POSITION_IGNORE == TypeMask.POSITION_IGNORE:
            return "no position" if self.type_mask & TypeMask.VELOCITY_IGNORE else "velocity only"
        if self.type_mask & TypeMask.POSITION_IGNORE:
            return "partial position"
        return None

    def used_fields(self) -> dict[str, float]:
        """Return the float fields that type_mask does not ignore, by name."""
        names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        bits = (1, 2, 4, 8, 16, 32, 64, 128, 256, 1024, 2048)
        return {n: getattr(self, n) for n, b in zip(names, bits, strict=True) if not self.type_mask & b}

    def nonfinite_used_fields(self) -> tuple[str, ...]:
        """Return the names of used fields that are NaN or infinite."""
        return tuple(name for name, value in self.used_fields().items() if not math.isfinite(value))


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
    """

    x: float
    y: float
    yaw: float | None
    action: str


@dataclass(frozen=True, slots=True)
class Drop:
    """Send nothing in place of the planner's setpoint, and count it under ``reason``."""

    reason: str


Verdict = Forward | Rewrite | Drop
