"""What the live page costs and does: the page's weight, pictures to the browser, and what a viewer costs the flight.

    .venv/bin/python benchmarks/web.py [--seconds 20]

1. weight: bytes that a browser loads first, as they are and by gzip
2. pictures: a sink with frames of 640 x 480 at 30 Hz; a client on loopback acknowledges each, as the page does. From the time that a
   frame was taken to the time that its JPEG is there.
3. viewers: the real service forwards position setpoints between two UDP ends; latency of each with no viewer, one viewer, and five of
   which three take nothing. The order is turned and repeated; memory of the I/O process beside it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

sys.path[0] = str(Path(__file__).parents[1])  # beside this file lies a detector.py

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from websockets.asyncio.client import connect

from companion.config_file import config_of
from companion.io.messages import Answer, Kind, Message, Wants
from companion.sim.companion_process import CompanionProcess
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA
from companion.web.assets import load_assets
from companion.web.sink import build

RATE_HZ = 100.0


def percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(share * len(values)))] if values else float("nan")


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# ---------------------------------------------------------------------- weight


def weight() -> dict[str, Any]:
    assets = load_assets()
    return {
        "files": len(assets),
        "bytes": sum(len(asset.data) for asset in assets.values()),
        "gzip_bytes": sum(len(asset.packed) for asset in assets.values()),
    }


# ---------------------------------------------------------------------- pictures


class Desk:
    def __init__(self) -> None:
        self.wants = Wants()
        self.dropped: dict[Kind, int] = {}

    @property
    def log(self) -> Desk:
        return self

    def info(self, event: str, **fields: Any) -> None: ...

    warning = error = info

    def want(self, wants: Wants) -> None:
        self.wants = wants

    def ask(self, name: str, fields: Any) -> Any:
        from concurrent.futures import Future

        future: Future[Answer] = Future()
        future.set_result(Answer(accepted=False))
        return future


async def pictures(seconds: float) -> dict[str, Any]:
    port = free_port()
    desk = Desk()
    config = config_of({"web": {"enabled": True, "port": port, "pictures_hz": 30.0}}, name="benchmark")
    page = build(config, desk)
    page.start()
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 40, (480, 640), np.uint8)
    gradient = (np.linspace(0, 200, 640)[None, :] + np.zeros((480, 1))).astype(np.uint8)
    image = gradient + noise
    delays_ms: list[float] = []
    bytes_of: list[int] = []
    stop = asyncio.Event()

    def publish(number: int) -> None:
        now_ns = time.monotonic_ns()
        fields = {"seq": number, "width_px": 640, "height_px": 480, "taken_ns": now_ns, "time_of": "exposure"}
        page.take(Message(Kind.FRAME, now_ns, number, fields, image=np.roll(image, number, axis=1)))

    async def feed() -> None:
        number, due_s = 0, time.monotonic()
        while not stop.is_set():
            number += 1
            await asyncio.to_thread(publish, number)
            due_s = max(due_s + 1 / 30.0, time.monotonic())
            await asyncio.sleep(due_s - time.monotonic())

    async with connect(f"ws://127.0.0.1:{port}/api/live", max_size=None, compression=None) as viewer:
        feeding = asyncio.create_task(feed())
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            said = await viewer.recv()
            if isinstance(said, bytes):
                (length,) = struct.unpack_from("<I", said)
                header = json.loads(said[4 : 4 + length])
                delays_ms.append((time.monotonic_ns() - header["taken_ns"]) / 1e6)
                bytes_of.append(len(said))
                await viewer.send('{"type": "shown"}')
        stop.set()
        await feeding
    await asyncio.to_thread(page.stop)
    return {
        "pictures_hz": round(len(delays_ms) / seconds, 1),
        "p50_ms": round(percentile(delays_ms, 0.5), 1),
        "p95_ms": round(percentile(delays_ms, 0.95), 1),
        "bytes": int(statistics.median(bytes_of)),
    }


# ---------------------------------------------------------------------- viewers beside a flight


class End(asyncio.DatagramProtocol):
    """One end of the flight's link: counts setpoints by the x that they carry."""

    def __init__(self) -> None:
        self.received_ns: dict[int, int] = {}
        self._mav = mavlink.MAVLink(None)
        self._mav.robust_parsing = True
        self.transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport: Any) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        now_ns = time.monotonic_ns()
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                self.received_ns[message.time_boot_ms] = now_ns


async def latencies_ms(planner_port: int, autopilot_port: int, seconds: float) -> list[float]:
    """Send setpoints through the service and return how long each took; the vehicle is not armed, so that they pass."""
    loop = asyncio.get_running_loop()
    autopilot_transport, autopilot = await loop.create_datagram_endpoint(
        End, remote_addr=("127.0.0.1", autopilot_port)
    )
    planner_transport, _ = await loop.create_datagram_endpoint(End, remote_addr=("127.0.0.1", planner_port))
    vehicle = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    planner = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    sent_ns: dict[int, int] = {}
    try:
        until_s, number, due_s = time.monotonic() + seconds + 1.0, 0, time.monotonic()
        while time.monotonic() < until_s:
            number += 1
            if number % 20 == 1:
                beat = vehicle.heartbeat_encode(2, 12, 81, 0, 3)
                autopilot_transport.sendto(beat.pack(vehicle))
            pose = vehicle.local_position_ned_encode(number * 10, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0)
            autopilot_transport.sendto(pose.pack(vehicle))
            attitude = vehicle.attitude_quaternion_encode(number * 10, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            autopilot_transport.sendto(attitude.pack(vehicle))
            await asyncio.sleep(0.002)
            setpoint = planner.set_position_target_local_ned_encode(
                number, 1, 1, 1, 0b0000111111111000, 1.0, 0.0, -1.0, 0, 0, 0, 0, 0, 0, 0.0, 0.0
            ).pack(planner)
            sent_ns[number] = time.monotonic_ns()
            planner_transport.sendto(setpoint)
            due_s = max(due_s + 1 / RATE_HZ, time.monotonic() - 0.02)
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
        await asyncio.sleep(0.3)
    finally:
        planner_transport.close()
        autopilot_transport.close()
    kept = [number for number in sent_ns if number > RATE_HZ]  # after the first second
    arrived = [number for number in kept if number in autopilot.received_ns]
    if len(arrived) < 0.99 * len(kept):
        print(f"  {len(kept) - len(arrived)} of {len(kept)} setpoints did not arrive", file=sys.stderr)
    return [(autopilot.received_ns[number] - sent_ns[number]) / 1e6 for number in arrived]


@asynccontextmanager
async def viewers(port: int, good: int, stalled: int) -> AsyncIterator[list[int]]:
    """Look at the page: some as a browser does, some that never take a byte again."""
    counts = [0] * good

    async def look(place: int) -> None:
        async with connect(
            f"ws://127.0.0.1:{port}/api/live", max_size=None, compression=None, ping_interval=None
        ) as viewer:
            while True:
                if isinstance(await viewer.recv(), bytes):
                    counts[place] += 1
                    await viewer.send('{"type": "shown"}')

    async with AsyncExitStack() as stack:
        tasks = [asyncio.create_task(look(place)) for place in range(good)]
        for _ in range(stalled):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            one.sendall(
                b"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
                b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
            )
        try:
            yield counts
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


def resident_mib(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def cpu_s(pid: int) -> float:
    """CPU time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def beside_a_flight(seconds: float, rounds: int) -> dict[str, Any]:
    port, planner, autopilot = free_port(), free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    with tempfile.TemporaryDirectory() as folder:
        tables = {
            "web": {"enabled": True, "port": port},
            "source": {"url": f"file:{OFFICE_WALK}", "loop": True},
            "camera": {"file": str(OFFICE_WALK_CAMERA)},
            "detector": {"method": "paper"},
            "link": {
                "planner": f"udpin:127.0.0.1:{planner}",
                "autopilot": f"udpin:127.0.0.1:{autopilot}",
            },
            "ground_station": {"parameters_file": f"{folder}/tuned.toml"},
        }
        kinds = {"none": (0, 0), "one": (1, 0), "five, three stalled": (2, 3)}
        p50: dict[str, list[float]] = {name: [] for name in kinds}
        p99: dict[str, list[float]] = {name: [] for name in kinds}
        rate: dict[str, list[float]] = {name: [] for name in kinds}
        cpu: dict[str, list[float]] = {name: [] for name in kinds}
        memory: list[float] = []
        async with CompanionProcess(tables) as service:
            pid = (await service.wait_for("io_started", 60.0))["pid"]
            await service.wait_for("web_serving", 60.0)
            worker = (await service.wait_for("worker_ready", 90.0)).get("pid")
            if worker is not None:
                # The detector takes a core of its own, whoever looks: on a machine of few it is not to be what is measured.
                os.setpriority(os.PRIO_PROCESS, worker, 19)
            memory.append(resident_mib(pid))
            for _ in range(rounds):
                for name, (good, stalled) in kinds.items():
                    async with viewers(port, good, stalled) as counts:
                        began_s, before_s = time.monotonic(), cpu_s(service.pid)
                        found = await latencies_ms(planner, autopilot, seconds)
                        took_s = time.monotonic() - began_s
                        cpu[name].append((cpu_s(service.pid) - before_s) / took_s * 100)
                    p50[name].append(percentile(found, 0.5))
                    p99[name].append(percentile(found, 0.99))
                    rate[name].append(max(counts, default=0) / took_s)
                    memory.append(resident_mib(pid))
    base = statistics.median(p50["none"])
    return {
        "p50_ms": {name: round(statistics.median(values), 3) for name, values in p50.items()},
        "p99_ms": {name: round(statistics.median(values), 3) for name, values in p99.items()},
        "added_p50_ms": {
            name: round(statistics.median(values) - base, 3) for name, values in p50.items() if name != "none"
        },
        "pictures_hz": {name: round(statistics.median(values), 1) for name, values in rate.items()},
        "mavlink_process_cpu_percent": {
            name: round(statistics.median(values), 1) for name, values in cpu.items()
        },
        "io_process_mib": [round(value, 1) for value in memory],
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=15.0, help="of each measurement")
    parser.add_argument("--rounds", type=int, default=3, help="of the measurement beside a flight")
    arguments = parser.parse_args()
    print(json.dumps({"weight": weight()}), flush=True)
    print(json.dumps({"pictures": asyncio.run(pictures(arguments.seconds))}), flush=True)
    print(
        json.dumps({"viewers": asyncio.run(beside_a_flight(arguments.seconds, arguments.rounds))}), flush=True
    )


if __name__ == "__main__":
    main()
