"""How soon a camera's trouble is noticed, and how soon it delivers again: fifty times gone and back, twenty times frozen.

    OMP_NUM_THREADS=1 .venv/bin/python -m benchmarks.camera_faults

The camera is a stand-in behind the V4L2 interface; limits are the defaults (timeout_s = 1).
"""

from __future__ import annotations

import asyncio
import io
import json
import time
from collections.abc import AsyncIterator, Callable

import numpy as np

from companion.clock import RealClock
from companion.config import LogConfig
from companion.frames.camera import CameraSource
from companion.frames.source import Frame
from companion.frames.v4l2.capture import V4l2Opener, V4l2Wish
from companion.log import open_log
from tests.fakes.video_kernel import FakeCamera, FakeKernel

NODE = "/dev/video0"
RATE_HZ = 30.0


async def next_new(frames: AsyncIterator[Frame], mark: int) -> None:
    """Wait for a picture that the camera took after its picture number ``mark``."""
    while int.from_bytes((await anext(frames)).image[0, :4].tobytes(), "little") <= mark:
        pass


async def trials(
    source: CameraSource,
    camera: FakeCamera,
    times: int,
    break_it: Callable[[int], None],
    mend_it: Callable[[int], None],
) -> tuple[list[float], list[float], int]:
    """Return seconds to notice, seconds to recover, and how often it recovered."""
    frames = source.frames()
    noticed, recovered = [], []
    for number in range(times):
        await next_new(frames, camera.pictures)
        began_s = time.monotonic()
        break_it(number)
        while not source.fault:  # noqa: ASYNC110  what is waited for happens in another thread
            await asyncio.sleep(0.001)
        noticed.append(time.monotonic() - began_s)
        mark, began_s = camera.pictures, time.monotonic()
        mend_it(number)
        await next_new(frames, mark)
        recovered.append(time.monotonic() - began_s)
    return noticed, recovered, len(recovered)


async def main() -> None:
    camera = FakeCamera(formats={"GREY": {(640, 480): (RATE_HZ,)}}, period_s=1 / RATE_HZ)
    kernel = FakeKernel({NODE: camera})
    opener = V4l2Opener(V4l2Wish(NODE), kernel)

    def unplug(number: int) -> None:
        kernel.cameras, camera.gone = {}, True

    def plug(number: int) -> None:
        kernel.cameras, camera.gone = {f"/dev/video{number % 3}": camera}, False

    def freeze(number: int) -> None:
        camera.frozen = True

    def thaw(number: int) -> None:
        camera.frozen = False

    print(
        "| trouble | times | noticed after, median (longest) | new picture after, median (longest) | recovered |"
    )
    print("|---|---|---|---|---|")
    stream = io.StringIO()
    with open_log(LogConfig(), stream) as log:
        async with CameraSource(opener, name=NODE, clock=RealClock(), log=log) as source:
            for name, times, break_it, mend_it in (
                ("unplugged, back under another name", 50, unplug, plug),
                ("frozen", 20, freeze, thaw),
            ):
                noticed, recovered, count = await trials(source, camera, times, break_it, mend_it)
                figures = [
                    f"{np.median(t) * 1e3:.0f} ms ({max(t) * 1e3:.0f} ms)" for t in (noticed, recovered)
                ]
                print(f"| {name} | {times} | {' | '.join(figures)} | {count} |")
    lost = [
        record
        for record in map(json.loads, stream.getvalue().splitlines())
        if record["event"] == "camera_lost"
    ]
    print(f"{len(lost)} announcements in the log")


if __name__ == "__main__":
    asyncio.run(main())
