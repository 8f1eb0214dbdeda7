"""Our own component: what others say to it, from either side, and what it sends by itself.

================================  ========================================================================
message                           what becomes of it
================================  ========================================================================
PARAM_*, COMMAND_LONG/INT to us   answered to both sides, and not passed on
PARAM_REQUEST_LIST to everybody   answered, and passed on
TIMESYNC answer to our question   taken, and not passed on: others would take it for an answer to theirs
COMMAND_ACK to us                 taken: the answer to a stream that we asked for
RC_CHANNELS, ESTIMATOR_STATUS     of the autopilot: read, and passed on
what we need a rate of            counted, and passed on; asked for where it does not come (``streams``)
================================  ========================================================================

Others' TIMESYNC questions are theirs: two clocks that answer would tear the autopilot's between them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.config import EngagementConfig
from companion.mavlink import commands, parameters, streams
from companion.mavlink.commands import CommandServer
from companion.mavlink.framing import EKF_STATUS_REPORT, RawFrame
from companion.mavlink.identity import MavSeverity
from companion.mavlink.parameters import ParameterServer
from companion.mavlink.signing import Signatures
from companion.mavlink.streams import ESTIMATOR_STATUS, RC_CHANNELS, StreamRequests
from companion.mavlink.telemetry import Heartbeat
from companion.mavlink.timesync import ClockSync, TimeSync

TIMESYNC: Final = 111

COMMAND_ACK: Final = 77

_REQUESTS: Final = parameters.MESSAGE_IDS | commands.MESSAGE_IDS
_COUNTED: Final = frozenset(
    {
        streams.LOCAL_POSITION_NED,
        streams.ATTITUDE,
        streams.ATTITUDE_QUATERNION,
        streams.GLOBAL_POSITION_INT,
        streams.RC_CHANNELS,
        streams.ESTIMATOR_STATUS,
        EKF_STATUS_REPORT,
    }
)
_READ: Final = frozenset({streams.RC_CHANNELS, streams.ESTIMATOR_STATUS, EKF_STATUS_REPORT})
"""Of the counted ones, those that are looked into."""
_OF_AUTOPILOT: Final = frozenset({TIMESYNC, COMMAND_ACK}) | _COUNTED
MESSAGE_IDS: Final = _REQUESTS | _OF_AUTOPILOT
"""What `OwnComponent.takes` looks at."""

TIMESYNC_FIELDS: Final = struct.Struct("<qq")
_RC_CHANNELS: Final = struct.Struct("<I18HBB")
FLAGS_AT: Final = {ESTIMATOR_STATUS: 40, EKF_STATUS_REPORT: 20}
_ACK: Final = struct.Struct("<HBBiBB")
FLAGS: Final = struct.Struct("<H")
_AUTOPILOT_COMPONENT: Final = 1
_REFUSED_TEXT: Final = "unsigned or wrongly signed request refused"


class Speaker(Protocol):
    """Our voice: ``companion.mavlink.identity.Identity``."""

    vehicle: Heartbeat | None

    @property
    def system_id(self) -> int:
        """Ours."""
        ...

    @property
    def component_id(self) -> int:
        """Ours."""
        ...

    def send(self, message: mavlink.MAVLink_message) -> None:
        """Send a message of ours to every side."""
        ...

    def status_text(self, severity: MavSeverity, text: str) -> None:
        """Send a status text."""
        ...


class Listener(Protocol):
    """Takes what the autopilot says beyond its telemetry."""

    def on_rc_channels(self, pulses_us: tuple[int, ...], now_ns: int) -> None:
        """Take the channels of the remote control, us."""
        ...

    def on_estimator(self, flags: int, now_ns: int) -> None:
        """Take ESTIMATOR_STATUS.flags or those of EKF_STATUS_REPORT."""
        ...

    def on_clock(self, sync: ClockSync, now_ns: int) -> None:
        """Take what the autopilot's clock is against ours."""
        ...


class OwnComponent:
    """Takes frames from the proxy and answers through our identity.

    Parameters
    ----------
    speaker
        Our identity.
    listener
        Takes what the autopilot says.
    parameter_server, command_server
        What answers requests.
    produce
        Returns what is to be sent by itself now (plots, computer status).
    engagement
        Says which streams are needed.
    timesync_interval_ns
        How often the clock is asked for; 0: never.
    signatures
        Where there is a key, only what is signed with it is obeyed.
    """

    message_ids = MESSAGE_IDS

    def __init__(
        self,
        speaker: Speaker,
        listener: Listener,
        *,
        parameter_server: ParameterServer,
        command_server: CommandServer,
        produce: Callable[[int], list[mavlink.MAVLink_message]],
        engagement: EngagementConfig,
        timesync_interval_ns: int,
        signatures: Signatures | None = None,
    ) -> None:
        self._speaker = speaker
        self._listener = listener
        self._parameters = parameter_server
        self._commands = command_server
        self._produce = produce
        self._timesync = TimeSync()
        self._timesync_interval_ns = timesync_interval_ns
        self._engagement = engagement
        self._streams = StreamRequests()
        self._asked_ns = -(1 << 62)
        self._signatures = signatures
        self.refused_requests = 0

    @property
    def timesync(self) -> TimeSync:
        """What is known of the autopilot's clock."""
        return self._timesync

    def takes(self, frame: RawFrame, *, from_autopilot: bool, now_ns: int) -> bool:
        """Take one frame of `message_ids`; return whether it was for us alone and is not to be passed on."""
        message_id = frame.message_id
        if message_id in _COUNTED:  # first: these are most of all frames
            vehicle = self._speaker.vehicle
            if (
                not from_autopilot
                or vehicle is None
                or frame[2] != vehicle.system_id
                or frame[3] != _AUTOPILOT_COMPONENT
            ):
                return False
            self._streams.count(message_id)
            if message_id not in _READ:
                return False
        elif message_id in _REQUESTS:
            return self._request(frame, now_ns)
        elif not from_autopilot or not self._is_vehicles(frame):
            return False
        payload = frame.payload
        match message_id:
            case _ if message_id == TIMESYNC:
                return self._clock(payload, now_ns)
            case _ if message_id == COMMAND_ACK:
                ours = (self._speaker.system_id, self._speaker.component_id)
                return _ACK.unpack(payload.ljust(_ACK.size, b"\0")[: _ACK.size])[-2:] == ours
            case _ if message_id == RC_CHANNELS:
                values = _RC_CHANNELS.unpack(payload.ljust(_RC_CHANNELS.size, b"\0")[: _RC_CHANNELS.size])
                self._listener.on_rc_channels(values[1 : 1 + min(18, values[19])], now_ns)
            case _ if message_id in FLAGS_AT:
                at = FLAGS_AT[message_id]
                self._listener.on_estimator(FLAGS.unpack_from(payload.ljust(at + 2, b"\0"), at)[0], now_ns)
        return False

    def tick(self, now_ns: int) -> None:
        """Send what is due. Call it ten times a second."""
        for message in self._parameters.due():
            self._speaker.send(message)
        if self._timesync_interval_ns and now_ns - self._asked_ns >= self._timesync_interval_ns:
            self._asked_ns = now_ns
            self._speaker.send(mavlink.MAVLink_timesync_message(0, self._timesync.ask(now_ns)))
        vehicle = self._speaker.vehicle
        if vehicle is not None:
            for message_id, interval_us in self._streams.due(
                streams.needs(vehicle.autopilot, self._engagement), now_ns
            ):
                self._speaker.send(streams.request(vehicle, message_id, interval_us))
        for message in self._produce(now_ns):
            self._speaker.send(message)

    def announce(self, name: str) -> None:
        """Show ground stations a parameter that has changed by itself."""
        self._speaker.send(self._parameters.announce(name))

    def _request(self, frame: RawFrame, now_ns: int) -> bool:
        request: commands.Command | parameters.Request
        if frame.message_id in commands.MESSAGE_IDS:
            request = commands.read_command(frame)
        else:
            request = parameters.read_request(frame)
        ours = (self._speaker.system_id, self._speaker.component_id)
        is_ours_alone = (request.target_system, request.target_component) == ours
        is_a_list = frame.message_id == parameters.PARAM_REQUEST_LIST
        is_for_all = request.target_system in (0, ours[0]) and request.target_component in (0, ours[1])
        if not is_ours_alone and not (is_a_list and is_for_all):
            return False  # a command to everybody is the autopilot's
        if is_ours_alone and not self._may(frame):
            self.refused_requests += 1
            self._speaker.status_text(MavSeverity.WARNING, f"void: {_REFUSED_TEXT}")
            return True
        if isinstance(request, commands.Command):
            answers = self._commands.answer(request, now_ns)
        else:
            answers, why_not = self._parameters.answer(request, now_ns)
            if why_not is not None:
                self._speaker.status_text(MavSeverity.WARNING, f"void: {why_not}")
        for message in answers:
            self._speaker.send(message)
        return is_ours_alone

    def _may(self, frame: RawFrame) -> bool:
        """Whether a request may be obeyed; where there is a key, whoever has it not may only look."""
        signatures = self._signatures
        if signatures is None:
            return True
        if frame.message_id in (parameters.PARAM_REQUEST_READ, parameters.PARAM_REQUEST_LIST):
            return True
        return signatures.verify(frame) is None

    def _clock(self, payload: bytes, now_ns: int) -> bool:
        tc1, ts1 = TIMESYNC_FIELDS.unpack(payload.ljust(TIMESYNC_FIELDS.size, b"\0")[: TIMESYNC_FIELDS.size])
        if tc1 == 0 or not self._timesync.is_ours(ts1):
            return False
        sync = self._timesync.on_answer(tc1, ts1, now_ns)
        if sync is not None:
            self._listener.on_clock(sync, now_ns)
        return True

    def _is_vehicles(self, frame: RawFrame) -> bool:
        vehicle = self._speaker.vehicle
        return (
            vehicle is not None
            and frame.component_id == _AUTOPILOT_COMPONENT
            and frame.system_id == vehicle.system_id
        )
