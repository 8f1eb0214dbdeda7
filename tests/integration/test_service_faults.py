"""Flying goes on whatever happens to disk, clock, configuration and log: the real ``companion run`` over real sockets.

"Flying goes on" means: setpoints that the planner sends are still decided on and reach the autopilot, its telemetry still
reaches the planner, and the service is the same process as before.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.sim.companion_process import toml_of
from companion.status.client import StatusError, ask
from companion.status.metrics import encoder
from companion.status.show import status_text

DEADLINE_S = 60.0
SETPOINT = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE


async def until(condition, what: str = "did not come"):
    end_s = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert time.monotonic() < end_s, what
        await asyncio.sleep(0.02)
    return found


class Wire:
    """One UDP socket to one side of the service."""

    def __init__(self, to: str, system: int, component: int) -> None:
        host, _, port = to.rpartition(":")
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.socket.connect((host, int(port)))
        self.socket.setblocking(False)
        self.packer = mavlink.MAVLink(None, system, component)
        self.parser = mavlink.MAVLink(None)
        self.received: list[Any] = []

    def send(self, message) -> None:
        self.socket.send(message.pack(self.packer))
        self.packer.seq = (self.packer.seq + 1) % 256

    def take(self) -> None:
        while True:
            try:
                data = self.socket.recv(65535)
            except (BlockingIOError, ConnectionRefusedError):
                return
            self.received += self.parser.parse_buffer(data) or ()

    def count(self, message_id: int) -> int:
        self.take()
        return sum(message.get_msgId() == message_id for message in self.received)


class Flight:
    """A planner and an autopilot that talk through a running service, armed and in OFFBOARD."""

    def __init__(self, process: subprocess.Popen, socket_path: Path) -> None:
        self.process = process
        self.path = socket_path
        self.sent_setpoints = 0

    async def status(self) -> dict:
        return await asyncio.to_thread(ask, self.path, "status")

    @contextlib.asynccontextmanager
    async def running(self):
        status = await until_answered(self)
        links = status["links"]
        self.planner = Wire(links["link.planner"]["url"], 245, 190)
        self.autopilot = Wire(links["link.autopilot"]["url"], 1, 1)
        task = asyncio.create_task(self._fly())
        try:
            yield self
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            self.planner.socket.close()
            self.autopilot.socket.close()

    async def _fly(self) -> None:
        for step in range(1_000_000):
            if step % 10 == 0:
                self.autopilot.send(mavlink.MAVLink_heartbeat_message(2, 12, 128 | 1, 6 << 16, 4, 3))
                self.planner.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            time_ms = time.monotonic_ns() // 1_000_000 % (1 << 32)
            self.autopilot.send(mavlink.MAVLink_local_position_ned_message(time_ms, 0, 0, -1.2, 0, 0, 0))
            self.autopilot.send(mavlink.MAVLink_attitude_message(time_ms, 0, 0, 0, 0, 0, 0))
            self.setpoint()
            await asyncio.sleep(0.02)

    def setpoint(self) -> None:
        self.sent_setpoints += 1
        self.planner.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                1, 1, 1, 1, 3576, 5.0, 0.0, -1.2, 0, 0, 0, 0, 0, 0, 0, 0
            )
        )

    async def goes_on(self, messages: int = 25) -> None:
        """Wait until so many more setpoints and messages of telemetry have come through."""
        assert self.process.poll() is None, "the service has ended"
        setpoints = self.autopilot.count(SETPOINT) + messages
        telemetry = self.planner.count(ATTITUDE) + messages
        await until(lambda: self.autopilot.count(SETPOINT) >= setpoints, "no setpoints")
        await until(lambda: self.planner.count(ATTITUDE) >= telemetry, "no telemetry")
        assert self.process.poll() is None, "the service has ended"

    def said(self, words: str) -> bool:
        """Whether a STATUSTEXT with these words has come."""
        self.planner.take()
        texts = [m.text for m in self.planner.received if m.get_msgId() == mavlink.MAVLINK_MSG_ID_STATUSTEXT]
        return any(words in text for text in texts)


async def until_answered(flight: Flight) -> dict:
    end_s = time.monotonic() + DEADLINE_S
    while True:
        try:
            return await flight.status()
        except StatusError:
            assert flight.process.poll() is None, "the service has ended"
            assert time.monotonic() < end_s
            await asyncio.sleep(0.1)


def started(folder: Path, tables: dict | None, *, stderr, environment, prefix) -> subprocess.Popen:
    folder.mkdir(exist_ok=True)
    config = folder / "config.toml"
    merged = {
        "source": {"url": "tcp:127.0.0.1:9"},
        "link": {"planner": "udpin:127.0.0.1:0", "autopilot": "udpin:127.0.0.1:0"},
        "status": {"socket": str(folder / "status.sock")},
        "guidance": {"give_up_s": 3600.0},
        "reload": {"watch_s": 0.0},
        **(tables or {}),
    }
    config.write_text(toml_of(merged))
    return subprocess.Popen(
        [*prefix, sys.executable, "-m", "companion", "run", "-c", str(config)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        env={**os.environ, **(environment or {})},
    )


@contextlib.asynccontextmanager
async def service(folder: Path, tables: dict | None = None, *, stderr, environment=None, prefix=()):
    """Run the service without a camera (it holds), ended with SIGTERM; yield the flight through it."""
    process = started(folder, tables, stderr=stderr, environment=environment, prefix=prefix)
    try:
        async with Flight(process, folder / "status.sock").running() as flight:
            yield flight
        process.send_signal(signal.SIGTERM)
        assert await asyncio.to_thread(process.wait, DEADLINE_S) == 0
    finally:
        process.kill()
        process.wait()


def events(log: Path, name: str) -> list[dict]:
    found = []
    for line in log.read_text().splitlines():
        with contextlib.suppress(ValueError):  # the last line may be half written
            found.append(json.loads(line))
    return [event for event in found if event["event"] == name]


# ---------------------------------------------------------------- configuration, disk and clock

JUMPING_CLOCK = '''
"""Python's wall clock, moved by as many seconds as a file says: before anything else is imported."""
import os, time
_real_ns = time.time_ns
def _jump_ns():
    try:
        with open(os.environ["JUMP_FILE"]) as file:
            return int(float(file.read() or 0) * 1e9)
    except (OSError, ValueError):
        return 0
time.time_ns = lambda: _real_ns() + _jump_ns()
time.time = lambda: time.time_ns() / 1e9
'''


async def test_flying_goes_on_with_a_broken_file_a_full_disk_and_a_clock_that_jumps(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(JUMPING_CLOCK)
    jump, log = tmp_path / "jump", tmp_path / "log"
    jump.write_text("0")
    environment = {
        "JUMP_FILE": str(jump),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]),
    }
    tables = {"ground_station": {"set_parameters": "always"}}
    with log.open("wb") as stderr:
        async with service(tmp_path / "etc", tables, stderr=stderr, environment=environment) as flight:
            await flight.goes_on()
            await broken_files(flight, tmp_path / "etc" / "config.toml", log)
            await full_disk(flight, tmp_path / "etc" / "config.tuned.toml", log)
            await jumping_clock(flight, jump)
    assert events(log, "autopilot_heartbeat_lost") == []
    assert events(log, "estimator_reset") == []


async def broken_files(flight: Flight, config: Path, log: Path) -> None:
    """SIGHUP with files that cannot be used: nothing changes, and that is said; then a good one is taken."""
    good = text_of(config)
    for broken, words in (
        (b"[guidance\n", "not valid TOML"),
        (good.encode() + b"[camera]\nhfov_deg = 999.0\n", "camera.hfov_deg"),
        (b"\0\xff", "not UTF-8 text"),
    ):
        before = len(events(log, "config_rejected"))
        write(config, broken)
        flight.process.send_signal(signal.SIGHUP)
        await until(lambda before=before: len(events(log, "config_rejected")) > before)
        assert words in events(log, "config_rejected")[-1]["error"]
        await flight.goes_on()
    assert flight.said("void: settings not taken")
    write(config, good.encode() + b"[log]\nsetpoints = true\n")
    flight.process.send_signal(signal.SIGHUP)
    await until(lambda: events(log, "config_reloaded"))
    assert events(log, "config_reloaded")[0]["changed"] == {"log.setpoints": True}
    await flight.goes_on()


async def full_disk(flight: Flight, kept: Path, log: Path) -> None:
    """No file may grow (RLIMIT_FSIZE), which is what a full disk does to a program: writing fails."""
    limits = resource.prlimit(flight.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(flight.process.pid, resource.RLIMIT_FSIZE, (0, limits[1]))
    set_parameter(flight, "VOID_MAX_STEP_M", 0.75)
    await until(lambda: flight.said("void: settings not kept"))
    assert not exists(kept)
    await flight.goes_on(100)
    resource.prlimit(flight.process.pid, resource.RLIMIT_FSIZE, limits)  # somebody has tidied up
    set_parameter(flight, "VOID_AGREE_DEG", 17.0)
    await until(kept.exists)
    assert "max_step_m = 0.75" in text_of(kept)
    await flight.goes_on()
    await until(lambda: events(log, "log_lines_dropped"))
    assert events(log, "log_lines_dropped")[0]["lines"] >= 100


async def jumping_clock(flight: Flight, jump: Path) -> None:
    """The wall clock jumps by an hour either way: no age, deadline or restart comes of it."""
    worker = await until_worker(flight)
    before = await flight.status()
    assert "HOLD: " in status_text(before)  # what is shown and measured is made for what a real service says
    assert b'void_companion_state{state="HOLD"} 1.0' in encoder()(before, "")[0]
    for seconds in ("3600", "-3600", "0"):
        write(jump, seconds.encode())
        await flight.goes_on()
        after = await flight.status()
        assert 0 < after["uptime_s"] - before["uptime_s"] < DEADLINE_S
        assert after["pose_age_ms"] < 1000 * DEADLINE_S
        assert after["state"] == before["state"] == "HOLD"
        assert after["worker"]["pid"] == worker
        assert after["worker"]["restarts"] == 0


async def until_worker(flight: Flight) -> int:
    end_s = time.monotonic() + DEADLINE_S
    while (status := await flight.status())["worker"]["state"] != "ready":
        assert time.monotonic() < end_s
        await asyncio.sleep(0.1)
    return status["worker"]["pid"]


def text_of(path: Path) -> str:
    return path.read_text()


def write(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def exists(path: Path) -> bool:
    return path.exists()


def set_parameter(flight: Flight, name: str, value: float) -> None:
    flight.planner.send(mavlink.MAVLink_param_set_message(1, 191, name.encode(), value, 9))


# ---------------------------------------------------------------- the log


async def test_a_log_that_nobody_reads_blocks_nothing(tmp_path):
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    tables = {"log": {"setpoints": True, "status_interval_s": 0.1}}
    try:
        async with service(tmp_path / "etc", tables, stderr=writing) as flight:
            await flight.goes_on()
            for _ in range(300):  # more lines than pipe and queue take, each of them at least 100 bytes
                for _ in range(10):
                    flight.setpoint()
                await asyncio.sleep(0.005)
            await flight.goes_on()
            assert await asyncio.to_thread(is_full, writing)
    finally:
        os.close(reading)
        os.close(writing)


def is_full(pipe: int) -> bool:
    """Whether a pipe takes nothing more; it is tried without waiting, by a descriptor of its own."""
    own = os.open(f"/proc/self/fd/{pipe}", os.O_WRONLY | os.O_NONBLOCK)
    try:
        os.write(own, b"x" * 4096)
    except OSError as error:
        return error.errno == errno.EAGAIN
    finally:
        os.close(own)
    return False


async def test_flying_goes_on_when_the_journal_goes_away_and_where_no_setting_can_be_kept(tmp_path):
    """systemd gives the journal as a stream socket; writing to one whose other end is gone is EPIPE."""
    journal, ours = socket.socketpair()
    tables = {
        "ground_station": {
            "set_parameters": "always",
            "parameters_file": "/proc/void-companion.toml",  # read-only for everybody, the superuser too
        },
        "log": {"setpoints": True},
    }
    with ours:
        async with service(tmp_path / "etc", tables, stderr=ours) as flight:
            await flight.goes_on()
            journal.close()
            await flight.goes_on(100)
            set_parameter(flight, "VOID_MAX_STEP_M", 0.75)
            await until(lambda: flight.said("void: settings not kept"))
            values = [
                message.param_value
                for message in flight.planner.received
                if message.get_msgId() == mavlink.MAVLINK_MSG_ID_PARAM_VALUE
            ]
            assert values[-1] == 0.75  # it acts all the same
            await flight.goes_on()


def descriptor_of(pid: int, number: int) -> str:
    return str(Path(f"/proc/{pid}/fd/{number}").readlink())


async def test_a_service_that_is_started_without_standard_descriptors_flies(tmp_path):
    """What it opens first must not become its standard error, where libraries write."""
    closed = ("/bin/sh", "-c", 'exec "$@" 0<&- 1>&- 2>&-', "sh")
    async with service(tmp_path / "etc", stderr=subprocess.DEVNULL, prefix=closed) as flight:
        await flight.goes_on(100)
        for number in (0, 1, 2):
            assert descriptor_of(flight.process.pid, number) == os.devnull
