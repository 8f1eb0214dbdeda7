"""What recording costs the process that passes MAVLink on: processor time, and the time a setpoint takes, with and without.

    python benchmarks/recorder_cost.py [--rate HZ] [--fps HZ] [--seconds S] [--rounds N] [--frames jpeg|png] [--json]

One running service, whose recorder is switched on and off by command; rounds alternate, so that other load on the machine
meets both. Loopback UDP, the mix of messages of ``service_cpu.py``; frames are 640 x 480, from this process. Then setpoints are
sent one at a time and each is waited for at the autopilot's side. The I/O process's own use is told apart.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import select
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from benchmarks.service_cpu import Traffic, cpu_ns, measure
from benchmarks.soak import address
from companion.recorder.disk import recordings
from companion.sim.companion_process import CompanionProcess
from companion.sim.frame_server import FrameServer
from companion.status.client import ask

LATENCY_SETPOINTS = 400


async def publish(server: FrameServer, fps: float) -> None:
    """Send frames that move, so that pictures are as large as real ones."""
    rng = np.random.default_rng(1)
    scene = np.kron(rng.integers(0, 255, (80, 160), np.uint8), np.ones((8, 8), np.uint8))
    due_s, number = time.monotonic(), 0
    while True:
        number += 1
        server.publish(
            np.ascontiguousarray(scene[:480, number % 640 : number % 640 + 640]), time.monotonic_ns()
        )
        due_s += 1.0 / fps
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))


def latency_us(traffic: Traffic, count: int) -> list[float]:
    """Return how long setpoints take through the service, one at a time."""
    traffic.drain()
    taken: list[float] = []
    for _ in range(count):
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            time.monotonic_ns() // 1_000_000 % (1 << 32),
            1,
            1,
            1,
            3576,
            5.0,
            0.0,
            -1.2,
            0,
            0,
            0,
            0,
            0,
            0,
            0,
            0,
        )
        data = message.pack(traffic.of_planner)
        traffic.of_planner.seq = (traffic.of_planner.seq + 1) % 256
        begin_ns = time.monotonic_ns()
        traffic.planner.send(data)
        while True:
            ready, _, _ = select.select([traffic.vehicle], [], [], 1.0)
            if not ready:
                break
            received = traffic.vehicle.recv(65535)
            if (
                received[7:10] == b"\x54\x00\x00"
            ):  # SET_POSITION_TARGET_LOCAL_NED; the rest is our own component
                taken.append((time.monotonic_ns() - begin_ns) / 1e3)
                break
        time.sleep(0.005)
    return taken


async def switch(socket: Path, *, on: bool) -> None:
    """Begin or end a recording and wait until it is so."""
    await asyncio.to_thread(ask, socket, "record", {"on": on})
    for _ in range(100):
        status = await asyncio.to_thread(ask, socket, "status")
        if status["recorder"]["recording"] is on:
            return
        await asyncio.sleep(0.1)
    raise RuntimeError("the recorder does not heed")


async def run(arguments: argparse.Namespace) -> dict:
    rows: dict[str, list[dict[str, float]]] = {"off": [], "on": []}
    with tempfile.TemporaryDirectory(prefix="void-recorder-") as folder:
        socket = Path(folder) / "status.sock"
        async with FrameServer() as server:
            publishing = asyncio.create_task(publish(server, arguments.fps))
            service = CompanionProcess(
                {
                    "source": {"url": "tcp:{}:{}".format(*server.address)},
                    "camera": {"hfov_deg": 70.0},
                    "status": {"socket": str(socket)},
                    "recorder": {
                        "start": "command",
                        "folder": f"{folder}/recordings",
                        "frames": arguments.frames,
                        "frames_hz": 0.0,
                        "keep_free_mib": 0.0,
                    },
                }
            )
            async with service:
                started = await service.wait_for("service_started", 60.0)
                await service.wait_for("worker_ready", 120.0)
                io_pid = (await service.wait_for("io_started", 60.0))["pid"]
                traffic = Traffic(address(started["planner"]), address(started["autopilot"]))
                try:
                    await measure(service.pid, traffic, arguments.rate, 2.0)
                    for _ in range(arguments.rounds):
                        for name in ("off", "on"):
                            await switch(socket, on=name == "on")
                            io_before = cpu_ns(io_pid)[1]
                            begin_s = time.monotonic()
                            main, everything = await measure(
                                service.pid, traffic, arguments.rate, arguments.seconds
                            )
                            io_share = (cpu_ns(io_pid)[1] - io_before) / 1e9 / (time.monotonic() - begin_s)
                            taken = await asyncio.to_thread(latency_us, traffic, LATENCY_SETPOINTS)
                            rows[name].append(
                                {
                                    "main_percent": 100 * main,
                                    "process_percent": 100 * everything,
                                    "io_process_percent": 100 * io_share,
                                    "latency_p50_us": statistics.median(taken),
                                    "latency_p95_us": statistics.quantiles(taken, n=20)[-1],
                                }
                            )
                    await switch(socket, on=False)
                finally:
                    traffic.close()
                    publishing.cancel()
                    await asyncio.gather(publishing, return_exceptions=True)
            mib = sum(recording.size_bytes for recording in recordings(Path(folder, "recordings"))) / (
                1 << 20
            )
    return {
        "rate_hz": arguments.rate,
        "fps": arguments.fps,
        "frames": arguments.frames,
        "recorded_mib": round(mib, 1),
        **{
            name: {key: round(statistics.median(row[key] for row in found), 2) for key in found[0]}
            for name, found in rows.items()
        },
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--frames", choices=("jpeg", "png"), default="jpeg")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = asyncio.run(run(arguments))
    if arguments.json:
        print(json.dumps(found))
        return 0
    for name in ("off", "on"):
        print(f"recording {name:>3}: " + ", ".join(f"{key} {value}" for key, value in found[name].items()))
    print(f"recorded {found['recorded_mib']} MiB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
