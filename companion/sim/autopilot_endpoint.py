"""The autopilot's side of MAVLink: what it answers and what it sends by itself. No I/O.

Answers what mavsdk 4.1 and QGroundControl ask: https://mavlink.io/en/services/command.html,
https://mavlink.io/en/services/parameter.html, https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.setpoint import LocalSetpoint, Setpoint
from companion.sim.commander import Result
from companion.sim.controller import Controller
from companion.sim.mission import mission_count, mission_item
from companion.sim.telemetry import ORIGIN_ALT_M, STREAMS, StreamSchedule, global_of
from companion.sim.wire import FrameReader, FrameWriter, ReceivedFrame, global_setpoint, local_setpoint

Address = tuple[str, int]

_FORCE = 21196
"""COMPONENT_ARM_DISARM param2 that overrides the checks."""

_REBOOT_S = 2.0
_PARAMETERS_AT_ONCE = 5
_FTP_REPLY_NAK = 129
_FTP_UNKNOWN_COMMAND = 7


@dataclass(frozen=True, slots=True)
class SetpointRecord:
    """One SET_POSITION_TARGET_LOCAL_NED as it arrived.

    Attributes
    ----------
    time_ns
        Our monotonic time of arrival.
    raw
        The frame's bytes.
    setpoint
        The decoded fields.
    seq, system_id, component_id
        From the header.
    sender
        Where the datagram came from.
    refusal
        Why the autopilot did not take it; None when it did.
    """

    time_ns: int
    raw: bytes
    setpoint: LocalSetpoint
    seq: int
    system_id: int
    component_id: int
    sender: Address
    refusal: str | None


class AutopilotEndpoint:
    """Bytes in, bytes out, for one link.

    Parameters
    ----------
    controller
        The autopilot behind it.
    system_id, component_id
        The sender of its messages.
    keep_frames
        Keep the raw bytes of every frame received and sent, for comparison.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        system_id: int = 1,
        component_id: int = 1,
        keep_frames: bool = False,
    ) -> None:
        self.controller = controller
        self.setpoints: list[SetpointRecord] = []
        self.frame_counts: Counter[str] = Counter()
        self.received_frames: list[bytes] = []
        self.sent_frames: list[bytes] = []
        self.sent_counts: Counter[str] = Counter()
        self._keep_frames = keep_frames
        self._system_id = system_id
        self._component_id = component_id
        self._reader = FrameReader()
        self._writer = FrameWriter(system_id, component_id)
        self._schedule = StreamSchedule(controller.default_streams)
        self._parameters_to_send: deque[int] = deque()
        self._boot_until_ns = 0

    @property
    def bad_bytes(self) -> int:
        """Bytes received that belong to no sound frame."""
        return self._reader.bad_bytes

    def reboot(self, now_ns: int) -> None:
        """Restart: silent and deaf for two seconds, then with the clock at zero and default streams."""
        self.controller.reboot(now_ns)
        self._writer = FrameWriter(self._system_id, self._component_id)
        self._schedule = StreamSchedule(self.controller.default_streams)
        self._parameters_to_send.clear()
        self._boot_until_ns = now_ns + round(_REBOOT_S * 1e9)

    def receive(self, datagram: bytes, now_ns: int, sender: Address = ("", 0)) -> list[bytes]:
        """Take one datagram; return the frames that answer it. Malformed input is counted, never raised."""
        answers: list[bytes] = []
        for frame in self._reader.read(datagram):
            if now_ns < self._boot_until_ns or self.controller.crashed:
                break
            self.frame_counts[frame.name] += 1
            if self._keep_frames:
                self.received_frames.append(frame.raw)
            answers += [self._pack(message) for message in self._answer(frame, now_ns, sender)]
        return answers

    def advance(self, now_ns: int) -> list[bytes]:
        """Let time pass; return the frames that are due."""
        self.controller.advance(now_ns)
        if now_ns < self._boot_until_ns or self.controller.crashed:
            return []
        snapshot = self.controller.snapshot()
        built = [STREAMS[i].build(snapshot) for i in self._schedule.due(snapshot.time_boot_us)]
        messages = [message for message in built if message is not None]
        while self.controller.texts:
            text = self.controller.texts.popleft()
            messages.append(mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_INFO, text.encode()[:50]))
        at_once = min(_PARAMETERS_AT_ONCE, len(self._parameters_to_send))
        messages += [self._param_value(self._parameters_to_send.popleft()) for _ in range(at_once)]
        return [self._pack(message) for message in messages]

    def _pack(self, message: Any) -> bytes:
        raw = self._writer.pack(message)
        self.sent_counts[message.get_type()] += 1
        if self._keep_frames:
            self.sent_frames.append(raw)
        return raw

    def _answer(self, frame: ReceivedFrame, now_ns: int, sender: Address) -> list[Any]:
        message = frame.message
        if frame.name == "SET_POSITION_TARGET_LOCAL_NED":
            setpoint = local_setpoint(message)
            refusal = self._take_setpoint(setpoint, now_ns)
            self._record(frame, setpoint, refusal, now_ns, sender)
            return []
        if frame.name == "SET_POSITION_TARGET_GLOBAL_INT":
            self._take_setpoint(global_setpoint(message), now_ns)
            return []
        if message is None or not self._is_for_us(message):
            return []
        match frame.name:
            case "COMMAND_LONG" | "COMMAND_INT":
                return self._command(frame, now_ns)
            case "SET_MODE":
                self.controller.request_custom_mode(message.custom_mode, now_ns)
            case "PARAM_REQUEST_LIST":
                self._parameters_to_send.extend(range(len(self.controller.parameters)))
            case "PARAM_REQUEST_READ":
                return self._read_parameter(message)
            case "PARAM_SET":
                return self._set_parameter(message)
            case "MISSION_REQUEST_LIST":
                return [
                    mission_count(
                        self.controller.mission, frame.system_id, frame.component_id, message.mission_type
                    )
                ]
            case "MISSION_REQUEST_INT":
                return [self._mission_item(frame)]
            case "MISSION_COUNT" | "MISSION_CLEAR_ALL":
                empty = frame.name == "MISSION_CLEAR_ALL" or message.count == 0
                result = mavlink.MAV_MISSION_ACCEPTED if empty else mavlink.MAV_MISSION_UNSUPPORTED
                return [
                    mavlink.MAVLink_mission_ack_message(
                        frame.system_id, frame.component_id, result, message.mission_type
                    )
                ]
            case "TIMESYNC" if message.tc1 == 0:
                boot_ns = self.controller.snapshot().time_boot_us * 1000
                return [mavlink.MAVLink_timesync_message(boot_ns, message.ts1)]
            case "PING" if message.target_system == 0:
                return [
                    mavlink.MAVLink_ping_message(
                        message.time_usec, message.seq, frame.system_id, frame.component_id
                    )
                ]
            case "FILE_TRANSFER_PROTOCOL":
                return [_ftp_refusal(frame)]
        return []

    def _is_for_us(self, message: Any) -> bool:
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self._system_id) and component in (0, self._component_id)

    def _take_setpoint(self, setpoint: Setpoint, now_ns: int) -> str | None:
        """Hand a setpoint on; return why it was not taken."""
        refusal = self.controller.take_setpoint(setpoint, now_ns)
        return None if refusal is None else refusal.reason

    def _record(
        self, frame: ReceivedFrame, setpoint: LocalSetpoint, refusal: str | None, now_ns: int, sender: Address
    ) -> None:
        self.setpoints.append(
            SetpointRecord(
                time_ns=now_ns,
                raw=frame.raw,
                setpoint=setpoint,
                seq=frame.seq,
                system_id=frame.system_id,
                component_id=frame.component_id,
                sender=sender,
                refusal=refusal,
            )
        )

    def _command(self, frame: ReceivedFrame, now_ns: int) -> list[Any]:
        message = frame.message
        extra: list[Any] = []
        p1, p2, p3 = message.param1, message.param2, message.param3
        match message.command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                result = self._arm(p1, force=p2 == _FORCE, now_ns=now_ns)
            case mavlink.MAV_CMD_DO_SET_MODE:
                result = self.controller.request_mode_by_command(_whole(p2), _whole(p3), now_ns)
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                result = self.controller.request_takeoff(_height(message), now_ns)
            case mavlink.MAV_CMD_NAV_LAND:
                result = self.controller.request_land(now_ns)
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                result = self.controller.request_return(now_ns)
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                result = (
                    Result.ACCEPTED if self._schedule.set_interval(_whole(p1), p2) else Result.UNSUPPORTED
                )
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                interval_us = self._schedule.interval_us(_whole(p1))
                result = Result.UNSUPPORTED if interval_us is None else Result.ACCEPTED
                if interval_us is not None:
                    extra = [mavlink.MAVLink_message_interval_message(_whole(p1), interval_us)]
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                result, extra = self._request_message(_whole(p1))
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                result, extra = self._request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            case mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
                result = self._reboot_on_command(p1)
            case _:
                result = Result.UNSUPPORTED
        ack = mavlink.MAVLink_command_ack_message(
            message.command, int(result), 0, 0, frame.system_id, frame.component_id
        )
        if message.command == mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN and result is Result.ACCEPTED:
            self.reboot(now_ns)
        return [ack, *extra]

    def _arm(self, wanted: float, *, force: bool, now_ns: int) -> Result:
        if wanted == 1.0:
            return self.controller.request_arm(now_ns)
        if wanted == 0.0:
            return self.controller.request_disarm(force=force)
        return Result.UNSUPPORTED

    def _request_message(self, message_id: int) -> tuple[Result, list[Any]]:
        stream = STREAMS.get(message_id)
        if stream is None:
            return Result.UNSUPPORTED, []
        message = stream.build(self.controller.snapshot())
        return (Result.FAILED, []) if message is None else (Result.ACCEPTED, [message])

    def _reboot_on_command(self, wanted: float) -> Result:
        if wanted != 1.0:
            return Result.UNSUPPORTED
        return Result.DENIED if self.controller.armed else Result.ACCEPTED

    def _mission_item(self, frame: ReceivedFrame) -> Any:
        mission, seq = self.controller.mission, frame.message.seq
        home_down_m = self.controller.snapshot().home_ned_m[2]
        return mission_item(
            mission,
            seq,
            global_of(mission.waypoints[seq]) if seq < len(mission.waypoints) else None,
            ORIGIN_ALT_M - home_down_m,
            system_id=frame.system_id,
            component_id=frame.component_id,
            mission_type=frame.message.mission_type,
        )

    def _read_parameter(self, message: Any) -> list[Any]:
        names = self.controller.parameters.names()
        if message.param_index >= 0:
            return [self._param_value(message.param_index)] if message.param_index < len(names) else []
        name = message.param_id
        return [self._param_value(names.index(name))] if name in names else []

    def _set_parameter(self, message: Any) -> list[Any]:
        parameters = self.controller.parameters
        if message.param_id not in parameters:
            return []
        # Refused or not, the answer is the value in force.
        parameters.set_from_wire(message.param_id, message.param_value, message.param_type)
        return [self._param_value(parameters.names().index(message.param_id))]

    def _param_value(self, index: int) -> Any:
        parameters = self.controller.parameters
        name = parameters.names()[index]
        value, kind = parameters.wire_value(name)
        return mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(parameters), index)


def _height(message: Any) -> float:
    """Return param7 of COMMAND_LONG, z of COMMAND_INT: metres above home."""
    return float(message.param7 if message.get_type() == "COMMAND_LONG" else message.z)


def _whole(value: float) -> int:
    """Return a command's float parameter as a whole number; -1 where it is none."""
    return int(value) if math.isfinite(value) else -1


def _ftp_refusal(frame: ReceivedFrame) -> Any:
    """Return the NAK that tells a ground station there are no files here."""
    asked = bytes(frame.message.payload)
    seq = (int.from_bytes(asked[0:2], "little") + 1) & 0xFFFF
    reply = bytearray(251)
    reply[0:2] = seq.to_bytes(2, "little")
    reply[2] = asked[2]
    reply[3] = _FTP_REPLY_NAK
    reply[4] = 1
    reply[5] = asked[3]
    reply[12] = _FTP_UNKNOWN_COMMAND
    return mavlink.MAVLink_file_transfer_protocol_message(0, frame.system_id, frame.component_id, list(reply))
