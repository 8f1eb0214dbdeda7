"""`companion run` on a live camera between the fake autopilot and planner; told what to do on stdin. In the wheel's environment.

Usage: flight_probe.py NODE. Writes one JSON object a line: {"phase": "flying"} when OFFBOARD is on, one {"phase":
"event", ...} for each camera event of the service's log, and the totals at the end. A line on stdin ends it.
"""

from __future__ import annotations

import asyncio
import json
import sys

from companion.errors import CompanionError
from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess
from companion.sim.planner import Planner, Waypoint
from companion.sim.traffic import compare

_CAMERA_EVENTS = frozenset(
    {"camera_opened", "camera_lost", "source_opened", "state", "worker_died", "worker_ready"}
)


def say(phase: str, **fields: object) -> None:
    print(json.dumps({"phase": phase, **fields}), flush=True)


def on_event(event: dict) -> None:
    if event.get("event") in _CAMERA_EVENTS:
        say("event", **{key: value for key, value in event.items() if key != "phase"})


async def fly(node: str) -> None:
    tables = {
        "source": {
            "url": f"v4l2:{node}",
            "pixel_format": "GREY",
            "width_px": 320,
            "height_px": 180,
            "rate_hz": 10,
            "timeout_s": 2.0,
        },
        "camera": {"hfov_deg": 75.0},
        # The processor is emulated: what a board does in a tenth of a second takes seconds here.
        "detector": {"deadline_s": 60.0, "start_timeout_s": 300.0},
        "log": {"status_interval_s": 1.0, "detections": True},
    }
    loop = asyncio.get_running_loop()
    async with CompanionProcess(tables, on_event=on_event) as service:
        started = await service.wait_for("service_started", 240.0)
        ends = {
            side: (started[side].rpartition(":")[0], int(started[side].rpartition(":")[2]))
            for side in ("planner", "autopilot")
        }
        async with (
            FakeAutopilot(ends["autopilot"], keep_frames=True) as autopilot,
            Planner(ends["planner"], rate_hz=5.0, keep_frames=True) as planner,
        ):
            await service.wait_for("worker_ready", 300.0)
            await planner.wait_ready(60.0)
            planner.aim(Waypoint(5.0, 0.0, -1.2))
            await planner.arm()
            await planner.start_offboard()
            first, first_down = len(planner.sent_frames), len(autopilot.sent_frames)
            say("flying", pid=service.pid)
            await loop.run_in_executor(None, sys.stdin.readline)
            mode, armed = str(planner.mode), planner.armed
            last, last_down = len(planner.sent_frames), len(autopilot.sent_frames)
            planner.stop_streaming()
            await asyncio.sleep(3.0)
            up, down = planner.sent_frames, autopilot.sent_frames
            traffic = compare(
                up[first:last],
                autopilot.received_frames,
                down[first_down:last_down],
                planner.received_frames,
                not_judged=[*up[:first], *up[last:], *down[:first_down], *down[last_down:]],
            )
            code = await service.stop()
            totals = {name: getattr(traffic, name) for name in traffic.__slots__}
            say("done", code=code, mode=mode, armed=armed, other_lines=service.other_lines[-5:], **totals)


def main() -> int:
    try:
        asyncio.run(fly(sys.argv[1]))
    except CompanionError as error:
        say("failed", error=str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
