"""The real service with the page on: one process flies, another one serves."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect

from companion.sim.companion_process import CompanionProcess
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA
from tests.companion.web.conftest import free_port

PATIENCE_S = 90.0


async def ask(port: int, method: str, path: str, body: Any = None) -> Any:
    data = b"" if body is None else json.dumps(body).encode()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    head = f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(data)}\r\n\r\n"
    writer.write(head.encode() + data)
    await writer.drain()
    answer = await reader.read()
    writer.close()
    await writer.wait_closed()
    return json.loads(answer.partition(b"\r\n\r\n")[2])


@pytest.mark.timeout(240)
async def test_the_service_is_seen_and_tuned_and_does_not_need_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))  # as systemd does
    port = free_port()
    tables = {
        "web": {"enabled": True, "port": port, "recordings": str(OFFICE_WALK.parent)},
        "source": {"url": f"file:{OFFICE_WALK}", "loop": True},
        "camera": {"file": str(OFFICE_WALK_CAMERA)},
        "detector": {"method": "paper"},
    }
    async with asyncio.timeout(PATIENCE_S * 2), CompanionProcess(tables) as service:
        await service.wait_for("web_serving", PATIENCE_S)
        async with connect(
            f"ws://127.0.0.1:{port}/api/live", open_timeout=PATIENCE_S, max_size=None
        ) as viewer:
            seen: dict[str, Any] = {}
            pictures = 0
            while pictures < 3 or not {"status", "switch", "links", "detection", "details"} <= seen.keys():
                said = await viewer.recv()
                if isinstance(said, bytes):
                    pictures += 1
                    await viewer.send('{"type": "shown"}')
                else:
                    seen.update(json.loads(said)["latest"])
            assert seen["details"]["method"] == "paper"
            assert set(seen["links"]) == {"link.planner", "link.autopilot"}
        applied = await ask(port, "POST", "/api/settings/apply", {"values": {"guidance.agree_deg": 13.0}})
        assert applied["accepted"], applied
        assert applied["at_once"] == {"guidance.agree_deg": 13.0}
        refused = await ask(port, "POST", "/api/settings/apply", {"values": {"camera.hfov_deg": 80.0}})
        assert refused["refused"] == {"camera.hfov_deg": "the worker and the switch S are built on it"}
        form = await ask(port, "GET", "/api/settings")
        entries = {entry["key"]: entry for section in form["sections"] for entry in section["keys"]}
        assert entries["guidance.agree_deg"]["value"] == 13.0
        assert entries["guidance.agree_deg"]["file"] != 13.0
        assert form["file"].endswith("companion.toml")
        assert [one["name"] for one in (await ask(port, "GET", "/api/recordings"))["recordings"]] == [
            "office_walk"
        ]
        assert (await ask(port, "POST", "/api/settings/undo", {}))["accepted"]

        saving = {"values": {"guidance.align_deg": 14.0}, "revision": form["revision"], "only_look": False}
        saved = await ask(port, "POST", "/api/settings/save", saving)
        assert saved["accepted"], saved
        assert saved["file"] == form["saves_to"] == str(tmp_path / "companion.page.toml")
        reloaded = await service.wait_for(  # it is noticed as any file of the configuration
            "config_reloaded", PATIENCE_S, where=lambda event: "guidance.align_deg" in event["changed"]
        )
        assert reloaded["changed"]["guidance.align_deg"] == 14.0

        started = await service.wait_for("io_started", PATIENCE_S)
        os.kill(started["pid"], signal.SIGKILL)  # the page dies, the service flies on and starts it again
        await service.wait_for("io_died", PATIENCE_S)
        first = service.of("web_serving")[0]
        await service.wait_for("web_serving", PATIENCE_S, where=lambda event: event is not first)
        assert (await ask(port, "GET", "/api/session"))["live"]
        assert service.returncode is None
