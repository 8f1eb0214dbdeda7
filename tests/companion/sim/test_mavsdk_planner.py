from __future__ import annotations

import asyncio
import json
import sys

import pytest

from companion.sim.autopilot import FakeAutopilot
from companion.sim.mavsdk_planner import main, parse_waypoints
from companion.sim.planner import Waypoint
from companion.sim.px4_modes import FlightMode


async def run_planner(*arguments: str) -> tuple[int, str, str]:
    """Run it as its own process: mavsdk's native threads must not live in the test."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "companion.sim.mavsdk_planner",
        *arguments,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(40):
            out, err = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


async def test_an_unmodified_mavsdk_client_arms_flies_arrives_and_stops() -> None:
    async with FakeAutopilot() as autopilot:
        host, port = autopilot.address
        code, out, err = await run_planner(
            "--url",
            f"udpout://{host}:{port}",
            "--waypoints",
            "0,0,-1.5 2,1,-1.5,45",
            "--arrive-radius",
            "0.3",
        )
        assert code == 0, err
        mission = json.loads(out)
        assert mission["ended"] == "complete"
        assert mission["arrived"] == [True, True]
        assert mission["system_id"] == 1
        assert autopilot.mode is FlightMode.HOLD
        assert autopilot.armed
        assert {record.setpoint.type_mask for record in autopilot.setpoints} == {0x9F8}
        assert {record.system_id for record in autopilot.setpoints} == {245}
        assert all(record.refusal is None for record in autopilot.setpoints)
        received = len(autopilot.setpoints)
        assert received > 40
        await asyncio.sleep(0.3)
        assert len(autopilot.setpoints) == received  # nothing goes on sending


async def test_without_an_autopilot_it_ends_with_a_clear_error() -> None:
    async with FakeAutopilot() as autopilot:
        port = autopilot.address[1]
    code, out, err = await run_planner(
        "--url", f"udpout://127.0.0.1:{port}", "--waypoints", "1,0,-1", "--discovery-timeout", "0.5"
    )
    assert code == 1
    assert "found no autopilot" in err
    assert "Traceback" not in err
    assert out == ""


def test_waypoints_are_read_from_text() -> None:
    assert parse_waypoints("1,2,-3  4,5,-6,90") == [Waypoint(1, 2, -3), Waypoint(4, 5, -6, 90)]


@pytest.mark.parametrize("text", ["", "1,2", "1,2,x", "1,2,nan", "1,2,3,4,5"])
def test_wrong_waypoints_are_a_usage_error(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--url", "udpin://127.0.0.1:1", "--waypoints", text])
    assert caught.value.code == 2
    assert "waypoint" in capsys.readouterr().err
