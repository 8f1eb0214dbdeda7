"""The real ``companion run`` over real sockets: nothing lost, nothing stale, and a clear word for bad input."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.setpoint import TypeMask
from companion.mavlink.framing import checksum
from companion.sim.autopilot import FakeAutopilot
from companion.sim.companion_process import CompanionProcess, CompanionProcessError, toml_of
from companion.sim.frame_server import FrameServer
from companion.sim.planner import Planner, Waypoint
from companion.sim.px4_modes import FlightMode
from companion.sim.traffic import compare
from companion.sim.vehicle import Vehicle, VehicleLimits

QUIET = {"log": {"status_interval_s": 0.5}}


def address(started: dict, side: str) -> tuple[str, int]:
    host, _, port = started[side].rpartition(":")
    return host, int(port)


class Wire(asyncio.DatagramProtocol):
    """One UDP socket that keeps what arrives."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport) -> None:
        self.transport = transport
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)

    def datagram_received(self, data: bytes, addr) -> None:
        self.received.append(data)

    def send(self, data: bytes) -> None:
        self.transport.sendto(data)


@contextlib.asynccontextmanager
async def wire_to(remote: tuple[str, int]):
    transport, wire = await asyncio.get_running_loop().create_datagram_endpoint(Wire, remote_addr=remote)
    try:
        yield wire
    finally:
        transport.close()
        await asyncio.sleep(0)


@contextlib.asynccontextmanager
async def noise_camera(rate_hz: float = 10.0):
    """A live camera that shows sharp noise: frames arrive, but nothing can be followed in them."""
    rng = np.random.default_rng(3)
    async with FrameServer() as server:

        async def publish() -> None:
            while True:
                image = cv2.GaussianBlur(rng.integers(0, 255, (120, 160), dtype=np.uint8), (3, 3), 0)
                server.publish(np.asarray(image), time.monotonic_ns())
                await asyncio.sleep(1 / rate_hz)

        task = asyncio.create_task(publish())
        try:
            yield "{}:{}".format(*server.address)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


class Talker:
    """Makes the mixed traffic of one side: v1 and v2, known and unknown messages, setpoints in between."""

    def __init__(self, system: int, component: int, seed: int) -> None:
        self.v2 = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.system, self.component = system, component
        self.rng = random.Random(seed)
        self.seq = 0
        self.sent: list[bytes] = []

    def _pack(self, message, *, v1: bool = False) -> bytes:
        self.v2.seq = self.seq
        frame = bytes(message.pack(self.v2, force_mavlink1=v1))
        self.seq = (self.seq + 1) % 256
        return frame

    def unknown(self) -> bytes:
        """A message of no dialect: only its header can be read, any checksum will do."""
        payload = self.rng.randbytes(self.rng.randint(1, 60))
        header = struct.pack(
            "<BBBBBBBHB", 0xFD, len(payload), 0, 0, self.seq, self.system, self.component, 0x7A31, 3
        )
        self.seq = (self.seq + 1) % 256
        return header + payload + self.rng.randbytes(2)

    def other(self) -> bytes:
        roll = self.rng.random()
        if roll < 0.15:
            return self.unknown()
        v1 = roll < 0.4
        if roll < 0.7:
            return self._pack(mavlink.MAVLink_param_value_message(b"ABC", self.rng.random(), 9, 5, 2), v1=v1)
        return self._pack(mavlink.MAVLink_ping_message(self.rng.getrandbits(40), 3, 0, 0), v1=v1)

    def setpoint(self) -> bytes:
        return self._pack(
            mavlink.MAVLink_set_position_target_local_ned_message(
                self.rng.getrandbits(30), 1, 1, 1, 3576,
                self.rng.uniform(-9, 9), self.rng.uniform(-9, 9), self.rng.uniform(-3, 0),
                0, 0, 0, 0, 0, 0, 0, 0,
            ),
            v1=self.rng.random() < 0.3,
        )  # fmt: skip

    def telemetry(self, ms: int) -> bytes:
        t = ms / 1000
        return (
            self._pack(mavlink.MAVLink_local_position_ned_message(ms, 0.2 * t, 0.0, -1.2, 0.2, 0, 0))
            + self._pack(mavlink.MAVLink_attitude_message(ms, 0, 0, 0.1, 0, 0, 0))
        )  # fmt: skip

    def heartbeat(self) -> bytes:
        return self._pack(mavlink.MAVLink_heartbeat_message(2, 12, 128 | 1, 6 << 16, 4, 3))


@pytest.mark.slow
async def test_ten_thousand_messages_each_way_while_the_worker_is_killed_ten_times():
    async with noise_camera() as camera:
        service = CompanionProcess(
            {
                "source": {"url": f"tcp:{camera}"},
                "detector": {"restart_delay_s": 0.05, "restart_delay_max_s": 0.2},
                "guidance": {"give_up_s": 3600.0},
                **QUIET,
            }
        )
        async with service:
            started = await service.wait_for("service_started")
            async with (
                wire_to(address(started, "planner")) as planner,
                wire_to(address(started, "autopilot")) as autopilot,
            ):
                up, down = Talker(245, 190, 1), Talker(1, 1, 2)
                up_sent: list[bytes] = []
                down_sent: list[bytes] = []

                def send(wire: Wire, sent: list[bytes], data: bytes) -> None:
                    sent.append(data)
                    wire.send(data)

                # Both sides learn their peers from what arrives, and the first setpoint needs a pose.
                autopilot.send(down.heartbeat())
                await asyncio.sleep(0.2)
                planner.send(up.other())
                await asyncio.sleep(0.2)
                autopilot.received.clear()
                for ms in range(0, 400, 20):
                    send(planner, up_sent, up.other())
                    send(autopilot, down_sent, down.heartbeat() + down.telemetry(ms))
                    await asyncio.sleep(0.01)
                kills = 0
                killed: set[int] = set()
                sent_up = sent_down = 0
                ms = 400
                while sent_up < 10_000 or sent_down < 10_000 or kills < 10:
                    # bursts of several frames, some of them in one datagram
                    frames = [up.setpoint() if up.rng.random() < 0.3 else up.other() for _ in range(6)]
                    send(planner, up_sent, frames[0] + frames[1])
                    for frame in frames[2:]:
                        send(planner, up_sent, frame)
                    send(autopilot, down_sent, down.telemetry(ms) + down.other())
                    for _ in range(3):
                        send(autopilot, down_sent, down.other())
                    if ms % 500 == 0:
                        send(autopilot, down_sent, down.heartbeat())
                    sent_up += 6
                    sent_down += 6
                    ms += 10
                    await asyncio.sleep(0.01)
                    for event in service.of("worker_starting"):
                        if kills < 10 and event["pid"] not in killed and up.rng.random() < 0.03:
                            killed.add(event["pid"])
                            with contextlib.suppress(ProcessLookupError):
                                os.kill(event["pid"], signal.SIGKILL)
                                kills += 1
                await asyncio.sleep(0.5)
                result = compare(up_sent, autopilot.received, down_sent, planner.received)
                assert kills == 10
                assert len(service.of("worker_died")) >= 9
                assert result.setpoints_sent > 2000
                assert result.z_changed == 0
                assert (result.other_lost, result.other_altered) == (0, 0)
                assert result.other_sent > 15_000
        summary = service.of("summary")[-1]
        late = summary[
            "planner_late_setpoints"
        ]  # where this machine held the service up for long: dropped on purpose
        assert result.setpoints_lost == late < result.setpoints_sent / 10
        counts = [summary[name] for name in ("forwarded", "substituted", "held", "turned")]
        assert sum(counts) == summary["setpoints_in"] == result.setpoints_sent - late
        assert summary["held"] > 1000, "no detection: the setpoints are held"
        assert service.returncode == 0
        assert service.other_lines == []


async def test_detection_resumes_by_itself_after_the_worker_was_killed():
    async with noise_camera() as camera:
        service = CompanionProcess(
            {
                "source": {"url": f"tcp:{camera}"},
                "log": {"status_interval_s": 0.5, "detections": True},
            }
        )
        async with service:
            first = await service.wait_for("worker_ready", 60)
            await service.wait_for("detection", 30)
            os.kill(first["pid"], signal.SIGKILL)
            second = await service.wait_for("worker_ready", 60, where=lambda e: e["pid"] != first["pid"])
            last_seq = max(event["frame_seq"] for event in service.of("detection"))
            await service.wait_for("detection", 30, where=lambda e: e["frame_seq"] > last_seq + 5)
            assert second["pid"] != first["pid"]


async def test_garbage_on_either_port_is_counted_and_good_frames_go_on():
    service = CompanionProcess({"source": {"url": "tcp:127.0.0.1:9"}, **QUIET})
    async with service:
        started = await service.wait_for("service_started")
        async with (
            wire_to(address(started, "planner")) as planner,
            wire_to(address(started, "autopilot")) as autopilot,
        ):
            rng = random.Random(5)
            up, down = Talker(245, 190, 1), Talker(1, 1, 2)
            good_up = [up.other() for _ in range(50)]
            good_down = [down.other() for _ in range(50)]
            autopilot.send(down.heartbeat())
            planner.send(up.other())
            await asyncio.sleep(0.2)
            for a, b in zip(good_up, good_down, strict=True):
                planner.send(rng.randbytes(rng.randint(1, 300)))
                autopilot.send(rng.randbytes(rng.randint(1, 300)))
                planner.send(a)
                autopilot.send(b)
                await asyncio.sleep(0.002)
            await service.wait_for(
                "status",
                10,
                where=lambda e: e["planner_garbage_bytes"] > 1000 and e["autopilot_garbage_bytes"] > 1000,
            )
            assert compare(good_up, autopilot.received, [], []).other_lost == 0
            assert compare([], [], good_down, planner.received).other_lost == 0
    assert service.returncode == 0
    assert service.other_lines == []


async def test_a_nan_never_leaves_and_an_unhandled_kind_is_announced_once():
    service = CompanionProcess({"source": {"url": "tcp:127.0.0.1:9"}, **QUIET})
    async with service:
        started = await service.wait_for("service_started")
        async with (
            wire_to(address(started, "planner")) as planner,
            wire_to(address(started, "autopilot")) as autopilot,
        ):
            up, down = Talker(245, 190, 1), Talker(1, 1, 2)
            autopilot.send(down.heartbeat() + down.telemetry(0) + down.telemetry(20))
            await asyncio.sleep(0.1)

            def local(mask: int, frame: int = 1, **fields: float) -> bytes:
                values = {
                    name: fields.get(name, 0.0)
                    for name in ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
                }
                return up._pack(
                    mavlink.MAVLink_set_position_target_local_ned_message(1, 1, 1, frame, mask, **values)
                )

            planner.send(local(3576, x=math.nan))
            planner.send(local(3576, x=1.0, z=-1.0, yaw=math.nan, vx=math.inf))
            for _ in range(3):
                planner.send(local(3576, 8, x=1.0))
                planner.send(local(int(TypeMask.POSITION_IGNORE | TypeMask.VELOCITY_IGNORE), afx=0.3))
            await asyncio.sleep(0.3)
            received = [d for d in autopilot.received if len(d) > 10 and d[7] == 84 and d[5] == 245]
            assert len(received) == 7
            for datagram in received:
                message = mavlink.MAVLink(None).parse_buffer(datagram)[0]
                assert all(
                    math.isfinite(v) for v in (message.x, message.y, message.z, message.yaw, message.vx)
                )
            announced = service.of("setpoint_unprotected")
            assert sorted(e["detail"] for e in announced) == ["acceleration only", "coordinate_frame 8"]
        await service.wait_for("status", 5, where=lambda e: sum(e["dropped"].values()) == 1)


async def test_sigterm_ends_it_within_two_seconds_and_leaves_no_process():
    async with noise_camera() as camera:
        service = CompanionProcess({"source": {"url": f"tcp:{camera}"}, **QUIET})
        async with service:
            ready = await service.wait_for("worker_ready", 60)
            began = time.monotonic_ns()
            assert await service.stop() == 0
            assert time.monotonic_ns() - began < 2e9
            with pytest.raises(ProcessLookupError):
                os.kill(ready["pid"], 0)


async def test_sigkill_of_the_companion_leaves_the_autopilot_to_its_failsafe():
    async with (
        noise_camera() as camera,
        FakeAutopilot(vehicle=Vehicle(VehicleLimits.indoor()), parameters={"COM_OBL_RC_ACT": 5}) as autopilot,
    ):
        service = CompanionProcess(
            {
                "source": {"url": f"tcp:{camera}"},
                "link": {"autopilot": "udpout:{}:{}".format(*autopilot.address)},
                **QUIET,
            }
        )
        async with service:
            started = await service.wait_for("service_started")
            worker = await service.wait_for("worker_ready", 60)
            async with Planner(address(started, "planner")) as planner:
                await planner.wait_ready()
                planner.aim(Waypoint(0, 0, -1.2))
                await planner.arm()
                await planner.start_offboard()
                await service.wait_for("state", 10)
                assert autopilot.mode is FlightMode.OFFBOARD
                os.kill(service.pid, signal.SIGKILL)
                await asyncio.sleep(1.6)
                assert autopilot.mode is not FlightMode.OFFBOARD
                for _ in range(40):
                    try:
                        os.kill(worker["pid"], 0)
                    except ProcessLookupError:
                        break
                    await asyncio.sleep(0.1)
                else:
                    pytest.fail("the worker outlived the service")


# ---------------------------------------------------------------------- bad input at the start


def run_companion(*arguments: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "companion", *arguments], capture_output=True, text=True, timeout=timeout_s
    )


def assert_clear_error(result: subprocess.CompletedProcess, *words: str) -> None:
    assert result.returncode == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr, result.stderr


def config_file(folder: Path, **source: object) -> Path:
    path = folder / "c.toml"
    path.write_text(
        toml_of(
            {
                "source": source,
                "link": {"planner": "udpin:127.0.0.1:0", "autopilot": "udpin:127.0.0.1:0"},
            }
        )
    )
    return path


def test_a_missing_source_is_a_clear_error(tmp_path):
    result = run_companion("run", "-c", str(config_file(tmp_path, url="file:nowhere.mp4")))
    assert_clear_error(result, "nowhere.mp4")


def test_a_corrupt_video_is_a_clear_error(tmp_path):
    (tmp_path / "broken.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(500))
    result = run_companion("run", "-c", str(config_file(tmp_path, url="file:broken.mp4")))
    assert_clear_error(result, "broken.mp4")


def test_a_wrong_key_a_missing_file_and_a_broken_camera_file_are_clear_errors(tmp_path):
    (tmp_path / "bad.toml").write_text("[guidance]\nmax_step = 3\n")
    assert_clear_error(
        run_companion("run", "-c", str(tmp_path / "bad.toml")), "guidance.max_step", "max_step_m"
    )
    assert_clear_error(run_companion("run", "-c", str(tmp_path / "none.toml")), "none.toml")
    assert_clear_error(run_companion("check-config", str(tmp_path / "bad.toml")), "guidance.max_step")
    image = np.zeros((48, 64), np.uint8)
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "0.png"), image)
    (tmp_path / "camera.toml").write_text("width_px = 'wide'\n")
    path = config_file(tmp_path, url="file:frames", loop=True)
    path.write_text(path.read_text() + '[camera]\nfile = "camera.toml"\n')
    assert_clear_error(run_companion("run", "-c", str(path)), "camera.toml", "width_px")


def test_a_port_in_use_is_a_clear_error(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        path = tmp_path / "c.toml"
        path.write_text(toml_of({"link": {"planner": f"udpin:127.0.0.1:{port}"}}))
        assert_clear_error(run_companion("run", "-c", str(path)), str(port))


def test_a_signing_key_that_others_may_read_is_a_clear_error(tmp_path):
    (tmp_path / "signing.key").write_bytes(bytes(range(32)))
    (tmp_path / "signing.key").chmod(0o644)
    path = config_file(tmp_path, url="tcp:127.0.0.1:9")
    path.write_text(path.read_text().replace("[link]", '[link]\nsigning_key_file = "signing.key"'))
    assert_clear_error(run_companion("run", "-c", str(path)), str(tmp_path / "signing.key"), "chmod 600")


def test_a_demo_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "taken").touch()
    assert_clear_error(run_companion("demo", "-o", str(tmp_path / "taken")), "taken")


def test_the_default_configuration_is_one_that_check_config_accepts(tmp_path):
    printed = run_companion("config", "--default")
    assert printed.returncode == 0
    path = tmp_path / "default.toml"
    path.write_text(printed.stdout)
    assert run_companion("check-config", str(path)).returncode == 0


async def test_tiny_images_are_reported_not_crashed_on(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(5):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((1, 1), 90, np.uint8))
    service = CompanionProcess(
        {
            "source": {"url": f"file:{folder}", "loop": True},
            "log": {"status_interval_s": 0.5, "detections": True},
        }
    )
    async with service:
        event = await service.wait_for("detection", 60)
        assert (event["kind"], event["reason"]) == ("none", "wrong_size")
    assert service.returncode == 0
    assert service.other_lines == []


def test_the_checksum_of_our_own_test_traffic_is_right():
    frame = Talker(1, 1, 1).telemetry(5)[:40]
    length = frame[1]
    stated = struct.unpack_from("<H", frame, 10 + length)[0]
    assert checksum(frame[1 : 10 + length], 32) == stated


async def test_a_companion_that_does_not_start_is_told_with_its_last_words():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        async with CompanionProcess({"link": {"planner": url}}) as service:
            with pytest.raises(CompanionProcessError, match="in use"):
                await service.wait_for("service_started")
