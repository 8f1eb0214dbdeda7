from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

import numpy as np
import pytest

from companion.errors import LinkError
from companion.sim.autopilot import FakeAutopilot
from companion.sim.link_faults import LinkFaults
from companion.sim.planner import Planner, PlannerError, Waypoint
from companion.sim.px4_modes import FlightMode
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.vehicle import Vehicle, VehicleLimits


async def until(condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():  # noqa: ASYNC110 - the condition is another task's state, with no event
            await asyncio.sleep(0.01)


def hovering() -> Vehicle:
    return Vehicle(VehicleLimits(), position_ned_m=(0.0, 0.0, -1.5))


async def test_a_planner_flies_it_round_and_every_setpoint_arrives_as_sent() -> None:
    async with FakeAutopilot() as autopilot, Planner(autopilot.address) as planner:
        goals = [Waypoint(0.0, 0.0, -1.0), Waypoint(2.0, 0.0, -1.0, 90.0)]
        mission = await planner.fly(goals, arrive_radius_m=0.3, waypoint_timeout_s=10.0)
        assert mission.ended == "complete"
        assert mission.arrived == (True, True)
        assert planner.modes == [FlightMode.HOLD, FlightMode.OFFBOARD]
        assert planner.armed
        await planner.finish()
        await until(lambda: len(autopilot.setpoints) == len(planner.sent))
        assert autopilot.mode is FlightMode.HOLD
        assert [r.raw for r in autopilot.setpoints] == [s.raw for s in planner.sent]
        assert [r.seq for r in autopilot.setpoints] == [s.seq for s in planner.sent]
        assert {r.setpoint.type_mask for r in autopilot.setpoints} == {3576, 2552}
        assert all(r.refusal is None for r in autopilot.setpoints)
        sent = [s.time_ns for s in planner.sent]
        assert np.median(np.diff(sent)) == pytest.approx(50e6, rel=0.2)


async def test_a_planner_that_waits_is_found_by_an_autopilot_that_sends() -> None:
    async with Planner() as planner, FakeAutopilot(planner.address) as autopilot:
        await planner.wait_ready(3.0)
        await planner.arm()
        assert autopilot.armed


async def test_the_planner_gives_up_when_the_pilot_takes_over_and_does_not_ask_again() -> None:
    async with (
        FakeAutopilot(vehicle=hovering(), armed=True) as autopilot,
        Planner(autopilot.address) as planner,
    ):
        flight = asyncio.create_task(planner.fly([Waypoint(30.0, 0.0, -1.5)], waypoint_timeout_s=10.0))
        await until(lambda: planner.mode is FlightMode.OFFBOARD)
        autopilot.change_mode(FlightMode.POSCTL)
        mission = await flight
        assert mission.ended == "left offboard"
        received = len(autopilot.setpoints)
        await until(lambda: len(autopilot.setpoints) > received + 5)
        assert autopilot.mode is FlightMode.POSCTL


async def test_a_planner_without_autopilot_says_so() -> None:
    async with FakeAutopilot() as autopilot:
        address = autopilot.address
    async with Planner(address) as planner:
        with pytest.raises(PlannerError, match=r"no HEARTBEAT from system 1 within 0\.2 s"):
            await planner.wait_ready(0.2)


async def test_both_ends_can_keep_every_frame_for_comparison() -> None:
    async with (
        FakeAutopilot(keep_frames=True) as autopilot,
        Planner(autopilot.address, keep_frames=True) as planner,
    ):
        await planner.wait_ready()
        await planner.arm()
        planner.aim(Waypoint(0.0, 0.0, -1.0))
        await until(lambda: len(planner.received_frames) > 100)
        sent = list(autopilot.sent_frames)
        await until(lambda: len(planner.received_frames) >= len(sent))
        assert planner.received_frames[: len(sent)] == sent
        sent = list(planner.sent_frames)
        await until(lambda: len(autopilot.received_frames) >= len(sent))
        assert autopilot.received_frames[: len(sent)] == sent
        assert [s.raw for s in planner.sent] == [f for f in planner.sent_frames if f[7:10] == b"\x54\0\0"]


async def test_a_refused_command_is_an_error_with_its_number() -> None:
    async with FakeAutopilot(vehicle=hovering()) as autopilot, Planner(autopilot.address) as planner:
        await planner.wait_ready()
        with pytest.raises(PlannerError, match="command 176 was refused with result 1"):
            await planner.set_mode(FlightMode.OFFBOARD)
        with pytest.raises(PlannerError, match="aim at a waypoint"):
            await planner.start_offboard()


async def test_a_lost_stream_leads_to_hold_and_a_resumed_one_back() -> None:
    parameters = {"COM_OF_LOSS_T": 0.2, "COM_OBL_RC_ACT": 5}
    async with (
        FakeAutopilot(vehicle=hovering(), armed=True, parameters=parameters) as autopilot,
        Planner(autopilot.address) as planner,
    ):
        await planner.wait_ready()
        planner.aim(Waypoint(0.0, 0.0, -1.5))
        await planner.start_offboard()
        assert autopilot.mode is FlightMode.OFFBOARD
        planner.stop_streaming()
        await until(lambda: autopilot.mode is FlightMode.HOLD)
        planner.aim(Waypoint(0.0, 0.0, -1.5))
        await until(lambda: autopilot.mode is FlightMode.OFFBOARD)
        await until(lambda: "Offboard signal regained" in planner.status_texts)


async def test_recorded_poses_are_reported_from_their_start_time() -> None:
    poses = RecordedPoses(
        np.array([0.0, 0.5]),
        np.array([[1.0, 0.0, -1.0], [2.0, 0.0, -1.0]]),
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
    )
    async with FakeAutopilot(replay=poses) as autopilot, Planner(autopilot.address) as planner:
        await planner.wait_ready()
        assert planner.position_ned_m == (1.0, 0.0, -1.0)
        await planner.arm()
        planner.aim(Waypoint(9.0, 9.0, -1.0))
        await planner.start_offboard()
        assert autopilot.position_ned_m == (1.0, 0.0, -1.0)
        start_ns = time.monotonic_ns()
        autopilot.start_replay(start_ns)
        await until(lambda: autopilot.position_ned_m[0] > 1.2)
        elapsed_s = (time.monotonic_ns() - start_ns) / 1e9
        assert autopilot.position_ned_m[0] <= 1.0 + elapsed_s / 0.5
        assert autopilot.state.velocity_ned_m_s == pytest.approx((2.0, 0.0, 0.0))
        await until(lambda: planner.position_ned_m == (2.0, 0.0, -1.0))
        assert autopilot.mode is FlightMode.OFFBOARD
        assert len(autopilot.setpoints) > 5


async def test_after_a_jump_the_camera_still_sees_from_the_true_place() -> None:
    async with FakeAutopilot(vehicle=hovering(), armed=True) as autopilot:
        before_ns = time.monotonic_ns()
        autopilot.jump_estimate((0.0, 3.0, 0.0))
        await until(lambda: autopilot.true_pose().time_ns > before_ns)
        pose = autopilot.true_pose()
        assert pose.time_ns <= time.monotonic_ns()
        assert (pose.north_m, pose.east_m, pose.down_m) == pytest.approx((0.0, 0.0, -1.5), abs=0.01)
        assert autopilot.position_ned_m == pytest.approx((0.0, 3.0, -1.5), abs=0.01)


def test_only_a_replaying_autopilot_can_start_a_replay() -> None:
    with pytest.raises(ValueError, match="without recorded poses"):
        FakeAutopilot().start_replay(0)


async def test_link_faults_lose_and_spoil_frames_both_ways() -> None:
    bad = LinkFaults(drop_rate=0.3, corrupt_rate=0.3, delay_s=0.01, jitter_s=0.02, duplicate_rate=0.1, seed=4)
    async with (
        FakeAutopilot(vehicle=hovering(), armed=True, outgoing=bad, incoming=bad) as autopilot,
        Planner(autopilot.address) as planner,
    ):
        planner.aim(Waypoint(0.0, 0.0, -1.5))
        await until(lambda: planner.frames_received > 300 and len(autopilot.setpoints) > 10, 10.0)
        assert autopilot.outgoing.dropped > 0
        assert autopilot.outgoing.corrupted > 0
        assert autopilot.incoming.dropped > 0
        assert len(autopilot.setpoints) < len(planner.sent)
        autopilot.set_faults(outgoing=LinkFaults(), incoming=LinkFaults(drop_rate=1.0))
        await asyncio.sleep(0.1)
        received = len(autopilot.setpoints)
        await asyncio.sleep(0.3)
        assert len(autopilot.setpoints) == received


async def test_garbage_on_its_port_is_counted() -> None:
    async with FakeAutopilot() as autopilot:
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(
            asyncio.DatagramProtocol, remote_addr=autopilot.address
        )
        try:
            transport.sendto(b"\xfd\xfe garbage" * 10)
            await until(lambda: autopilot.bad_bytes == 100)
        finally:
            transport.close()
        assert autopilot.frame_counts == {}


async def test_a_port_in_use_is_a_clear_error() -> None:
    async with FakeAutopilot() as autopilot:
        with pytest.raises(LinkError, match=rf"udp 127.0.0.1:{autopilot.address[1]}"):
            async with FakeAutopilot(local=autopilot.address):
                pass
        with pytest.raises(LinkError, match="the planner cannot listen"):
            async with Planner(local=autopilot.address):
                pass
