"""The loops of the service: what they tell the switch S, and that nothing but a stop ends them in flight."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time

import cv2
import numpy as np
import pytest
from structlog import make_filtering_bound_logger, wrap_logger
from structlog.testing import CapturingLogger

from companion.clock import RealClock
from companion.config import Config, LinkConfig, SourceConfig
from companion.errors import SourceError
from companion.guidance.observation import DetectionReport
from companion.interception import Interception
from companion.mavlink.identity import Identity, MavState
from companion.service import Service
from companion.vision.supervisor import VisionSupervisor

SEC = 1_000_000_000
LINKS = LinkConfig(planner="udpin:127.0.0.1:0", autopilot="udpin:127.0.0.1:0")


class Sink:
    def __init__(self) -> None:
        self.datagrams: list[bytes] = []

    def send(self, datagram: bytes) -> int:
        self.datagrams.append(datagram)
        return 1


class SteppedClock:
    """Time that passes only when somebody sleeps; ends the test's loop after ``until_ns``."""

    def __init__(self, until_ns: int) -> None:
        self.time_ns = 100 * SEC
        self.until_ns = self.time_ns + until_ns
        self.on_sleep = lambda now_ns: None

    def now_ns(self) -> int:
        return self.time_ns

    async def sleep_until_ns(self, when_ns: int) -> None:
        self.time_ns = max(self.time_ns, when_ns)
        self.on_sleep(self.time_ns)
        if self.time_ns >= self.until_ns:
            raise asyncio.CancelledError
        await asyncio.sleep(0)


def capturing_log():
    """Return a log as the service has it, and the list that its events go to; a bare CapturingLogger cannot bind."""
    captured = CapturingLogger()

    def as_call(logger, method, event):
        return (event.pop("event"),), event

    log = wrap_logger(
        captured, processors=[as_call], wrapper_class=make_filtering_bound_logger("info"), context_class=dict
    )
    return log.bind(), captured


def parts(clock, config: Config):
    bound, log = capturing_log()
    service = Service(config, clock=clock, log=bound)
    sink = Sink()
    flight = Interception(config, identity=Identity(sink, Sink(), now_ns=clock.now_ns), log=bound)
    vision = VisionSupervisor(
        config.detector, config.camera, clock=clock, on_report=lambda report: None, log=bound
    )
    return service, flight, vision, log, sink


async def camera_faults(rate_hz: float, min_rate_hz: float, seconds: float) -> list[str | None]:
    """What health says of a camera, each time that it says something else."""
    clock = SteppedClock(int(seconds * SEC))
    service, flight, vision, _, _ = parts(clock, Config(source=SourceConfig(min_rate_hz=min_rate_hz)))
    service._source_fault = None
    said: list[str | None] = []
    set_fault = flight.set_fault

    def listen(name: str, reason: str | None, now_ns: int) -> None:
        if name == "camera" and (not said or said[-1] != reason):
            said.append(reason)
        set_fault(name, reason, now_ns)

    flight.set_fault = listen
    due_ns = clock.now_ns()

    def frames(now_ns: int) -> None:
        nonlocal due_ns
        while due_ns <= now_ns:
            service._last_frame_ns = due_ns
            flight.statistics.frames.tick(due_ns)
            due_ns += int(SEC / rate_hz)

    clock.on_sleep = frames
    with contextlib.suppress(asyncio.CancelledError):
        await service._health(flight, vision)
    return said


async def test_a_camera_that_is_fast_enough_has_no_fault():
    assert await camera_faults(10.0, 5.0, 20) == [None]


async def test_a_camera_below_the_floor_is_a_fault_after_the_start():
    assert await camera_faults(3.0, 5.0, 20) == [None, "frame rate below the floor"]


async def test_a_camera_exactly_at_the_floor_does_not_flap():
    assert len(await camera_faults(5.02, 5.0, 60)) <= 2


async def test_a_worker_that_does_not_run_is_a_fault():
    clock = SteppedClock(SEC)
    service, flight, vision, _, _ = parts(clock, Config())
    with contextlib.suppress(asyncio.CancelledError):
        await service._health(flight, vision)
    assert "vision worker stopped" in flight.switch._faults.values()
    assert "no frame yet" in flight.switch._faults.values()


async def test_no_heartbeat_where_health_stands_still_and_a_true_state_where_it_runs():
    clock = SteppedClock(10 * SEC)
    service, flight, _, _, sink = parts(clock, Config())
    with contextlib.suppress(asyncio.CancelledError):
        await service._heartbeat(flight, flight._identity)
    assert len(sink.datagrams) == 2  # at 0 s and at 1 s: health last ran at 0 s
    assert flight.mav_state(clock.now_ns()) is MavState.BOOT


async def test_a_report_that_cannot_be_taken_is_logged_once_and_ends_nothing():
    service, flight, _, log, _ = parts(RealClock(), Config())

    def fail(report: DetectionReport, now_ns: int) -> None:
        raise RuntimeError("broken")

    flight.on_report = fail
    for seq in range(5):
        service._take_report(flight, DetectionReport(seq, seq, "none"))
    assert [call.args for call in log.calls] == [("report_failed",)]


async def test_a_recording_that_has_ended_is_a_fault_that_stays(tmp_path):
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((24, 32), 40 * i, np.uint8))
    config = Config(source=SourceConfig(url=f"file:{tmp_path}", playback="fastest"))
    service, flight, vision, log, _ = parts(RealClock(), config)
    vision._was_ready.set()
    await asyncio.wait_for(service._frames(flight, vision), 10)
    assert service._source_fault == "frame source has ended"
    assert flight.statistics.frames_total == 3
    assert ("source_ended",) in [call.args for call in log.calls]


async def test_a_recording_that_is_not_there_ends_the_start_with_its_name(tmp_path):
    config = Config(link=LINKS, source=SourceConfig(url=f"file:{tmp_path}/absent.mp4"))
    service = Service(config, clock=RealClock(), log=capturing_log()[0])
    with pytest.raises(ExceptionGroup) as caught:
        await asyncio.wait_for(service.run(), 20)
    assert caught.group_contains(SourceError, match="absent.mp4")


@pytest.mark.parametrize("after_s", [0.0, 0.05, 0.3, 1.0])
async def test_a_stop_ends_it_within_two_seconds_also_while_source_and_worker_start(after_s):
    with socket.socket() as silent:  # accepts, and never sends a frame
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        config = Config(link=LINKS, source=SourceConfig(url=f"tcp:{address}"))
        service = Service(config, clock=RealClock(), log=capturing_log()[0])
        running = asyncio.create_task(service.run())
        await asyncio.sleep(after_s)
        asked = time.monotonic()
        service.stop()
        await asyncio.wait_for(running, 10)
        assert time.monotonic() - asked < 2.0


async def test_a_sender_that_is_silent_until_the_end_is_announced_with_its_name():
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        config = Config(link=LINKS, source=SourceConfig(url=f"tcp:{address}", timeout_s=0.05))
        log, captured = capturing_log()
        service = Service(config, clock=RealClock(), log=log)
        running = asyncio.create_task(service.run())
        for _ in range(2000):
            if lost := [call for call in captured.calls if call.args == ("frame_stream_lost",)]:
                break
            await asyncio.sleep(0.01)
        service.stop()
        await asyncio.wait_for(running, 10)
    assert lost[0].kwargs == {"source": address, "reason": "nothing for 0.05 s"}
