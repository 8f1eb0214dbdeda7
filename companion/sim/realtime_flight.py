"""A flight in real time: the real ``companion run`` as a process, the camera as another one, any MAVLink planner.

It does not repeat bit for bit: what the machine is slow at, the flight is late with. That is what it is for.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack

from companion.clock import Clock, RealClock
from companion.run_statistics import percentiles
from companion.sim.autopilot import FakeAutopilot
from companion.sim.camera_feed import CameraFeed
from companion.sim.companion_process import CompanionProcess, CompanionProcessError, Event
from companion.sim.flight import FlightError, FlightSpec, FlownFlight
from companion.sim.flight_loop import (
    Address,
    above_start,
    autopilot_of,
    camera_model_of,
    camera_of,
    goal_of,
    service_tables,
    take_off,
    wait_for_height,
    watch,
)
from companion.sim.flight_place import Place
from companion.sim.flight_record import FlightRecorder
from companion.sim.planner import Planner, Waypoint

_WORKER_START_S = 90.0
_CLIENT_START_S = 45.0
_CLIENT_STOP_S = 5.0
_LAST_WORDS = 400


def fly_in_real_time(spec: FlightSpec, place: Place) -> FlownFlight:
    """Fly in real time.

    Raises
    ------
    companion.errors.CompanionError
        When a process does not come up or ends, or the vehicle does not take off.
    """
    return asyncio.run(_fly(spec, place))


async def _fly(spec: FlightSpec, place: Place) -> FlownFlight:
    clock = RealClock()
    recorder = FlightRecorder()
    summary = percentiles(())
    async with AsyncExitStack() as stack:
        autopilot = await stack.enter_async_context(autopilot_of(spec, place, clock))
        service: CompanionProcess | None = None
        address: Address = autopilot.address
        if spec.method != "off":
            service = await _started_service(spec, place, autopilot, recorder, stack)
            started = await service.wait_for("service_started", _WORKER_START_S)
            host, _, port = started["planner"].rpartition(":")
            address = host, int(port)
            await service.wait_for("worker_ready", _WORKER_START_S)
        fly_with = _with_mavsdk if spec.planner == "mavsdk" else _with_waypoints
        planned = await stack.enter_async_context(fly_with(spec, place, autopilot, address, clock))

        outcome = await watch(spec, place, autopilot, recorder, planned, clock)

        record = recorder.record(autopilot.setpoints, {})
        if service is not None:
            code = await service.stop()
            found = service.of("summary")
            if code != 0 or not found:
                raise CompanionProcessError(
                    f"companion run ended with code {code}:\n" + "\n".join(service.other_lines)
                )
            summary = found[-1]["frame_to_setpoint_ms"]
    return FlownFlight(outcome, record, 1.0, summary)


async def _started_service(
    spec: FlightSpec, place: Place, autopilot: FakeAutopilot, recorder: FlightRecorder, stack: AsyncExitStack
) -> CompanionProcess:
    """Start the camera and the service."""
    feed = await stack.enter_async_context(
        CameraFeed(
            camera_of(spec, place),
            camera_model_of(spec),
            autopilot.true_pose,
            rate_hz=spec.frame_rate_hz,
            faults=spec.frame_faults,
        )
    )
    tables = service_tables(spec, autopilot.address)
    tables["source"]["url"] = "tcp:{}:{}".format(*feed.address)

    def on_event(event: Event) -> None:
        recorder.on_event(event, time.monotonic_ns())

    return await stack.enter_async_context(CompanionProcess(tables, on_event=on_event))


@contextlib.asynccontextmanager
async def _with_waypoints(
    spec: FlightSpec, place: Place, autopilot: FakeAutopilot, address: Address, clock: Clock
) -> AsyncIterator[Callable[[], Waypoint | None]]:
    """Take off with our own planner and aim at the goal."""
    async with Planner(address, rate_hz=spec.planner_hz) as planner:
        await take_off(planner, autopilot, place, clock)
        planner.aim(goal_of(place))
        yield lambda: goal_of(place)


@contextlib.asynccontextmanager
async def _with_mavsdk(
    spec: FlightSpec, place: Place, autopilot: FakeAutopilot, address: Address, clock: Clock
) -> AsyncIterator[Callable[[], Waypoint | None]]:
    """Have an unmodified mavsdk client, in a process of its own, take off and fly to the goal."""
    waypoints = " ".join(f"{w.north_m},{w.east_m},{w.down_m}" for w in (above_start(place), goal_of(place)))
    client = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion.sim.mavsdk_planner"),
        *("--url", "udpout://{}:{}".format(*address)),
        *("--waypoints", waypoints, "--arrive-radius", "0.4"),
        *("--waypoint-timeout", str(spec.rules_for(place).time_limit_s + 60.0)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    ended = asyncio.create_task(client.communicate(), name="mavsdk client")
    try:
        climbed = asyncio.create_task(wait_for_height(autopilot, place, clock, within_s=_CLIENT_START_S))
        await asyncio.wait({ended, climbed}, return_when=asyncio.FIRST_COMPLETED)
        if not climbed.done():
            climbed.cancel()
            raise FlightError(f"the mavsdk client ended: {(await ended)[1].decode()[-_LAST_WORDS:].strip()}")
        await climbed
        yield lambda: goal_of(place)
    finally:
        if client.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                client.terminate()
        try:
            async with asyncio.timeout(_CLIENT_STOP_S):
                await asyncio.shield(ended)
        except TimeoutError:
            client.kill()
            await ended
