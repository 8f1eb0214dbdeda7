"""A camera on a simulated vehicle for simulated time: rendered where time stands still, handed over without a thread."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from companion.clock import Clock
from companion.frames.source import Frame
from companion.guidance.observation import Pose
from companion.sim.camera_feed import CameraMount, Renderer, render_at
from companion.sim.frame_faults import FrameFaults

if TYPE_CHECKING:
    from detector.camera_model import CameraModel


class SteppedCamera:
    """A frame source (``companion.frames.source.FrameSource``) that renders what a vehicle sees, at a steady rate.

    Parameters
    ----------
    scene
        The world.
    camera
        Size and lens.
    pose
        Gives the vehicle's true pose now, for example ``FakeAutopilot.true_pose``.
    clock
        Where time comes from; it stands still while a frame is rendered.
    rate_hz
        Frames a second.
    faults
        Frames that are lost or late; none later than the time between two frames.
    mount
        How the camera sits on the body.
    on_frame
        Called with each image and its pose when it is exposed.
    """

    def __init__(
        self,
        scene: Renderer,
        camera: CameraModel,
        pose: Callable[[], Pose],
        *,
        clock: Clock,
        rate_hz: float,
        faults: FrameFaults | None = None,
        mount: CameraMount | None = None,
        on_frame: Callable[[NDArray[np.uint8], Pose], None] | None = None,
    ) -> None:
        if not 0.0 < rate_hz <= 240.0:
            raise ValueError(f"rate_hz must be above 0 and at most 240, got {rate_hz}")
        faults = faults if faults is not None else FrameFaults()
        if faults.longest_delay_s >= 1.0 / rate_hz:
            raise ValueError(
                f"faults: frames up to {faults.longest_delay_s:g} s late; allowed: less than 1 / rate_hz"
            )
        self._scene = scene
        self._camera = camera
        self._pose = pose
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self._faults = faults
        self._mount = mount
        self._on_frame = on_frame
        self._seq = 0

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        pass

    async def frames(self) -> AsyncIterator[Frame]:
        """Yield a frame each period; does not end by itself."""
        exposed_ns = self._clock.now_ns()
        while True:
            seq, self._seq = self._seq, self._seq + 1
            delay_ns = self._faults.delay_ns(seq)
            if delay_ns is not None:
                pose = self._pose()
                image = render_at(self._scene, self._camera, pose, self._mount)
                if self._on_frame is not None:
                    self._on_frame(image, pose)
                if delay_ns:
                    await self._clock.sleep_until_ns(exposed_ns + delay_ns)
                yield Frame(image, pose.time_ns, seq)
            exposed_ns += self._period_ns
            await self._clock.sleep_until_ns(exposed_ns)
