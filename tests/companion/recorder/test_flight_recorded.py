"""The whole way: a running service records itself, and its recording replays to the same decisions."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from pathlib import Path

import cv2
import numpy as np

from companion.cli import main
from companion.io.messages import Kind
from companion.recorder.reading import RecordingFile
from companion.replay.run import replay
from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess
from companion.sim.frame_server import FrameServer
from companion.sim.planner import Planner, Waypoint

DEADLINE_S = 90.0


@contextlib.asynccontextmanager
async def camera():
    """A live camera that shows sharp noise, ten times a second."""
    rng = np.random.default_rng(3)
    async with FrameServer() as server:

        async def publish() -> None:
            while True:
                image = cv2.GaussianBlur(rng.integers(0, 255, (96, 128), dtype=np.uint8), (3, 3), 0)
                server.publish(np.asarray(image), time.monotonic_ns())
                await asyncio.sleep(0.1)

        task = asyncio.create_task(publish())
        try:
            yield "tcp:{}:{}".format(*server.address)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def until(condition):
    end_s = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert time.monotonic() < end_s, "did not come"
        await asyncio.sleep(0.05)
    return found


async def test_a_flight_in_real_time_replays_to_the_same_decisions(tmp_path):
    async with FakeAutopilot() as autopilot, camera() as url:
        tables = {
            "link": {"autopilot": "udpout:{}:{}".format(*autopilot.address)},
            "source": {"url": url},
            "camera": {"hfov_deg": 75.0},
            "recorder": {
                "start": "always",
                "folder": str(tmp_path),
                "frames": "png",
                "frames_hz": 0.0,
                "keep_free_mib": 0.0,
            },
        }
        async with CompanionProcess(tables) as service:
            started = await service.wait_for("service_started", DEADLINE_S)
            host, _, port = started["planner"].rpartition(":")
            async with Planner((host, int(port))) as planner:
                await planner.wait_ready()
                planner.aim(Waypoint(2.0, 0.0, -1.5))
                await planner.arm()
                await planner.start_offboard()
                await service.wait_for("recording_started", DEADLINE_S)
                await service.wait_for("worker_ready", DEADLINE_S)
                states = len(service.of("state"))
                await until(lambda: len(service.of("state")) > states)
                await asyncio.sleep(1.0)
    (path,) = tmp_path.glob("*.mcap")
    differing: list[str] = []
    summary = replay(RecordingFile(path), on_difference=lambda difference: differing.append(str(difference)))
    assert differing == []
    assert summary.is_same
    assert summary.decisions["setpoint"] > 10
    assert summary.decisions["state"] >= 3
    kinds = {message.kind for message in RecordingFile(path).messages()}
    assert {Kind.FRAME, Kind.DETECTION, Kind.POSE, Kind.LOG, Kind.STATUS} <= kinds
    assert (path.with_suffix(".tlog")).stat().st_size > 1000


async def test_recordings_are_begun_and_ended_by_command(tmp_path, capsys):
    socket = tmp_path / "status.sock"
    folder = tmp_path / "recordings"
    tables = {
        "source": {"url": "tcp:127.0.0.1:9"},
        "recorder": {"start": "command", "folder": str(folder), "keep_free_mib": 0.0},
        "status": {"socket": str(socket)},
    }

    async def record(what: str) -> str:
        assert await asyncio.to_thread(main, ["record", what, "-s", str(socket)]) == 0
        return capsys.readouterr().out

    async with CompanionProcess(tables) as service:
        await service.wait_for("io_started", DEADLINE_S)
        await until(socket.exists)
        assert (await record("status")).startswith("not recording")
        assert (await record("start")).startswith("recording (command): ")
        assert (await record("status")).startswith("recording (command): ")
        assert (await record("stop")).startswith("not recording")
    (path,) = folder.glob("*.mcap")
    assert any(message.kind is Kind.CONFIG for message in RecordingFile(path).messages())


async def test_without_a_recorder_the_command_says_so(tmp_path, capsys):
    socket = tmp_path / "status.sock"
    tables = {"source": {"url": "tcp:127.0.0.1:9"}, "status": {"socket": str(socket)}}
    async with CompanionProcess(tables) as service:
        await service.wait_for("service_started", DEADLINE_S)
        await until(socket.exists)
        assert await asyncio.to_thread(main, ["record", "start", "-s", str(socket)]) == 1
    assert 'recorder.start is "never"' in capsys.readouterr().err


def kinds_in(path: Path) -> list[Kind]:
    file = RecordingFile(path)
    found = [message.kind for message in file.messages()] if path.stat().st_size > 1000 else []
    assert file.damage is not None or not found  # nobody has finished it
    return found


async def test_a_service_that_is_killed_leaves_a_file_that_can_be_read_and_no_process(tmp_path):
    tables = {
        "source": {"url": "tcp:127.0.0.1:9"},
        "recorder": {"start": "always", "folder": str(tmp_path), "keep_free_mib": 0.0},
    }
    async with CompanionProcess(tables) as service:
        started = await service.wait_for("io_started", DEADLINE_S)
        await service.wait_for("recording_started", DEADLINE_S)
        (path,) = tmp_path.glob("*.mcap")
        await until(lambda: len(kinds_in(path)) > 50)  # what is not finished can be read, too
        os.kill(service.pid, signal.SIGKILL)
        await until(lambda: not Path(f"/proc/{started['pid']}").exists())
    found = kinds_in(path)
    assert len(found) > 50
    assert {Kind.CONFIG, Kind.LOG, Kind.LOOP} <= set(found)
