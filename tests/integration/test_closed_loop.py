"""Closed loop with a rendered camera: the real service, the fake autopilot, and real clients as planners."""

from __future__ import annotations

import asyncio
import json
import math
import sys
from contextlib import AsyncExitStack
from functools import partial

import pytest

from companion.sim.autopilot import FakeAutopilot
from companion.sim.camera_feed import CameraFeed
from companion.sim.companion_process import CompanionProcess
from companion.sim.planner import Planner, Waypoint
from companion.sim.scene import empty_room, room_with_wall
from companion.sim.vehicle import Vehicle, VehicleLimits
from detector.camera_model import CameraModel

HFOV_DEG = 75.0
CAMERA = CameraModel.from_hfov(320, 240, HFOV_DEG)
ROOM = partial(empty_room, 14.0, 9.0, 3.0, behind_m=3.0)
WALLED = partial(room_with_wall, 12.0, 8.0, wall_north_m=4.5, gap_m=0.0)


class World:
    """Scene, camera, vehicle and service, joined."""

    def __init__(self, scene, **guidance: float) -> None:
        self.scene = scene
        self.guidance = guidance
        self.stack = AsyncExitStack()

    async def __aenter__(self) -> World:
        enter = self.stack.enter_async_context
        self.autopilot = await enter(FakeAutopilot(vehicle=Vehicle(VehicleLimits.indoor()), keep_frames=True))
        feed = await enter(CameraFeed(self.scene, CAMERA, self.autopilot.true_pose))
        self.service = await enter(
            CompanionProcess(
                {
                    "source": {"url": "tcp:{}:{}".format(*feed.address)},
                    "camera": {"hfov_deg": HFOV_DEG},
                    "guidance": self.guidance,
                    "link": {"autopilot": "udpout:{}:{}".format(*self.autopilot.address)},
                    "log": {"status_interval_s": 0.5, "detections": True},
                }
            )
        )
        started = await self.service.wait_for("service_started")
        host, _, port = started["planner"].rpartition(":")
        self.planner_address = (host, int(port))
        await self.service.wait_for("detection", 60)
        return self

    async def __aexit__(self, *exc_info) -> None:
        await self.stack.aclose()

    def states(self) -> list[str]:
        return [event["state"] for event in self.service.of("state")]


@pytest.mark.slow
async def test_an_unmodified_mavsdk_client_arms_starts_offboard_and_arrives_through_the_companion():
    goal = (5.0, 0.8, -1.2)
    async with World(ROOM) as world:
        # in a process of its own: its native threads are not this test's
        client = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "companion.sim.mavsdk_planner",
            "--url",
            "udpout://{}:{}".format(*world.planner_address),
            "--waypoints",
            "0,0,-1.2 {},{},{}".format(*goal),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(90):
                out, err = await client.communicate()
        finally:
            if client.returncode is None:
                client.kill()
                await client.wait()
        assert client.returncode == 0, err.decode()[-2000:]
        assert json.loads(out)["ended"] == "complete"
        position = world.autopilot.true_state.position_ned_m
        assert math.dist(position, goal) < 0.8
        # Setpoints were shortened to the step, toward the goal, and z is the client's to the last bit.
        sent = [record.setpoint for record in world.autopilot.setpoints]
        assert {round(s.z, 3) for s in sent} == {-1.2}
        assert any(0.2 < s.x < goal[0] - 0.5 for s in sent), "no setpoint was substituted"
        assert all(record.refusal is None for record in world.autopilot.setpoints)
        assert "STEER" in world.states() or "FOLLOW" in world.states()
        summary = world.service
    counts = summary.of("summary")[-1]
    assert counts["substituted"] > 20
    assert counts["handler_errors"] == 0
    assert not counts["dropped"]


@pytest.mark.slow
async def test_before_a_wall_it_turns_and_never_touches():
    goal = Waypoint(8.0, 0.0, -1.2)
    async with World(WALLED) as world, Planner(world.planner_address) as planner:
        scene = WALLED()
        await planner.wait_ready()
        planner.aim(goal)
        await planner.arm()
        await planner.start_offboard()
        nearest = math.inf
        for _ in range(500):
            await asyncio.sleep(0.05)
            nearest = min(nearest, scene.clearance(world.autopilot.true_state.position_ned_m))
            if "TURN" in world.states() and abs(world.autopilot.true_state.yaw_rad) > math.radians(20):
                break
        else:
            pytest.fail(f"it never turned: {world.states()}")
        assert nearest > 0.6
        assert {round(r.setpoint.z, 3) for r in world.autopilot.setpoints} == {-1.2}
        turned = [r.setpoint for r in world.autopilot.setpoints[-10:]]
        assert all(s.type_mask == 2552 for s in turned), "a turn is position hold plus yaw"
        assert any("wall" in event["reason"] for event in world.service.of("state"))
        assert any("void: TURN" in text for text in planner.status_texts)
