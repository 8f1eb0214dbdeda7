"""A planner that flies a list of waypoints by streaming SET_POSITION_TARGET_LOCAL_NED.

https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED
"""

from __future__ import annotations

import asyncio
import math
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from companion.clock import Clock, RealClock
from companion.errors import CompanionError, LinkError
from companion.sim.px4_modes import FlightMode, mode_from_custom
from companion.sim.vehicle import Vector3
from companion.sim.wire import RECEIVE_BUFFER_BYTES, FrameReader, FrameWriter, ReceivedFrame

Address = tuple[str, int]

POSITION_ONLY = 3576
POSITION_AND_YAW = 2552

_HEARTBEAT_PERIOD_NS = 1_000_000_000
_ACK_S = 0.5
_ACK_TRIES = 6
_STREAM_BEFORE_OFFBOARD_S = 0.5
_POLL_S = 0.02


class PlannerError(CompanionError):
    """The autopilot does not answer, or refuses what the planner asks."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A place in local NED, m, with the heading to take there (deg) or None to leave the heading alone."""

    north_m: float
    east_m: float
    down_m: float
    yaw_deg: float | None = None

    @property
    def type_mask(self) -> int:
        """Position alone, or position and yaw."""
        return POSITION_ONLY if self.yaw_deg is None else POSITION_AND_YAW

    def distance_m(self, position_ned_m: Vector3) -> float:
        """Return how far a position is from here."""
        return math.dist((self.north_m, self.east_m, self.down_m), position_ned_m)


@dataclass(frozen=True, slots=True)
class SentSetpoint:
    """One setpoint as it left.

    Attributes
    ----------
    time_ns
        Our monotonic time.
    seq
        Sequence number in the frame's header.
    raw
        The frame's bytes.
    waypoint
        What it asked for.
    """

    time_ns: int
    seq: int
    raw: bytes
    waypoint: Waypoint


@dataclass(frozen=True, slots=True)
class FlownMission:
    """How a mission went.

    Attributes
    ----------
    arrived
        For each waypoint, in order: whether it was reached in time. Shorter than the list when it was given up.
    ended
        ``complete``, ``timeout`` or ``left offboard``.
    """

    arrived: tuple[bool, ...]
    ended: str


class Planner:
    """A MAVLink client on UDP that streams one waypoint after another.

    ``async with`` is its lifetime. It sends a HEARTBEAT at 1 Hz from the start, and setpoints from the first
    ``aim`` until ``stop_streaming``. Out of OFFBOARD by anybody else's doing, it never asks for it again.

    Parameters
    ----------
    remote
        Send to this address (the companion's planner side, or an autopilot). None: wait for somebody to send,
        and answer there.
    local
        Address to listen on; port 0 lets the system choose, see ``address``.
    rate_hz
        Setpoints a second.
    system_id, component_id
        The planner's own identity.
    target_system, target_component
        The autopilot.
    keep_frames
        Keep the bytes of every frame sent and received, in ``sent_frames`` and ``received_frames``.
    clock
        Where time comes from.

    Raises
    ------
    companion.errors.LinkError
        On entering, when the local address cannot be had.
    """

    def __init__(
        self,
        remote: Address | None = None,
        *,
        local: Address = ("127.0.0.1", 0),
        rate_hz: float = 20.0,
        system_id: int = 245,
        component_id: int = mavlink.MAV_COMP_ID_MISSIONPLANNER,
        target_system: int = 1,
        target_component: int = 1,
        keep_frames: bool = False,
        clock: Clock | None = None,
    ) -> None:
        if not (math.isfinite(rate_hz) and 0.0 < rate_hz <= 200.0):
            raise ValueError(f"rate_hz must be above 0 and at most 200, got {rate_hz}")
        self._clock: Clock = clock if clock is not None else RealClock()
        self._remote = remote
        self._local = local
        self._period_ns = round(1e9 / rate_hz)
        self._target_system = target_system
        self._target_component = target_component
        self._writer = FrameWriter(system_id, component_id)
        self._reader = FrameReader()
        self._transport: asyncio.DatagramTransport | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._waypoint: Waypoint | None = None
        self._start_ns = self._clock.now_ns()
        self._acks: dict[int, int] = {}
        self._offboard_asked = False
        self._keep_frames = keep_frames
        self.sent: list[SentSetpoint] = []
        self.sent_frames: list[bytes] = []
        self.received_frames: list[bytes] = []
        self.status_texts: list[str] = []
        self.modes: list[FlightMode] = []
        self.armed = False
        self.position_ned_m: Vector3 | None = None
        self.frames_received = 0
        self.datagrams_sent = 0
        self.datagrams_received = 0

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        try:
            self._transport, _ = await loop.create_datagram_endpoint(
                lambda: _Receiver(self), local_addr=self._local
            )
        except OSError as error:
            host, port = self._local
            raise LinkError(f"the planner cannot listen on udp {host}:{port}: {error}") from error
        self._transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES
        )
        self._tasks = [
            loop.create_task(self._send_heartbeats(), name="planner heartbeats"),
            loop.create_task(self._send_setpoints(), name="planner setpoints"),
        ]
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)
        if self._transport is not None:
            self._transport.close()
            await asyncio.sleep(0)  # lets the loop close the socket
        for task in self._tasks:
            if not task.cancelled():
                task.result()  # it never ends by itself: this raises what stopped it

    @property
    def address(self) -> Address:
        """The address it listens on."""
        if self._transport is None:
            raise RuntimeError("the planner has not been entered: use 'async with'")
        host, port = self._transport.get_extra_info("sockname")[:2]
        return host, port

    @property
    def mode(self) -> FlightMode | None:
        """The mode the autopilot showed last; ``modes`` has all, each change once."""
        return self.modes[-1] if self.modes else None

    # ---- flying ----

    async def wait_ready(self, timeout_s: float = 10.0) -> None:
        """Wait for the autopilot's HEARTBEAT and position.

        Raises
        ------
        PlannerError
            When they do not come in time.
        """
        if not await self._until(lambda: bool(self.modes) and self.position_ned_m is not None, timeout_s):
            seen = "no HEARTBEAT" if not self.modes else "no LOCAL_POSITION_NED"
            raise PlannerError(f"{seen} from system {self._target_system} within {timeout_s:g} s")

    def aim(self, waypoint: Waypoint) -> None:
        """Stream this waypoint from now on."""
        self._waypoint = waypoint

    def stop_streaming(self) -> None:
        """Send no more setpoints."""
        self._waypoint = None

    async def arm(self) -> None:
        """Arm.

        Raises
        ------
        PlannerError
            When the autopilot refuses or does not answer.
        """
        await self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    async def start_offboard(self) -> None:
        """Ask for OFFBOARD once, after half a second of setpoints.

        Raises
        ------
        PlannerError
            When nothing is streamed yet, or the autopilot refuses or does not answer.
        """
        if self._waypoint is None:
            raise PlannerError("aim at a waypoint before asking for OFFBOARD")
        await self._pause(_STREAM_BEFORE_OFFBOARD_S)
        await self.set_mode(FlightMode.OFFBOARD)
        self._offboard_asked = True

    async def set_mode(self, mode: FlightMode) -> None:
        """Ask for a mode.

        Raises
        ------
        PlannerError
            When the autopilot refuses or does not answer.
        """
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        await self.command(mavlink.MAV_CMD_DO_SET_MODE, flags, mode.main, mode.sub)

    async def command(self, command: int, *params: float) -> None:
        """Send a COMMAND_LONG until it is acknowledged.

        Raises
        ------
        PlannerError
            When it is refused or not answered.
        """
        padded = [*params, *([0.0] * (7 - len(params)))]
        self._acks.pop(command, None)
        for confirmation in range(_ACK_TRIES):
            message = mavlink.MAVLink_command_long_message(
                self._target_system, self._target_component, command, confirmation, *padded
            )
            self._send(self._writer.pack(message))
            if await self._until(lambda: command in self._acks, _ACK_S):
                result = self._acks[command]
                if result != mavlink.MAV_RESULT_ACCEPTED:
                    raise PlannerError(f"command {command} was refused with result {result}")
                return
        raise PlannerError(f"command {command} was not answered within {_ACK_S * _ACK_TRIES:g} s")

    async def fly(
        self,
        waypoints: Sequence[Waypoint],
        *,
        arrive_radius_m: float = 0.5,
        waypoint_timeout_s: float = 30.0,
    ) -> FlownMission:
        """Arm, enter OFFBOARD and fly the waypoints in order; goes on streaming the last one.

        Parameters
        ----------
        waypoints
            At least one.
        arrive_radius_m
            A waypoint is reached when LOCAL_POSITION_NED is this near.
        waypoint_timeout_s
            A waypoint not reached in this time ends the mission.

        Raises
        ------
        PlannerError
            When the autopilot is silent, or refuses to arm or to enter OFFBOARD.
        ValueError
            When there are no waypoints.
        """
        if not waypoints:
            raise ValueError("at least one waypoint is needed")
        await self.wait_ready()
        self.aim(waypoints[0])
        await self.arm()
        await self.start_offboard()
        await self._until(lambda: self.mode is FlightMode.OFFBOARD, 3.0)
        arrived: list[bool] = []
        for waypoint in waypoints:
            self.aim(waypoint)

            def reached(goal: Waypoint = waypoint) -> bool:
                return (
                    self.position_ned_m is not None
                    and goal.distance_m(self.position_ned_m) <= arrive_radius_m
                )

            await self._until(lambda: reached() or self._left_offboard(), waypoint_timeout_s)
            if self._left_offboard():
                return FlownMission(tuple(arrived), "left offboard")
            arrived.append(reached())
            if not arrived[-1]:
                return FlownMission(tuple(arrived), "timeout")
        return FlownMission(tuple(arrived), "complete")

    async def finish(self) -> None:
        """Hand over to Hold, then stop streaming.

        Raises
        ------
        PlannerError
            When the autopilot refuses or does not answer.
        """
        await self.set_mode(FlightMode.HOLD)
        self.stop_streaming()

    def _left_offboard(self) -> bool:
        return self._offboard_asked and self.mode is not None and self.mode is not FlightMode.OFFBOARD

    # ---- the link ----

    def datagram_arrived(self, datagram: bytes, sender: Address) -> None:
        """Take one datagram from the socket."""
        self.datagrams_received += 1
        for frame in self._reader.read(datagram):
            self.frames_received += 1
            if self._keep_frames:
                self.received_frames.append(frame.raw)
            if self._remote is None:
                self._remote = sender
            if frame.message is not None and frame.system_id == self._target_system:
                self._take(frame)

    def _take(self, frame: ReceivedFrame) -> None:
        message: Any = frame.message
        from_autopilot = frame.component_id == self._target_component
        match frame.name:
            case "HEARTBEAT" if from_autopilot:
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                mode = mode_from_custom(message.custom_mode)
                if mode is not None and mode is not self.mode:
                    self.modes.append(mode)
            case "LOCAL_POSITION_NED" if from_autopilot:
                self.position_ned_m = (message.x, message.y, message.z)
            case "COMMAND_ACK" if from_autopilot:
                self._acks[message.command] = message.result
            case "STATUSTEXT":
                self.status_texts.append(message.text)

    async def _send_heartbeats(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            message = mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                mavlink.MAV_AUTOPILOT_INVALID,
                0,
                0,
                mavlink.MAV_STATE_ACTIVE,
                3,
            )
            self._send(self._writer.pack(message))
            due_ns += _HEARTBEAT_PERIOD_NS
            await self._clock.sleep_until_ns(due_ns)

    async def _send_setpoints(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            if self._waypoint is not None:
                self._send_setpoint(self._waypoint)
            # After a stall the missed setpoints are not made up for: only the newest matters.
            due_ns = max(due_ns + self._period_ns, self._clock.now_ns())
            await self._clock.sleep_until_ns(due_ns)

    def _send_setpoint(self, waypoint: Waypoint) -> None:
        if self._remote is None:
            return
        now_ns = self._clock.now_ns()
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            time_boot_ms=(now_ns - self._start_ns) // 1_000_000 & 0xFFFFFFFF,
            target_system=self._target_system,
            target_component=self._target_component,
            coordinate_frame=mavlink.MAV_FRAME_LOCAL_NED,
            type_mask=waypoint.type_mask,
            x=waypoint.north_m,
            y=waypoint.east_m,
            z=waypoint.down_m,
            vx=0.0,
            vy=0.0,
            vz=0.0,
            afx=0.0,
            afy=0.0,
            afz=0.0,
            yaw=math.radians(waypoint.yaw_deg) if waypoint.yaw_deg is not None else 0.0,
            yaw_rate=0.0,
        )
        seq = self._writer.next_seq
        raw = self._writer.pack(message)
        self.sent.append(SentSetpoint(now_ns, seq, raw, waypoint))
        self._send(raw)

    def _send(self, datagram: bytes) -> None:
        if self._transport is not None and self._remote is not None and not self._transport.is_closing():
            self._transport.sendto(datagram, self._remote)
            self.datagrams_sent += 1
            if self._keep_frames:
                self.sent_frames.append(datagram)

    async def _until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition that arriving messages change; return whether it holds."""
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not condition():
            if self._clock.now_ns() >= end_ns:
                return False
            await self._pause(_POLL_S)
        return True

    async def _pause(self, seconds: float) -> None:
        await self._clock.sleep_until_ns(self._clock.now_ns() + round(seconds * 1e9))


class _Receiver(asyncio.DatagramProtocol):
    """Hands datagrams to the planner. A peer that is not there yet (ICMP refusal) is not an error."""

    def __init__(self, planner: Planner) -> None:
        self._planner = planner

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._planner.datagram_arrived(data, addr[:2])
