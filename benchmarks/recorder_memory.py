"""Does the I/O process grow while it records? Its real process and feed, many times faster than a flight.

    python benchmarks/recorder_memory.py [--minutes M] [--speed N] [--file-mib MIB] [--size WxH] [--folder DIR] [--json FILE]

M minutes of a flight's frames (10 Hz), poses (30 Hz), MAVLink (170 messages/s), setpoints (20 Hz), loops (5 Hz), status and log lines go through feed, socket
and shared memory into the recorder, N times as fast as they would come. Every minute of the flight the kernel is asked what the process
has resident and how much of it is anonymous memory (heap); growth is of the last against the sixth, as in `soak.py`. What is due by the
real clock (sizes of files every second, the disk every two) is not faster, so files overshoot their size N-fold more.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import shutil
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.config import Config
from companion.frames.source import Frame
from companion.guidance.observation import Pose
from companion.io.feed import Feed
from companion.io.messages import Answer, LogLine, Request, Wanted, Wants
from companion.io.process import IoProcess
from companion.io.sinks import RECORDER
from companion.recorder.sink import wants_of
from companion.sim.footage import OFFICE_WALK

FRAMES_HZ = 10
TICKS_PER_MINUTE = 60 * FRAMES_HZ
SETTLED_MIN = 5
ATTITUDE = bytes.fromhex("fd1c00000001011e0000") + bytes(30)
"""A frame of ATTITUDE's length; the recorder does not look at checksums."""


def images_of(size_px: tuple[int, int]) -> list[NDArray[np.uint8]]:
    """Return the package's footage at a size."""
    found = []
    for path in sorted((OFFICE_WALK / "images").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found.append(np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), np.uint8))
    return found


def memory_kib(pid: int) -> dict[str, int]:
    """Return what the kernel says of a process: Rss, Anonymous, and the heap's part."""
    found: dict[str, int] = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]:
        name, _, rest = line.partition(":")
        found[name] = int(rest.split()[0])
    heap, is_heap = 0, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        if "-" in line.split(" ", 1)[0] and ":" not in line.split(" ", 1)[0]:
            is_heap = line.endswith("[heap]")
        elif is_heap and line.startswith("Rss:"):
            heap += int(line.split()[1])
    return {"rss": found["Rss"], "anonymous": found["Anonymous"], "heap": heap}


class Flight:
    """Tells a feed what a flight tells it, a tick of a tenth of a second at a time."""

    def __init__(self, feed: Feed, images: list[NDArray[np.uint8]]) -> None:
        self._feed = feed
        self._images = images
        self._ticks = 0

    def tick(self) -> None:
        """Tell the next tenth of a second."""
        feed, now_ns = self._feed, time.monotonic_ns()
        count = len(self._images)
        at = self._ticks % (2 * count - 2)
        feed.frame(Frame(self._images[min(at, 2 * count - 2 - at)], now_ns, self._ticks, "exposure"), now_ns)
        for number in range(17):
            feed.mavlink(number % 2, "in" if number % 3 else "out", ATTITUDE, now_ns)
        for number in range(3):
            feed.pose(Pose(now_ns, self._ticks / 7, number / 3, -1.2, (0.8, 0.0, 0.0, 0.6)), 0.3)
        for _ in range(2):
            feed.setpoint(
                {"planner": "255/190", "planned": [1.0, self._ticks / 3, -1.2], "sent": [1.0, 0.5, -1.2]},
                now_ns,
            )
        if self._ticks % 2 == 0:
            feed.loop("health", now_ns, {"camera": None, "worker": "ready"})
        if self._ticks % 10 == 0:
            feed.status({"state": "PROTECTING", "frames_hz": 10.0, "at": self._ticks}, now_ns)
            feed.log({"event": "setpoint_replaced", "level": "info", "value": self._ticks}, now_ns)
        self._ticks += 1


class Service:
    """The service's side of the process's socket: sends what waits, answers what is asked."""

    def __init__(self, process: IoProcess, feed: Feed) -> None:
        self.process = process
        self.feed = feed
        self.files = 0
        self.lost = 0

    def turn(self) -> None:
        """Send what waits and take what came."""
        for packet, fd in self.feed.packets():
            while True:
                try:
                    self.process.send_packet(packet, fd)
                    break
                except BlockingIOError:
                    select.select([], [self.process.message_fd], [], 0.1)
        while select.select([self.process.message_fd], [], [], 0)[0]:
            self._take()

    def _take(self) -> None:
        match self.process.receive():
            case None:
                raise SystemExit("the I/O process has ended")
            case Wanted(kinds, frames_hz):
                self.feed.want(Wants(kinds, frames_hz))
            case LogLine(_, event, fields):
                self.files += event in ("recording_started", "recording_goes_on")
                if event not in ("recording_started", "recording_goes_on", "recording_ended"):
                    print(event, fields, flush=True)
            case Request(number, name, fields):
                if name == "recorder_state":
                    self.lost = fields["lost_messages"]
                    self.feed.control(name, fields, time.monotonic_ns(), retain=True)
                self.feed.answer(number, Answer(accepted=True), time.monotonic_ns())


def run(arguments: argparse.Namespace) -> dict:
    width_px, height_px = (int(part) for part in arguments.size.split("x"))
    folder = Path(tempfile.mkdtemp(prefix="void-memory-", dir=arguments.folder))
    try:
        config = Config.model_validate(
            {
                "recorder": {
                    "start": "always",
                    "folder": str(folder),
                    "file_mib": arguments.file_mib,
                    "total_mib": max(64.0, 2 * arguments.file_mib),
                    "keep_free_mib": 0.0,
                    "frames_hz": 0.0,
                }
            }
        )
        feed = Feed()
        feed.want(wants_of(config))
        feed.config(config, 0)
        process = IoProcess.start(config, [RECORDER])
        try:
            return fly(arguments, Service(process, feed), Flight(feed, images_of((width_px, height_px))))
        finally:
            process.stop(2.0)
            feed.close()
    finally:
        shutil.rmtree(folder)


def fly(arguments: argparse.Namespace, service: Service, flight: Flight) -> dict:
    rows: list[dict] = []
    due_s = time.monotonic()
    for tick in range(round(arguments.minutes * TICKS_PER_MINUTE)):
        flight.tick()
        service.turn()
        due_s = max(due_s + 1.0 / FRAMES_HZ / arguments.speed, time.monotonic() - 0.05)
        time.sleep(max(0.0, due_s - time.monotonic()))
        if (tick + 1) % TICKS_PER_MINUTE == 0:
            row = {"minute": (tick + 1) // TICKS_PER_MINUTE, **memory_kib(service.process.pid)}
            row |= {"files": service.files, "lost": service.lost}
            rows.append(row)
            print(row, flush=True)
    settled, last = rows[min(SETTLED_MIN, len(rows) - 1)], rows[-1]
    return {
        "rows": rows,
        "growth": last["rss"] / settled["rss"] - 1.0,
        "most": max(row["rss"] for row in rows) / settled["rss"] - 1.0,
        "load_average": os.getloadavg(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="of the flight")
    parser.add_argument("--speed", type=float, default=20.0)
    parser.add_argument("--file-mib", type=float, default=4.0, help="recorder.file_mib")
    parser.add_argument("--size", default="320x240", help="of the frames")
    parser.add_argument("--folder", help="where recordings go meanwhile")
    parser.add_argument("--json", metavar="FILE", help="write the outcome there")
    arguments = parser.parse_args()
    outcome = run(arguments)
    last = outcome["rows"][-1]
    print(
        f"{last['minute']} min of flight, {last['files']} files, {last['lost']} messages lost: "
        f"{last['rss'] / 1024:.1f} MiB at the end, {100 * outcome['growth']:+.2f} % since the sixth minute, "
        f"at the most {100 * outcome['most']:+.2f} %"
    )
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(outcome, indent=2) + "\n")


if __name__ == "__main__":
    main()
