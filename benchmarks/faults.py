"""Breaks one part after another of a closed loop and reports how old setpoints became and how long they were missing.

    python -m benchmarks.faults --repeat 3
    python -m benchmarks.faults --repeat 100 --json faults.json
    python -m benchmarks.faults --repeat 20 --only "worker killed"

The real ``companion run`` with its worker, a rendered room as camera, the fake PX4 and a planner at 20 Hz, on loopback.
Each time the loop flies again before the next fault. "age" is from the planner's sending of a setpoint to its arrival at the
autopilot, whatever became of it on its way; "gap" is the longest time without one while the planner streams and the link is up.
Both are measured by this process, which is planner and autopilot at once. "stall" is how late its own loop was at most: on a loaded
machine an age or gap may be that, and not the companion's. "ours" is the greatest age of a setpoint while this process was in time.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from companion.sim.autopilot import FakeAutopilot
from companion.sim.camera_feed import CameraFeed
from companion.sim.companion_process import CompanionProcess
from companion.sim.link_faults import LinkFaults
from companion.sim.planner import Planner, Waypoint
from companion.sim.px4_modes import FlightMode
from companion.sim.scene import empty_room
from companion.sim.vehicle import Vehicle, VehicleLimits
from detector.camera_model import CameraModel

HFOV_DEG = 75.0
CAMERA = CameraModel.from_hfov(320, 240, HFOV_DEG)
SCENE = partial(empty_room, 14.0, 9.0, 3.0, behind_m=3.0)
GOALS = (Waypoint(2.5, 0.0, -1.2), Waypoint(0.0, 0.0, -1.2))
_STALL_NS = 20_000_000
_IN_TIME_S = 0.05
LIMIT_S = 0.5
AFTER_S = 4.0
"""How long the loop is watched after each fault."""
CUT_S = 2.0


@dataclass
class Outcome:
    """What one kind of fault did, over all its times.

    Attributes
    ----------
    times
        How often it was done.
    max_age_s, max_gap_s
        The greatest.
    max_stall_s
        The greatest lateness of this process's own loop.
    max_ours_age_s
        The greatest age of a setpoint between whose sending and arrival this process was late by less than 50 ms.
    states
        States of the switch S that were seen, in the order of their first time.
    """

    times: int = 0
    max_age_s: float = 0.0
    max_gap_s: float = 0.0
    max_stall_s: float = 0.0
    max_ours_age_s: float = 0.0
    states: list[str] = field(default_factory=list)


class Loop:
    """The closed loop."""

    def __init__(self) -> None:
        self._stack = AsyncExitStack()
        self._stalls: list[tuple[int, int]] = []
        self.killed: set[int] = set()

    async def __aenter__(self) -> Loop:
        enter = self._stack.enter_async_context
        watch = asyncio.create_task(self._watch_own_loop())
        self._stack.callback(watch.cancel)
        self.autopilot = await enter(
            FakeAutopilot(vehicle=Vehicle(VehicleLimits.indoor()), parameters={"COM_OBL_RC_ACT": 5})
        )
        feed = await enter(CameraFeed(SCENE, CAMERA, self.autopilot.true_pose))
        self.service = await enter(
            CompanionProcess(
                {
                    "source": {"url": "tcp:{}:{}".format(*feed.address)},
                    "camera": {"hfov_deg": HFOV_DEG},
                    "link": {"autopilot": "udpout:{}:{}".format(*self.autopilot.address)},
                }
            )
        )
        started = await self.service.wait_for("service_started")
        host, _, port = started["planner"].rpartition(":")
        await self.service.wait_for("worker_ready", 60)
        self.planner = await enter(Planner((host, int(port))))
        await self.planner.wait_ready()
        await self.fly()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    async def fly(self) -> None:
        """Be armed, in OFFBOARD and in the air again, whatever was before."""
        self.planner.aim(GOALS[0])
        async with asyncio.timeout(40):
            while not (
                self.autopilot.armed
                and self.autopilot.mode is FlightMode.OFFBOARD
                and self.autopilot.position_ned_m[2] < -0.8
            ):
                if not self.autopilot.armed:
                    self.autopilot.arm()
                if self.autopilot.mode is not FlightMode.OFFBOARD:
                    self.autopilot.change_mode(FlightMode.OFFBOARD)
                await asyncio.sleep(0.1)

    async def _watch_own_loop(self) -> None:
        """Note whenever this process did not run in time, as (since, until) in ns."""
        while True:
            due_ns = time.monotonic_ns() + 10_000_000
            await asyncio.sleep(0.01)
            now_ns = time.monotonic_ns()
            if now_ns - due_ns > _STALL_NS:
                self._stalls.append((due_ns, now_ns))

    def stall_s(self, since_ns: int, until_ns: int | None = None) -> float:
        """Return the greatest lateness of this process between two times."""
        until_ns = time.monotonic_ns() if until_ns is None else until_ns
        return max(
            ((late - due) / 1e9 for due, late in self._stalls if late > since_ns and due < until_ns),
            default=0.0,
        )

    def ages(self, since_ns: int) -> list[tuple[int, int]]:
        """Return when each setpoint that arrived since then was sent, and when it arrived."""
        sent_ns = {sent.seq: sent.time_ns for sent in self.planner.sent[-200:]}  # a sequence number lasts 256
        return [
            (sent_ns[record.seq], record.time_ns)
            for record in self.autopilot.setpoints
            if record.time_ns >= since_ns and record.seq in sent_ns
        ]

    def gap_s(self, since_ns: int, until_ns: int) -> float:
        """Return the longest time without a setpoint between two times."""
        times = [r.time_ns for r in self.autopilot.setpoints if since_ns <= r.time_ns <= until_ns]
        ends = [since_ns, *times, until_ns]
        return max((b - a) / 1e9 for a, b in itertools.pairwise(ends))


async def worker_killed(loop: Loop) -> int:
    """Kill the vision worker, and return since when setpoints must pass."""
    async with asyncio.timeout(60):  # after the last time it may still be starting
        while (pid := loop.service.of("worker_ready")[-1]["pid"]) in loop.killed:  # noqa: ASYNC110 - no event for it
            await asyncio.sleep(0.1)
    loop.killed.add(pid)
    os.kill(pid, signal.SIGKILL)
    return time.monotonic_ns()


async def link_cut(loop: Loop) -> int:
    """Cut the autopilot's link for two seconds."""
    dead = LinkFaults(drop_rate=1.0)
    loop.autopilot.set_faults(outgoing=dead, incoming=dead)
    await asyncio.sleep(CUT_S)
    loop.autopilot.set_faults(outgoing=LinkFaults(), incoming=LinkFaults())
    return time.monotonic_ns()


async def planner_killed(loop: Loop) -> int:
    """Silence the planner for two seconds: nothing of ours may go on in its place."""
    stopped_ns = time.monotonic_ns()
    loop.planner.stop_streaming()
    await asyncio.sleep(0.3 + CUT_S)
    silent_ns = stopped_ns + 300_000_000
    late = [
        record
        for record in loop.autopilot.setpoints  # what this process took late was not late
        if record.time_ns > silent_ns and loop.stall_s(stopped_ns, record.time_ns) <= _IN_TIME_S
    ]
    if late:
        raise RuntimeError(f"{len(late)} setpoints after the planner's last")
    loop.planner.aim(GOALS[0])
    return time.monotonic_ns()


async def autopilot_rebooted(loop: Loop) -> int:
    """Restart the autopilot: it is deaf for two seconds."""
    loop.autopilot.reboot()
    await asyncio.sleep(CUT_S + 0.2)
    return time.monotonic_ns()


async def estimator_reset(loop: Loop) -> int:
    """Move the estimate by 3 m, and the goal with it."""
    now_ns = time.monotonic_ns()
    loop.autopilot.jump_estimate((3.0, 0.0, 0.0))
    await asyncio.sleep(1.0)
    loop.autopilot.jump_estimate((-3.0, 0.0, 0.0))
    return now_ns


FAULTS: dict[str, Callable[[Loop], Awaitable[int]]] = {
    "worker killed": worker_killed,
    "link cut and back": link_cut,
    "planner killed": planner_killed,
    "autopilot rebooted": autopilot_rebooted,
    "estimator reset": estimator_reset,
}


async def run(repeat: int, names: Sequence[str]) -> dict[str, Outcome]:
    """Do these faults ``repeat`` times each; return what came of it."""
    outcomes = {name: Outcome() for name in names}
    async with Loop() as loop:
        for name in names:
            fault, outcome = FAULTS[name], outcomes[name]
            for number in range(repeat):
                await loop.fly()
                began_ns, seen = time.monotonic_ns(), len(loop.service.of("state"))
                up_ns = await fault(loop)
                await asyncio.sleep(AFTER_S)
                outcome.times += 1
                gap_s, stall_s = loop.gap_s(up_ns, time.monotonic_ns()), loop.stall_s(began_ns)
                flights = loop.ages(began_ns)
                age_s = max(((arrived - sent) / 1e9 for sent, arrived in flights), default=0.0)
                ours_s = max(
                    ((b - a) / 1e9 for a, b in flights if loop.stall_s(a, b) <= _IN_TIME_S), default=0.0
                )
                outcome.max_age_s = max(outcome.max_age_s, age_s)
                outcome.max_gap_s = max(outcome.max_gap_s, gap_s)
                outcome.max_stall_s = max(outcome.max_stall_s, stall_s)
                outcome.max_ours_age_s = max(outcome.max_ours_age_s, ours_s)
                if max(age_s, gap_s) > LIMIT_S:
                    text = f"age {age_s:.3f} s, gap {gap_s:.3f} s, own stall {stall_s:.3f} s, ours {ours_s:.3f} s"
                    print(f"{name}, {number + 1} of {repeat}: {text}", file=sys.stderr, flush=True)
                for event in loop.service.of("state")[seen:]:
                    if event["state"] not in outcome.states:
                        outcome.states.append(event["state"])
            print(f"{name}: {asdict(outcome)}", file=sys.stderr, flush=True)
    return outcomes


def main() -> int:
    """Run from the command line; 1 where a setpoint was older, or missing for longer, than half a second."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=3, help="times of each fault (default: 3)")
    parser.add_argument("--only", choices=tuple(FAULTS), action="append", help="this fault (may be repeated)")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    arguments = parser.parse_args()
    if arguments.repeat < 1:
        parser.error("--repeat must be at least 1")
    outcomes = asyncio.run(run(arguments.repeat, arguments.only or tuple(FAULTS)))
    print(f"{'fault':<20} {'times':>5} {'oldest s':>9} {'gap s':>6} {'stall s':>8} {'ours s':>7}  states")
    for name, outcome in outcomes.items():
        states = " ".join(outcome.states)
        figures = f"{outcome.max_age_s:>9.3f} {outcome.max_gap_s:>6.3f} {outcome.max_stall_s:>8.3f} {outcome.max_ours_age_s:>7.3f}"
        print(f"{name:<20} {outcome.times:>5} {figures}  {states}")
    if arguments.json is not None:
        text = json.dumps({name: asdict(outcome) for name, outcome in outcomes.items()}, indent=2)
        arguments.json.write_text(text + "\n", encoding="utf-8")
    worst = max(max(o.max_age_s, o.max_gap_s) for o in outcomes.values())
    return 0 if worst <= LIMIT_S else 1


if __name__ == "__main__":
    sys.exit(main())
