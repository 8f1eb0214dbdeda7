"""A fake PX4 or ArduPilot Copter on UDP."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Literal, Self

from companion.clock import Clock, RealClock
from companion.errors import LinkError
from companion.guidance.observation import Pose
from companion.sim.ardupilot_controller import ArduPilotController
from companion.sim.ardupilot_modes import CopterMode
from companion.sim.autopilot_endpoint import Address, AutopilotEndpoint, SetpointRecord
from companion.sim.commander import Result
from companion.sim.controller import Controller
from companion.sim.estimate_errors import ErringEstimate
from companion.sim.flight_controller import FlightController
from companion.sim.link_faults import FaultyLink, LinkFaults
from companion.sim.mission import Mission
from companion.sim.parameters import COPTER_DEFAULTS, ParameterTable
from companion.sim.px4_modes import FlightMode
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.telemetry import LandedState
from companion.sim.vehicle import Vector3, Vehicle, VehicleState
from companion.sim.wire import RECEIVE_BUFFER_BYTES

_TICK_NS = 5_000_000
_MOST_PEERS = 8


class FakeAutopilot:
    """An autopilot that flies a simulated vehicle, or replays recorded poses, on UDP.

    ``async with`` is its lifetime. It behaves as measured on PX4 v1.16.1 or ArduCopter 4.7-dev: modes, arming, entry
    into and loss of OFFBOARD or GUIDED, which setpoints are taken, and what it sends by itself.

    Parameters
    ----------
    remote
        Send to this address from the start, as PX4 does to its companion (the other side listens).
        None: wait, and send to whoever has sent a sound frame.
    local
        Address to listen on; port 0 lets the system choose, see ``address``.
    vehicle
        What it flies; by default at PX4's measured response, on the ground at the origin.
    replay
        Report these poses instead of flying; the first one until ``start_replay``.
    personality
        ``px4`` or ``ardupilot``.
    parameters
        Parameters that differ from that autopilot's defaults, for example ``{"COM_OBL_RC_ACT": 5}``.
    mode, armed
        The state to begin with; by default HOLD, of ArduPilot STABILIZE.
    system_id, component_id
        Its MAVLink identity.
    clock
        Where time comes from.
    outgoing, incoming
        Faults of the link, one for each direction; can be changed at any time by ``set_faults``.
    keep_frames
        Keep the bytes of every frame received and sent.
    erring
        Errors of the estimate that it flies by and reports; without it the estimate is the truth.

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
        vehicle: Vehicle | None = None,
        replay: RecordedPoses | None = None,
        personality: Literal["px4", "ardupilot"] = "px4",
        parameters: Mapping[str, int | float] | None = None,
        mode: FlightMode | CopterMode | None = None,
        armed: bool = False,
        system_id: int = 1,
        component_id: int = 1,
        clock: Clock | None = None,
        outgoing: LinkFaults | None = None,
        incoming: LinkFaults | None = None,
        keep_frames: bool = False,
        erring: ErringEstimate | None = None,
    ) -> None:
        self._clock: Clock = clock if clock is not None else RealClock()
        self._controller = _controller_of(
            personality,
            self._clock.now_ns(),
            vehicle=vehicle,
            replay=replay,
            parameters=parameters,
            mode=mode,
            armed=armed,
            system_id=system_id,
            component_id=component_id,
            erring=erring,
        )
        self._endpoint = AutopilotEndpoint(
            self._controller, system_id=system_id, component_id=component_id, keep_frames=keep_frames
        )
        self._local = local
        self._remote = remote
        self._peers: list[Address] = [] if remote is None else [remote]
        self._outgoing = FaultyLink(outgoing)
        self._incoming = FaultyLink(incoming)
        self._transport: asyncio.DatagramTransport | None = None
        self._task: asyncio.Task[None] | None = None
        self._delayed: set[asyncio.TimerHandle] = set()
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
            raise LinkError(f"the fake autopilot cannot listen on udp {host}:{port}: {error}") from error
        self._transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES
        )
        self._task = loop.create_task(self._run(), name="fake autopilot")
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        for handle in self._delayed:
            handle.cancel()
        self._delayed.clear()
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait({self._task})
        if self._transport is not None:
            self._transport.close()
            await asyncio.sleep(0)  # lets the loop close the socket
        if self._task is not None and not self._task.cancelled():
            self._task.result()  # it never ends by itself: this raises what stopped it

    # ---- what it is doing ----

    @property
    def address(self) -> Address:
        """The address it listens on."""
        if self._transport is None:
            raise RuntimeError("the fake autopilot has not been entered: use 'async with'")
        host, port = self._transport.get_extra_info("sockname")[:2]
        return host, port

    @property
    def mode(self) -> FlightMode | CopterMode:
        """The mode it flies in."""
        return self._controller.mode

    @property
    def crashed(self) -> str:
        """What ended the autopilot's program (a NaN in a setpoint ends ArduPilot's), "" while it runs."""
        return self._controller.crashed

    @property
    def armed(self) -> bool:
        """Whether it is armed."""
        return self._controller.armed

    @property
    def landed(self) -> LandedState:
        """On the ground, in the air, taking off or landing."""
        return self._controller.landed

    @property
    def state(self) -> VehicleState:
        """The estimate, as telemetry reports it."""
        return self._controller.estimate

    @property
    def true_state(self) -> VehicleState:
        """Where the vehicle really is: differs from ``state`` by the errors and jumps of the estimate."""
        return self._controller.true_state

    def true_pose(self) -> Pose:
        """Return where the vehicle really is, with the time at which that was true: what a camera sees from."""
        state = self._controller.true_state
        north_m, east_m, down_m = state.position_ned_m
        return Pose(self._controller.now_ns, north_m, east_m, down_m, state.q_ned_from_body)

    @property
    def position_ned_m(self) -> Vector3:
        """The estimated position."""
        return self._controller.estimate.position_ned_m

    @property
    def setpoints(self) -> list[SetpointRecord]:
        """Every SET_POSITION_TARGET_LOCAL_NED received, in order, refused ones included."""
        return self._endpoint.setpoints

    @property
    def frame_counts(self) -> Counter[str]:
        """Number of frames received, by message name."""
        return self._endpoint.frame_counts

    @property
    def sent_counts(self) -> Counter[str]:
        """Number of frames sent, by message name, those lost by link faults included."""
        return self._endpoint.sent_counts

    @property
    def received_frames(self) -> list[bytes]:
        """The bytes of every frame received, with ``keep_frames``."""
        return self._endpoint.received_frames

    @property
    def sent_frames(self) -> list[bytes]:
        """The bytes of every frame sent, with ``keep_frames``, those lost by link faults included."""
        return self._endpoint.sent_frames

    @property
    def bad_bytes(self) -> int:
        """Bytes received that belong to no sound frame."""
        return self._endpoint.bad_bytes

    @property
    def outgoing(self) -> FaultyLink:
        """The link from the autopilot, with its counters."""
        return self._outgoing

    @property
    def incoming(self) -> FaultyLink:
        """The link to the autopilot, with its counters."""
        return self._incoming

    # ---- what can be done to it ----

    def start_replay(self, t0_monotonic_ns: int) -> None:
        """Say when the first recorded pose is true."""
        self._controller.start_replay(t0_monotonic_ns)

    def change_mode(self, mode: FlightMode | CopterMode) -> Result:
        """Change the mode as the pilot would, with hands on centred sticks from now on."""
        self._controller.pilot_present = True
        return self._controller.request_custom_mode(mode.custom_mode, self._clock.now_ns())

    def arm(self) -> Result:
        """Arm as the pilot would."""
        return self._controller.request_arm(self._clock.now_ns())

    def set_mission(self, waypoints: Sequence[Vector3]) -> None:
        """Give it a mission of waypoints in local NED (m), as if it had been uploaded."""
        self._controller.mission = Mission(waypoints)

    @property
    def mission_seq(self) -> int:
        """The mission item that is flown."""
        return self._controller.mission.current

    def jump_estimate(self, jump_ned_m: Vector3) -> None:
        """Move the estimate at once, as an estimator reset does; ODOMETRY's reset counter counts it."""
        self._controller.jump_estimate(jump_ned_m)

    def reboot(self) -> None:
        """Restart the autopilot: silent for two seconds, clock at zero, disarmed."""
        self._endpoint.reboot(self._clock.now_ns())

    def set_faults(self, *, outgoing: LinkFaults | None = None, incoming: LinkFaults | None = None) -> None:
        """Replace the faults of one or both directions; the counters of a replaced one start anew."""
        if outgoing is not None:
            self._outgoing = FaultyLink(outgoing)
        if incoming is not None:
            self._incoming = FaultyLink(incoming)

    # ---- the loop ----

    async def _run(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            now_ns = self._clock.now_ns()
            if self._peers:
                frames = self._endpoint.advance(now_ns)
                for peer in self._peers:
                    self._send(frames, peer)
            else:
                self._controller.advance(now_ns)  # it flies whether anybody listens or not
            due_ns = max(due_ns + _TICK_NS, now_ns)
            await self._clock.sleep_until_ns(due_ns)

    def datagram_arrived(self, datagram: bytes, sender: Address) -> None:
        """Take one datagram from the socket."""
        self.datagrams_received += 1
        for delay_s, content in self._incoming.pass_on(datagram):
            if delay_s > 0.0:
                self._later(delay_s, content, sender)
            else:
                self._receive(content, sender)

    def _receive(self, datagram: bytes, sender: Address) -> None:
        counted = sum(self._endpoint.frame_counts.values())
        answers = self._endpoint.receive(datagram, self._clock.now_ns(), sender)
        if self._remote is not None:
            sender = self._remote
        elif sender not in self._peers and sum(self._endpoint.frame_counts.values()) > counted:
            self._peers = [*self._peers, sender][-_MOST_PEERS:]
        self._send(answers, sender)

    def _send(self, frames: list[bytes], peer: Address) -> None:
        for frame in frames:
            for delay_s, content in self._outgoing.pass_on(frame):
                if delay_s > 0.0:
                    self._later(delay_s, content, peer, outgoing=True)
                else:
                    self._transmit(content, peer)

    def _later(self, delay_s: float, content: bytes, peer: Address, *, outgoing: bool = False) -> None:
        def deliver() -> None:
            self._delayed.discard(handle)
            (self._transmit if outgoing else self._receive)(content, peer)

        handle = asyncio.get_running_loop().call_later(delay_s, deliver)
        self._delayed.add(handle)

    def _transmit(self, datagram: bytes, peer: Address) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(datagram, peer)
            self.datagrams_sent += 1


def _controller_of(
    personality: Literal["px4", "ardupilot"],
    now_ns: int,
    *,
    vehicle: Vehicle | None,
    replay: RecordedPoses | None,
    parameters: Mapping[str, int | float] | None,
    mode: FlightMode | CopterMode | None,
    armed: bool,
    system_id: int,
    component_id: int,
    erring: ErringEstimate | None,
) -> Controller:
    """Return the autopilot behind the link.

    Raises
    ------
    ValueError
        When the mode is one of the other autopilot.
    """
    if personality == "px4":
        if isinstance(mode, CopterMode):
            raise ValueError(f"PX4 has no mode {mode.name}")
        return FlightController(
            now_ns,
            vehicle=vehicle,
            replay=replay,
            parameters=ParameterTable(parameters),
            mode=FlightMode.HOLD if mode is None else mode,
            armed=armed,
            system_id=system_id,
            component_id=component_id,
            erring=erring,
        )
    if isinstance(mode, FlightMode):
        raise ValueError(f"ArduPilot has no mode {mode.name}")  # noqa: TRY004 - the value is not one of its modes
    return ArduPilotController(
        now_ns,
        vehicle=vehicle,
        replay=replay,
        parameters=ParameterTable(parameters, defaults=COPTER_DEFAULTS, bytewise=False),
        mode=CopterMode.STABILIZE if mode is None else mode,
        armed=armed,
        system_id=system_id,
        component_id=component_id,
        erring=erring,
    )


class _Receiver(asyncio.DatagramProtocol):
    """Hands datagrams to the autopilot. A peer that is not there yet (ICMP refusal) is not an error."""

    def __init__(self, autopilot: FakeAutopilot) -> None:
        self._autopilot = autopilot

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._autopilot.datagram_arrived(data, addr[:2])
