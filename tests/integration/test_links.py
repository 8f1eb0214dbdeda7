"""The real ``companion run`` with a planner, a ground station and an autopilot on a serial line: who gets what."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import signal
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.framing import Framer, RawFrame
from companion.sim.companion_process import CompanionProcess

DISARMED_PX4 = (2, 12, 1, 0, 3, 3)
"""Setpoints are forwarded untouched: what is tested here is where frames go."""


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():  # noqa: ASYNC110  what is waited for has no event: it crosses the kernel
            await asyncio.sleep(0.01)


class Speaker:
    """One system with its component: makes frames, and keeps those that it hears."""

    def __init__(self, system: int, component: int) -> None:
        self._packer = mavlink.MAVLink(None, system, component)
        self._framer = Framer()
        self.heard: list[RawFrame] = []

    def pack(self, message: mavlink.MAVLink_message) -> bytes:
        data = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256
        return data

    def heartbeat(self, *fields: int) -> bytes:
        return self.pack(mavlink.MAVLink_heartbeat_message(*fields))

    def hear(self, data: bytes) -> None:
        self.heard += self._framer.feed(data)

    def has(self, data: bytes) -> bool:
        return any(frame.data == data for frame in self.heard)

    def heard_of(self, system: int) -> bool:
        return any(frame.system_id == system for frame in self.heard)


@contextlib.contextmanager
def serial_autopilot(device: Path, autopilot: Speaker) -> Iterator[Callable[[bytes], int]]:
    """A pseudo-terminal with the autopilot at its far end; yields what writes to the line."""
    far, near = pty.openpty()
    tty.setraw(near)
    tty.setraw(far)
    os.set_blocking(far, False)
    device.unlink(missing_ok=True)
    device.symlink_to(os.ttyname(near))
    os.close(near)
    loop = asyncio.get_running_loop()

    def read() -> None:
        with contextlib.suppress(OSError):  # nobody has the device open at the moment
            autopilot.hear(os.read(far, 65536))

    loop.add_reader(far, read)
    try:
        yield lambda data: os.write(far, data)
    finally:
        loop.remove_reader(far)
        os.close(far)
        device.unlink(missing_ok=True)


class Wire(asyncio.DatagramProtocol):
    """The planner's UDP socket."""

    def __init__(self, speaker: Speaker) -> None:
        self._speaker = speaker

    def datagram_received(self, data: bytes, addr: object) -> None:
        self._speaker.hear(data)


async def listen(reader: asyncio.StreamReader, speaker: Speaker) -> None:
    while data := await reader.read(65536):
        speaker.hear(data)


def there(text: str) -> tuple[str, int]:
    host, _, port = text.strip().rpartition(":")
    return host, int(port)


def states(service: CompanionProcess) -> list[str]:
    """The states of the serial line so far."""
    return [e["state"] for e in service.of("link_state") if e["link"] == "link.autopilot"]


async def test_a_planner_a_ground_station_and_a_serial_autopilot_hear_what_is_for_them(
    tmp_path: Path,
) -> None:
    device = tmp_path / "usb-autopilot"
    planner, station, autopilot = Speaker(245, 190), Speaker(255, 190), Speaker(1, 1)
    service = CompanionProcess(
        {
            "source": {"url": "tcp:127.0.0.1:9"},
            "link": {
                "planner": ["udpin:127.0.0.1:0", "tcpin:127.0.0.1:0"],
                "autopilot": f"serial:{device}:921600",
                "filters": ["deny out planner.2 message=30"],
            },
            "log": {"status_interval_s": 0.5},
        }
    )
    async with service, contextlib.AsyncExitStack() as stack:
        started = await service.wait_for("service_started", 60)
        planner_address, station_address = map(there, str(started["planner"]).split(","))
        wire, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: Wire(planner), remote_addr=planner_address
        )
        stack.callback(wire.close)
        reader, writer = await asyncio.open_connection(*station_address)
        stack.callback(writer.close)
        station_task = asyncio.create_task(listen(reader, station))
        stack.callback(station_task.cancel)

        for round_number in range(2):  # the second time after the autopilot was unplugged
            with serial_autopilot(device, autopilot) as write:
                await until(lambda n=round_number: states(service).count("open") == n + 1)

                async def all_are_known(write: Callable[[bytes], int] = write) -> None:
                    """Speak until each has heard the others: then the companion knows where each of them is."""
                    for speaker in (planner, station, autopilot):
                        speaker.heard.clear()
                    async with asyncio.timeout(60):
                        while not (
                            planner.heard_of(1)
                            and planner.heard_of(255)
                            and station.heard_of(1)
                            and station.heard_of(245)
                            and autopilot.heard_of(245)
                            and autopilot.heard_of(255)
                        ):
                            write(autopilot.heartbeat(*DISARMED_PX4))
                            wire.sendto(planner.heartbeat(18, 8, 0, 0, 4, 3))
                            writer.write(station.heartbeat(6, 8, 0, 0, 4, 3))
                            await asyncio.sleep(0.05)

                await all_are_known()
                attitude = autopilot.pack(mavlink.MAVLink_attitude_message(1, 0.1, 0, 0, 0, 0, 1.0))
                to_station = autopilot.pack(mavlink.MAVLink_command_ack_message(400, 0, 0, 0, 255, 190))
                to_all = autopilot.pack(mavlink.MAVLink_vfr_hud_message(1, 2, 3, 4, 5, 6))
                write(attitude + to_station + to_all)
                setpoint = planner.pack(
                    mavlink.MAVLink_set_position_target_local_ned_message(
                        7, 1, 1, 1, 3576, 1.5, 2.5, -1.2, 0, 0, 0, 0, 0, 0, 0.25, 0
                    )
                )
                wire.sendto(setpoint)
                command = station.pack(
                    mavlink.MAVLink_command_long_message(1, 1, 520, 0, 1, 0, 0, 0, 0, 0, 0)
                )
                writer.write(command)
                last = [planner.pack(mavlink.MAVLink_ping_message(1, 1, 0, 0))]
                wire.sendto(last[0])
                last.append(station.pack(mavlink.MAVLink_ping_message(2, 2, 0, 0)))
                writer.write(last[1])
                await until(lambda last=last: all(map(autopilot.has, last)) and planner.has(last[1]))
                await until(lambda to_all=to_all: planner.has(to_all) and station.has(to_all))
                assert planner.has(attitude)
                assert not station.has(attitude)  # the filter
                assert station.has(to_station)
                assert not planner.has(to_station)
                assert autopilot.has(setpoint)
                assert not station.has(setpoint)
                assert autopilot.has(command)
                assert not planner.has(command)
                assert station.has(last[0])
            await until(lambda: states(service)[-1].startswith("waiting"))
        status = await service.wait_for(
            "status", 60, where=lambda e: e["links"]["link.autopilot"]["opened"] == 2
        )
        assert status["links"]["link.planner.2"]["filtered"] >= 1
        assert status["links"]["link.planner.1"]["filtered"] == 0
        assert set(status["links"]) == {"link.planner.1", "link.planner.2", "link.autopilot"}
        os.kill(service.pid, signal.SIGTERM)
        await until(lambda: service.returncode is not None)  # with a deadline that a loaded machine keeps
    assert service.returncode == 0
    assert service.other_lines == []
