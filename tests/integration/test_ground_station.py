"""A ground station and the real ``companion run``: parameters, commands, plots, and the autopilot's clock."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess
from companion.sim.frame_server import FrameServer
from companion.sim.px4_modes import FlightMode
from companion.sim.vehicle import Vehicle
from companion.tuning import SETTINGS

OURS = (1, 191)


class GroundStation(asyncio.DatagramProtocol):
    """Keeps what it hears, by name, and says what it is told to."""

    def __init__(self) -> None:
        self.heard: list[mavlink.MAVLink_message] = []
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._link = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr) -> None:
        self.heard += self._parser.parse_buffer(bytearray(data)) or []

    def send(self, message) -> None:
        self._transport.sendto(bytes(message.pack(self._link)))
        self._link.seq = (self._link.seq + 1) % 256

    def of_ours(self, name: str) -> list[mavlink.MAVLink_message]:
        return [
            m
            for m in self.heard
            if m.get_type() == name and (m.get_srcSystem(), m.get_srcComponent()) == OURS
        ]

    def texts(self) -> str:
        return "".join(m.text for m in self.of_ours("STATUSTEXT"))

    async def until(self, true: Callable[[], object], *, ask=None) -> None:
        """Wait for something to be heard; ask again and again, as ground stations do."""
        async with asyncio.timeout(40):
            while not true():
                if ask is not None:
                    self.send(ask)
                for _ in range(10):
                    if true():
                        return
                    await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def flown(tables: dict):
    """A service with a camera, a hovering PX4 in OFFBOARD's ground state, and a ground station."""
    async with FrameServer() as server:

        async def publish() -> None:
            while True:
                server.publish(np.zeros((60, 80), dtype=np.uint8), time.monotonic_ns())
                await asyncio.sleep(0.05)

        camera = asyncio.create_task(publish())
        tables = {
            "source": {"url": "tcp:{}:{}".format(*server.address)},
            "log": {"status_interval_s": 0.5},
            **tables,
        }
        try:
            async with CompanionProcess(tables) as service:
                started = await service.wait_for("service_started")
                sides = {}
                for side in ("planner", "autopilot"):
                    host, _, port = str(started[side]).strip("[]'").rpartition(":")
                    sides[side] = (host.rpartition(":")[2], int(port))
                vehicle = Vehicle(position_ned_m=(0.0, 0.0, -2.0))
                async with FakeAutopilot(
                    sides["autopilot"], vehicle=vehicle, armed=True, mode=FlightMode.HOLD
                ) as autopilot:
                    transport, station = await asyncio.get_running_loop().create_datagram_endpoint(
                        GroundStation, remote_addr=sides["planner"]
                    )
                    try:
                        beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
                        await station.until(lambda: station.of_ours("HEARTBEAT"), ask=beat)
                        yield station, autopilot, service
                    finally:
                        transport.close()
                        await asyncio.sleep(0)
        finally:
            camera.cancel()
            await asyncio.gather(camera, return_exceptions=True)


def command(number: int, *params: float):
    return mavlink.MAVLink_command_long_message(*OURS, number, 0, *params, *([0.0] * (7 - len(params))))


async def test_a_ground_station_sees_sets_and_commands(tmp_path):
    tuned = tmp_path / "tuned.toml"
    tables = {
        "engagement": {"by": "command", "engaged_at_start": False},
        "ground_station": {"parameters_file": str(tuned), "plot_rate_hz": 5.0, "computer_status_s": 0.5},
    }
    async with flown(tables) as (station, autopilot, service):
        # The whole table, answered to a request to everybody.
        everybody = mavlink.MAVLink_param_request_list_message(1, 0)
        count = len(SETTINGS) + 1
        await station.until(
            lambda: len({m.param_index for m in station.of_ours("PARAM_VALUE")}) == count, ask=everybody
        )
        values = {m.param_id: m.param_value for m in station.of_ours("PARAM_VALUE")}
        assert values["VOID_MAX_STEP_M"] == 1.5
        assert values["VOID_ENGAGE"] == 0.0

        # One is set, acts, and is kept.
        def newest(name: str) -> float:
            return [m.param_value for m in station.of_ours("PARAM_VALUE") if m.param_id == name][-1]

        change = mavlink.MAVLink_param_set_message(*OURS, b"VOID_MAX_STEP_M", 0.5, 9)
        await station.until(lambda: newest("VOID_MAX_STEP_M") == 0.5, ask=change)
        await station.until(tuned.exists)
        assert "max_step_m = 0.5" in tuned.read_text()
        change = mavlink.MAVLink_param_set_message(*OURS, b"VOID_MAX_STEP_M", 99.0, 9)
        await station.until(lambda: "found 99.0" in station.texts(), ask=change)
        assert newest("VOID_MAX_STEP_M") == 0.5

        # Commands: refused with the reason, unknown, and answered.
        def result(number: int) -> int | None:
            acks = [m for m in station.of_ours("COMMAND_ACK") if m.command == number]
            return acks[-1].result if acks else None

        await station.until(lambda: result(31010) == 1, ask=command(31010, 1.0))
        await station.until(lambda: "no camera model" in station.texts())
        await station.until(lambda: result(400) == 3, ask=command(400, 1.0))
        await station.until(lambda: station.of_ours("AUTOPILOT_VERSION"), ask=command(512, 148.0))

        # Plots, the computer, and the clock of the autopilot.
        await station.until(lambda: station.of_ours("ONBOARD_COMPUTER_STATUS"))
        await station.until(
            lambda: (
                {m.name for m in station.of_ours("NAMED_VALUE_FLOAT")}
                >= {"void_state", "void_fps", "void_rtt"}
            )
        )
        assert autopilot.frame_counts["TIMESYNC"] >= 1
        assert not [m for m in station.heard if m.get_type() == "TIMESYNC" and m.tc1]
        assert autopilot.frame_counts["PARAM_SET"] == 0
        assert autopilot.frame_counts["PARAM_REQUEST_LIST"] >= 1
        await station.until(lambda: any(e["clock_round_trip_ms"] is not None for e in service.of("status")))


async def test_a_ground_station_engages_and_lets_go():
    tables = {"camera": {"hfov_deg": 80.0}, "engagement": {"by": "command", "engaged_at_start": False}}
    async with flown(tables) as (station, _, service):
        engage = command(92, 1.0)

        def engaged() -> list[float]:
            return [m.param_value for m in station.of_ours("PARAM_VALUE") if m.param_id == "VOID_ENGAGE"]

        await station.until(lambda: engaged()[-1:] == [1.0], ask=engage)  # once worker and poses are there
        assert "void: engaged" in station.texts()
        await station.until(lambda: engaged()[-1:] == [0.0], ask=command(92, 0.0))
        await station.until(lambda: "NOT engaged" in station.texts())
        await station.until(lambda: [e["engaged"] for e in service.of("status")][-1:] == [False])
        # All is well and nobody wants protection: STANDBY.
        await station.until(lambda: 3 in {m.system_status for m in station.of_ours("HEARTBEAT")})
