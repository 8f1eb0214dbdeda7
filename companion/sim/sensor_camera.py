"""A rendered camera with a real one's faults: frame by frame, the same for the same seed."""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from companion.sim.image_effects import CameraMotion, ImageEffects, SubFrame, exposed, sensed, sub_frames
from companion.sim.panda_camera import PandaCamera, RenderQuality
from companion.sim.world.model import World
from detector.camera_model import CameraModel

_FASTEST_M_S = 20.0
_FASTEST_RAD_S = 10.0


class SampledRenderer(Protocol):
    """A renderer whose samples can be chosen, such as ``companion.sim.panda_camera.PandaCamera``."""

    def render(
        self,
        camera: CameraModel,
        position_ned_m: ArrayLike,
        r_ned_from_camera: ArrayLike,
        *,
        supersample: int | None = None,
        shift_px: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.uint8]:
        """Return the grey image; ``supersample`` samples a pixel and axis, moved by a part of a pixel."""
        ...


def photograph(
    renderer: SampledRenderer,
    camera: CameraModel,
    position_ned_m: ArrayLike,
    r_ned_from_camera: ArrayLike,
    motion: CameraMotion,
    effects: ImageEffects,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """Return one picture by a real camera, (height_px, width_px) uint8.

    Parameters
    ----------
    renderer
        Makes the ideal pictures.
    camera
        Size and lens.
    position_ned_m, r_ned_from_camera
        (3,) and (3, 3): the pose in the middle of the exposure.
    motion
        While the shutter is open.
    effects
        What the sensor does.
    rng
        Draws the noise.
    """
    frames: tuple[SubFrame, ...] = ()
    if effects.exposure_s > 0.0:
        frames = sub_frames(motion.blur_px(camera, effects.exposure_s), effects.exposure_s)
    if not frames:
        return sensed(renderer.render(camera, position_ned_m, r_ned_from_camera), effects, rng)

    def rendered(position: ArrayLike, rotation: ArrayLike, frame: SubFrame) -> NDArray[np.uint8]:
        return renderer.render(camera, position, rotation, supersample=1, shift_px=frame.shift_px)

    return sensed(exposed(rendered, position_ned_m, r_ned_from_camera, motion, frames), effects, rng)


class SensorCamera:
    """Adds a sensor's effects to a renderer; satisfies ``companion.sim.camera_feed.Renderer``.

    It is asked for the frames of one camera in their order: the motion that blurs a frame is that from the frame
    before, and each frame has its own noise.

    Parameters
    ----------
    renderer
        Makes the ideal pictures.
    effects
        What the sensor does to them.
    seed
        Of the noise: the same seed and the same poses give the same pixels.
    frame_period_s
        Time between two frames.
    """

    def __init__(
        self, renderer: SampledRenderer, *, effects: ImageEffects, seed: int, frame_period_s: float
    ) -> None:
        if seed < 0:
            raise ValueError(f"seed must be at least 0, got {seed}")
        if not 0.0 < frame_period_s < 10.0:
            raise ValueError(f"frame_period_s must be above 0 and below 10, got {frame_period_s}")
        self._renderer = renderer
        self._effects = effects
        self._seed = seed
        self._frame_period_s = frame_period_s
        self._frame = 0
        self._last: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @classmethod
    def in_world(
        cls,
        world: World,
        *,
        effects: ImageEffects | None = None,
        seed: int = 0,
        frame_period_s: float = 0.1,
        quality: RenderQuality | None = None,
    ) -> Self:
        """Return one that looks at a world; for ``functools.partial``, so that another process can make it."""
        return cls(
            PandaCamera(world, quality=quality),
            effects=effects if effects is not None else ImageEffects(),
            seed=seed,
            frame_period_s=frame_period_s,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give back what the renderer holds."""
        if isinstance(self._renderer, PandaCamera):
            self._renderer.close()

    def render(
        self, camera: CameraModel, position_ned_m: ArrayLike, r_ned_from_camera: ArrayLike, /
    ) -> NDArray[np.uint8]:
        """Return the next frame, (height_px, width_px) uint8, from the pose in the middle of its exposure."""
        position = np.asarray(position_ned_m, dtype=np.float64)
        rotation = np.asarray(r_ned_from_camera, dtype=np.float64)
        motion = self._motion_to(position, rotation)
        rng = np.random.default_rng([self._seed, self._frame])
        self._frame += 1
        return photograph(self._renderer, camera, position, rotation, motion, self._effects, rng)

    def _motion_to(self, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> CameraMotion:
        last, self._last = self._last, (position.copy(), rotation.copy())
        if last is None:
            return CameraMotion()
        motion = CameraMotion.between(last, self._last, self._frame_period_s)
        if (
            np.linalg.norm(motion.velocity_ned_m_s) > _FASTEST_M_S
            or np.linalg.norm(motion.rate_ned_rad_s) > _FASTEST_RAD_S
        ):
            return CameraMotion()  # put somewhere else, not moved there
        return motion
