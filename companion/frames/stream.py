"""A video stream over the network, decoded by OpenCV's FFmpeg: RTSP, or MPEG-TS over UDP."""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from typing import Final

import cv2
import numpy as np

from companion.errors import SourceError
from companion.frames.capture import CapturedImage, CaptureError, DamagedImageError, nothing_to_give_back

_OPEN_TIMEOUT_MS: Final = 5_000
_STALE_READ_S: Final = 0.002
"""A frame that was there this soon was waiting: newer ones may be behind it."""
_MOST_STALE: Final = 30


class StreamCapture:
    """An open stream; satisfies ``companion.frames.capture.Capture``. Streams do not tell when they were exposed.

    Parameters
    ----------
    url
        ``rtsp://...``, ``rtsps://...`` or ``udp://...``.
    timeout_s
        Longest silence; FFmpeg keeps it, so ``read`` may take as long.
    name
        Of the stream in messages: its URL without the password.

    Raises
    ------
    companion.errors.SourceError
        When there is nobody there, or what comes cannot be decoded.
    """

    def __init__(self, url: str, timeout_s: float, *, name: str) -> None:
        self._timeout_s = timeout_s
        settings = [
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_TIMEOUT_MS),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(1, round(timeout_s * 1e3))),
        ]
        try:
            self._capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, settings)
        except cv2.error as error:
            raise SourceError(f"{name}: cannot be opened: {error.err}") from error
        if not self._capture.isOpened():
            raise SourceError(
                f"{name}: no stream within {_OPEN_TIMEOUT_MS / 1e3:g} s, or none that can be decoded"
            )

    @property
    def facts(self) -> Mapping[str, object]:
        """What the log says of it."""
        number = int(self._capture.get(cv2.CAP_PROP_FOURCC))
        codec = number.to_bytes(4, "little", signed=True).decode("ascii", "backslashreplace").strip("\0 ")
        return {"codec": codec, "rate_hz": round(self._capture.get(cv2.CAP_PROP_FPS), 3)}

    def read(self, timeout_s: float) -> CapturedImage | None:  # noqa: ARG002  FFmpeg keeps its own time-out
        """Return the newest image; waits for as long as the stream may be silent.

        Raises
        ------
        companion.frames.capture.CaptureError
            When the stream has ended or was silent for too long.
        companion.frames.capture.DamagedImageError
            When what came cannot be decoded.
        """
        try:
            stale = -1
            began_s = time.monotonic()
            while True:  # frames that arrived while nobody looked are decoded and passed over
                if not self._capture.grab():
                    raise CaptureError(f"the stream has ended or was silent for {self._timeout_s:g} s")
                stale += 1
                now_s = time.monotonic()
                if now_s - began_s > _STALE_READ_S or stale >= _MOST_STALE:
                    break
                began_s = now_s
            decoded, image = self._capture.retrieve()
            if not decoded or image is None or image.size == 0:
                raise DamagedImageError("cannot be decoded")
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        except cv2.error as error:
            raise DamagedImageError("cannot be decoded") from error
        pixels = np.ascontiguousarray(grey, dtype=np.uint8)
        return CapturedImage(pixels, None, zlib.crc32(pixels.data), stale, nothing_to_give_back)

    def close(self) -> None:
        """Close the connection."""
        self._capture.release()
