"""Text in pictures. ASCII alone: it is all that OpenCV's font has in every version that is supported."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.drawing.palette import INK, Colour

_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


def text_size(words: str, scale: float, thickness: int = 1) -> tuple[int, int]:
    """Return the width and height in px that the words take."""
    (width, height), _ = cv2.getTextSize(words, _FONT, scale, thickness)
    return int(width), int(height)


def put_text(
    picture: NDArray[np.uint8],
    words: str,
    at: tuple[int, int],
    *,
    scale: float = 0.5,
    colour: Colour = INK,
    thickness: int = 1,
    anchor: tuple[float, float] = (0.0, 1.0),
    room_px: int | None = None,
) -> None:
    """Write one line of text.

    Parameters
    ----------
    picture
        (H, W, 3), written into.
    words
        ASCII.
    at
        Where the anchor comes to stand.
    scale, colour, thickness
        Of the font; 0.5 is some 12 px high.
    anchor
        Point of the text's box, (0, 0) its upper left corner, (1, 1) its lower right.
    room_px
        The text is shrunk to this width where it would be wider.
    """
    width, height = text_size(words, scale, thickness)
    if room_px is not None and width > room_px:
        scale *= max(room_px, 1) / width
        width, height = text_size(words, scale, thickness)
    origin = (round(at[0] - anchor[0] * width), round(at[1] + (1.0 - anchor[1]) * height))
    cv2.putText(picture, words, origin, _FONT, scale, colour, thickness=thickness, lineType=cv2.LINE_AA)


def put_text_upwards(
    picture: NDArray[np.uint8],
    words: str,
    middle: tuple[int, int],
    *,
    scale: float = 0.5,
    colour: Colour = INK,
) -> None:
    """Write one line of text that reads from the bottom to the top, its middle at a point; for the y axis of a chart."""
    width, height = text_size(words, scale)
    pad = height // 2 + 2  # room for what hangs below the line
    patch = np.full((height + 2 * pad, width + 2 * pad, 3), 255, np.uint8)
    put_text(patch, words, (pad, pad), scale=scale, colour=colour, anchor=(0.0, 0.0))
    turned = np.asarray(cv2.rotate(patch, cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8)
    top, left = middle[1] - turned.shape[0] // 2, middle[0] - turned.shape[1] // 2
    y0, x0 = max(top, 0), max(left, 0)
    y1 = min(top + turned.shape[0], picture.shape[0])
    x1 = min(left + turned.shape[1], picture.shape[1])
    if y1 > y0 and x1 > x0:
        place = picture[y0:y1, x0:x1]
        np.minimum(place, turned[y0 - top : y1 - top, x0 - left : x1 - left], out=place)
