"""Our own component on the vehicle's MAVLink network: what it says, and as whom.

https://mavlink.io/en/services/heartbeat.html, https://mavlink.io/en/messages/common.html#STATUSTEXT
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Final, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.signing import Signatures
from companion.mavlink.telemetry import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    Heartbeat,
)

_AUTOPILOT_COMPONENT: Final = 1
_TEXT_BYTES: Final = 50
_REPEAT_NS: Final = 1_000_000_000
_CUSTOM_MODE_ENABLED: Final = 1
_PX4_AUTO_LOITER: Final = (4, 3)
"""Main mode AUTO, sub mode LOITER: what PX4 calls Hold."""
_COPTER_BRAKE: Final = (17, 0)


class MavState(IntEnum):
    """The MAV_STATE values that the service can be in."""

    BOOT = 1
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


class MavSeverity(IntEnum):
    """MAV_SEVERITY of a status text."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7


class Endpoint(Protocol):
    """Where own frames go."""

    def send(self, datagram: bytes) -> int:
        """Send a datagram to all peers and return how many took it."""
        ...


class Identity:
    """Says as our own component what the service has to say, to every side.

    Until the autopilot's first HEARTBEAT has told the vehicle's system id, 1 is used: an autopilot that waits
    to be spoken to must hear something.

    Parameters
    ----------
    planner, autopilot
        Both sides; every frame of ours goes to each.
    component_id
        Our own, MAV_COMP_ID_ONBOARD_COMPUTER by default.
    now_ns
        Monotonic time, for the rate limit.
    signatures
        Signs what we say; None: it goes unsigned.
    max_waiting
        Different status texts sent in a second, and as many more that may wait.
    """

    def __init__(
        self,
        planner: Endpoint,
        autopilot: Endpoint,
        *,
        component_id: int = 191,
        now_ns: Callable[[], int] = time.monotonic_ns,
        signatures: Signatures | None = None,
        max_waiting: int = 20,
    ) -> None:
        self.vehicle: Heartbeat | None = None
        self.dropped_texts = 0
        self._endpoints = (planner, autopilot)
        self._encoder = mavlink.MAVLink(None, srcSystem=1, srcComponent=component_id)
        self._now_ns = now_ns
        self._signatures = signatures
        self._max_waiting = max_waiting
        self._waiting: deque[tuple[MavSeverity, str]] = deque()
        self._said_ns: dict[str, int] = {}
        self._text_id = 0

    @property
    def system_id(self) -> int:
        """The vehicle's system id, which is ours too."""
        return int(self._encoder.srcSystem)

    @property
    def component_id(self) -> int:
        """Our own component id."""
        return int(self._encoder.srcComponent)

    def learn(self, heartbeat: Heartbeat) -> bool:
        """Take the vehicle's identity from a HEARTBEAT, if it is an autopilot's; return whether it is."""
        if not is_autopilot(heartbeat):
            return False
        self.vehicle = heartbeat
        self._encoder.srcSystem = heartbeat.system_id
        return True

    def heartbeat(self, state: MavState) -> None:
        """Send our HEARTBEAT, as an onboard controller, and status texts that waited. Call it once a second."""
        self.send(heartbeat_message(state))
        waiting, self._waiting = self._waiting, deque()
        for severity, text in waiting:
            self.status_text(severity, text)

    def status_text(self, severity: MavSeverity, text: str) -> None:
        """Send a status text, in chunks of 50 bytes where it is longer.

        The same text is not sent twice within a second. Of many different ones in a second, those beyond
        ``max_waiting`` wait for the next `heartbeat`; of too many that wait, the least important are dropped.
        """
        now_ns = self._now_ns()
        self._said_ns = {known: at for known, at in self._said_ns.items() if now_ns - at < _REPEAT_NS}
        if text in self._said_ns or any(waiting == text for _, waiting in self._waiting):
            return
        if len(self._said_ns) >= self._max_waiting:
            self._wait(severity, text)
            return
        self._said_ns[text] = now_ns
        self._send_text(severity, text)

    def request_hold(self) -> bool:
        """Ask the autopilot once for its own Hold (PX4) or Brake (ArduCopter).

        Returns False, and sends nothing, where the autopilot is unknown or of another kind.
        """
        if self.vehicle is None:
            return False
        match self.vehicle.autopilot:
            case autopilot if autopilot == MAV_AUTOPILOT_PX4:
                main, sub = _PX4_AUTO_LOITER
            case autopilot if autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
                main, sub = _COPTER_BRAKE
            case _:
                return False
        self.send(
            mavlink.MAVLink_command_long_message(
                self.vehicle.system_id,
                self.vehicle.component_id,
                mavlink.MAV_CMD_DO_SET_MODE,
                0,
                _CUSTOM_MODE_ENABLED,
                main,
                sub,
                0,
                0,
                0,
                0,
            )
        )
        return True

    def _wait(self, severity: MavSeverity, text: str) -> None:
        self._waiting.append((severity, text))
        if len(self._waiting) > self._max_waiting:
            least = max(self._waiting, key=lambda waiting: waiting[0])
            self._waiting.remove(least)
            self.dropped_texts += 1

    def _send_text(self, severity: MavSeverity, text: str) -> None:
        chunks = text_chunks(text)
        text_id = 0
        if len(chunks) > 1:
            self._text_id = self._text_id % 0xFFFF + 1  # never 0, which means a single chunk
            text_id = self._text_id
        for number, chunk in enumerate(chunks):
            self.send(mavlink.MAVLink_statustext_message(int(severity), chunk, id=text_id, chunk_seq=number))

    def send(self, message: mavlink.MAVLink_message) -> None:
        """Send a message as our own component, to every side."""
        frame = bytes(message.pack(self._encoder))
        self._encoder.seq = (self._encoder.seq + 1) % 256
        if self._signatures is not None:
            frame = self._signatures.sign(frame)
        for endpoint in self._endpoints:
            endpoint.send(frame)

    def send_to_autopilot(self, message: mavlink.MAVLink_message) -> None:
        """Send a message as our own component to the autopilot's side alone: setpoints concern nobody else."""
        frame = bytes(message.pack(self._encoder))
        self._encoder.seq = (self._encoder.seq + 1) % 256
        self._endpoints[1].send(frame if self._signatures is None else self._signatures.sign(frame))


def heartbeat_message(state: MavState) -> mavlink.MAVLink_message:
    """Return our HEARTBEAT: an onboard controller, no autopilot."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID, 0, 0, int(state), 3
    )


def is_autopilot(heartbeat: Heartbeat) -> bool:
    """Return whether a HEARTBEAT comes from a vehicle's autopilot (component 1, a real autopilot)."""
    return (
        heartbeat.component_id == _AUTOPILOT_COMPONENT
        and heartbeat.autopilot != MAV_AUTOPILOT_INVALID
        and heartbeat.system_id != 0
    )


def text_chunks(text: str) -> list[bytes]:
    """Return a status text in chunks of at most 50 bytes, UTF-8.

    A null in a chunk marks the last one, so a text of several full chunks is followed by an empty one.
    """
    data = text.encode("utf-8", "replace").replace(b"\0", b" ")
    if len(data) <= _TEXT_BYTES:
        return [data]
    chunks = [data[at : at + _TEXT_BYTES] for at in range(0, len(data), _TEXT_BYTES)]
    if len(chunks[-1]) == _TEXT_BYTES:
        chunks.append(b"")
    return chunks
