"""What capture costs: CPU and copies from the camera to the worker's memory, 640 x 480 at 30/s.

    OMP_NUM_THREADS=1 .venv/bin/python -m benchmarks.capture [SECONDS]

The driver is a stand-in that hands out finished pictures, so what is measured is this program: V4L2 calls, choice of the newest,
judgement (a checksum of each picture), hand-over to the event loop, and the copy into shared memory. "file" decodes a recording on top.
"""

from __future__ import annotations

import asyncio
import io
import resource
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.clock import RealClock
from companion.config import LogConfig, SourceConfig
from companion.frames.camera import CameraSource
from companion.frames.open import open_source
from companion.frames.source import Frame
from companion.frames.v4l2.capture import V4l2Opener, V4l2Wish
from companion.log import open_log
from companion.vision.frame_slots import FrameSlots
from tests.fakes.video_kernel import FakeCamera, FakeKernel, FakeNode

SIZE_PX = (640, 480)
RATE_HZ = 30.0
NODE = "/dev/video0"


class FinishedPictures(FakeNode):
    """A driver whose pictures are there already, and that sleeps as poll(2) does."""

    def wait(self, timeout_s: float) -> bool:
        rest_s = self.next_s - time.monotonic()
        time.sleep(max(0.0, min(rest_s, timeout_s)))
        return rest_s <= timeout_s

    def _encoded(self, grey: Any) -> Any:
        if not hasattr(self, "finished"):
            self.finished = [super(FinishedPictures, self)._encoded(noise(seed)) for seed in range(8)]
        return self.finished[self.sequence % 8]


class FinishedCamera(FakeCamera):
    def picture(self, width_px: int, height_px: int) -> Any:
        return None


class Kernel(FakeKernel):
    def __init__(self, camera: FakeCamera) -> None:
        super().__init__({NODE: camera})
        self.nodes_opened: list[FinishedPictures] = []

    def open(self, path: str) -> FakeNode:
        node = FinishedPictures(self.cameras[path])
        self.nodes_opened.append(node)
        return node


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (SIZE_PX[1], SIZE_PX[0]), dtype=np.uint8)


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


async def cost(frames: AsyncIterator[Frame], seconds: float) -> tuple[float, float, Frame]:
    """Return frames a second and the part of a core that they cost, and one of them."""
    slots = FrameSlots(SIZE_PX[0] * SIZE_PX[1])
    frame = await anext(frames)
    began_s, began_cpu_s, count = time.monotonic(), cpu_s(), 0
    while time.monotonic() - began_s < seconds:
        frame = await anext(frames)
        slots.write(count % 2, frame.image)
        count += 1
    elapsed_s, used_s = time.monotonic() - began_s, cpu_s() - began_cpu_s
    slots.close()
    return count / elapsed_s, used_s / elapsed_s, frame


async def main(seconds: float) -> None:
    print("| source | frames/s | CPU, of a core | copies of the pixels |\n|---|---|---|---|")
    with open_log(LogConfig(), io.StringIO()) as log:
        for name in ("GREY", "NV12", "YUYV", "MJPG"):
            camera = FinishedCamera(formats={name: {SIZE_PX: (RATE_HZ,)}}, period_s=1 / RATE_HZ)
            kernel = Kernel(camera)
            opener = V4l2Opener(V4l2Wish(NODE), kernel)
            async with CameraSource(opener, name=NODE, clock=RealClock(), log=log) as source:
                rate_hz, part, frame = await cost(source.frames(), seconds)
                memory = kernel.nodes_opened[-1].memory
                shared = any(np.shares_memory(frame.image, buffer) for buffer in memory)
            copies = "1, driver to shared memory" if shared else "decoded, then 1"
            print(f"| v4l2 {name} | {rate_hz:.1f} | {part:.1%} | {copies} |")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "noise.avi"
            video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, SIZE_PX, False)
            for number in range(round((seconds + 3) * RATE_HZ)):
                video.write(cv2.GaussianBlur(noise(number % 20), (0, 0), 2))
            video.release()
            async with open_source(SourceConfig(url=f"file:{path}"), clock=RealClock(), log=log) as source:
                rate_hz, part, _ = await cost(source.frames(), seconds)
            print(f"| file, MJPEG | {rate_hz:.1f} | {part:.1%} | decoded, then 1 |")


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0))
