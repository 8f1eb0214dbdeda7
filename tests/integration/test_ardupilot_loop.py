"""Closed loop with the fake ArduPilot over real sockets: proxy, interception and switch, with an ideal detector."""

from __future__ import annotations

import asyncio
import math
import time
from contextlib import AsyncExitStack

import pytest
from pymavlink.dialects.v20 import common as mavlink
from structlog.testing import CapturingLogger

from companion.config import Config
from companion.guidance.coordinates import heading_rad
from companion.guidance.setpoint import LocalSetpoint
from companion.guidance.substitution import State
from companion.interception import Interception
from companion.mavlink.identity import Identity
from companion.mavlink.link import UdpEndpoint
from companion.mavlink.proxy import InlineProxy
from companion.sim.ardupilot_modes import CopterMode
from companion.sim.autopilot import FakeAutopilot
from companion.sim.vehicle import Vehicle, VehicleLimits
from companion.sim.wire import FrameReader, FrameWriter
from tests.fakes.flat_world import Flight, clearance_m, room
from tests.fakes.wire_flight import local

WALLS = [*room(20, 16), (4.5, -8.0, 4.5, 8.0)]
CLIMB_M = 1.2


class Loop:
    """Planner, proxy, ArduPilot and an ideal detector, joined."""

    def __init__(self) -> None:
        self.stack = AsyncExitStack()
        self.nearest = math.inf
        self.results: dict[int, int] = {}
        self.position: tuple[float, float, float] | None = None
        self._writer = FrameWriter(245, 190)
        self._reader = FrameReader()
        self._eye = Flight(WALLS)

    async def __aenter__(self) -> Loop:
        enter = self.stack.enter_async_context
        self.autopilot = await enter(
            FakeAutopilot(personality="ardupilot", vehicle=Vehicle(VehicleLimits.indoor()))
        )
        planner = await enter(UdpEndpoint("udpin:127.0.0.1:0"))
        vehicle = await enter(UdpEndpoint("udpout:{}:{}".format(*self.autopilot.address)))
        identity = Identity(planner, vehicle)
        self.flight = Interception(Config(), identity=identity, log=CapturingLogger())
        self.proxy = InlineProxy(planner, vehicle, self.flight, now_ns=time.monotonic_ns)
        identity.heartbeat(self.flight.mav_state(time.monotonic_ns()))  # the autopilot learns where to send
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(
            lambda: _Client(self), remote_addr=planner.local_address
        )
        self.stack.callback(self._transport.close)
        see = loop.create_task(self._see())
        self.stack.push_async_callback(_cancelled, see)
        return self

    async def __aexit__(self, *exc_info) -> None:
        await self.stack.aclose()

    @property
    def state(self) -> State:
        return self.flight.switch.state

    def take(self, datagram: bytes) -> None:
        for frame in self._reader.read(datagram):
            if frame.name == "COMMAND_ACK":
                self.results[frame.message.command] = frame.message.result
            if frame.name == "LOCAL_POSITION_NED":
                self.position = (frame.message.x, frame.message.y, frame.message.z)

    def send(self, message) -> None:
        self._transport.sendto(self._writer.pack(message))

    async def command(self, number: int, *params: float) -> int:
        self.results.pop(number, None)
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params))))
        await self.until(lambda: number in self.results)
        return self.results[number]

    async def until(self, condition, seconds: float = 10.0) -> None:
        async with asyncio.timeout(seconds):
            while not condition():  # noqa: ASYNC110 - the state of other tasks, with no event
                await asyncio.sleep(0.01)

    async def stream(self, setpoint: LocalSetpoint, seconds: float, *, until=lambda: False) -> bool:
        """Send a setpoint ten times a second; return whether the condition came true."""
        fields = {name: getattr(setpoint, name) for name in LocalSetpoint.__slots__}
        for _ in range(round(seconds * 10)):
            self.send(mavlink.MAVLink_set_position_target_local_ned_message(**fields))
            await asyncio.sleep(0.1)
            if until():
                return True
        return False

    async def take_off(self) -> None:
        await self.until(lambda: self.proxy.vehicle is not None)
        for message_id, interval_us in ((32, 50_000), (30, 20_000)):
            assert await self.command(511, message_id, interval_us) == 0
        assert await self.command(176, 1, 4) == 0
        assert await self.command(400, 1) == 0
        assert await self.command(22, 0, 0, 0, 0, 0, 0, CLIMB_M) == 0
        await self.until(lambda: self.position is not None and self.position[2] < 0.15 - CLIMB_M)

    async def _see(self) -> None:
        """An ideal detector at 5 Hz, and a tape measure."""
        eye = self._eye
        while True:
            pose = self.autopilot.true_pose()
            eye.now, eye.n, eye.e, eye.d = pose.time_ns, pose.north_m, pose.east_m, pose.down_m
            eye.yaw = heading_rad(pose.q_ned_from_body)
            eye.verdicts.append((pose.time_ns, None))  # numbers the reports
            self.nearest = min(self.nearest, clearance_m(eye.n, eye.e, WALLS))
            self.flight.on_report(eye.report(), time.monotonic_ns())
            await asyncio.sleep(0.2)


class _Client(asyncio.DatagramProtocol):
    def __init__(self, loop: Loop) -> None:
        self._loop = loop

    def datagram_received(self, data: bytes, addr) -> None:
        self._loop.take(data)


async def _cancelled(task: asyncio.Task) -> None:
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.result()


@pytest.mark.slow
@pytest.mark.parametrize(
    "setpoint",
    [local(3576, 9, p=(3.0, 0.0, 0.0)), local(3527, 8, v=(0.8, 0.0, 0.0))],
    ids=["body offset", "body velocity"],
)
async def test_an_arducopter_is_turned_before_a_wall_and_loiter_by_the_pilot_wins(setpoint):
    async with Loop() as loop:
        await loop.take_off()
        assert await loop.stream(setpoint, 20, until=lambda: loop.state is State.TURN), (
            loop.flight.switch.reason
        )
        await loop.stream(setpoint, 3)
        assert loop.nearest > 0.3
        assert loop.position[2] == pytest.approx(-CLIMB_M, abs=0.2)
        assert abs(loop.autopilot.true_state.yaw_rad) > math.radians(15)

        sent = [record.setpoint for record in loop.autopilot.setpoints]
        assert all(record.refusal is None for record in loop.autopilot.setpoints)
        assert {s.coordinate_frame for s in sent} == {setpoint.coordinate_frame}
        assert all(s.vz == setpoint.vz for s in sent)
        assert loop.autopilot.crashed == ""

        loop.flight.set_fault("camera", "camera gone", time.monotonic_ns())
        await loop.stream(setpoint, 1)
        held = loop.position
        await loop.stream(setpoint, 3)
        assert loop.state is State.HOLD
        assert math.dist(loop.position, held) < 0.3

        loop.autopilot.change_mode(CopterMode.LOITER)
        await loop.stream(setpoint, 3, until=lambda: loop.state is State.DISENGAGED)
        assert loop.state is State.DISENGAGED
        await loop.stream(setpoint, 1)
        assert loop.autopilot.mode is CopterMode.LOITER, "nothing of ours asks for GUIDED again"
        counts = loop.proxy.counters.as_dict()
        assert counts["handler_errors"] == 0
        assert counts["held"] > 10
        assert counts["turned"] > 0  # a turn ends early where a way is seen
        assert counts["substituted"] > 5
        assert (
            sum(counts[name] for name in ("forwarded", "substituted", "held", "turned"))
            + sum(counts["dropped"].values())
            == counts["setpoints_in"]
        )
