"""`companion run` on a live camera between the fake autopilot and planner; told what to do on stdin. In the wheel's environment.

Usage: flight_probe.py NODE. Writes one JSON object a line: {"phase": "flying"} when OFFBOARD is on, one {"phase":
"event", ...} for each camera event of the service's log, and the totals at the end. A line on stdin ends it.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from functools import partial

from pymavlink.dialects.v20 import common as mavlink

from companion.errors import CompanionError
from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess
from companion.sim.planner import Planner, PlannerError, Waypoint
from companion.sim.telemetry import STREAMS
from companion.sim.traffic import compare

_CAMERA_EVENTS = frozenset(
    {"camera_opened", "camera_lost", "source_opened", "state", "worker_died", "worker_ready"}
)


_TRIES = 10
_ON_ITS_WAY_S = 30.0
_POSE_HZ = 10.0
_LOSS_S = 20.0
_STATION_ID = 254  # not the planner's: its messages are none of those that are compared
_SET_MESSAGE_INTERVAL = int(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)
_ANSWERS = frozenset((mavlink.MAVLINK_MSG_ID_COMMAND_ACK, mavlink.MAVLINK_MSG_ID_TIMESYNC))
_POSES = frozenset(
    (
        mavlink.MAVLINK_MSG_ID_ODOMETRY,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
    )
)


def say(phase: str, **fields: object) -> None:
    print(json.dumps({"phase": phase, **fields}), flush=True)


def on_event(event: dict) -> None:
    if event.get("event") in _CAMERA_EVENTS:
        say("event", **{key: value for key, value in event.items() if key != "phase"})


async def arrived(frame: bytes, received: list[bytes]) -> None:
    """Wait until a frame has come, and with it, on one link in order, all before it; and a little for the other way."""
    end_s = time.monotonic() + _ON_ITS_WAY_S
    while frame not in received[-500:] and time.monotonic() < end_s:  # noqa: ASYNC110  the planner's list tells nobody
        await asyncio.sleep(0.2)
    await asyncio.sleep(3.0)


def message_id(frame: bytes) -> int:
    """Return the message's number in a frame of MAVLink 2."""
    return int.from_bytes(frame[7:10], "little")


def is_answer(frame: bytes) -> bool:
    """Whether a MAVLink 2 frame answers somebody: the service asks the autopilot too, and has what answers it."""
    return message_id(frame) in _ANSWERS


async def slow_down(autopilot: FakeAutopilot) -> None:
    """Ask for telemetry a tenth as often as PX4 sends it: the emulated processor has no time for more."""
    async with Planner(autopilot.address, rate_hz=1.0, system_id=_STATION_ID) as station:
        for message_id, stream in STREAMS.items():
            if stream.rate_hz > 1.0:
                interval_us = 1e6 / _POSE_HZ if message_id in _POSES else 1e6
                await patiently(
                    partial(station.command, _SET_MESSAGE_INTERVAL, float(message_id), interval_us)
                )


async def patiently(ask: Callable[[], Awaitable[None]]) -> None:
    """Ask again where the answer is late; a refusal that stays is one."""
    for _ in range(_TRIES - 1):
        try:
            return await ask()
        except PlannerError:
            await asyncio.sleep(1.0)
    return await ask()


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
        "guidance": {"pose_max_age_s": 3.0, "planner_timeout_s": 10.0},
        "log": {"status_interval_s": 1.0, "detections": True},
    }
    loop = asyncio.get_running_loop()
    async with FakeAutopilot(keep_frames=True, parameters={"COM_OF_LOSS_T": _LOSS_S}) as autopilot:
        await slow_down(autopilot)
        tables["link"] = {"autopilot": "udpout:{}:{}".format(*autopilot.address)}
        async with CompanionProcess(tables, on_event=on_event) as service:
            started = await service.wait_for("service_started", 900.0)
            host, _, port = started["planner"].rpartition(":")
            async with Planner((host, int(port)), rate_hz=5.0, keep_frames=True) as planner:
                await service.wait_for("worker_ready", 600.0)
                await planner.wait_ready(300.0)
                first, first_down = len(planner.sent_frames), len(autopilot.sent_frames)
                planner.aim(Waypoint(5.0, 0.0, -1.2))
                await patiently(planner.arm)
                await patiently(planner.start_offboard)
                say("flying", pid=service.pid)
                await loop.run_in_executor(None, sys.stdin.readline)
                mode, armed = str(planner.mode), planner.armed
                planner.stop_streaming()
                up, down = planner.sent_frames, autopilot.sent_frames
                last, last_down = len(up), len(down)
                meanwhile = down[first_down:last_down]
                judged = [frame for frame in meanwhile if not is_answer(frame)]
                await arrived(judged[-1], planner.received_frames)
                answers = [frame for frame in meanwhile if is_answer(frame)]
                traffic = compare(
                    up[first:last],
                    autopilot.received_frames,
                    judged,
                    planner.received_frames,
                    not_judged=[*up[:first], *up[last:], *down[:first_down], *down[last_down:], *answers],
                )
                missing = Counter(judged) - Counter(planner.received_frames)
                kinds = Counter(message_id(frame) for frame in missing.elements())
                code = await service.stop()
                totals = {name: getattr(traffic, name) for name in traffic.__slots__}
                say(
                    "done",
                    code=code,
                    mode=mode,
                    armed=armed,
                    missing_down=kinds,
                    other_lines=service.other_lines[-5:],
                    **totals,
                )


def main() -> int:
    try:
        asyncio.run(fly(sys.argv[1]))
    except CompanionError as error:
        say("failed", error=str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
