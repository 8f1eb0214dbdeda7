"""Addressed: setpoints sent to our own component go through the switch S and out to the autopilot as ours.

PX4 forwards a setpoint for 1/191 to us and ignores it itself, so a planner on any of its links reaches us. What goes out is
a new frame: our own sender and sequence number, the autopilot as its target. The planner's would come back to the link
that it came from.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.setpoint import Drop, Forward, GlobalSetpoint, LocalSetpoint, Setpoint, Unprotected
from companion.interception import Interception
from companion.mavlink import codec
from companion.mavlink.framing import INCOMPAT_SIGNED, RawFrame
from companion.mavlink.identity import Identity
from companion.mavlink.proxy import OwnComponent
from companion.mavlink.signing import Signatures, without_signature

_SETPOINTS: Final = frozenset({codec.SET_POSITION_TARGET_LOCAL_NED, codec.SET_POSITION_TARGET_GLOBAL_INT})
_COMPONENT_AT: Final = 51


class AddressedSetpoints:
    """Stands before our own component in the proxy, and takes the setpoints that are for it.

    Parameters
    ----------
    flight
        Decides on setpoints.
    identity
        As whom they go out.
    own
        Our own component, asked about all other frames.
    signatures
        Where there is a key, setpoints must be signed with it; without one a signed setpoint cannot be sent on.
    """

    def __init__(
        self,
        flight: Interception,
        identity: Identity,
        *,
        own: OwnComponent,
        signatures: Signatures | None = None,
    ) -> None:
        self._flight = flight
        self._identity = identity
        self._own = own
        self._signatures = signatures
        self.message_ids = own.message_ids | _SETPOINTS
        self.dropped: Counter[str] = Counter()
        self.sent = 0

    def takes(self, frame: RawFrame, *, from_autopilot: bool, now_ns: int) -> bool:
        """Take a frame; return whether it was for us alone and is not to be passed on."""
        if frame.message_id in _SETPOINTS:
            identity = self._identity
            target = (codec.target_system(frame), frame.payload.ljust(53, b"\0")[_COMPONENT_AT])
            if target != (identity.system_id, identity.component_id):
                return False
            reason = self._send(frame, now_ns)
            if reason is None:
                self.sent += 1
            else:
                self.dropped[reason] += 1
            return True
        if frame.message_id not in self._own.message_ids:
            return False
        return self._own.takes(frame, from_autopilot=from_autopilot, now_ns=now_ns)

    def _send(self, frame: RawFrame, now_ns: int) -> str | None:
        """Send what the switch S makes of a setpoint; return why nothing was sent, where that is so."""
        vehicle = self._identity.vehicle
        if vehicle is None:
            return "autopilot not known"
        source = (frame.system_id, frame.component_id)
        why_not = self._why_refused(frame)
        if why_not is not None:
            self._flight.on_refused_signature(source, why_not)
            return why_not
        if frame.incompat_flags & ~INCOMPAT_SIGNED:
            return "incompatibility flags"
        plain = without_signature(frame) if frame.is_signed else frame
        setpoint = codec.unpack(plain)
        if setpoint is None or setpoint.nonfinite_used_fields():
            return "not finite"
        verdict = self._flight.on_setpoint(setpoint, *source, now_ns)
        match verdict:
            case Unprotected(reason=reason):
                # Sent to us to be protected: what cannot be is not sent on.
                self._flight.on_unprotected("addressed", reason)
                return "not understood"
            case Drop(reason=reason):
                return reason
            case Forward():
                data = codec.sanitise(plain)
            case _:
                data = codec.rewrite(plain, verdict)
        decided = codec.unpack(plain._replace(data=data))
        if decided is None:
            return "not finite"
        self._identity.send_to_autopilot(_message(decided, vehicle.system_id, vehicle.component_id))
        return None

    def _why_refused(self, frame: RawFrame) -> str | None:
        if self._signatures is not None:
            return self._signatures.verify(frame)
        return "signed, and there is no key" if frame.is_signed else None


def _message(setpoint: Setpoint, system_id: int, component_id: int) -> mavlink.MAVLink_message:
    """Return a setpoint as a message for the autopilot."""
    kind = LocalSetpoint if isinstance(setpoint, LocalSetpoint) else GlobalSetpoint
    fields = {name: getattr(setpoint, name) for name in kind.__slots__}
    fields |= {"target_system": system_id, "target_component": component_id}
    if kind is LocalSetpoint:
        return mavlink.MAVLink_set_position_target_local_ned_message(**fields)
    return mavlink.MAVLink_set_position_target_global_int_message(**fields)
