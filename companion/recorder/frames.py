"""Frames for a recording: which, and as what."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.config.recorder import RecorderConfig

_PNG_EFFORT: Final = 1
"""zlib's least: larger efforts take several times as long for a tenth less."""


class Frames:
    """Chooses frames by the rate that is recorded, and encodes them.

    Parameters
    ----------
    config
        Rate and format.
    """

    def __init__(self, config: RecorderConfig) -> None:
        self.format = config.frames
        self._interval_ns = round(1e9 / config.frames_hz) if config.frames_hz > 0 else 0
        self._due_ns = 0
        self._options = (
            [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]
            if config.frames == "jpeg"
            else [cv2.IMWRITE_PNG_COMPRESSION, _PNG_EFFORT]
        )

    @property
    def is_lossless(self) -> bool:
        """Whether pixels are recorded as they are."""
        return self.format == "png"

    def picture(self, image: NDArray[np.uint8], taken_ns: int) -> bytes | None:
        """Return a frame, (H, W) uint8, encoded; None where it is not to be recorded."""
        if self.format == "none" or taken_ns < self._due_ns - self._interval_ns // 8:
            return None
        self._due_ns = max(self._due_ns + self._interval_ns, taken_ns + self._interval_ns // 2)
        is_done, picture = cv2.imencode(f".{self.format}", image, self._options)
        if not is_done:
            raise ValueError(f"cannot encode a frame of {image.shape} as {self.format}")
        return picture.tobytes()
