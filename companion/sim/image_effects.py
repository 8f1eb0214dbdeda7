"""What a real camera does to a picture: brightness, vignetting, noise, and blur by its own motion. Pure functions.

Motion blur is the mean of several renderings within the exposure. A warp of one picture by a homography would be
cheaper, but knows only rotation: at 1 m/s past a wall half a metre away, 10 ms blur a picture by 5 px at 320 x 240, and
near walls are what this is for. And it costs little: the renderings of one exposure share the samples that a sharp
picture spends on smooth edges, each with one sample a pixel, a little beside the other's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.camera_model import CameraModel

Floats = NDArray[np.float64]

_LEAST_BLUR_PX: Final = 0.5
_LEAST_SUB_FRAMES: Final = 4  # as many samples a pixel as a sharp picture has
_MOST_SUB_FRAMES: Final = 12
_BRIGHT_GREY: Final = 240.0
_MOST_GAIN: Final = 4.0
_NEAR_M: Final = 1.0
"""How near things are thought to be when the number of renderings is chosen."""


@dataclass(frozen=True, slots=True)
class ImageEffects:
    """What a camera adds to an ideal picture.

    Attributes
    ----------
    metered_grey
        Automatic exposure: each picture is brought to this mean grey, as far as its bright parts stay below white; 0 turns it off.
    brightness
        Factor on all grey values after that.
    vignetting
        Part of the light that is lost in the corners, 0 to 1.
    read_noise_grey
        Standard deviation of the noise of a black pixel, grey values.
    shot_noise_grey
        Variance of the noise for each grey value of light, grey values.
    exposure_s
        How long the shutter is open; 0: no motion blur.
    """

    metered_grey: float = 130.0
    brightness: float = 1.0
    vignetting: float = 0.1
    read_noise_grey: float = 1.5
    shot_noise_grey: float = 0.03
    exposure_s: float = 0.008

    def __post_init__(self) -> None:
        limits = {
            "metered_grey": (0.0, 200.0),
            "brightness": (0.01, 10.0),
            "vignetting": (0.0, 1.0),
            "read_noise_grey": (0.0, 100.0),
            "shot_noise_grey": (0.0, 10.0),
            "exposure_s": (0.0, 0.2),
        }
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ValueError(f"{name} must be from {least:g} to {most:g}, got {value}")

    @classmethod
    def none(cls) -> ImageEffects:
        """Return an ideal camera."""
        return cls(metered_grey=0.0, vignetting=0.0, read_noise_grey=0.0, shot_noise_grey=0.0, exposure_s=0.0)


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """How the camera moves, in a frame that stands still.

    Attributes
    ----------
    velocity_ned_m_s
        Local NED.
    rate_ned_rad_s
        Angular velocity as a vector in local NED.
    """

    velocity_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate_ned_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def between(
        cls,
        earlier: tuple[ArrayLike, ArrayLike],
        later: tuple[ArrayLike, ArrayLike],
        time_s: float,
    ) -> CameraMotion:
        """Return the mean motion between two poses, each a position (3,) and r_ned_from_camera (3, 3)."""
        if not time_s > 0.0:
            raise ValueError(f"time_s must be above 0, got {time_s}")
        (p0, r0), (p1, r1) = (
            (np.asarray(p, dtype=np.float64), np.asarray(r, dtype=np.float64)) for p, r in (earlier, later)
        )
        turn = cv2.Rodrigues(r1 @ r0.T)[0].ravel()
        velocity, rate = (p1 - p0) / time_s, turn / time_s
        return cls(
            (float(velocity[0]), float(velocity[1]), float(velocity[2])),
            (float(rate[0]), float(rate[1]), float(rate[2])),
        )

    def blur_px(self, camera: CameraModel, exposure_s: float) -> float:
        """Return about how far the picture of something 1 m away moves within the exposure."""
        angle = np.linalg.norm(self.rate_ned_rad_s) + np.linalg.norm(self.velocity_ned_m_s) / _NEAR_M
        return float(angle) * exposure_s * camera.fx_px


@dataclass(frozen=True, slots=True)
class SubFrame:
    """One rendering of an exposure: its time from the middle, s, and where its samples lie in a pixel."""

    time_s: float
    shift_px: tuple[float, float]


def sub_frames(blur_px: float, exposure_s: float) -> tuple[SubFrame, ...]:
    """Return the renderings that make up an exposure: none where the blur is too small to be seen.

    About one a pixel of blur: fewer would show as ghosts.
    """
    if blur_px < _LEAST_BLUR_PX:
        return ()
    count = min(max(math.ceil(blur_px), _LEAST_SUB_FRAMES), _MOST_SUB_FRAMES)
    # Van der Corput's sequences to bases 2 and 3 spread the samples over the pixel for any count.
    places = np.array([[_radical_inverse(k, 2), _radical_inverse(k, 3)] for k in range(count)])
    places -= places.mean(axis=0)  # the picture as a whole stays where it is
    return tuple(
        SubFrame(exposure_s * ((k + 0.5) / count - 0.5), (float(x), float(y)))
        for k, (x, y) in enumerate(places)
    )


def exposed(
    render: Callable[[Floats, Floats, SubFrame], NDArray[np.uint8]],
    position_ned_m: ArrayLike,
    r_ned_from_camera: ArrayLike,
    motion: CameraMotion,
    frames: tuple[SubFrame, ...],
) -> NDArray[np.float32]:
    """Return the mean of the renderings of one exposure, not rounded.

    Parameters
    ----------
    render
        Gives the picture from a position (3,) and a rotation (3, 3), local NED.
    position_ned_m, r_ned_from_camera
        The pose in the middle of the exposure.
    motion
        Of the camera, taken as steady while the shutter is open.
    frames
        From :func:`sub_frames`; at least one.
    """
    position = np.asarray(position_ned_m, dtype=np.float64)
    rotation = np.asarray(r_ned_from_camera, dtype=np.float64)
    velocity, rate = np.array(motion.velocity_ned_m_s), np.array(motion.rate_ned_rad_s)
    total: NDArray[np.float32] | None = None
    for frame in frames:
        turn = np.asarray(cv2.Rodrigues(rate * frame.time_s)[0], dtype=np.float64)
        picture = render(position + frame.time_s * velocity, turn @ rotation, frame).astype(np.float32)
        total = picture if total is None else total + picture
    if total is None:
        raise ValueError("an exposure needs at least one rendering")
    return total / np.float32(len(frames))


def sensed(
    light: NDArray[np.float32] | NDArray[np.uint8], effects: ImageEffects, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return what the sensor makes of a picture: brightness, vignetting, noise, and rounding to grey values."""
    if light.ndim != 2:
        raise ValueError(f"expected a grey image (height, width), got {light.shape}")
    grey = light.astype(np.float32) * np.float32(effects.brightness * _gain(light, effects.metered_grey))
    if effects.vignetting > 0.0:
        grey *= _vignette(grey.shape[0], grey.shape[1], effects.vignetting)
    if effects.read_noise_grey > 0.0 or effects.shot_noise_grey > 0.0:
        np.minimum(grey, 255.0, out=grey)  # a full well has no more noise than a full well
        variance = np.float32(effects.read_noise_grey**2) + np.float32(effects.shot_noise_grey) * grey
        grey += np.sqrt(variance) * rng.standard_normal(grey.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8))


def _gain(light: NDArray[np.float32] | NDArray[np.uint8], metered_grey: float) -> float:
    """Return the factor of an automatic exposure that meters the mean, and spares the brightest parts but a fiftieth."""
    mean, bright = float(np.mean(light)), float(np.percentile(light[::2, ::2], 98.0))
    if metered_grey <= 0.0 or bright <= 0.0:
        return 1.0
    return min(max(min(metered_grey / mean, _BRIGHT_GREY / bright), 1.0 / _MOST_GAIN), _MOST_GAIN)


def _vignette(height_px: int, width_px: int, lost: float) -> NDArray[np.float32]:
    y = np.linspace(-1.0, 1.0, height_px, dtype=np.float32)[:, None]
    x = np.linspace(-1.0, 1.0, width_px, dtype=np.float32)[None, :]
    return np.asarray(1.0 - np.float32(lost) * (x * x + y * y) / np.float32(2.0), dtype=np.float32)


def _radical_inverse(number: int, base: int) -> float:
    value, place = 0.0, 1.0 / base
    while number:
        number, digit = divmod(number, base)
        value += digit * place
        place /= base
    return value
