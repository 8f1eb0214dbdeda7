"""What is decided, in a form that two runs are compared by (pure)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from companion.guidance.setpoint import LocalSetpoint, Setpoint
from companion.mavlink import codec
from companion.mavlink.commands import COMMAND_LONG, read_command
from companion.mavlink.framing import SIGNATURE_BYTES, Framer, RawFrame

_SETPOINTS: Final = frozenset(
    {
        codec.SET_ATTITUDE_TARGET,
        codec.SET_POSITION_TARGET_LOCAL_NED,
        codec.SET_POSITION_TARGET_GLOBAL_INT,
    }
)
_DO_SET_MODE: Final = 176
_FLOATS: Final = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate", "alt")

Kind = Literal["setpoint", "state", "command"]


@dataclass(frozen=True, slots=True)
class Decision:
    """One thing that was decided.

    Attributes
    ----------
    kind
        A setpoint that was sent, a change of state, or a command of ours to the autopilot.
    key
        Two decisions are the same to the last bit when their keys are.
    text
        For people.
    setpoint
        Its values, for a comparison with tolerance.
    """

    kind: Kind
    key: tuple[object, ...]
    text: str
    setpoint: Setpoint | None = None

    def agrees(self, other: Decision, tolerance: float) -> bool:
        """Return whether both say the same, numbers of setpoints up to a tolerance (m, m/s, rad)."""
        if self.key == other.key:
            return True
        mine, theirs = self.setpoint, other.setpoint
        if tolerance <= 0.0 or mine is None or theirs is None or type(mine) is not type(theirs):
            return False
        for name in mine.__slots__:
            one, two = getattr(mine, name), getattr(theirs, name)
            if name in _FLOATS:
                if not (math.isclose(one, two, rel_tol=0.0, abs_tol=tolerance) or one != one == (two != two)):
                    return False
            elif one != two:
                return False
        return True


def sent_decisions(link: int, datagram: bytes, own_component: int) -> list[Decision]:
    """Return what of a datagram that left on a link is a decision: setpoints, and our requests for a mode.

    The sequence number of frames of our own counts everything that we say, and is no decision.
    """
    found: list[Decision] = []
    for frame in Framer().feed(datagram):
        is_own = frame.component_id == own_component
        if frame.message_id in _SETPOINTS:
            setpoint = codec.unpack(frame)
            found.append(Decision("setpoint", _key(link, frame, is_own), _in_words(link, setpoint), setpoint))
        elif frame.message_id == COMMAND_LONG and is_own:
            command = read_command(frame)
            if command.number == _DO_SET_MODE:
                text = f"mode {command.params[1]:g}/{command.params[2]:g} asked for"
                found.append(Decision("command", _key(link, frame, is_own), text))
    return found


def state_decision(previous: str, state: str, reason: str, time_ns: int) -> Decision:
    """Return a change of the switch S as a decision."""
    text = f"{previous or 'start'} -> {state} ({reason})"
    return Decision("state", (previous, state, reason, time_ns), text)


def differences(
    recorded: Sequence[Decision], now: Sequence[Decision], tolerance: float
) -> list[tuple[Decision | None, Decision | None]]:
    """Return where two lists of decisions on the same input differ: pairs, with None for what is missing."""
    if len(recorded) == len(now) and all(map(lambda a, b: a.agrees(b, tolerance), recorded, now)):
        return []
    found: list[tuple[Decision | None, Decision | None]] = []
    for kind in ("state", "setpoint", "command"):
        one = [decision for decision in recorded if decision.kind == kind]
        two = [decision for decision in now if decision.kind == kind]
        for place in range(max(len(one), len(two))):
            before = one[place] if place < len(one) else None
            after = two[place] if place < len(two) else None
            if before is None or after is None or not before.agrees(after, tolerance):
                found.append((before, after))
    return found


def _key(link: int, frame: RawFrame, is_own: bool) -> tuple[object, ...]:
    if not is_own:
        # A signature holds the time of day.
        return link, frame.data[:-SIGNATURE_BYTES] if frame.is_signed else frame.data
    return link, frame.message_id, frame.system_id, frame.component_id, frame.payload


def _in_words(link: int, setpoint: Setpoint | None) -> str:
    if setpoint is None:
        return f"link {link}: attitude"
    if isinstance(setpoint, LocalSetpoint):
        used = setpoint.used_fields()
        values = ", ".join(f"{name} {value:.3f}" for name, value in used.items())
        return f"link {link}: {values or 'nothing used'}"
    return f"link {link}: lat {setpoint.lat_int} lon {setpoint.lon_int} alt {setpoint.alt:.2f} yaw {setpoint.yaw:.3f}"
