"""Takeover and addressed mode over real sockets: the fake autopilots, the proxy, the switch and an ideal detector."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import time
from contextlib import AsyncExitStack
from functools import partial

import pytest
from pymavlink.dialects.v20 import common as mavlink
from structlog.testing import CapturingLogger

from companion.addressed import AddressedSetpoints
from companion.clock import RealClock
from companion.config import Config
from companion.guidance.coordinates import heading_rad
from companion.guidance.substitution import State
from companion.guidance.takeover import Facts, Flown, Phase, Way
from companion.interception import Interception
from companion.mavlink.identity import Identity
from companion.mavlink.link import UdpEndpoint
from companion.mavlink.proxy import InlineProxy
from companion.own import Own
from companion.sim.ardupilot_modes import CopterMode
from companion.sim.autopilot import FakeAutopilot
from companion.sim.camera_feed import CameraFeed
from companion.sim.companion_process import CompanionProcess
from companion.sim.px4_modes import FlightMode
from companion.sim.scene import room_with_wall
from companion.sim.vehicle import Vehicle, VehicleLimits
from companion.sim.wire import FrameWriter
from companion.takeover import TakeoverFlight
from detector.camera_model import CameraModel
from tests.fakes.flat_world import Flight, clearance_m, room

HEIGHT_M = 1.5
GOAL = (12.0, 0.0, -HEIGHT_M)
WALLS = [*room(40, 30), (6.0, -6.0, 6.0, 1.2)]
"""A wall across the mission's way, which ends 1.2 m east of it."""
NEAR = [*room(40, 30), (4.0, -8.0, 4.0, 8.0)]
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


def facts_of_letting_go() -> Facts:
    """Not engaged, once: the next step engages anew."""
    return Facts(armed=True, engaged=False, flown=Flown.OTHER, way=Way.UNKNOWN, arrived=False, fault=None)


async def taken_over(loop: Loop) -> None:
    loop.start_mission()
    await loop.until(lambda: loop.phase is Phase.FLYING)


@pytest.mark.slow
async def test_the_pilots_mode_ends_our_part_and_a_dead_detector_leaves_nothing_stale():
    async with Loop(walls=NEAR) as loop:
        await taken_over(loop)
        loop.autopilot.change_mode(FlightMode.POSCTL)
        await loop.until(lambda: loop.phase is Phase.OUT, 10)
        sent = len(loop.autopilot.setpoints)
        for _ in range(15):
            await asyncio.sleep(0.1)
            assert loop.autopilot.mode is FlightMode.POSCTL
        assert len(loop.autopilot.setpoints) <= sent + 2, "the stream went on"

        # Another flight, after arming anew is imitated by letting go and engaging.
        loop.takeover.table.step(facts_of_letting_go(), time.monotonic_ns())
        await taken_over(loop)
        loop.sees = False
        await loop.until(lambda: loop.phase is Phase.OUT, 20)
        assert loop.autopilot.mode is FlightMode.HOLD, "the autopilot's own hold was asked for"
        ended_ns = loop.autopilot.setpoints[-1].time_ns
        await asyncio.sleep(1.5)
        assert loop.autopilot.setpoints[-1].time_ns <= ended_ns + 200_000_000
        assert loop.autopilot.mode is FlightMode.HOLD
        assert loop.flight.switch.state is State.DISENGAGED


@pytest.mark.slow
async def test_setpoints_for_our_component_go_out_as_ours_through_the_switch():
    async with Loop(mode="addressed", walls=NEAR) as loop:
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            asyncio.DatagramProtocol, remote_addr=loop.planner.local_address
        )
        loop.stack.callback(transport.close)
        writer = FrameWriter(255, 190)

        def send(component: int, x: float = 9.0) -> None:
            position = (x, 0.0, -HEIGHT_M)
            transport.sendto(
                writer.pack(
                    mavlink.MAVLink_set_position_target_local_ned_message(
                        7, 1, component, 1, 3576, *position, *[0.0] * 8
                    )
                )
            )

        for _ in range(20):
            send(191)
            await asyncio.sleep(0.05)
        await loop.until(lambda: len(loop.autopilot.setpoints) > 5, 10)
        assert loop.autopilot.change_mode(FlightMode.OFFBOARD) == 0
        async with asyncio.timeout(40):
            while loop.flight.switch.state is not State.TURN:
                send(191)
                await asyncio.sleep(0.05)
        records = loop.autopilot.setpoints
        assert {(r.system_id, r.component_id) for r in records} == {(1, 191)}
        assert {(r.setpoint.target_system, r.setpoint.target_component) for r in records} == {(1, 1)}
        assert all(r.refusal is None for r in records)
        assert {r.setpoint.z for r in records} == {-HEIGHT_M}
        assert any(r.setpoint.x < 8.0 for r in records), "no setpoint was substituted"
        assert loop.nearest > 0.3
        sent = loop.addressed.sent
        send(191, math.nan)
        await loop.until(lambda: loop.addressed.dropped["not finite"] == 1, 10)
        assert loop.addressed.sent == sent


@pytest.mark.slow
async def test_after_sigkill_in_takeover_px4s_failsafe_acts_in_time():
    hfov_deg = 75.0
    camera = CameraModel.from_hfov(320, 240, hfov_deg)
    scene = partial(room_with_wall, 12.0, 8.0, wall_north_m=5.0, gap_m=0.0)
    async with AsyncExitStack() as stack:
        vehicle = Vehicle(VehicleLimits.indoor(), position_ned_m=(0.0, 0.0, -1.2))
        autopilot = await stack.enter_async_context(
            FakeAutopilot(vehicle=vehicle, armed=True, parameters={"MPC_XY_CRUISE": 0.6, "COM_OBL_RC_ACT": 5})
        )
        autopilot.set_mission([(9.0, 0.0, -1.2)])
        feed = await stack.enter_async_context(CameraFeed(scene, camera, autopilot.true_pose))
        service = await stack.enter_async_context(
            CompanionProcess(
                {
                    "source": {"url": "tcp:{}:{}".format(*feed.address)},
                    "camera": {"hfov_deg": hfov_deg},
                    "interception": {"mode": "takeover"},
                    "link": {"autopilot": "udpout:{}:{}".format(*autopilot.address)},
                }
            )
        )
        await service.wait_for("mission_downloaded", 60)
        autopilot.change_mode(FlightMode.MISSION)
        await service.wait_for("takeover", 60, where=lambda event: event["phase"] == "FLYING")
        os.kill(service.pid, signal.SIGKILL)
        async with asyncio.timeout(20):
            while autopilot.mode is FlightMode.OFFBOARD:  # noqa: ASYNC110 - the state of another task
                await asyncio.sleep(0.005)
        left_ns = time.monotonic_ns()
        assert autopilot.mode is FlightMode.HOLD
        assert (left_ns - autopilot.setpoints[-1].time_ns) / 1e9 <= 1.0 + 0.2
