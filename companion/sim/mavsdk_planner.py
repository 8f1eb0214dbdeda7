"""The same mission flown by an unmodified mavsdk 4.1 client (Offboard plugin).

mavsdk brings native threads of its own, so a program that does other things should start this as a process:

    python -m companion.sim.mavsdk_planner --url udpin://127.0.0.1:14540 --waypoints "3,0,-1.5 3,2,-1.5,90"

It writes one JSON object, the mission's result, to standard output.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.errors import CompanionError
from companion.sim.planner import Waypoint
from companion.sim.vehicle import Vector3


class MavsdkPlannerError(CompanionError):
    """mavsdk cannot connect, finds no autopilot, or the autopilot refuses."""


@dataclass(frozen=True, slots=True)
class MavsdkMission:
    """How the mission went.

    Attributes
    ----------
    system_id
        The autopilot that was found.
    arrived
        For each waypoint, in order: whether it was reached in time. Shorter than the list when it was given up.
    ended
        ``complete``, ``timeout`` or ``left offboard``.
    final_position_ned_m
        The last position mavsdk reported.
    final_mode
        The flight mode mavsdk saw at the end, after handing over to Hold.
    """

    system_id: int
    arrived: tuple[bool, ...]
    ended: str
    final_position_ned_m: Vector3
    final_mode: str


async def fly_with_mavsdk(
    url: str,
    waypoints: Sequence[Waypoint],
    *,
    system_id: int = 245,
    component_id: int = 190,
    arrive_radius_m: float = 0.5,
    waypoint_timeout_s: float = 30.0,
    discovery_timeout_s: float = 10.0,
) -> MavsdkMission:
    """Find the autopilot, arm, enter OFFBOARD, fly the waypoints in order, hand over to Hold and close mavsdk.

    Parameters
    ----------
    url
        mavsdk connection, for example ``udpin://127.0.0.1:14540`` or ``udpout://127.0.0.1:14560``.
    waypoints
        At least one. mavsdk always sends a yaw: without one it is the azimuth of the leg.
    system_id, component_id
        The client's own identity; mavsdk's heartbeat is on.
    arrive_radius_m
        A waypoint is reached when the position is this near.
    waypoint_timeout_s
        A waypoint not reached in this time ends the mission.
    discovery_timeout_s
        How long to wait for the autopilot, and for its first position.

    Raises
    ------
    MavsdkPlannerError
        When there is no connection or no autopilot, or it refuses to arm or to enter OFFBOARD.
    ValueError
        When there are no waypoints.
    """
    if not waypoints:
        raise ValueError("at least one waypoint is needed")
    # Loads mavsdk's native library: only where it is used.
    from mavsdk.asyncio import Configuration, Mavsdk, MavsdkConnectionError

    configuration = Configuration.create_manual(system_id, component_id, True)
    try:
        async with Mavsdk(configuration) as mavsdk:
            try:
                await mavsdk.add_any_connection(url)
            except MavsdkConnectionError as error:
                raise MavsdkPlannerError(f"mavsdk cannot connect to {url}: {error}") from error
            system = await mavsdk.first_autopilot(timeout_s=discovery_timeout_s)
            if system is None:
                raise MavsdkPlannerError(
                    f"mavsdk found no autopilot at {url} within {discovery_timeout_s:g} s"
                )
            flight = _Flight(system)
            try:
                return await flight.fly(waypoints, arrive_radius_m, waypoint_timeout_s, discovery_timeout_s)
            finally:
                await flight.close()
    finally:
        configuration.destroy()


class _Flight:
    """The plugins of one system, and the position they report."""

    def __init__(self, system: Any) -> None:
        from mavsdk.asyncio.plugins.action import ActionAsync
        from mavsdk.asyncio.plugins.offboard import OffboardAsync
        from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

        self._system = system
        self._action = ActionAsync(system)
        self._offboard = OffboardAsync(system)
        self._telemetry = TelemetryAsync(system)
        self._position: Vector3 | None = None
        self._moved = asyncio.Event()
        self._listener = asyncio.get_running_loop().create_task(self._listen(), name="mavsdk position")

    async def close(self) -> None:
        """End the subscription and release the plugins, before mavsdk itself is destroyed."""
        self._listener.cancel()
        await asyncio.gather(self._listener, return_exceptions=True)
        for plugin in (self._telemetry, self._offboard, self._action):
            plugin.destroy()

    async def fly(
        self,
        waypoints: Sequence[Waypoint],
        arrive_radius_m: float,
        waypoint_timeout_s: float,
        position_timeout_s: float,
    ) -> MavsdkMission:
        """Arm, enter OFFBOARD, fly and hand over to Hold."""
        from mavsdk.plugins.action import ActionError
        from mavsdk.plugins.offboard import OffboardError

        start = await self._first_position(position_timeout_s)
        yaws_deg = _yaws(start, waypoints)
        try:
            await self._aim(waypoints[0], yaws_deg[0])
            await self._action.arm()
            await self._offboard.start()
        except (ActionError, OffboardError) as error:
            raise MavsdkPlannerError(f"the autopilot refused: {error}") from error

        arrived: list[bool] = []
        ended = "complete"
        for waypoint, yaw_deg in zip(waypoints, yaws_deg, strict=True):
            await self._aim(waypoint, yaw_deg)
            arrived.append(await self._reach(waypoint, arrive_radius_m, waypoint_timeout_s))
            if not arrived[-1]:
                ended = "timeout" if await self._offboard.is_active() else "left offboard"
                break
        if ended != "left offboard":
            try:
                await self._offboard.stop()
            except OffboardError as error:
                raise MavsdkPlannerError(f"the autopilot refused to hold: {error}") from error
        mode = await self._telemetry.flight_mode()
        return MavsdkMission(
            system_id=await self._system.get_system_id(),
            arrived=tuple(arrived),
            ended=ended,
            final_position_ned_m=self._position if self._position is not None else start,
            final_mode=str(getattr(mode, "name", mode)),
        )

    async def _aim(self, waypoint: Waypoint, yaw_deg: float) -> None:
        from mavsdk.plugins.offboard import PositionNedYaw

        await self._offboard.set_position_ned(
            PositionNedYaw(waypoint.north_m, waypoint.east_m, waypoint.down_m, yaw_deg)
        )

    async def _listen(self) -> None:
        async for update in self._telemetry.subscribe_position_velocity_ned():
            position = update.position
            self._position = (position.north_m, position.east_m, position.down_m)
            self._moved.set()

    async def _first_position(self, timeout_s: float) -> Vector3:
        try:
            async with asyncio.timeout(timeout_s):
                await self._moved.wait()
        except TimeoutError as error:
            raise MavsdkPlannerError(f"no position from the autopilot within {timeout_s:g} s") from error
        assert self._position is not None  # noqa: S101 - set before the event is
        return self._position

    async def _reach(self, waypoint: Waypoint, radius_m: float, timeout_s: float) -> bool:
        """Return whether the waypoint was reached; False at once when OFFBOARD has been left."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + timeout_s
        next_look_s = loop.time() + 2.0
        while loop.time() < end_s:
            self._moved.clear()
            if self._position is not None and waypoint.distance_m(self._position) <= radius_m:
                return True
            if loop.time() >= next_look_s:
                # mavsdk learns of a change of mode from the next heartbeats.
                if not await self._offboard.is_active():
                    return False
                next_look_s = loop.time() + 0.5
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.5):
                    await self._moved.wait()
        return False


def _yaws(start: Vector3, waypoints: Sequence[Waypoint]) -> list[float]:
    """Return a yaw in degrees for each waypoint: its own, or the azimuth of the leg to it."""
    yaws = []
    north, east = start[0], start[1]
    yaw_deg = 0.0
    for waypoint in waypoints:
        d_north, d_east = waypoint.north_m - north, waypoint.east_m - east
        if waypoint.yaw_deg is not None:
            yaw_deg = waypoint.yaw_deg
        elif math.hypot(d_north, d_east) > 0.1:  # straight up has no azimuth: keep the heading
            yaw_deg = math.degrees(math.atan2(d_east, d_north))
        yaws.append(yaw_deg)
        north, east = waypoint.north_m, waypoint.east_m
    return yaws


def parse_waypoints(text: str) -> list[Waypoint]:
    """Return the waypoints of ``"n,e,d n,e,d,yaw"`` (m, deg), separated by spaces.

    Raises
    ------
    ValueError
        When a waypoint does not have three or four finite numbers.
    """
    waypoints = []
    for part in text.split():
        try:
            numbers = [float(number) for number in part.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (3, 4) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"waypoint {part!r}: expected north,east,down or north,east,down,yaw_deg")
        waypoints.append(Waypoint(*numbers))
    if not waypoints:
        raise ValueError("at least one waypoint is needed")
    return waypoints


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly from the command line; 0 when all waypoints were reached.

    Standard output carries the result alone: from here on, everything else that is written there goes to
    standard error.
    """
    parser = argparse.ArgumentParser(prog="python -m companion.sim.mavsdk_planner", description=__doc__)
    parser.add_argument("--url", required=True, help="mavsdk connection, for example udpin://127.0.0.1:14540")
    parser.add_argument("--waypoints", required=True, help='"n,e,d n,e,d,yaw_deg": m, local NED, and degrees')
    parser.add_argument("--system-id", type=int, default=245)
    parser.add_argument("--component-id", type=int, default=190)
    parser.add_argument("--arrive-radius", type=float, default=0.5, metavar="M")
    parser.add_argument("--waypoint-timeout", type=float, default=30.0, metavar="S")
    parser.add_argument("--discovery-timeout", type=float, default=10.0, metavar="S")
    options = parser.parse_args(arguments)
    try:
        waypoints = parse_waypoints(options.waypoints)
    except ValueError as error:
        parser.error(str(error))
    # mavsdk's native library logs to standard output: that is kept for the result.
    sys.stdout.flush()
    result_fd = os.dup(1)
    os.dup2(2, 1)
    try:
        mission = asyncio.run(
            fly_with_mavsdk(
                options.url,
                waypoints,
                system_id=options.system_id,
                component_id=options.component_id,
                arrive_radius_m=options.arrive_radius,
                waypoint_timeout_s=options.waypoint_timeout,
                discovery_timeout_s=options.discovery_timeout,
            )
        )
    except CompanionError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    with os.fdopen(result_fd, "w") as result:
        result.write(json.dumps(dataclasses.asdict(mission)) + "\n")
    return 0 if mission.ended == "complete" else 1


if __name__ == "__main__":
    sys.exit(main())
