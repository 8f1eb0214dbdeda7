"""Does any process of the service grow? The real service with a recording, a fake autopilot and a planner, for as long as asked.

    python benchmarks/soak.py [--minutes M] [--method parallax|paper] [--metrics] [--record] [--json FILE]

Frames of 320 x 240 at 10 Hz walk there and back through the footage that ships with the package, with its poses; the vehicle is
armed and in OFFBOARD, the planner sends setpoints at 10 Hz. Every ten seconds the status is asked for, the metrics are
scraped and memory is looked at; every five minutes the configuration is read again (SIGHUP). Growth of a process is the median of its last minute against
the median of the minute that follows its first five. A worker that was started anew is another process.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import statistics
import tempfile
import time
import urllib.request
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

from companion.errors import CompanionError
from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_POSES
from companion.sim.planner import Planner, Waypoint
from companion.sim.recorded_poses import RecordedPoses
from companion.status.client import ask

SIZE_PX = (320, 240)
FRAME_RATE_HZ = 10.0
HFOV_DEG = 51.7
"""Of the footage's middle 480 of 540 pixels (fx 495.6 px)."""
SAMPLE_S = 10.0
SETTLED_S = 300.0
COMPARED_S = 60.0
RELOAD_EVERY_S = 300.0
AHEAD_S = 3.0
ALTITUDE_DOWN_M = -1.2

Address = tuple[str, int]


def there_and_back(count: int) -> list[int]:
    """Return indices that go to the end and back without a jump, however often they are repeated."""
    return [*range(count), *range(count - 2, 0, -1)]


def write_images(folder: Path) -> int:
    """Write the footage at the small size, there and back; return how many images it was."""
    paths = sorted((OFFICE_WALK / "images").iterdir())
    for number, index in enumerate(there_and_back(len(paths))):
        image = cv2.imread(str(paths[index]), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        height_px, width_px = image.shape
        side = (width_px - height_px * 4 // 3) // 2
        small = cv2.resize(image[:, side : width_px - side], SIZE_PX, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{number:04d}.png"), small)
    return len(paths)


def endless_poses(count: int, duration_s: float) -> RecordedPoses:
    """Return the poses of those images, repeated for as long as is flown."""
    recorded = RecordedPoses.load(OFFICE_WALK_POSES)
    indices = there_and_back(count)
    needed = round(duration_s * FRAME_RATE_HZ) + 2
    chosen = np.array([indices[number % len(indices)] for number in range(needed)])
    return RecordedPoses(
        np.arange(needed) / FRAME_RATE_HZ,
        recorded.positions_ned_m[chosen],
        recorded.q_ned_from_body[chosen],
    )


def processes_below(pid: int, names: dict[int, str]) -> dict[int, str]:
    """Return a process and its descendants by pid, each with the name that the status gives it."""
    found = {pid: "service"}
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                stat = (folder / "stat").read_text()
            except OSError:
                continue
            parents[int(folder.name)] = int(stat.rpartition(")")[2].split()[1])
    grown = True
    while grown:
        grown = False
        for child, parent in parents.items():
            if parent in found and child not in found:
                found[child] = names.get(child, f"below {found[parent]}")
                grown = True
    return found


def rss_kib(pid: int) -> int | None:
    try:
        for line in (Path("/proc") / str(pid) / "status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1])
    except OSError:
        pass
    return None


def growth(samples: list[tuple[float, int]]) -> float | None:
    """Return the share by which a process has grown since its first five minutes; None where it has not lived long enough.

    Parameters
    ----------
    samples
        Time (s) and RSS.
    """
    born_s, last_s = samples[0][0], samples[-1][0]
    settled = [rss for at, rss in samples if SETTLED_S <= at - born_s < SETTLED_S + COMPARED_S]
    latest = [rss for at, rss in samples if last_s - at < COMPARED_S]
    if last_s - born_s < SETTLED_S + 2 * COMPARED_S or not settled:
        return None
    return statistics.median(latest) / statistics.median(settled) - 1.0


class Soak:
    """One run and what was seen in it."""

    def __init__(self, minutes: float, method: str, *, metrics: bool, record: bool) -> None:
        self.record = record
        self.duration_s = 60.0 * minutes
        self.method = method
        self.metrics_port = free_port() if metrics else 0
        self.samples: dict[tuple[str, int], list[tuple[float, int]]] = defaultdict(list)
        self.asked = 0
        self.unanswered = 0
        self.reloads = 0
        self.last_status: dict = {}

    async def run(self) -> None:
        with tempfile.TemporaryDirectory(prefix="void-soak-") as name:
            folder = Path(name)
            images = folder / "images"
            images.mkdir()
            poses = endless_poses(write_images(images), self.duration_s + 120.0)
            socket_path = folder / "status.sock"
            service = CompanionProcess(
                {
                    "source": {"url": f"file:{images}", "loop": True, "fps": FRAME_RATE_HZ},
                    "camera": {"hfov_deg": HFOV_DEG},
                    "detector": {"method": self.method},
                    "guidance": {"view_deg": 20.0, "turn_step_deg": 20.0, "give_up_s": 3600.0},
                    "status": {"socket": str(socket_path), "metrics_port": self.metrics_port},
                    **({"recorder": self._recorder(folder)} if self.record else {}),
                }
            )
            async with service:
                started = await service.wait_for("service_started", 60.0)
                planner_at, autopilot_at = address(started["planner"]), address(started["autopilot"])
                async with (
                    FakeAutopilot(autopilot_at, replay=poses) as autopilot,
                    Planner(planner_at, rate_hz=10.0) as planner,
                ):
                    await planner.wait_ready(30.0)
                    planner.aim(Waypoint(0.0, 0.0, ALTITUDE_DOWN_M))
                    await planner.arm()
                    await planner.start_offboard()
                    began = await service.wait_for("source_started", 120.0)
                    autopilot.start_replay(int(began["started_ns"]))
                    await self._watch(service, planner, poses, socket_path)
                self.events = defaultdict(int)
                for event in service.events:
                    self.events[event["event"]] += 1

    def _recorder(self, folder: Path) -> dict:
        """Return the recorder's table: small files, so that they follow each other and the oldest ones go."""
        return {"start": "always", "folder": str(folder / "recordings"), "file_mib": 4.0, "total_mib": 64.0}

    async def _watch(
        self, service: CompanionProcess, planner: Planner, poses: RecordedPoses, socket_path: Path
    ) -> None:
        begin_s = time.monotonic()
        next_sample_s, next_reload_s = 0.0, RELOAD_EVERY_S
        while (elapsed_s := time.monotonic() - begin_s) < self.duration_s:
            north, east, _ = poses.pose_at(min(elapsed_s + AHEAD_S, poses.duration_s))[0]
            planner.aim(Waypoint(north, east, ALTITUDE_DOWN_M))
            planner.sent.clear()  # this process must not be the one that grows
            if service.returncode is not None:
                raise SystemExit(f"the service ended with {service.returncode}: {service.other_lines[-5:]}")
            if elapsed_s >= next_sample_s:
                next_sample_s += SAMPLE_S
                await self._sample(service, elapsed_s, socket_path)
            if elapsed_s >= next_reload_s:
                next_reload_s += RELOAD_EVERY_S
                os.kill(service.pid, signal.SIGHUP)
                self.reloads += 1
            await asyncio.sleep(0.2)

    async def _sample(self, service: CompanionProcess, elapsed_s: float, socket_path: Path) -> None:
        self.asked += 1
        try:
            self.last_status = await asyncio.to_thread(ask, socket_path, "status")
            if self.metrics_port:
                await asyncio.to_thread(scrape, self.metrics_port)
        except (CompanionError, OSError) as error:  # counted: a soak goes on
            self.unanswered += 1
            print(f"{elapsed_s:7.0f} s  no status: {error}", flush=True)
        shown = []
        names = {use["pid"]: name for name, use in self.last_status.get("processes", {}).items()}
        for pid, name in processes_below(service.pid, names).items():
            rss = rss_kib(pid)
            if rss is not None:
                self.samples[(name, pid)].append((elapsed_s, rss))
                shown.append(f"{name} {rss / 1024:.1f}")
        if round(elapsed_s) % 60 < SAMPLE_S:
            rate = self.last_status.get("frames_hz"), self.last_status.get("reports_hz")
            print(
                f"{elapsed_s:7.0f} s  MiB: {', '.join(shown)}  frames/s, answers/s: {rate}  "
                f"state {self.last_status.get('state')}",
                flush=True,
            )

    def report(self) -> dict:
        return {
            "minutes": self.duration_s / 60,
            "method": self.method,
            "processes": [
                {
                    "name": name,
                    "pid": pid,
                    "lived_s": round(samples[-1][0] - samples[0][0]),
                    "settled_mib": round(
                        statistics.median(
                            [rss for at, rss in samples if at - samples[0][0] >= SETTLED_S][:6] or [0]
                        )
                        / 1024,
                        1,
                    ),
                    "last_mib": round(samples[-1][1] / 1024, 1),
                    "growth": growth(samples),
                }
                for (name, pid), samples in self.samples.items()
            ],
            "status_asked": self.asked,
            "status_unanswered": self.unanswered,
            "reloads": self.reloads,
            "frames": self.last_status.get("counts", {}).get("frames"),
            "setpoints": self.last_status.get("counts", {}).get("setpoints_in"),
            "worker_restarts": self.last_status.get("worker", {}).get("restarts"),
            "load_average": os.getloadavg(),
            "events": dict(self.events),
        }


def scrape(port: int) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        answer.read()


def address(text: str) -> Address:
    host, _, port = text.rpartition(":")
    return host, int(port)


def free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--method", choices=("parallax", "paper"), default="parallax")
    parser.add_argument("--metrics", action="store_true", help="scrape the metrics too")
    parser.add_argument("--record", action="store_true", help="with the recorder, in the I/O process")
    parser.add_argument("--json", metavar="FILE", help="write the outcome there")
    arguments = parser.parse_args()
    soak = Soak(arguments.minutes, arguments.method, metrics=arguments.metrics, record=arguments.record)
    asyncio.run(soak.run())
    outcome = soak.report()
    for process in outcome["processes"]:
        grown = process["growth"]
        words = "too short to say" if grown is None else f"{100 * grown:+.2f} %"
        print(
            f"{process['name']:14s} pid {process['pid']}: {process['settled_mib']} MiB after five minutes, "
            f"{process['last_mib']} MiB at the end: {words}"
        )
    print(json.dumps({key: outcome[key] for key in outcome if key != "processes"}))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(outcome, indent=2) + "\n")


if __name__ == "__main__":
    main()
