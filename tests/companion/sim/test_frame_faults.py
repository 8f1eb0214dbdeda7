from __future__ import annotations

import asyncio
import functools
import time

import numpy as np
import pytest

from companion.frames.source import Frame
from companion.guidance.observation import Pose
from companion.sim.camera_feed import CameraFeed
from companion.sim.frame_faults import FrameFaults
from companion.sim.scene import square_wall
from companion.sim.stepped_camera import SteppedCamera
from detector.camera_model import CameraModel
from tests.companion.sim.test_camera_feed import read_frame

CAMERA = CameraModel.from_hfov(64, 48, 70.0)
WALL = functools.partial(square_wall, 3.0)


class SteppedClock:
    """Time that passes only by waiting."""

    def __init__(self) -> None:
        self.ns = 0

    def now_ns(self) -> int:
        return self.ns

    async def sleep_until_ns(self, when_ns: int) -> None:
        self.ns = max(self.ns, when_ns)


def test_faults_are_as_frequent_and_as_late_as_asked_for() -> None:
    faults = FrameFaults(drop_rate=0.3, latency_s=0.04, jitter_s=0.02, seed=5)
    delays = [faults.delay_ns(k) for k in range(2000)]
    late_s = np.array([delay for delay in delays if delay is not None]) / 1e9
    assert 1.0 - len(late_s) / 2000 == pytest.approx(0.3, abs=0.04)
    assert 0.04 <= late_s.min() < 0.0405
    assert 0.0595 < late_s.max() <= 0.06
    assert delays == [faults.delay_ns(k) for k in range(2000)]
    assert delays[:50] != [FrameFaults(0.3, 0.04, 0.02, seed=6).delay_ns(k) for k in range(50)]
    assert FrameFaults().delay_ns(3) == 0


@pytest.mark.parametrize(
    "wrong", [{"drop_rate": 1.1}, {"latency_s": -1.0}, {"jitter_s": float("nan")}, {"seed": -1}]
)
def test_faults_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FrameFaults(**wrong)


async def test_a_camera_on_simulated_time_loses_frames_and_hands_them_over_late() -> None:
    clock = SteppedClock()
    faults = FrameFaults(drop_rate=0.4, latency_s=0.03, jitter_s=0.02, seed=1)
    camera = SteppedCamera(
        WALL(),
        CAMERA,
        lambda: Pose(clock.ns, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0)),
        clock=clock,
        rate_hz=10.0,
        faults=faults,
    )
    got: list[tuple[Frame, int]] = []
    async for frame in camera.frames():
        got.append((frame, clock.ns))
        if len(got) == 12:
            break
    delays = {k: faults.delay_ns(k) for k in range(got[-1][0].seq + 1)}
    assert [frame.seq for frame, _ in got] == [k for k, delay in delays.items() if delay is not None]
    assert any(delay is None for delay in delays.values())
    for frame, at_ns in got:
        assert frame.time_ns == frame.seq * 100_000_000
        assert at_ns - frame.time_ns == delays[frame.seq]


def test_a_frame_later_than_the_next_is_refused_on_simulated_time() -> None:
    with pytest.raises(ValueError, match="1 / rate_hz"):
        SteppedCamera(
            WALL(),
            CAMERA,
            lambda: Pose(0, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0)),
            clock=SteppedClock(),
            rate_hz=10.0,
            faults=FrameFaults(latency_s=0.08, jitter_s=0.03),
        )


async def test_a_camera_process_loses_frames_and_sends_them_late() -> None:
    sent: list[int] = []

    def pose() -> Pose:
        sent.append(time.monotonic_ns())
        return Pose(sent[-1], 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0))

    faults = FrameFaults(drop_rate=0.5, latency_s=0.3, seed=2)
    async with CameraFeed(WALL, CAMERA, pose, rate_hz=40.0, faults=faults) as feed:
        reader, writer = await asyncio.open_connection(*feed.address)
        got = []
        async with asyncio.timeout(20):
            for _ in range(8):
                _, _, time_ns = await read_frame(reader)
                got.append((time_ns, time.monotonic_ns()))
        writer.close()
    for time_ns, at_ns in got:
        assert at_ns - time_ns >= 290_000_000
    exposed = [time_ns for time_ns, _ in got]
    assert exposed == sorted(exposed)
    # Half of them are lost: more poses were sent between the first and the last frame than frames came.
    assert sum(exposed[0] <= at <= exposed[-1] for at in sent) > len(got)
