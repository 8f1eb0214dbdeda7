"""What is known of the two autopilots: which versions and parameters suit, and what happens otherwise (pure)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from companion.doctor.check import Check, Level
from companion.mavlink.telemetry import MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4

_PX4_HOLD: Final = 5
_PX4_FAILSAFES: Final = {0: "POSCTL", 1: "ALTCTL", 2: "Manual", 3: "Return", 4: "Land", 5: "Hold"}
_OFFBOARD_BIT: Final = 2


@dataclass(frozen=True, slots=True)
class ParameterFact:
    """A parameter of an autopilot and the judgement of its value."""

    name: str
    judge: Callable[[float], Check]


def facts(autopilot: int) -> tuple[ParameterFact, ...]:
    """Return the parameters that matter of a kind of autopilot (MAV_AUTOPILOT)."""
    if autopilot == MAV_AUTOPILOT_PX4:
        return (
            ParameterFact("COM_OF_LOSS_T", _com_of_loss_t),
            ParameterFact("COM_OBL_RC_ACT", _com_obl_rc_act),
            ParameterFact("COM_RC_OVERRIDE", _com_rc_override),
        )
    if autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
        return (ParameterFact("GUID_TIMEOUT", _guid_timeout),)
    return ()


def version_check(autopilot: int, version: tuple[int, int, int] | None) -> Check:
    """Judge an autopilot's version."""
    if version is None:
        return Check(
            "autopilot version",
            Level.WARN,
            "not told",
            "AUTOPILOT_VERSION was asked for and did not come: is the link both ways?",
        )
    name = {MAV_AUTOPILOT_PX4: "PX4", MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot"}.get(autopilot, "unknown")
    text = f"{name} {version[0]}.{version[1]}.{version[2]}"
    least, most = {
        MAV_AUTOPILOT_PX4: ((1, 14), (1, 17)),
        MAV_AUTOPILOT_ARDUPILOTMEGA: ((4, 5), (4, 7)),
    }.get(autopilot, ((0, 0), (0, 0)))
    if not least <= version[:2] <= most:
        wanted = f"{least[0]}.{least[1]} to {most[0]}.{most[1]}"
        return Check(
            "autopilot version",
            Level.WARN,
            text,
            f"made for {name} {wanted}: try this one in a simulator first",
        )
    return Check("autopilot version", Level.OK, text)


def _com_of_loss_t(value: float) -> Check:
    found = f"{value:g} s"
    if value > 1.5:
        advice = f"a dead companion or planner is noticed after {value:g} s: set COM_OF_LOSS_T to 1.0 or less"
        return Check("COM_OF_LOSS_T", Level.WARN, found, advice)
    if value < 0.3:
        return Check(
            "COM_OF_LOSS_T",
            Level.WARN,
            found,
            "one late setpoint ends OFFBOARD: set COM_OF_LOSS_T to 0.5 to 1.0",
        )
    return Check("COM_OF_LOSS_T", Level.OK, found)


def _com_obl_rc_act(value: float) -> Check:
    action = _PX4_FAILSAFES.get(round(value), "?")
    found = f"{value:g} ({action})"
    if round(value) == _PX4_HOLD or round(value) == 4:
        return Check("COM_OBL_RC_ACT", Level.OK, found)
    why = {
        0: "without sticks the vehicle sinks",
        1: "without sticks the vehicle sinks and drifts",
        2: "without sticks the vehicle falls",
        3: "Return climbs and flies straight, indoors into the ceiling",
    }.get(round(value), "not what an indoor flight wants")
    return Check(
        "COM_OBL_RC_ACT", Level.WARN, found, f"when setpoints end, {why}: set COM_OBL_RC_ACT to 5 (Hold)"
    )


def _com_rc_override(value: float) -> Check:
    found = f"{value:g}"
    if math.isfinite(value) and int(value) & _OFFBOARD_BIT:
        return Check("COM_RC_OVERRIDE", Level.OK, f"{found}: sticks end OFFBOARD")
    return Check(
        "COM_RC_OVERRIDE",
        Level.WARN,
        f"{found}: sticks do not end OFFBOARD",
        "set COM_RC_OVERRIDE to 3, or have a mode switch under your thumb",
    )


def _guid_timeout(value: float) -> Check:
    found = f"{value:g} s"
    if value > 3.0:
        return Check(
            "GUID_TIMEOUT",
            Level.WARN,
            found,
            f"a velocity goes on for {value + 1.1:.1f} s after the last setpoint: set GUID_TIMEOUT to 3 or less",
        )
    return Check(
        "GUID_TIMEOUT", Level.OK, f"{found}; positions do not time out: a lost link ends at the last step"
    )
