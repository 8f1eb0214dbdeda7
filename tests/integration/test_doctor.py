"""The doctor at the bedside of the fake autopilots, over loopback."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import socket
import sys
import time

import numpy as np

from companion.clock import RealClock
from companion.config import CameraConfig, Config, LinkConfig, LogConfig, SourceConfig
from companion.doctor.check import Check, Level
from companion.doctor.checks import judge
from companion.doctor.listen import examine
from companion.log import open_log
from companion.sim.autopilot import FakeAutopilot
from companion.sim.frame_server import FrameServer


def free_port() -> int:
    """A port that was free a moment ago."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.asynccontextmanager
async def camera(rate_hz: float = 20.0):
    """A camera that shows the same picture."""
    async with FrameServer() as server:

        async def publish() -> None:
            while True:
                server.publish(np.zeros((60, 80), dtype=np.uint8), time.monotonic_ns())
                await asyncio.sleep(1 / rate_hz)

        task = asyncio.create_task(publish())
        try:
            yield "tcp:{}:{}".format(*server.address)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


def configuration(port: int, source: str) -> Config:
    return Config(
        link=LinkConfig(planner="udpin:127.0.0.1:0", autopilot=f"udpin:127.0.0.1:{port}"),
        source=SourceConfig(url=source, min_rate_hz=2.0),
        camera=CameraConfig(hfov_deg=80.0),
    )


async def examined(personality: str, seconds: float) -> dict[str, Check]:
    port = free_port()
    async with camera() as source, FakeAutopilot(("127.0.0.1", port), personality=personality):
        config = configuration(port, source)
        with open_log(LogConfig(level="error"), io.StringIO()) as log:
            found = await examine(config, seconds=seconds, clock=RealClock(), log=log, with_worker=False)
    return {check.name: check for check in judge(found, config)}


async def test_px4_with_its_default_parameters():
    checks = await examined("px4", 4.0)
    for name in (
        "autopilot",
        "HEARTBEAT",
        "LOCAL_POSITION_NED",
        "ATTITUDE",
        "estimator",
        "autopilot version",
    ):
        assert checks[name].level is Level.OK, checks[name]
    assert checks["autopilot version"].found == "PX4 1.16.1"
    assert checks["COM_OF_LOSS_T"] == Check("COM_OF_LOSS_T", Level.OK, "1 s")
    assert (checks["COM_OBL_RC_ACT"].level, checks["COM_OBL_RC_ACT"].found) == (Level.WARN, "0 (POSCTL)")
    assert "to 5 (Hold)" in checks["COM_OBL_RC_ACT"].advice
    assert checks["COM_RC_OVERRIDE"].level is Level.WARN
    assert "round trip" in checks["clock"].found
    assert checks["camera"].found.startswith("80 x 60, ")
    assert checks["link planner"].level is Level.OK


async def test_an_ardupilot_that_sends_nothing_is_asked_and_then_does():
    checks = await examined("ardupilot", 8.0)
    for name in (
        "LOCAL_POSITION_NED",
        "ATTITUDE",
        "EKF_STATUS_REPORT",
        "GLOBAL_POSITION_INT",
        "GUID_TIMEOUT",
    ):
        assert checks[name].level is Level.OK, checks[name]
    assert checks["GUID_TIMEOUT"].found.startswith("3 s")


async def test_the_command_says_what_is_wrong_and_fails(tmp_path):
    """No autopilot, no camera, and the port taken as by a service that runs."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        file = tmp_path / "drone.toml"
        file.write_text(
            f'[link]\nplanner = "udpin:127.0.0.1:0"\nautopilot = "udpin:127.0.0.1:{port}"\n'
            f'[source]\nurl = "file:{tmp_path}/gone.mp4"\n[detector]\nparams_file = "gone.toml"\n'
        )
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "companion", "doctor", "-c", str(file), "-s", "2", "--json",
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        out, err = await process.communicate()
    assert process.returncode == 1, err
    checks = {check["name"]: check for check in json.loads(out)["checks"]}
    assert "stop the companion service" in checks["link autopilot"]["advice"]
    assert checks["autopilot"]["level"] == "fail"
    assert "gone.mp4" in checks["camera"]["found"]
    assert "gone.toml" in checks["vision"]["found"]
    assert b"Traceback" not in err
