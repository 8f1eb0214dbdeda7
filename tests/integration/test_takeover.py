"""Takeover and addressed mode over real sockets: the fake autopilots, the proxy, the switch and an ideal detector."""

from __future__ import annotations

import asyncio
import math
import time
from contextlib import AsyncExitStack

import pytest
from structlog.testing import CapturingLogger

from companion.addressed import AddressedSetpoints
from companion.clock import RealClock
from companion.config import Config
from companion.guidance.coordinates import heading_rad
from companion.guidance.takeover import Phase
from companion.interception import Interception
from companion.mavlink.identity import Identity
from companion.mavlink.link import UdpEndpoint
from companion.mavlink.proxy import InlineProxy
from companion.own import Own
from companion.sim.ardupilot_modes import CopterMode
from companion.sim.autopilot import FakeAutopilot
from companion.sim.px4_modes import FlightMode
from companion.sim.vehicle import Vehicle, VehicleLimits
from companion.takeover import TakeoverFlight
from tests.fakes.flat_world import Flight, clearance_m, room

HEIGHT_M = 1.5
GOAL = (12.0, 0.0, -HEIGHT_M)
WALLS = [*room(40, 30), (6.0, -6.0, 6.0, 1.2)]
"""A wall across the mission's way, which ends 1.2 m east of it."""
SOURCE = {"source": {"url": "tcp:127.0.0.1:9"}, "camera": {"hfov_deg": 75.0}}


class Loop:
    """An autopilot in its mission, the companion's parts in the given mode, and an ideal detector."""

    def __init__(self, personality: str = "px4", *, mode: str = "takeover", walls=WALLS) -> None:
        self.personality, self.mode, self.walls = personality, mode, walls
        self.stack = AsyncExitStack()
        self.nearest = math.inf
        self.sees = True

    async def __aenter__(self) -> Loop:
        enter = self.stack.enter_async_context
        px4 = self.personality == "px4"
        speed = {"MPC_XY_CRUISE": 0.6, "COM_OBL_RC_ACT": 5} if px4 else {"WPNAV_SPEED": 60}
        self.autopilot = await enter(
            FakeAutopilot(
                personality=self.personality,
                vehicle=Vehicle(VehicleLimits.indoor(), position_ned_m=(0.0, 0.0, -HEIGHT_M)),
                parameters=speed,
                armed=True,
                mode=FlightMode.HOLD if px4 else CopterMode.LOITER,
            )
        )
        self.autopilot.set_mission([GOAL])
        self.planner = await enter(UdpEndpoint("udpin:127.0.0.1:0"))
        vehicle = await enter(UdpEndpoint("udpout:{}:{}".format(*self.autopilot.address)))
        config = Config.model_validate({**SOURCE, "interception": {"mode": self.mode}})
        identity = Identity(self.planner, vehicle)
        self.log = CapturingLogger()
        self.flight = Interception(config, identity=identity, log=self.log)
        now_ns = time.monotonic_ns()
        own = Own(
            config, self.flight, identity, log=self.log, now_ns=now_ns, apply=lambda _: None, signatures=None
        )
        self.takeover = TakeoverFlight(
            config, self.flight, identity, log=self.log, own=own.component,
            engaged=lambda: own.engagement.engaged,
        )  # fmt: skip
        self.addressed = AddressedSetpoints(self.flight, identity, own=own.component)
        tap = self.takeover if self.mode == "takeover" else self.addressed
        self.proxy = InlineProxy(self.planner, vehicle, self.flight, now_ns=time.monotonic_ns, own=tap)
        loop = asyncio.get_running_loop()
        tasks = [loop.create_task(self._see()), loop.create_task(self._speak(identity, own))]
        if self.mode == "takeover":
            tasks.append(loop.create_task(self.takeover.run(RealClock())))
        for task in tasks:
            self.stack.push_async_callback(_cancelled, task)
        await self.until(lambda: self.flight.switch.pose is not None, 20)
        return self

    async def __aexit__(self, *exc_info) -> None:
        await self.stack.aclose()

    @property
    def phase(self) -> Phase:
        return self.takeover.table.phase

    def start_mission(self) -> None:
        self.autopilot.change_mode(self.mission_mode)

    @property
    def mission_mode(self):
        return FlightMode.MISSION if self.personality == "px4" else CopterMode.AUTO

    @property
    def setpoint_mode(self):
        return FlightMode.OFFBOARD if self.personality == "px4" else CopterMode.GUIDED

    async def until(self, condition, seconds: float = 60.0) -> None:
        try:
            async with asyncio.timeout(seconds):
                while not condition():  # noqa: ASYNC110 - the state of other tasks, with no event
                    await asyncio.sleep(0.01)
        except TimeoutError:
            pytest.fail(f"{self.phase} {self.takeover.table.reason}, {self.flight.switch.state}: "
                        f"{self.flight.switch.reason}; {self.autopilot.mode} {self.autopilot.position_ned_m}")  # fmt: skip

    async def _speak(self, identity: Identity, own: Own) -> None:
        while True:
            now_ns = time.monotonic_ns()
            identity.heartbeat(self.flight.mav_state(now_ns))
            for _ in range(10):
                own.component.tick(time.monotonic_ns())
                await asyncio.sleep(0.1)

    async def _see(self) -> None:
        """An ideal detector at 5 Hz, and a tape measure."""
        eye = Flight(self.walls)
        while True:
            pose = self.autopilot.true_pose()
            eye.now, eye.n, eye.e, eye.d = pose.time_ns, pose.north_m, pose.east_m, pose.down_m
            eye.yaw = heading_rad(pose.q_ned_from_body)
            eye.verdicts.append((pose.time_ns, None))  # numbers the reports
            self.nearest = min(self.nearest, clearance_m(eye.n, eye.e, self.walls))
            if self.sees:
                self.flight.on_report(eye.report(), time.monotonic_ns())
            await asyncio.sleep(0.2)


async def _cancelled(task: asyncio.Task) -> None:
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.result()


@pytest.mark.slow
@pytest.mark.parametrize("personality", ["px4", "ardupilot"])
async def test_a_mission_toward_a_wall_is_taken_over_led_around_and_given_back(personality):
    async with Loop(personality) as loop:
        loop.start_mission()
        await loop.until(lambda: loop.phase is Phase.FLYING)
        assert loop.autopilot.mode is loop.setpoint_mode
        await loop.until(lambda: loop.phase is Phase.WATCHING, 90)
        assert loop.autopilot.mode is loop.mission_mode
        assert loop.autopilot.mission_seq == 0
        assert loop.nearest > 0.3
        records = loop.autopilot.setpoints
        assert {(r.system_id, r.component_id) for r in records} == {(1, 191)}
        # ArduPilot takes none before it is in GUIDED, and PX4 all of them.
        assert all(r.refusal in (None, "not in GUIDED") for r in records)
        assert all(abs(r.setpoint.z + HEIGHT_M) < 0.2 for r in records), "z is the mission's"
