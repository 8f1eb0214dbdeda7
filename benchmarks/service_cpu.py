"""What the process that passes MAVLink on costs: the real service on a recording, without messages and at a rate of them.

    python benchmarks/service_cpu.py [--rate HZ] [--seconds S] [--rounds N] [--event-loop asyncio] [--json]

Loopback UDP. Three loads alternate in rounds, so that other load on the machine meets all of them: no messages; one message a datagram
at the rate, which is the dearest way to send them, each wakes the process; and a flight, the simulated PX4 with the telemetry that it
sends by default and a planner at 20 Hz, whose messages share datagrams as real ones do. The share at the rate is worked out for the flight from
what it really sent.

Of the messages at the rate a tenth are the planner's setpoints, which are decided on (armed, OFFBOARD); the rest is telemetry
(ATTITUDE and LOCAL_POSITION_NED, one a datagram), which is read and passed on. Frames come from a folder of 320 x 240 grey PNG images at
10 Hz; the vision worker is a process of its own and not counted. Processor time is the kernel's, of every thread; "main thread" is the one that passes messages on, the
rest decodes images, writes logs and starts workers.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import statistics
import tempfile
import time
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from benchmarks.soak import HFOV_DEG, address, write_images
from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess
from companion.sim.planner import Planner, Waypoint
from companion.status.client import ask

SETPOINT_SHARE = 0.1


def cpu_ns(pid: int) -> tuple[int, int]:
    """Return processor time of the main thread and of all threads."""
    main = everything = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        used = int((task / "schedstat").read_text().split()[0])
        everything += used
        if task.name == str(pid):
            main = used
    return main, everything


class Traffic:
    """The vehicle's and the planner's sockets."""

    def __init__(self, planner_at: tuple[str, int], autopilot_at: tuple[str, int]) -> None:
        self.vehicle, self.planner = open_socket(autopilot_at), open_socket(planner_at)
        self.of_vehicle = mavlink.MAVLink(None, 1, 1)
        self.of_planner = mavlink.MAVLink(None, 245, 190)
        self.number = 0
        self.sent = 0
        self.came_through = 0

    def heartbeat(self) -> None:
        armed_offboard = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | 1
        self._send(
            self.vehicle,
            self.of_vehicle,
            mavlink.MAVLink_heartbeat_message(2, 12, armed_offboard, 6 << 16, 4, 3),
        )

    def next(self) -> None:
        """Send the next message of the mix."""
        self.number += 1
        time_ms = time.monotonic_ns() // 1_000_000 % (1 << 32)
        if self.number % round(1 / SETPOINT_SHARE) == 0:
            setpoint = mavlink.MAVLink_set_position_target_local_ned_message(
                time_ms, 1, 1, 1, 3576, 5.0, 0.0, -1.2, 0, 0, 0, 0, 0, 0, 0, 0
            )
            self._send(self.planner, self.of_planner, setpoint)
        elif self.number % 2:
            self._send(
                self.vehicle, self.of_vehicle, mavlink.MAVLink_attitude_message(time_ms, 0, 0, 0, 0, 0, 0)
            )
        else:
            position = mavlink.MAVLink_local_position_ned_message(time_ms, 0.0, 0.0, -1.2, 0, 0, 0)
            self._send(self.vehicle, self.of_vehicle, position)

    def drain(self) -> None:
        for end in (self.vehicle, self.planner):
            while True:
                try:
                    end.recv(65535)
                except (BlockingIOError, ConnectionRefusedError):
                    break
                self.came_through += 1

    def _send(self, end: socket.socket, packer: mavlink.MAVLink, message: mavlink.MAVLink_message) -> None:
        end.send(message.pack(packer))
        packer.seq = (packer.seq + 1) % 256
        self.sent += 1

    def close(self) -> None:
        self.vehicle.close()
        self.planner.close()


def open_socket(to: tuple[str, int]) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    opened.connect(to)
    opened.setblocking(False)
    return opened


async def measure(pid: int, traffic: Traffic, rate_hz: float, seconds: float) -> tuple[float, float]:
    """Return the shares of a core that main thread and process took at a rate of messages."""
    before, begin_s = cpu_ns(pid), time.monotonic()
    sent, next_heartbeat_s = 0, 0.0
    while (elapsed_s := time.monotonic() - begin_s) < seconds:
        if elapsed_s >= next_heartbeat_s:
            next_heartbeat_s += 1.0
            traffic.heartbeat()
        while sent < elapsed_s * rate_hz:
            traffic.next()
            sent += 1
        traffic.drain()
        await asyncio.sleep(0.002)
    after, elapsed_s = cpu_ns(pid), time.monotonic() - begin_s
    main, everything = ((a - b) / 1e9 / elapsed_s for a, b in zip(after, before, strict=True))
    return main, everything


async def measure_flight(
    pid: int, planner_at: tuple[str, int], autopilot_at: tuple[str, int], socket_path: Path, seconds: float
) -> tuple[float, float, float]:
    """Return the shares of a core of main thread and process with a simulated autopilot and a planner, and messages/s."""
    async with FakeAutopilot(autopilot_at) as autopilot, Planner(planner_at, rate_hz=20.0) as planner:
        await planner.wait_ready(30.0)
        planner.aim(Waypoint(0.0, 0.0, -1.2))
        if not autopilot.armed:
            await planner.arm()
        await planner.start_offboard()
        messages = await received_messages(socket_path)
        before, begin_s = cpu_ns(pid), time.monotonic()
        await asyncio.sleep(seconds)
        after, elapsed_s = cpu_ns(pid), time.monotonic() - begin_s
        messages = await received_messages(socket_path) - messages
    main, everything = ((a - b) / 1e9 / elapsed_s for a, b in zip(after, before, strict=True))
    return main, everything, messages / elapsed_s


async def received_messages(socket_path: Path) -> int:
    status = await asyncio.to_thread(ask, socket_path, "status")
    return sum(link["received_frames"] for link in status["links"].values())


async def run(rate_hz: float, seconds: float, rounds: int, event_loop: str) -> dict:
    shares: dict[str, list[tuple[float, float]]] = {
        "idle": [],
        "at_rate": [],
        "flight": [],
        "flight_at_rate": [],
    }
    flight_rates_hz = []
    with tempfile.TemporaryDirectory(prefix="void-cpu-") as folder, tempfile.TemporaryDirectory() as place:
        write_images(Path(folder))
        socket_path = Path(place) / "status.sock"
        service = CompanionProcess(
            {
                "source": {"url": f"file:{folder}", "loop": True, "fps": 10.0},
                "camera": {"hfov_deg": HFOV_DEG},
                "guidance": {"view_deg": 20.0, "turn_step_deg": 20.0},
                "status": {"socket": str(socket_path)},
                "link": {"event_loop": event_loop},
            }
        )
        async with service:
            started = await service.wait_for("service_started", 60.0)
            await service.wait_for("source_started", 120.0)
            traffic = Traffic(address(started["planner"]), address(started["autopilot"]))
            try:
                await measure(service.pid, traffic, rate_hz, 2.0)
                traffic.sent = traffic.came_through = 0
                for _ in range(rounds):
                    idle = await measure(service.pid, traffic, 0.0, seconds)
                    shares["idle"].append(idle)
                    shares["at_rate"].append(await measure(service.pid, traffic, rate_hz, seconds))
                    *flight, flight_hz = await measure_flight(
                        service.pid,
                        address(started["planner"]),
                        address(started["autopilot"]),
                        socket_path,
                        seconds,
                    )
                    flight_rates_hz.append(round(flight_hz))
                    shares["flight"].append((flight[0], flight[1]))
                    scaled = [a + (b - a) * rate_hz / flight_hz for a, b in zip(idle, flight, strict=True)]
                    shares["flight_at_rate"].append((scaled[0], scaled[1]))
            finally:
                traffic.close()
        summary = service.of("summary")[-1]
    return {
        "rate_hz": rate_hz,
        "rounds": rounds,
        "seconds": seconds,
        "event_loop": "uvloop" if event_loop == "auto" and _has_uvloop() else "asyncio",
        "load_average": os.getloadavg()[0],
        "messages_sent": traffic.sent,
        "datagrams_that_came_through": traffic.came_through,
        "setpoints_in": summary["setpoints_in"],
        "flight_rates_hz": flight_rates_hz,
        **{
            f"{name}_{part}_percent": [round(100 * share[number], 2) for share in taken]
            for name, taken in shares.items()
            for number, part in enumerate(("main_thread", "process"))
        },
    }


def _has_uvloop() -> bool:
    from importlib.util import find_spec

    return find_spec("uvloop") is not None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--event-loop", choices=("auto", "asyncio"), default="auto")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    outcome = asyncio.run(run(arguments.rate, arguments.seconds, arguments.rounds, arguments.event_loop))
    if arguments.json:
        print(json.dumps(outcome))
        return
    sent_hz = statistics.median(outcome["flight_rates_hz"])
    for name, words in (
        ("idle", "no messages"),
        ("at_rate", f"{arguments.rate:g} messages/s, one a datagram"),
        ("flight", f"a flight, {sent_hz:g} messages/s"),
        ("flight_at_rate", f"a flight, at {arguments.rate:g} messages/s"),
    ):
        main_thread, process = (
            statistics.median(outcome[f"{name}_{part}_percent"]) for part in ("main_thread", "process")
        )
        print(f"{words:34s} main thread {main_thread:5.2f} %, whole process {process:5.2f} % of a core")
    print(json.dumps(outcome))


if __name__ == "__main__":
    main()
