"""From a driver's bytes to a grey image: a view of them where they hold one, decoded where they are compressed."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.frames.capture import DamagedImageError
from companion.frames.v4l2.device import ActiveFormat

_JPEG: Final = ("MJPG", "JPEG")
_PLANE_FIRST: Final = ("GREY", "NV12", "NV21", "YU12", "YV12", "NV16", "422P")
"""Formats that begin with all grey values, one byte each."""
_PACKED_AT: Final = {"YUYV": 0, "YVYU": 0, "UYVY": 1, "VYUY": 1}
"""Formats of two bytes a pixel, and which of them is the grey value."""

READABLE: Final = (
    "GREY", "NV12", "YU12", "NV21", "YV12", "NV16", "422P", "YUYV", "UYVY", "YVYU", "VYUY", *_JPEG,
)  # fmt: skip
"""Four letters of the pixel formats that are understood, the one that costs least first."""


def is_compressed(name: str) -> bool:
    """Return whether a format's images differ in length."""
    return name in _JPEG


def grey_image(data: NDArray[np.uint8], active: ActiveFormat) -> NDArray[np.uint8]:
    """Return the grey values of an image.

    Parameters
    ----------
    data
        (N,) uint8, as the driver gave it.
    active
        What it holds.

    Returns
    -------
    (H, W) uint8: a view of ``data``, with its strides, unless that is compressed.

    Raises
    ------
    companion.frames.capture.DamagedImageError
        When it is not a whole image.
    """
    if active.name in _JPEG:
        return _decoded(data)
    pixel_bytes = 2 if active.name in _PACKED_AT else 1
    row_bytes = active.width_px * pixel_bytes
    line_bytes = max(active.line_bytes, row_bytes)
    needed = line_bytes * (active.height_px - 1) + row_bytes
    if data.size < needed:
        raise DamagedImageError(f"{data.size} of {needed} bytes")
    rows = np.lib.stride_tricks.as_strided(
        data, (active.height_px, row_bytes), (line_bytes, 1), writeable=False
    )
    if pixel_bytes == 1:
        return rows
    return rows[:, _PACKED_AT[active.name] :: 2]


def _decoded(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    # Looked for at the end, where cameras may pad with zeros: the decoder takes half an image for a whole one.
    if not data[-4096:].tobytes().rstrip(b"\0").endswith(b"\xff\xd9"):
        raise DamagedImageError("a JPEG without its end")
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise DamagedImageError("not a JPEG") from error
    if image is None:
        raise DamagedImageError("not a JPEG")
    return np.asarray(image, dtype=np.uint8)
