"""``companion status``: what it prints of a running service, of one that does not run, and which socket it means."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import threading

import pytest
from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.cli import main
from companion.status import command
from companion.status.command import chosen_socket
from companion.status.server import StatusServer

DEADLINE_S = 60.0

STATUS = {
    "version": "0.1.0",
    "pid": 12,
    "uptime_s": 65.0,
    "state": "HOLD",
    "reason": "no parallax",
    "not_ready": None,
    "frames_hz": 30.0,
    "reports_hz": 12.0,
    "setpoints_hz": 20.0,
    "pose_age_ms": None,
    "engaged": True,
    "clock_round_trip_ms": None,
    "armed": False,
    "autopilot_age_ms": None,
    "source": {"url": "", "fault": "no frame yet", "frame_age_ms": None},
    "worker": {
        "state": "starting",
        "pid": None,
        "restarts": 0,
        "report_age_ms": None,
        "frames_replaced": 0,
        "frames_refused": 0,
        "last_error": "",
    },
    "links": {},
    "counts": {
        **dict.fromkeys(("forwarded", "substituted", "held", "turned"), 0),
        "dropped": {},
        "unprotected": {},
    },
    "host": {
        "cpu_load": None,
        "memory_used_mib": None,
        "memory_total_mib": None,
        "disk_used_mib": None,
        "disk_total_mib": None,
        "temperatures_deg_c": {},
    },
    "processes": {},
}


@contextlib.contextmanager
def service(path):
    """A status server with a loop of its own."""

    async def snapshot():
        return STATUS

    log = wrap_logger(CapturingLogger(), processors=[lambda *args: ((), {})]).bind()
    loop = asyncio.new_event_loop()
    server = StatusServer(path, snapshot=snapshot, commands={}, log=log)
    task = loop.create_task(server.run())

    def run() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(task)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        while not path.exists():
            assert thread.is_alive()
        yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(DEADLINE_S)
        loop.close()


def test_a_running_service_as_text_and_as_json(tmp_path, capsys):
    path = tmp_path / "status.sock"
    with service(path):
        assert main(["status", "-s", str(path)]) == 0
        text = capsys.readouterr().out
        assert "up 1 min 5 s" in text
        assert "HOLD: no parallax" in text
        assert main(["status", "--json", "-s", str(path)]) == 0
        assert json.loads(capsys.readouterr().out) == {"running": True, **STATUS}


def test_one_that_does_not_run_is_a_clear_line_and_exit_code_1(tmp_path, capsys):
    path = tmp_path / "status.sock"
    assert main(["status", "-s", str(path)]) == 1
    streams = capsys.readouterr()
    assert streams.err == f"error: the service is not running: there is no socket {path}\n"
    assert streams.out == ""
    assert main(["status", "--json", "-s", str(path)]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found == {"running": False, "error": f"the service is not running: there is no socket {path}"}


def test_watch_shows_it_again_and_waits_for_one_that_has_ended(tmp_path):
    path = tmp_path / "status.sock"
    words = [sys.executable, "-m", "companion", "status", "--watch", "--json", "-s", str(path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["running"] is False
        with service(path):
            while not (found := json.loads(process.stdout.readline()))["running"]:
                pass
            assert found["state"] == "HOLD"
            assert json.loads(process.stdout.readline())["running"] is True
        while json.loads(process.stdout.readline())["running"]:
            pass
        process.stdout.close()  # as `| head` does: it ends quietly
        _, errors = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, errors) == (0, "")


def test_the_socket_is_the_one_named_configured_or_of_the_unit(tmp_path, monkeypatch):
    for name in ("RUNTIME_DIRECTORY", "VOID_COMPANION_STATUS__SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "etc" / "config.toml"
    config.parent.mkdir()
    config.write_text('[status]\nsocket = "s.sock"\n')
    assert str(chosen_socket("a.sock", None)) == "a.sock"
    assert chosen_socket(None, str(config)) == config.parent / "s.sock"
    assert str(chosen_socket(None, None)) == "/run/void-companion/status.sock"
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/other")
    assert str(chosen_socket(None, None)) == "/run/other/status.sock"
    monkeypatch.setenv("VOID_COMPANION_STATUS__SOCKET", "/srv/x.sock")
    assert str(chosen_socket(None, None)) == "/srv/x.sock"


def test_a_fault_that_waiting_does_not_mend_ends_the_watch(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command, "_WATCH_S", 0.0)
    assert main(["status", "--watch", "-s", str(tmp_path / ("x" * 200))]) == 1
    assert "cannot be used" in capsys.readouterr().err


@pytest.mark.parametrize("line", [["--socket", "a", "--config", "b"], ["extra"]])
def test_wrong_usage(line):
    with pytest.raises(SystemExit) as caught:
        main(["status", *line])
    assert caught.value.code == 2


@pytest.mark.parametrize(
    ("module", "not_needed"),
    [
        (
            "companion.cli",
            {"asyncio", "numpy", "pydantic", "structlog", "rich", "cv2", "pymavlink", "sklearn"},
        ),
        (
            "companion.status.command",
            {"cv2", "pymavlink", "sklearn", "prometheus_client", "companion.service", "mavsdk"},
        ),
    ],
)
def test_it_starts_without_what_it_does_not_need(module, not_needed):
    program = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=DEADLINE_S)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert module in loaded
    assert not loaded & not_needed
