"""Camera frames as the page gets them: JPEG behind a small header of JSON."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

_LENGTH: Final = struct.Struct("<I")


def encode_jpeg(image: NDArray[np.uint8], *, width_px: int, quality: int) -> bytes:
    """Return a frame as JPEG, made smaller where it is wider than that.

    Parameters
    ----------
    image
        (H, W) uint8.
    width_px
        Widest that it may be.
    quality
        20 to 95.
    """
    if image.shape[1] > width_px:
        height_px = max(1, round(image.shape[0] * width_px / image.shape[1]))
        image = np.asarray(cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)
    encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not encoded:
        raise ValueError(f"a picture of {image.shape} could not be encoded")
    return data.tobytes()


def picture_message(header: Mapping[str, Any], jpeg: bytes) -> bytes:
    """Return a picture as it goes over the socket: the header's length (32 bits, little endian), the header, the JPEG."""
    text = json.dumps(header, separators=(",", ":")).encode()
    return _LENGTH.pack(len(text)) + text + jpeg


def jpeg_of(message: bytes) -> bytes:
    """Return the JPEG of a picture message."""
    (length,) = _LENGTH.unpack_from(message)
    return message[_LENGTH.size + length :]
