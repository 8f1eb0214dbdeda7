"""``companion demo``: the main job on embedded data, and in a closed loop, without camera or drone.

Part 1 plays real footage: frames from a folder through the detector, the recorded poses from a fake autopilot, and a
planner that streams positions ahead on the recorded track. Part 2 flies a vehicle in a ray-cast room with a wall.
Both go through the real ``companion run``, in its own process, over real sockets.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from rich.console import Console
from rich.live import Live
from rich.table import Table

from companion.clock import RealClock
from companion.errors import CompanionError
from companion.sim.annotated_video import Story
from companion.sim.autopilot import FakeAutopilot
from companion.sim.camera_feed import CameraFeed
from companion.sim.companion_process import CompanionProcess, CompanionProcessError, Event
from companion.sim.demo_video import FootageVideo, RoomVideo
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA, OFFICE_WALK_POSES
from companion.sim.planner import Planner, Waypoint
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.scene import room_with_wall
from companion.sim.traffic import Comparison, compare
from companion.sim.vehicle import Vehicle, VehicleLimits
from detector.camera_model import CameraModel

Address = tuple[str, int]

_AHEAD_S: Final = 3.0
"""In part 1 the planner aims where the recorded walk will be in this time."""
_AIM_EVERY_S: Final = 2.0
_PLANNER_HZ: Final = 10.0
_STATUS_S: Final = 0.25
_WORKER_START_S: Final = 90.0
_ALTITUDE_DOWN_M: Final = -1.2
DEMO_ROOM: Final = partial(room_with_wall, 12.0, 8.0, wall_north_m=4.5, gap_m=3.0)
_ROOM_IMAGE_PX: Final = (320, 240)
_ROOM_HFOV_DEG: Final = 75.0
_ROOM_GOAL: Final = Waypoint(8.0, 0.0, _ALTITUDE_DOWN_M)
_ROOM_TIME_S: Final = 55.0
_ARRIVED_M: Final = 0.5


@dataclass
class Part:
    """What one part of the demo did, from both ends."""

    name: str
    summary: Event = field(default_factory=dict)
    traffic: Comparison | None = None
    states: Counter[str] = field(default_factory=Counter)
    outcome: str = ""
    video: str = ""


def run_demo(output: Path, *, as_json: bool = False) -> int:
    """Run the demo and return an exit code: 0 when nothing was lost or altered.

    Parameters
    ----------
    output
        Folder for the annotated videos; made where it does not exist.
    as_json
        Print the summary as one JSON object and nothing else on standard output.

    Raises
    ------
    companion.errors.CompanionError
        When the folder cannot be made, or the service does not do what the demo asks of it.
    """
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CompanionError(f"{output}: cannot be made a folder for the videos: {error.strerror}") from error
    console = Console(stderr=as_json)
    parts = asyncio.run(_run(output, console))
    summary = summarise(parts)
    if as_json:
        sys.stdout.write(json.dumps(summary) + "\n")
    else:
        _print_summary(console, parts, summary)
    sound = not (summary["lost"] or summary["altered_other"] or summary["z_changed"])
    return 0 if sound else 1


async def _run(output: Path, console: Console) -> list[Part]:
    with Display(console) as display:
        footage = await _footage(output, display)
        room = await _room(output, display)
    return [footage, room]


def summarise(parts: Sequence[Part]) -> dict[str, Any]:
    """Return the totals over all parts.

    forwarded + substituted + held + turned + dropped = setpoints_in. The counts are the service's own; lost, z_changed
    and altered_other come from comparing the bytes at both ends, and what was dropped on purpose is not lost.
    """
    totals: Counter[str] = Counter()
    detections: Counter[str] = Counter()
    for part in parts:
        for name in ("frames", "setpoints_in", "forwarded", "substituted", "held", "turned"):
            totals[name] += part.summary.get(name, 0)
        detections.update(part.summary.get("detections", {}))
        late = part.summary.get("planner_late_setpoints", 0)
        dropped = sum(part.summary.get("dropped", {}).values())
        totals["setpoints_in"] += late
        totals["dropped"] += dropped + late
        if part.traffic is not None:
            totals["z_changed"] += part.traffic.z_changed
            totals["lost"] += part.traffic.setpoints_lost - dropped - late + part.traffic.other_lost
            totals["altered_other"] += part.traffic.other_altered
    names = (
        "setpoints_in",
        "forwarded",
        "substituted",
        "held",
        "turned",
        "dropped",
        "z_changed",
        "lost",
        "altered_other",
    )
    return {
        "frames": totals["frames"],
        "detections": dict(detections),
        **{name: totals[name] for name in names},
        "detection_ms": _worst(parts, "detection_ms"),
        "frame_to_setpoint_ms": _worst(parts, "frame_to_setpoint_ms"),
        "parts": {
            part.name: {
                "outcome": part.outcome,
                "states": dict(part.states),
                "video": part.video,
                "detections": part.summary.get("detections", {}),
            }
            for part in parts
        },
    }


def _worst(parts: Sequence[Part], name: str) -> dict[str, float | None]:
    """Return each percentile of the slower part: percentiles of two parts cannot be added."""
    found: dict[str, float | None] = {}
    for key in ("p50", "p95"):
        values = [
            part.summary[name][key] for part in parts if part.summary.get(name, {}).get(key) is not None
        ]
        found[key] = max(values, default=None)
    return found


# ---------------------------------------------------------------------- the two parts


async def _footage(output: Path, display: Display) -> Part:
    part = Part("footage")
    clock = RealClock()
    poses = RecordedPoses.load(OFFICE_WALK_POSES)
    video = FootageVideo(OFFICE_WALK, output / "demo-footage.mp4")
    display.begin("1 of 2: real footage, recorded poses")
    service = CompanionProcess(
        {
            "source": {"url": f"file:{OFFICE_WALK}"},
            "camera": {"file": str(OFFICE_WALK_CAMERA)},
            "log": {"status_interval_s": _STATUS_S, "detections": True},
        },
        on_event=_listener(part, display, video.story),
    )
    async with service:
        to_planner, to_autopilot = await _addresses(service)
        async with (
            FakeAutopilot(to_autopilot, replay=poses, keep_frames=True) as autopilot,
            Planner(to_planner, rate_hz=_PLANNER_HZ, keep_frames=True) as planner,
        ):
            # Poses begin with the frames, armed or not: begun later they would jump to where the frames are by then.
            joined, started_ns = await asyncio.gather(
                _start(planner, autopilot, _ahead(poses, 0.0)), _replay_with_frames(service, autopilot)
            )
            video.started_ns = started_ns
            elapsed_s = 0.0
            while elapsed_s < poses.duration_s:
                planner.aim(_ahead(poses, elapsed_s))
                await clock.sleep_until_ns(started_ns + round((elapsed_s + _AIM_EVERY_S) * 1e9))
                elapsed_s = (clock.now_ns() - started_ns) / 1e9
            await _finish(part, service, autopilot, planner, joined)
    part.outcome = "the recording was played to its end"
    display.say("writing the annotated video")
    part.video = await asyncio.to_thread(video.write)
    return part


def _ahead(poses: RecordedPoses, elapsed_s: float) -> Waypoint:
    """Return where the recorded walk is in three seconds, at the planner's own altitude."""
    north, east, _ = poses.pose_at(min(elapsed_s + _AHEAD_S, poses.duration_s))[0]
    return Waypoint(north, east, _ALTITUDE_DOWN_M)


async def _room(output: Path, display: Display) -> Part:
    part = Part("room")
    clock = RealClock()
    camera = CameraModel.from_hfov(*_ROOM_IMAGE_PX, _ROOM_HFOV_DEG)
    scene = DEMO_ROOM()
    video = RoomVideo(
        scene, camera, (_ROOM_GOAL.north_m, _ROOM_GOAL.east_m, _ROOM_GOAL.down_m), output / "demo-room.mp4"
    )
    vehicle = Vehicle(VehicleLimits.indoor())
    display.begin("2 of 2: closed loop in a room with a wall across the way")
    async with FakeAutopilot(vehicle=vehicle, keep_frames=True) as autopilot, AsyncExitStack() as stack:
        feed = await stack.enter_async_context(CameraFeed(DEMO_ROOM, camera, autopilot.true_pose))
        service = CompanionProcess(
            {
                "source": {"url": "tcp:{}:{}".format(*feed.address)},
                "camera": {"hfov_deg": _ROOM_HFOV_DEG},
                "link": {"autopilot": "udpout:{}:{}".format(*autopilot.address)},
                "log": {"status_interval_s": _STATUS_S, "detections": True},
            },
            on_event=_listener(part, display, video.story),
        )
        await stack.enter_async_context(service)
        to_planner, _ = await _addresses(service)
        planner = await stack.enter_async_context(Planner(to_planner, rate_hz=_PLANNER_HZ, keep_frames=True))
        await service.wait_for("worker_ready", _WORKER_START_S)
        joined = await _start(planner, autopilot, _ROOM_GOAL)
        begin_ns = clock.now_ns()
        closest_m = math.inf
        outcome = "time was up"
        while clock.now_ns() - begin_ns < _ROOM_TIME_S * 1e9:
            pose = autopilot.true_pose()
            position = (pose.north_m, pose.east_m, pose.down_m)
            video.on_pose(pose)
            closest_m = min(closest_m, scene.clearance(position))
            if _ROOM_GOAL.distance_m(position) < _ARRIVED_M:
                outcome = f"goal reached after {(clock.now_ns() - begin_ns) / 1e9:.0f} s"
                break
            await clock.sleep_until_ns(clock.now_ns() + 50_000_000)
        part.outcome = f"{outcome}, never nearer than {closest_m:.1f} m to a wall"
        await _finish(part, service, autopilot, planner, joined)
    display.say("writing the annotated video")
    part.video = await asyncio.to_thread(video.write)
    return part


async def _replay_with_frames(service: CompanionProcess, autopilot: FakeAutopilot) -> int:
    """Begin the recorded poses when the source does; return when that was, in monotonic ns."""
    started_ns = int((await service.wait_for("source_started", _WORKER_START_S))["started_ns"])
    autopilot.start_replay(started_ns)
    return started_ns


async def _addresses(service: CompanionProcess) -> tuple[Address, Address]:
    """Return where the service listens for the planner and for the autopilot."""
    started = await service.wait_for("service_started", 30.0)
    found = []
    for side in ("planner", "autopilot"):
        host, _, port = started[side].rpartition(":")
        found.append((host, int(port)))
    return found[0], found[1]


@dataclass(frozen=True, slots=True)
class Joined:
    """Frames sent by each end before both were known to the service: nobody could receive them yet."""

    by_planner: int
    by_autopilot: int


async def _start(planner: Planner, autopilot: FakeAutopilot, waypoint: Waypoint) -> Joined:
    """Arm and enter OFFBOARD with setpoints that are streamed already."""
    await planner.wait_ready()
    joined = Joined(len(planner.sent_frames), len(autopilot.sent_frames))
    planner.aim(waypoint)
    await planner.arm()
    await planner.start_offboard()
    return joined


async def _finish(
    part: Part, service: CompanionProcess, autopilot: FakeAutopilot, planner: Planner, joined: Joined
) -> None:
    """Stop the planner, let the last frames arrive, end the service, and compare both ends."""
    clock = RealClock()
    planner.stop_streaming()
    await clock.sleep_until_ns(clock.now_ns() + 200_000_000)
    planner_judged = slice(joined.by_planner, len(planner.sent_frames))
    autopilot_judged = slice(joined.by_autopilot, len(autopilot.sent_frames))
    await clock.sleep_until_ns(clock.now_ns() + 300_000_000)
    up, down = planner.sent_frames, autopilot.sent_frames
    part.traffic = compare(
        up[planner_judged],
        autopilot.received_frames,
        down[autopilot_judged],
        planner.received_frames,
        not_judged=[
            *up[: planner_judged.start],
            *up[planner_judged.stop :],
            *down[: autopilot_judged.start],
            *down[autopilot_judged.stop :],
        ],
    )
    code = await service.stop()
    summaries = service.of("summary")
    if code != 0 or not summaries:
        raise CompanionProcessError(
            f"companion run ended with code {code}:\n" + "\n".join(service.other_lines)
        )
    part.summary = summaries[-1]


def _listener(part: Part, display: Display, story: Story) -> Callable[[Event], None]:
    def on_event(event: Event) -> None:
        story.take(event, time.monotonic_ns())
        if event.get("event") == "state":
            part.states[event["state"]] += 1
        display.on_event(event)

    return on_event


# ---------------------------------------------------------------------- what it prints


class Display:
    """A live table on a terminal; elsewhere one line for each change of state."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = (
            Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else None
        )
        self._title = ""
        self._rows: dict[str, str] = {}

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def begin(self, title: str) -> None:
        """Begin a part."""
        self._title = title
        self._rows = {}
        self._console.print(f"[bold]{title}[/bold]")

    def say(self, words: str) -> None:
        """Say one line."""
        self._console.print(f"  {words}", style="dim")

    def on_event(self, event: Event) -> None:
        """Show one event of the service's log."""
        match event.get("event"):
            case "state":
                self._rows["state"] = f"{event['state']}: {event['reason']}"
                if self._live is None:
                    self.say(f"{event['previous']} -> {event['state']}: {event['reason']}")
            case "detection":
                self._rows["direction"] = direction_in_words(event)
            case "status":
                self._take_status(event)
            case "worker_died" | "service_failed" | "source_failed":
                self.say(f"{event['event']}: {event.get('reason') or event.get('error')}")
        if self._live is not None:
            self._live.update(self._table())

    def _take_status(self, event: Event) -> None:
        setpoint = event.get("setpoint")
        if setpoint:
            self._rows["planner setpoint"] = _place(setpoint["planned"])
            yaw = setpoint.get("yaw_deg")
            sent = _place(setpoint["sent"]) if setpoint.get("sent") else "-"
            self._rows["sent instead"] = (
                f"{sent}  ({setpoint['action']}{'' if yaw is None else f', yaw {yaw:.0f} deg'})"
            )
        self._rows["rates"] = (
            f"frames {event['frames_hz']:.0f} Hz, answers {event['reports_hz']:.1f} Hz, setpoints {event['setpoints_hz']:.0f} Hz"
        )
        report = event.get("report", {})
        self._rows["ages"] = f"pose {_ms(event.get('pose_age_ms'))}, answer {_ms(report.get('age_ms'))}"
        counts = ("forwarded", "substituted", "held", "turned")
        self._rows["setpoints"] = f"{event['setpoints_in']} in: " + ", ".join(
            f"{event[c]} {c}" for c in counts
        )

    def _table(self) -> Table:
        table = Table(title=self._title, show_header=False, min_width=78, title_justify="left")
        table.add_column(style="dim", width=18)
        table.add_column()
        for name in ("state", "direction", "planner setpoint", "sent instead", "rates", "ages", "setpoints"):
            table.add_row(name, self._rows.get(name, "-"))
        return table


def direction_in_words(event: Event) -> str:
    """Return one detection event for people."""
    distance = "" if event.get("distance_m") is None else f", {event['distance_m']:.1f} m"
    if event["kind"] == "none":
        return f"none: {event.get('reason', '')}"
    if event["kind"] == "single_plane":
        return f"single plane{distance}"
    return f"({event['x_px']:.0f}, {event['y_px']:.0f}) px, {event['kind'].replace('_', ' ')}{distance}"


def _place(ned: Sequence[float]) -> str:
    return f"x {ned[0]:+.2f}  y {ned[1]:+.2f}  z {ned[2]:+.2f}"


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} ms"


def _print_summary(console: Console, parts: Sequence[Part], summary: Mapping[str, Any]) -> None:
    table = Table(title="Summary", title_justify="left")
    for column in ("", *(part.name for part in parts), "both"):
        table.add_column(column, justify="right" if column else "left")
    for name in ("frames", "setpoints_in", "forwarded", "substituted", "held", "turned"):
        table.add_row(name, *(str(part.summary.get(name, 0)) for part in parts), str(summary[name]))
    for kind in sorted(summary["detections"]):
        counts = [part.summary.get("detections", {}).get(kind, 0) for part in parts]
        table.add_row(f"answers: {kind}", *map(str, counts), str(summary["detections"][kind]))
    for name in ("dropped", "lost", "altered_other", "z_changed"):
        table.add_row(name, *([""] * len(parts)), str(summary[name]))
    for name in ("detection_ms", "frame_to_setpoint_ms"):
        cells = [f"{p.summary[name]['p50']} / {p.summary[name]['p95']}" for p in parts]
        table.add_row(f"{name} p50 / p95", *cells, "")
    console.print(table)
    for part in parts:
        console.print(f"{part.name}: {part.outcome}")
        console.print(f"  video: {part.video}")
