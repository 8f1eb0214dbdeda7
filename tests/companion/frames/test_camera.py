"""A camera that goes, stalls, freezes and lies: noticed, announced, opened again, and nobody else is disturbed."""

import asyncio
import io
import itertools
import json
import socket
import threading
import time

import pytest
from pymavlink.dialects.v20 import common

from companion.clock import RealClock
from companion.config import Config, LinkConfig, LogConfig, SourceConfig
from companion.errors import SourceError
from companion.frames.camera import CameraLimits, CameraSource
from companion.frames.capture import CaptureError
from companion.frames.judge import ImageJudge
from companion.frames.open import open_source
from companion.frames.v4l2.buffers import N_BUFFERS
from companion.frames.v4l2.capture import V4l2Opener, V4l2Wish
from companion.log import open_log
from companion.service import Service
from tests.fakes.video_kernel import FakeCamera, FakeKernel

NODE = "/dev/video0"
QUICK = CameraLimits(timeout_s=0.1, first_retry_s=0.005, last_retry_s=0.02)
PATIENT = CameraLimits(timeout_s=20.0, first_retry_s=0.005, last_retry_s=0.02)
FROZEN = "the same picture again and again for 0.1 s"
MS = 1_000_000


@pytest.fixture
def events():
    stream = io.StringIO()
    with open_log(LogConfig(), stream) as log:
        yield log, lambda: [json.loads(line) for line in stream.getvalue().splitlines()]


def names(said) -> list[str]:
    return [record["event"] for record in said]


def reasons(said) -> list[str]:
    return [record["reason"] for record in said if record["event"] == "camera_lost"]


async def until(holds) -> None:
    """Wait for what another thread does."""
    for _ in range(4000):
        if holds():
            return
        await asyncio.sleep(0.005)
    raise AssertionError("it never came to hold")


def source_of(kernel: FakeKernel, log, limits: CameraLimits = QUICK) -> CameraSource:
    return CameraSource(
        V4l2Opener(V4l2Wish(NODE), kernel), name=f"v4l2:{NODE}", clock=RealClock(), log=log, limits=limits
    )


async def next_of(frames):
    async with asyncio.timeout(20):
        return await anext(frames)


async def picture_after(frames, mark: int) -> None:
    """Wait for a picture that the camera took after its picture number ``mark``."""
    for _ in range(1000):
        image = (await next_of(frames)).image
        if int.from_bytes(image[0, :4].tobytes(), "little") > mark:
            return
    raise AssertionError("old pictures only")


async def test_gone_and_back_fifty_times_also_under_another_name(events):
    log, said = events
    camera = FakeCamera()
    kernel = FakeKernel({NODE: camera})
    async with source_of(kernel, log, PATIENT) as source:
        frames = source.frames()
        for number in range(50):
            await picture_after(frames, camera.pictures)
            kernel.cameras = {}
            camera.gone = True
            await until(lambda number=number: reasons(said()).count("unplugged") > number)
            camera.gone = False
            kernel.cameras = {f"/dev/video{number % 3}": camera}
        await picture_after(frames, camera.pictures)
    assert reasons(said()).count("unplugged") == source.counts.reconnects == 50
    assert camera.in_use is False


async def test_a_camera_that_has_gone_leaves_nothing_mapped(events):
    log, said = events
    camera = FakeCamera()
    kernel = FakeKernel({NODE: camera})
    service = Service(
        Config(link=LinkConfig(planner="udpin:127.0.0.1:0", autopilot="udpin:127.0.0.1:0")),
        clock=RealClock(),
        log=log,
        open_frames=lambda: source_of(kernel, log, PATIENT),
    )
    running = asyncio.create_task(service.run())
    try:
        await until(lambda: camera.pictures > 10 or running.done())
        assert kernel.mapped() == N_BUFFERS
        camera.gone = True
        await until(lambda: "unplugged" in reasons(said()))
        await until(lambda: kernel.mapped() == 0)
    finally:
        service.stop()
        await asyncio.wait_for(running, 20)


async def test_frozen_twenty_times(events):
    log, said = events
    camera = FakeCamera()
    async with source_of(FakeKernel({NODE: camera}), log) as source:
        frames = source.frames()
        for number in range(20):
            await picture_after(frames, camera.pictures)
            camera.frozen = True
            await until(lambda number=number: reasons(said()).count(FROZEN) > number)
            camera.frozen = False
        await picture_after(frames, camera.pictures)
    assert source.counts.repeated >= 20


@pytest.mark.parametrize(
    ("fault", "value", "reason"),
    [
        ("stalled", True, "no image for 0.1 s"),
        ("damaged", True, "only damaged images (the driver says so) for 0.1 s"),
        ("truncated", True, "only damaged images (1536 of 3072 bytes) for 0.1 s"),
    ],
)
async def test_what_else_goes_wrong_is_announced_once_and_mended(events, fault, value, reason):
    log, said = events
    camera = FakeCamera()
    async with source_of(FakeKernel({NODE: camera}), log) as source:
        frames = source.frames()
        await next_of(frames)
        setattr(camera, fault, value)
        await until(lambda: reason in reasons(said()))
        setattr(camera, fault, False)
        await picture_after(frames, camera.pictures)
    assert source.counts.reconnects >= 1


async def test_a_camera_that_comes_back_with_another_size_is_refused_until_it_is_right(events):
    log, said = events
    camera = FakeCamera(formats={"GREY": {(64, 48): (200.0,)}})
    async with source_of(FakeKernel({NODE: camera}), log) as source:
        frames = source.frames()
        await next_of(frames)
        camera.formats = {"GREY": {(32, 24): (200.0,)}}
        camera.gone = True
        await until(lambda: reasons(said()))
        camera.gone = False
        await until(lambda: source.counts.wrong_size > 0)
        camera.formats = {"GREY": {(64, 48): (200.0,)}}
        camera.gone = True
        await until(lambda: len(reasons(said())) >= 2)
        camera.gone = False
        before = source.counts.wrong_size
        # One of before the plug was pulled may still be waiting.
        assert [(await next_of(frames)).image.shape for _ in range(3)] == [(48, 64)] * 3
        assert before >= 1


async def test_a_camera_that_is_not_there_at_the_start_is_waited_for(events):
    log, said = events
    kernel = FakeKernel({})
    async with source_of(kernel, log) as source:
        await until(lambda: reasons(said()))
        assert source.fault == f"{NODE}: no such camera"
        await asyncio.sleep(0.1)
        kernel.cameras = {NODE: FakeCamera()}
        assert (await next_of(source.frames())).time_of == "exposure"
        assert source.fault == ""
    assert reasons(said()) == [f"{NODE}: no such camera; `companion cameras` lists those that are there"]


async def test_the_newest_frame_wins_and_its_time_is_that_of_its_exposure(events):
    async with source_of(FakeKernel({NODE: FakeCamera()}), events[0]) as source:
        frames = source.frames()
        first = await next_of(frames)
        await until(lambda: source.counts.skipped_late >= 10)
        asked_ns = time.monotonic_ns()
        second = await next_of(frames)
        third = await next_of(frames)
    assert second.seq >= first.seq + 10
    assert asked_ns - 2_000 * MS < second.time_ns <= third.time_ns <= time.monotonic_ns()
    assert second.time_of == "exposure"


@pytest.mark.parametrize(
    ("camera", "refused"),
    [
        (FakeCamera(timestamp_flag=0), False),
        (FakeCamera(time_offset_ns=3_000 * MS), True),
        (FakeCamera(time_offset_ns=-3_000 * MS), True),
    ],
)
async def test_a_time_stamp_that_is_not_of_our_clock_is_the_time_of_arrival_and_says_so(
    events, camera, refused
):
    log, said = events
    limits = CameraLimits(latency_s=0.5)
    async with source_of(FakeKernel({NODE: camera}), log, limits) as source:
        before_ns = time.monotonic_ns()
        frame = await next_of(source.frames())
        now_ns = time.monotonic_ns()
    assert frame.time_of == "arrival"
    assert before_ns - 500 * MS <= frame.time_ns <= now_ns - 500 * MS
    assert (source.counts.time_refused > 0) is refused
    await until(lambda: "camera_opened" in names(said()))  # said after it, by the same thread
    assert names(said()).count("frame_time_refused") == int(refused)


async def test_a_driver_that_does_not_come_back_is_left_to_itself(events):
    log, said = events
    release = threading.Event()
    calls = itertools.count()
    opener = V4l2Opener(V4l2Wish(NODE), FakeKernel({NODE: FakeCamera()}))

    def hangs_the_first_time():
        if next(calls) == 0:
            release.wait(30)
            raise CaptureError("came back at last")
        return opener()

    limits = CameraLimits(hung_s=0.5)
    source = CameraSource(hangs_the_first_time, name="x", clock=RealClock(), log=log, limits=limits)
    try:
        async with source:
            assert (await next_of(source.frames())).seq >= 0  # the newest: on a busy machine not the first
    finally:
        release.set()
    await until(lambda: not any(thread.name == "camera-capture" for thread in threading.enumerate()))
    await until(lambda: "camera_opened" in names(said()))
    assert names(said()) == ["camera_hangs", "camera_opened"]


def test_a_picture_of_before_the_camera_was_opened_again_is_not_new():
    judge = ImageJudge(1.0)
    judge.opened(0)
    assert judge.overdue(2_999 * MS) is None  # a sensor may take its time to start
    assert judge.overdue(3_000 * MS) == "no image for 3 s"
    assert judge.judge((64, 48), 7, 100 * MS) == "good"
    assert judge.overdue(1_099 * MS) is None
    assert judge.overdue(1_100 * MS) == "no image for 1 s"
    judge.opened(1_200 * MS)
    assert judge.judge((64, 48), 7, 1_300 * MS) == "repeated"
    assert judge.judge((64, 49), 8, 1_300 * MS) == "wrong_size"
    assert judge.judge((64, 48), 9, 1_400 * MS) == "good"


def test_a_source_that_is_not_named_or_not_a_camera_is_a_clear_error(events):
    with pytest.raises(SourceError, match=r"source\.url is empty"):
        open_source(SourceConfig(), clock=RealClock(), log=events[0])


def datagrams(camera_is_back: bool, number: int) -> bytes:
    sender = common.MAVLink(None, 255, 190)
    sender.seq = number % 256
    return bytes(common.MAVLink_ping_message(number, number, 1, int(camera_is_back)).pack(sender))


async def test_mavlink_passes_untouched_while_the_camera_goes_and_freezes(events):
    log, said = events
    camera = FakeCamera()
    config = Config(
        link=LinkConfig(planner="udpin:127.0.0.1:0", autopilot="udpin:127.0.0.1:0"),
        source=SourceConfig(timeout_s=0.1),
    )
    service = Service(
        config, clock=RealClock(), log=log, open_frames=lambda: source_of(FakeKernel({NODE: camera}), log)
    )
    running = asyncio.create_task(service.run())
    loop = asyncio.get_running_loop()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
    ):
        try:
            await until(lambda: bool(service.links) or running.done())
            for side, link in zip((planner, autopilot), service.links, strict=True):
                side.setblocking(False)
                side.connect(link.local_address)
            heartbeat = common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(common.MAVLink(None, 1, 1))
            autopilot.send(bytes(heartbeat))
            await until(lambda: bool(service.links[1].peers))
            faults = []
            health = service._with_reason
            service._with_reason = lambda fault: faults.append(health(fault)) or faults[-1]
            sent, got = [], []
            for number in range(60):
                camera.gone = number % 10 in (3, 4)
                camera.frozen = number % 10 in (7, 8)
                sent.append(datagrams(camera.gone, number))
                planner.send(sent[-1])
                while len(got) < len(sent):
                    data = await asyncio.wait_for(loop.sock_recv(autopilot, 2048), 20)
                    if data in sent:
                        got.append(data)
                await asyncio.sleep(0.02)
            assert got == sent
            await until(lambda: "unplugged" in reasons(said()))
            camera.frozen, camera.gone = False, True
            await until(lambda: "no frames from the camera: /dev/video0: no such camera" in faults)
        finally:
            service.stop()
            await asyncio.wait_for(running, 20)
    assert not [record for record in said() if record["level"] in ("error", "critical")]
