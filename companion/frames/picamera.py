"""A Raspberry Pi camera through picamera2, the board's own library: the sensor's time stamp comes with each frame."""

from __future__ import annotations

import importlib
import time
import zlib
from collections.abc import Mapping
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.errors import SourceError
from companion.frames.capture import CapturedImage, CaptureError, DamagedImageError, nothing_to_give_back

_DEFAULT_SIZE_PX: Final = (640, 480)
_BUFFERS: Final = 4


@dataclass(frozen=True, slots=True)
class PicameraWish:
    """How a camera is to be opened; see ``companion.frames.v4l2.capture.V4l2Wish``.

    Attributes
    ----------
    number
        0 for the first camera.
    size_px
        (width, height); None: 640 x 480.
    rate_hz
        Frame rate; 0: as the library has it.
    controls
        libcamera's names, such as ``ExposureTime`` (in microseconds) and ``AnalogueGain``, and values.
    """

    number: int = 0
    size_px: tuple[int, int] | None = None
    rate_hz: float = 0.0
    controls: tuple[tuple[str, str], ...] = ()


def picamera2_module() -> Any:
    """Return the library.

    Raises
    ------
    companion.errors.SourceError
        When it is not installed; says how it is.
    """
    try:
        return importlib.import_module("picamera2")
    except ImportError as error:
        raise SourceError(
            f"picamera2: is not to be had here ({error}): on Raspberry Pi OS, apt install python3-picamera2, "
            "and make the virtual environment with --system-site-packages"
        ) from error


class PicameraCapture:
    """An open, running camera; satisfies ``companion.frames.capture.Capture``.

    Parameters
    ----------
    library
        The module ``picamera2``.
    wish
        How it is to be set up.

    Raises
    ------
    companion.errors.SourceError
        When there is no such camera, or it cannot do what is asked.
    """

    def __init__(self, library: Any, wish: PicameraWish) -> None:
        known = library.Picamera2.global_camera_info()
        if wish.number >= len(known):
            raise SourceError(
                f"picamera2:{wish.number}: no such camera; found {len(known)}: "
                f"{', '.join(str(camera.get('Model', '?')) for camera in known) or 'is its cable in?'}"
            )
        size_px = wish.size_px or _DEFAULT_SIZE_PX
        controls: dict[str, object] = {name: _number(name, value) for name, value in wish.controls}
        if wish.rate_hz:
            period_us = round(1e6 / wish.rate_hz)
            controls["FrameDurationLimits"] = (period_us, period_us)
        try:
            self._camera = library.Picamera2(wish.number)
        except (RuntimeError, IndexError) as error:  # what the library raises, also when the camera is in use
            raise SourceError(f"picamera2:{wish.number}: cannot be opened: {error}") from error
        try:
            # YUV: its first plane is the grey image. No queue: a frame of before the request is none.
            configuration = self._camera.create_video_configuration(
                main={"format": "YUV420", "size": size_px},
                controls=controls,
                buffer_count=_BUFFERS,
                queue=False,
            )
            self._camera.configure(configuration)
            self._camera.start()
            stream = self._camera.camera_configuration()["main"]
        except (RuntimeError, ValueError, KeyError) as error:
            self._camera.close()
            raise SourceError(f"picamera2:{wish.number}: cannot be set up: {error}") from error
        self._size_px: tuple[int, int] = tuple(stream["size"])
        self._line_bytes: int = stream["stride"]
        self._facts = {
            "camera": str(known[wish.number].get("Model", "?")),
            "format": "YUV420",
            "controls": controls,
        }

    @property
    def facts(self) -> Mapping[str, object]:
        """What the log says of it."""
        return self._facts

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the newest image, or None when there is none within the time.

        Raises
        ------
        companion.frames.capture.CaptureError
            When the camera has failed.
        companion.frames.capture.DamagedImageError
            When what came is not a whole image.
        """
        try:
            request = self._camera.capture_request(wait=timeout_s)
        except (FutureTimeoutError, TimeoutError):
            return None
        except RuntimeError as error:
            raise CaptureError(f"failed: {error}") from error
        try:
            data = request.make_buffer("main")
            sensor_ns = request.get_metadata().get("SensorTimestamp")
        finally:
            request.release()
        width_px, height_px = self._size_px
        if data.size < self._line_bytes * height_px:
            raise DamagedImageError(f"{data.size} of {self._line_bytes * height_px} bytes")
        rows = np.asarray(data[: self._line_bytes * height_px], dtype=np.uint8).reshape(height_px, -1)
        return CapturedImage(
            rows[:, :width_px],
            None if sensor_ns is None else monotonic_from_boottime_ns(int(sensor_ns)),
            zlib.crc32(rows.data),
            0,
            nothing_to_give_back,
        )

    def close(self) -> None:
        """Stop and close."""
        self._camera.stop()
        self._camera.close()


def monotonic_from_boottime_ns(boottime_ns: int) -> int:
    """Return CLOCK_MONOTONIC of a time of CLOCK_BOOTTIME; they differ by the time that the machine slept."""
    slept_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
    return boottime_ns - slept_ns


def _number(name: str, value: str) -> float | bool:
    words = value.strip().lower()
    if words in ("true", "false"):
        return words == "true"
    try:
        return int(words, 0)
    except ValueError:
        pass
    try:
        return float(words)
    except ValueError as error:
        raise SourceError(
            f"picamera2: control {name}: found {value!r}; allowed: a number, true or false"
        ) from error
