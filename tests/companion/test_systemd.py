"""What systemd is told, on a real datagram socket; and the unit, by systemd's own judge where it is installed."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from companion.clock import RealClock
from companion.config import Config
from companion.service import Service
from companion.systemd import NotifySocketError, ServiceNotifier
from tests.companion.test_service_loops import capturing_log

SEC = 1_000_000_000


class NotifySocket:
    """A notify socket as systemd opens it."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.setblocking(False)

    def said(self) -> list[str]:
        datagrams = []
        with contextlib.suppress(BlockingIOError):
            while True:
                datagrams.append(self.socket.recv(4096).decode())
        return datagrams

    def wait_for(self, text: str, limit_s: float = 60.0) -> list[str]:
        """Return everything said up to the first datagram with this text."""
        heard: list[str] = []
        self.socket.settimeout(limit_s)
        try:
            while not heard or text not in heard[-1]:
                heard.append(self.socket.recv(4096).decode())
        finally:
            self.socket.setblocking(False)
        return heard


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    address = str(tmp_path / "notify") if request.param == "path" else f"@void-companion-test-{os.getpid()}"
    found = NotifySocket(address)
    yield found
    found.socket.close()


@pytest.fixture
def notifier(manager):
    found = ServiceNotifier(manager.address, watchdog_ns=4 * SEC)
    yield found
    found.close()


def test_each_message_is_one_datagram(manager, notifier):
    notifier.ready()
    notifier.working("HOLD: no frame yet")
    notifier.reloading(1_234_567_999)
    notifier.stopping()
    assert manager.said() == [
        "READY=1",
        "STATUS=HOLD: no frame yet\nWATCHDOG=1",
        "RELOADING=1\nMONOTONIC_USEC=1234567",
        "STOPPING=1",
    ]


def test_the_watchdog_is_fed_each_time_and_an_unchanged_status_is_said_once(manager, notifier):
    notifier.working("HOLD")
    notifier.working("HOLD")
    notifier.working("FOLLOW")
    assert manager.said() == ["STATUS=HOLD\nWATCHDOG=1", "WATCHDOG=1", "STATUS=FOLLOW\nWATCHDOG=1"]


def test_a_status_of_several_lines_cannot_say_anything_else(manager, notifier):
    notifier.working("worker died\nSTOPPING=1")
    assert manager.said() == ["STATUS=worker died STOPPING=1\nWATCHDOG=1"]


def test_without_a_watchdog_none_is_fed(manager):
    notifier = ServiceNotifier(manager.address)
    notifier.working("HOLD")
    notifier.working("HOLD")
    notifier.close()
    assert manager.said() == ["STATUS=HOLD"]


def test_a_manager_that_does_not_read_stops_nothing(manager, notifier):
    for number in range(5000):
        notifier.working(f"state {number}")
    assert manager.said()[0] == "STATUS=state 0\nWATCHDOG=1"
    notifier.working("HOLD")
    assert manager.said() == ["STATUS=HOLD\nWATCHDOG=1"]


def test_a_manager_that_has_gone_stops_nothing(manager, notifier):
    manager.socket.close()
    notifier.ready()
    notifier.working("HOLD")


def test_the_environment_is_read_once_and_taken_away(manager):
    environment = {
        "NOTIFY_SOCKET": manager.address,
        "WATCHDOG_USEC": "2000000",
        "WATCHDOG_PID": str(os.getpid()),
        "HOME": "/",
    }
    notifier = ServiceNotifier.from_environment(environment)
    notifier.working("HOLD")
    assert notifier.enabled
    assert notifier.period_ns == 2 * SEC // 4
    assert manager.said() == ["STATUS=HOLD\nWATCHDOG=1"]
    assert environment == {"HOME": "/"}
    notifier.close()


def test_the_watchdog_of_another_process_is_not_ours(manager):
    environment = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}
    notifier = ServiceNotifier.from_environment(environment)
    notifier.working("HOLD")
    assert manager.said() == ["STATUS=HOLD"]
    notifier.close()


def test_without_a_manager_nothing_is_said():
    notifier = ServiceNotifier.from_environment({})
    notifier.ready()
    notifier.stopping()
    assert not notifier.enabled


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"NOTIFY_SOCKET": "relative"}, "NOTIFY_SOCKET: found 'relative'"),
        ({"NOTIFY_SOCKET": "/run/x", "WATCHDOG_USEC": "soon"}, "WATCHDOG_USEC: found 'soon'"),
        ({"NOTIFY_SOCKET": "/run/x", "WATCHDOG_USEC": "0"}, "WATCHDOG_USEC: found '0'"),
    ],
)
def test_variables_that_systemd_does_not_set_are_refused(environment, said):
    with pytest.raises(NotifySocketError, match=said):
        ServiceNotifier.from_environment(environment)


async def test_health_that_does_not_run_starves_the_watchdog(manager, notifier):
    """The loop that feeds it speaks for the one that judges: with that one stuck, systemd hears nothing."""
    bound, _ = capturing_log()

    class Late(RealClock):
        ahead_ns = 0

        def now_ns(self) -> int:
            return super().now_ns() + self.ahead_ns

    class Flight:
        def status(self, now_ns: int) -> dict[str, object]:
            return {"state": "HOLD", "reason": "no pose", "frames_hz": 0.0}

    clock = Late()
    service = Service(Config(), clock=clock, log=bound, notifier=notifier)
    loop = asyncio.create_task(service._tell_systemd(Flight()))
    await asyncio.sleep(0)
    assert manager.said() == [], "ready before health has run"
    service._health_ns = clock.now_ns()
    service._health_has_run = True
    loop.cancel()
    loop = asyncio.create_task(service._tell_systemd(Flight()))
    await asyncio.sleep(0)
    assert manager.said() == ["READY=1", "STATUS=HOLD: no pose; frames 0.0/s\nWATCHDOG=1"]
    loop.cancel()
    clock.ahead_ns = 2 * SEC
    loop = asyncio.create_task(service._tell_systemd(Flight()))
    await asyncio.sleep(0)
    assert manager.said() == []
    loop.cancel()
    await asyncio.gather(loop, return_exceptions=True)


def test_companion_run_tells_a_manager_of_its_life(tmp_path):
    manager = NotifySocket(str(tmp_path / "notify"))
    config = tmp_path / "companion.toml"
    config.write_text(
        '[source]\nurl = "tcp:127.0.0.1:9"\n[link]\nplanner = "udpin:127.0.0.1:0"\nautopilot = "udpin:127.0.0.1:0"\n'
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "companion", "run", "-c", str(config)],
        env={**os.environ, "NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "1000000"},
        stderr=subprocess.DEVNULL,
    )
    try:
        started = manager.wait_for("READY=1")
        assert started == ["READY=1"]
        fed = manager.wait_for("WATCHDOG=1")
        assert any(line.startswith("STATUS=") for line in fed[0].splitlines())
        process.send_signal(signal.SIGSTOP)  # what hangs feeds nothing
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        manager.said()
        time.sleep(0.6)  # more than two of its periods
        assert manager.said() == []
        process.send_signal(signal.SIGCONT)
        manager.wait_for("WATCHDOG=1")
        process.send_signal(signal.SIGTERM)
        manager.wait_for("STOPPING=1")
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        manager.socket.close()
