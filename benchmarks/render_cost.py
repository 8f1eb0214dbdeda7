"""What a rendered picture costs, and how near it comes to a very fine one: `python -m benchmarks.render_cost [WORLD]`.

The fine one is averaged from 16 samples a pixel with anisotropic textures. "rms" is the difference to it in grey values,
"lines" the segments longer than 20 px that LSD finds. One thread of numeric libraries; Mesa takes all processors.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.panda_camera import PandaCamera, RenderQuality
from companion.sim.world.file import load_world
from companion.sim.world.model import World
from detector.camera_model import CameraModel

QUALITIES = {
    "1 sample": RenderQuality(1, 1, 0.0),
    "1 sample, anisotropic 8": RenderQuality(1, 8, 0.0),
    "2 x 2 samples": RenderQuality(2, 1, 0.0),
    "2 x 2 samples, sharper (default)": RenderQuality(),
    "2 x 2 samples, anisotropic 8": RenderQuality(2, 8, 0.0),
    "3 x 3 samples, sharper": RenderQuality(3, 1, -1.0),
}
FINE = RenderQuality(4, 16, 0.0)


def poses(world: World) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Twelve places along the first metres of the straight way."""
    start = np.array([world.start.north_m, world.start.east_m, -world.start.height_m])
    yaw = np.radians(world.start.yaw_deg)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return [
        (start + 0.1 * k * ahead, r_from_euler(0.02, 0.0, yaw + 0.05 * (k - 6)) @ r_body_from_camera(0, 0, 0))
        for k in range(12)
    ]


def timed(work: Callable[[int], object], count: int = 36) -> str:
    """Median of the time, and mean of what all processors spent on it, which a busy machine hardly changes."""
    work(0)
    seconds = []
    spent_s = time.process_time()
    for k in range(count):
        begin = time.perf_counter()
        work(k % 12)
        seconds.append(time.perf_counter() - begin)
    spent_s = time.process_time() - spent_s
    return f"{1e3 * float(np.median(seconds)):6.1f} ms, of processors {1e3 * spent_s / count:6.1f} ms"


def lines(image: NDArray[np.uint8]) -> int:
    found = cv2.createLineSegmentDetector().detect(image)[0]
    ends = np.zeros((0, 4)) if found is None else found.reshape(-1, 4)
    return int((np.hypot(ends[:, 0] - ends[:, 2], ends[:, 1] - ends[:, 3]) > 20).sum())


def main() -> None:
    cv2.setNumThreads(1)
    world = load_world(sys.argv[1] if len(sys.argv) > 1 else "room")
    places = poses(world)
    for size in ((320, 240), (640, 480)):
        camera = CameraModel.from_hfov(*size, 75.0)
        with PandaCamera(world, quality=FINE) as eye:
            fine = [eye.render(camera, *place) for place in places]
            depth_ms = timed(lambda k, eye=eye, camera=camera: eye.depth(camera, *places[k]))  # type: ignore[misc]
        print(
            f"{size[0]} x {size[1]}: depth {depth_ms}, lines of the fine picture {np.mean([lines(i) for i in fine]):.0f}"
        )
        for name, quality in QUALITIES.items():
            with PandaCamera(world, quality=quality) as eye:
                images = [eye.render(camera, *place) for place in places]
                ms = timed(lambda k, eye=eye, camera=camera: eye.render(camera, *places[k]))  # type: ignore[misc]
            off = [np.sqrt(np.mean((a.astype(float) - b) ** 2)) for a, b in zip(images, fine, strict=True)]
            print(
                f"  {name:34s} {ms}  rms {np.mean(off):.2f}  lines {np.mean([lines(i) for i in images]):.0f}"
            )


if __name__ == "__main__":
    main()
