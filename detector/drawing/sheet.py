"""Pictures side by side with captions, a colour bar and a legend: a figure as a paper has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.drawing.chart import nice_ticks, tick_text
from detector.drawing.palette import BLACK, INK, WHITE, Colour, magnitude_colours
from detector.drawing.text import put_text, text_size

Shape = Literal["disc", "line", "square", "crossed square", "diamond", "cross"]
Entry = tuple[Shape, Colour, str]
"""A mark, its colour and what it means."""

_GAP_PX: Final = 16
_SCALE: Final = 0.6
_ROW_PX: Final = 30


def captioned(picture: NDArray[np.uint8], words: str) -> NDArray[np.uint8]:
    """Return the picture with a line of text below it."""
    strip = np.full((_ROW_PX, picture.shape[1], 3), 255, np.uint8)
    room_px = picture.shape[1] - 4
    put_text(strip, words, (2, 9), scale=_SCALE, anchor=(0.0, 0.0), room_px=room_px)
    return np.vstack([picture, strip])


def side_by_side(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return pictures in a row, on white where they are lower than the highest."""
    high = max(picture.shape[0] for picture in pictures)
    row: list[NDArray[np.uint8]] = []
    for picture in pictures:
        below = np.full((high - picture.shape[0], picture.shape[1], 3), 255, np.uint8)
        row += [np.vstack([picture, below]), np.full((high, _GAP_PX, 3), 255, np.uint8)]
    return np.hstack(row[:-1])


def one_below_the_other(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return pictures in a column, on white where they are narrower than the widest."""
    wide = max(picture.shape[1] for picture in pictures)
    column = [
        np.hstack([picture, np.full((picture.shape[0], wide - picture.shape[1], 3), 255, np.uint8)])
        for picture in pictures
    ]
    return np.vstack(column)


def framed(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture with a white margin."""
    pad = _GAP_PX
    height, width = picture.shape[:2]
    sheet = np.full((height + 2 * pad, width + 2 * pad, 3), 255, np.uint8)
    sheet[pad : pad + height, pad : pad + width] = picture
    return sheet


def colour_bar(smallest: float, largest: float, unit: str, height_px: int) -> NDArray[np.uint8]:
    """Return the scale of magnitudes on a light backdrop, upright, with ticks.

    Parameters
    ----------
    smallest, largest
        Magnitudes of the first and the last colour, which what lies beyond has too: the ticks say so.
    unit
        Written above it.
    height_px
        Of the whole.
    """
    largest = max(largest, smallest + 1e-9)
    span = largest - smallest
    top, bottom, wide = 40, height_px - 12, 22
    ticks = [tick for tick in nice_ticks(smallest, largest, 6) if 0.07 < (tick - smallest) / span < 0.93]
    labels = [(smallest, f"<= {smallest:.3g}" if smallest > 0.0 else "0")]
    labels += [(tick, tick_text(tick)) for tick in ticks]
    labels.append((largest, f">= {largest:.3g}"))
    room = max(text_size(text, _SCALE)[0] for _, text in labels)
    picture = np.full((height_px, wide + 16 + max(room, text_size(unit, _SCALE)[0]) + 4, 3), 255, np.uint8)
    values = np.linspace(largest, smallest, max(bottom - top, 1))
    colours = magnitude_colours(values, largest, smallest=smallest, on_light=True)
    picture[top : top + len(values), :wide] = colours[:, None, :]
    cv2.rectangle(picture, (0, top), (wide, bottom), INK, thickness=1)
    put_text(picture, unit, (0, 8), scale=_SCALE, anchor=(0.0, 0.0))
    for value, text in labels:
        y = round(bottom - (value - smallest) / span * (bottom - top))
        cv2.line(picture, (wide, y), (wide + 6, y), INK, 1)
        put_text(picture, text, (wide + 11, y), scale=_SCALE, anchor=(0.0, 0.5))
    return picture


def legend(entries: Sequence[Entry], width_px: int) -> NDArray[np.uint8]:
    """Return the meaning of marks, in as many rows as they need."""
    rows: list[NDArray[np.uint8]] = []
    x = width_px + 1
    for shape, colour, words in entries:
        needed = 38 + text_size(words, _SCALE)[0]
        if x + needed > width_px:
            rows.append(np.full((_ROW_PX + 4, width_px, 3), 255, np.uint8))
            x = 2
        _symbol(rows[-1], shape, colour, (x + 13, _ROW_PX // 2 + 1))
        put_text(rows[-1], words, (x + 32, _ROW_PX // 2 + 1), scale=_SCALE, anchor=(0.0, 0.5))
        x += needed + 18
    return np.vstack(rows)


def _symbol(row: NDArray[np.uint8], shape: Shape, colour: Colour, at: tuple[int, int]) -> None:
    """Draw a mark as :class:`detector.drawing.frame.FrameCanvas` does."""
    x, y = at
    a, b = (x - 10, y - 10), (x + 10, y + 10)
    c, d = (x - 10, y + 10), (x + 10, y - 10)
    if shape == "disc":
        cv2.circle(row, at, 9, BLACK, thickness=cv2.FILLED, lineType=cv2.LINE_AA)
        cv2.circle(row, at, 8, colour, thickness=cv2.FILLED, lineType=cv2.LINE_AA)
        return
    if shape == "line":
        cv2.line(row, (x - 12, y), (x + 12, y), colour, thickness=4, lineType=cv2.LINE_AA)
        return
    if shape == "cross":
        cv2.drawMarker(row, at, BLACK, markerType=cv2.MARKER_CROSS, markerSize=24, thickness=6)
        cv2.drawMarker(row, at, WHITE, markerType=cv2.MARKER_CROSS, markerSize=22, thickness=2)
        return
    for thickness, shade in ((4, BLACK), (2, colour)):
        if shape == "diamond":
            corners = np.array([[x - 12, y], [x, y - 12], [x + 12, y], [x, y + 12]], np.int32)
            cv2.polylines(row, [corners], True, shade, thickness=thickness, lineType=cv2.LINE_AA)
            continue
        cv2.rectangle(row, a, b, shade, thickness=thickness)
        if shape == "crossed square":
            cv2.line(row, a, b, shade, thickness=thickness, lineType=cv2.LINE_AA)
            cv2.line(row, c, d, shade, thickness=thickness, lineType=cv2.LINE_AA)
