"""The inline proxy: every frame goes through as it came, setpoints of position and velocity as the handler decides.

Each side may have several links (``network``, ``routing``); which of them a frame goes to is decided after what is sent.

Everything happens in the call that received a datagram: no queue, no task, no wait. So order holds, nothing
can stall, and several frames of one datagram leave as one datagram again.

What happens to a planner's setpoint:

===================================================  ===================================================
setpoint                                             sent to the autopilot
===================================================  ===================================================
a used field is NaN or infinite                      nothing; counted
signed, no key is configured                         untouched; announced as unprotected
signed, the signature is not accepted                nothing; counted and announced
signed, the signature is accepted                    as unsigned ones; what is changed is signed again
with unknown incompatibility flags                   untouched; announced as unprotected
an attitude (82)                                     untouched; announced as unprotected
for a system that is not the vehicle                 untouched
a position or velocity (84, 86)                      what the handler says: `Forward`, one of the replacements,
                                                     `Drop`, or `Unprotected`: untouched and announced
the handler fails                                    nothing; counted and logged
===================================================  ===================================================
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from companion.config.link_filter import FilterRule
from companion.guidance.setpoint import (
    Drop,
    Forward,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Setpoint,
    Unprotected,
    Verdict,
)
from companion.mavlink import codec, requests, telemetry
from companion.mavlink.endpoint import Link, LinkCounters
from companion.mavlink.framing import INCOMPAT_SIGNED, RawFrame
from companion.mavlink.identity import is_autopilot
from companion.mavlink.network import Network
from companion.mavlink.requests import EngageRequest
from companion.mavlink.signing import Signatures, link_id_of, without_signature
from companion.mavlink.sources import SetpointSources, Source
from companion.mavlink.telemetry import Heartbeat, Telemetry, Unusable

_LOG: Final = logging.getLogger(__name__)
_NAMES: Final = {
    codec.SET_ATTITUDE_TARGET: "ATTITUDE",
    codec.SET_POSITION_TARGET_LOCAL_NED: "LOCAL_NED",
    codec.SET_POSITION_TARGET_GLOBAL_INT: "GLOBAL_INT",
}
_ACTIONS: Final = ("substituted", "held", "turned")
_TELEMETRY: Final = telemetry.MESSAGE_IDS
_AUTOPILOT_COMPONENT: Final = 1
_ATTITUDES: Final = frozenset({telemetry.ATTITUDE, telemetry.ATTITUDE_QUATERNION})
_ATTITUDE_EVERY_NS: Final = 8_000_000
"""Attitudes that follow each other faster wait for the next one, each with its own time: read together they cost a fifth."""
_VEHICLE_SILENT_NS: Final = 5_000_000_000
"""After this another autopilot may become the one whose telemetry counts."""


class ProxyHandler(Protocol):
    """Decides on setpoints and takes telemetry. Every call must return at once."""

    def on_setpoint(self, setpoint: Setpoint, system_id: int, component_id: int, now_ns: int) -> Verdict:
        """Return what is sent in place of a setpoint of position or velocity; the ids are the sender's."""
        ...

    def on_rivals(self, sources: tuple[Source, ...], now_ns: int) -> None:
        """Take note that several senders fight over the vehicle with their setpoints; called every few seconds."""
        ...

    def on_unprotected(self, kind: str, detail: str) -> None:
        """Take note that a setpoint passes untouched although it moves the vehicle.

        Called for each such setpoint; the words are the same for the same kind.

        Parameters
        ----------
        kind
            ``LOCAL_NED``, ``GLOBAL_INT``, ``ATTITUDE`` or ``signed``.
        detail
            What about it is not handled.
        """
        ...

    def on_refused_signature(self, source: Source, reason: str) -> None:
        """Take note that a setpoint was dropped because its signature is not accepted; called for each."""
        ...

    def on_telemetry(self, message: Telemetry | Unusable, now_ns: int) -> None:
        """Take a message of the vehicle's autopilot; it has been forwarded already."""
        ...

    def on_engage_request(self, request: EngageRequest, now_ns: int) -> None:
        """Take note that the planner's side asks for OFFBOARD or GUIDED, or to arm; it is being forwarded."""
        ...


class OwnComponent(Protocol):
    """Takes what is said to our own component: ``companion.mavlink.component.OwnComponent``."""

    message_ids: frozenset[int]
    """Frames of other messages are not offered."""

    def takes(self, frame: RawFrame, *, from_autopilot: bool, now_ns: int) -> bool:
        """Take a frame; return whether it was for us alone and is not to be passed on."""
        ...


@dataclass(slots=True)
class ProxyCounters:
    """What the proxy did.

    Attributes
    ----------
    to_autopilot_frames, to_planner_frames
        Frames passed on, rewritten setpoints included.
    setpoints_in
        SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT for the vehicle. Each is forwarded, rewritten or dropped.
    forwarded
        Those passed on with all their values, unprotected ones included.
    rewritten
        By `Rewrite.action`: substituted, held, turned.
    dropped
        Setpoints of any message that were not passed on, by reason.
    unprotected
        Setpoints of any message that passed untouched although they move the vehicle, by kind.
    setpoints_elsewhere
        Setpoints for other systems.
    rivalries
        Times that several senders were found to fight over the vehicle.
    handler_errors
        Failures of the handler, and verdicts that cannot be carried out.
    unusable_telemetry
        Messages of interest whose fields could not be used.
    unrouted_frames
        Frames with a target that no link has heard of, and those that filters kept from leaving.
    """

    planner: Sequence[LinkCounters]
    autopilot: Sequence[LinkCounters]
    to_autopilot_frames: int = 0
    to_planner_frames: int = 0
    setpoints_in: int = 0
    forwarded: int = 0
    rewritten: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    unprotected: Counter[str] = field(default_factory=Counter)
    setpoints_elsewhere: int = 0
    rivalries: int = 0
    handler_errors: int = 0
    unusable_telemetry: int = 0
    unrouted_frames: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return all counts by name, for logs and summaries."""
        return {
            "setpoints_in": self.setpoints_in,
            "forwarded": self.forwarded,
            **{action: self.rewritten[action] for action in _ACTIONS},
            "dropped": dict(self.dropped),
            "unprotected": dict(self.unprotected),
            "setpoints_elsewhere": self.setpoints_elsewhere,
            "rivalries": self.rivalries,
            "to_autopilot_frames": self.to_autopilot_frames,
            "to_planner_frames": self.to_planner_frames,
            "handler_errors": self.handler_errors,
            "unusable_telemetry": self.unusable_telemetry,
            "unrouted_frames": self.unrouted_frames,
            **{f"planner_{name}": count for name, count in _link_counts(self.planner).items()},
            **{f"autopilot_{name}": count for name, count in _link_counts(self.autopilot).items()},
        }


class InlineProxy:
    """Joins the planner's side and the autopilot's.

    Parameters
    ----------
    planner, autopilot
        The two sides, one link or several each; their `on_frames` is taken over.
    handler
        Decides on setpoints.
    now_ns
        Monotonic time.
    signatures
        Verifies signed setpoints and signs them again; None: there is no key.
    own
        Our own component; None: nobody is spoken to here.
    filters
        What the links let in and out; in a link's way in they stand before everything else here.
    """

    def __init__(
        self,
        planner: Link | Sequence[Link],
        autopilot: Link | Sequence[Link],
        handler: ProxyHandler,
        *,
        now_ns: Callable[[], int],
        signatures: Signatures | None = None,
        own: OwnComponent | None = None,
        filters: Sequence[FilterRule] = (),
    ) -> None:
        planner = planner if isinstance(planner, Sequence) else (planner,)
        autopilot = autopilot if isinstance(autopilot, Sequence) else (autopilot,)
        self.counters = ProxyCounters(
            [link.counters for link in planner], [link.counters for link in autopilot]
        )
        self.network = Network(planner, autopilot, self._received, filters=filters)
        """The links; its `router` knows who was heard where."""
        self._planner_links = len(planner)
        self._handler = handler
        self._now_ns = now_ns
        self._vehicle: Heartbeat | None = None
        self._vehicle_heard_ns = 0
        self._autopilot_systems: set[int] = set()
        self._last_failure = ""
        self._sources = SetpointSources()
        self._signatures = signatures
        self._attitudes: list[tuple[RawFrame, int]] = []
        self._attitudes_read_ns = -_VEHICLE_SILENT_NS
        self._own = own
        self._own_ids = frozenset() if own is None else own.message_ids

    @property
    def vehicle(self) -> Heartbeat | None:
        """The newest HEARTBEAT of the autopilot whose telemetry counts; None before the first."""
        return self._vehicle

    def _received(self, link: int, frames: list[RawFrame]) -> None:
        """Take what a link received, and pass on what is left of it."""
        if link < self._planner_links:
            self._from_planner(link, frames)
        else:
            self._from_autopilot(link, frames)
        self.counters.unrouted_frames = self.network.unrouted_frames

    # ------------------------------------------------------------------ planner -> autopilot

    def _from_planner(self, link: int, frames: list[RawFrame]) -> None:
        now_ns = self._now_ns()
        out: list[RawFrame] = []
        for frame in frames:
            if frame.message_id in self._own_ids and self._is_for_own(frame, now_ns, from_autopilot=False):
                continue
            if frame.message_id in _NAMES:
                data = self._setpoint(frame, now_ns)
                if not data:
                    continue
                if data is not frame.data:
                    frame = frame._replace(data=data)  # noqa: PLW2901  from here on it is this frame that is sent
            elif frame.message_id in requests.MESSAGE_IDS:
                self._note_request(frame, now_ns)
            out.append(frame)
        if out:
            self.counters.to_autopilot_frames += self.network.forward(link, out)

    def _is_for_own(self, frame: RawFrame, now_ns: int, *, from_autopilot: bool) -> bool:
        """Offer a frame to our own component; return whether it was for it alone."""
        own = self._own
        try:
            return own is not None and own.takes(frame, from_autopilot=from_autopilot, now_ns=now_ns)
        except Exception as error:  # noqa: BLE001  the frame goes on whatever our own component does
            self._handler_failed("takes", error)
            return False

    def _note_request(self, frame: RawFrame, now_ns: int) -> None:
        """Tell the handler of a request for OFFBOARD or arming before it is sent: the HEARTBEAT says so a second late."""
        if self._vehicle is None:
            return
        request = requests.engage_request(frame, self._vehicle)
        if request is None:
            return
        self._read_attitudes()
        try:
            self._handler.on_engage_request(request, now_ns)
        except Exception as error:  # noqa: BLE001  the request goes on whatever the handler does
            self._handler_failed("on_engage_request", error)

    def _setpoint(self, frame: RawFrame, now_ns: int) -> bytes:
        """Return what is sent in place of a setpoint frame; nothing where it is dropped."""
        counters = self.counters
        setpoint = codec.unpack(frame)
        if setpoint is None:
            nonfinite = codec.attitude_nonfinite_used_fields(frame)
        else:
            nonfinite = setpoint.nonfinite_used_fields()
        target = codec.target_system(frame)
        # Before the autopilot has been heard, every target may be the vehicle.
        is_elsewhere = bool(target and self._autopilot_systems and target not in self._autopilot_systems)
        counters.setpoints_in += setpoint is not None and not is_elsewhere
        if nonfinite:
            return self._dropped("not finite")
        if is_elsewhere:
            counters.setpoints_elsewhere += 1
            return frame.data
        name = _NAMES[frame.message_id]
        signatures = self._signatures
        if frame.is_signed and signatures is not None:
            why_not = signatures.verify(frame)
            if why_not is not None:
                return self._refused(frame, why_not)
        self._note_source(frame, now_ns)
        if frame.incompat_flags & ~INCOMPAT_SIGNED:
            return self._unprotected(frame, name, f"incompatibility flags {frame.incompat_flags:#x}")
        if frame.is_signed and signatures is None:
            return self._unprotected(frame, "signed", name)
        if setpoint is None:
            return self._unprotected(frame, name, "not handled")
        self._read_attitudes()
        try:
            verdict = self._handler.on_setpoint(setpoint, frame.system_id, frame.component_id, now_ns)
            if isinstance(verdict, Unprotected):
                return self._unprotected(frame, name, verdict.reason)
            if frame.is_signed and signatures is not None:
                return self._carry_out_signed(verdict, frame, signatures)
            return self._carry_out(verdict, frame)
        except Exception as error:  # noqa: BLE001  whatever fails there, this setpoint is held back and the rest goes on
            self._handler_failed("on_setpoint", error)
            return self._dropped("handler error")

    def _carry_out_signed(self, verdict: Verdict, frame: RawFrame, signatures: Signatures) -> bytes:
        """Return what a signed setpoint becomes: its own bytes where nothing changes, else with our signature."""
        plain = without_signature(frame)
        data = self._carry_out(verdict, plain)
        if not data or data == plain.data:
            return frame.data if data else data
        return signatures.sign(data, other_link_id=link_id_of(frame))

    def _refused(self, frame: RawFrame, reason: str) -> bytes:
        try:
            self._handler.on_refused_signature((frame.system_id, frame.component_id), reason)
        except Exception as error:  # noqa: BLE001  a failed announcement must not cost the frames behind it
            self._handler_failed("on_refused_signature", error)
        return self._dropped(reason)

    def _note_source(self, frame: RawFrame, now_ns: int) -> None:
        rivals = self._sources.note((frame.system_id, frame.component_id), now_ns)
        if not rivals:
            return
        self.counters.rivalries += 1
        try:
            self._handler.on_rivals(rivals, now_ns)
        except Exception as error:  # noqa: BLE001  a failed announcement must not cost the frame
            self._handler_failed("on_rivals", error)

    def _carry_out(self, verdict: Verdict, frame: RawFrame) -> bytes:
        match verdict:
            case Forward():
                data = codec.sanitise(frame)
                self.counters.forwarded += 1
                return data
            case Rewrite() | RewriteOffset() | RewriteVelocity() | RewriteGlobal():
                if verdict.action not in _ACTIONS:
                    raise ValueError(f"action {verdict.action!r}, expected one of {_ACTIONS}")
                data = codec.rewrite(frame, verdict)
                self.counters.rewritten[verdict.action] += 1
                return data
            case Drop():
                return self._dropped(verdict.reason)
        raise TypeError(f"not a verdict: {verdict!r}")

    def _dropped(self, reason: str) -> bytes:
        self.counters.dropped[reason] += 1
        return b""

    def _unprotected(self, frame: RawFrame, kind: str, detail: str) -> bytes:
        self.counters.unprotected[kind] += 1
        self.counters.forwarded += frame.message_id != codec.SET_ATTITUDE_TARGET
        try:
            self._handler.on_unprotected(kind, detail)
        except Exception as error:  # noqa: BLE001  a failed announcement must not cost the frame
            self._handler_failed("on_unprotected", error)
        return frame.data

    # ------------------------------------------------------------------ autopilot -> planner

    def _from_autopilot(self, link: int, frames: list[RawFrame]) -> None:
        now_ns = self._now_ns()
        own_ids, reads, passed = self._own_ids, False, frames
        for frame in frames:
            if frame[1] in own_ids and self._is_for_own(frame, now_ns, from_autopilot=True):
                passed = [other for other in passed if other is not frame]
            reads = reads or frame[1] in _TELEMETRY
        if not passed:
            return
        self.counters.to_planner_frames += self.network.forward(link, passed)
        if reads:  # behind the sending: what the planner waits for does not wait for us
            for frame in passed:
                if frame[1] not in _TELEMETRY or frame[3] != _AUTOPILOT_COMPONENT:
                    continue
                if frame[1] not in _ATTITUDES:
                    self._read_attitudes()
                    self._telemetry(frame, now_ns)
                    continue
                self._attitudes.append((frame, now_ns))
                if now_ns - self._attitudes_read_ns >= _ATTITUDE_EVERY_NS:
                    self._attitudes_read_ns = now_ns
                    self._read_attitudes()

    def _read_attitudes(self) -> None:
        """Read those that wait; before anything else is read or decided, so that the order of what is known holds."""
        if self._attitudes:
            waiting, self._attitudes = self._attitudes, []
            for frame, arrived_ns in waiting:
                self._telemetry(frame, arrived_ns)

    def _telemetry(self, frame: RawFrame, now_ns: int) -> None:
        message = telemetry.decode(frame)
        if isinstance(message, Heartbeat):
            self._heard(message, now_ns)
        elif type(message) is Unusable:
            self.counters.unusable_telemetry += 1
        vehicle = self._vehicle
        if vehicle is None or frame[2] != vehicle.system_id:
            return
        try:
            self._handler.on_telemetry(message, now_ns)
        except Exception as error:  # noqa: BLE001  the frame is through; the next ones must get through too
            self._handler_failed("on_telemetry", error)

    def _heard(self, heartbeat: Heartbeat, now_ns: int) -> None:
        if not is_autopilot(heartbeat):
            return
        self._autopilot_systems.add(heartbeat.system_id)
        silent = now_ns - self._vehicle_heard_ns > _VEHICLE_SILENT_NS
        if self._vehicle is None or silent or heartbeat.system_id == self._vehicle.system_id:
            self._vehicle = heartbeat
            self._vehicle_heard_ns = now_ns
            self.network.router.own_system_id = heartbeat.system_id

    def _handler_failed(self, call: str, error: Exception) -> None:
        self.counters.handler_errors += 1
        failure = f"{call}: {error!r}"
        if failure != self._last_failure:  # once, not at the rate of the messages
            self._last_failure = failure
            _LOG.error("the proxy's handler failed in %s", call, exc_info=error)


def _link_counts(links: Sequence[LinkCounters]) -> dict[str, int]:
    return {
        "garbage_bytes": sum(link.framing.garbage_bytes for link in links),
        "crc_errors": sum(link.framing.crc_errors for link in links),
        "send_drops": sum(link.send_drops for link in links),
        "late_setpoints": sum(link.late_setpoints for link in links),
    }
