"""A frame with marks on it. Coordinates are px of the frame, whatever its size in the picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.drawing.palette import BLACK, INK, WHITE, Colour, magnitude_colours
from detector.drawing.text import put_text, text_size
from detector.flow import Tracks

Backdrop = Literal["dark", "light"]

_DIM: Final = 0.6
"""A dark backdrop is the frame times this, so that the drawing stands out on bright walls too."""
_FADED: Final = 0.35
"""A light backdrop keeps this share of the frame's contrast, under white."""
_FAR_PX: Final = 20000.0
"""Points further outside would overflow the drawing routines' integers."""
_SHIFT: Final = 4
"""Binary digits behind the point in the coordinates of thin lines: flow of a few px keeps its direction."""


class FrameCanvas:
    """A darkened or faded copy of a frame, perhaps of another size, to draw on.

    Parameters
    ----------
    image
        (H, W) grey or (H, W, 3) BGR uint8; it is not changed.
    zoom
        Size of the picture over that of the frame.
    backdrop
        ``dark`` for bright marks, ``light`` for print.

    Attributes
    ----------
    picture
        (zoom H, zoom W, 3) uint8, BGR.
    unit
        Thickness in px of a thin stroke.
    """

    def __init__(self, image: NDArray[np.uint8], zoom: float = 1.0, backdrop: Backdrop = "dark") -> None:
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        if zoom != 1.0:
            size = (max(1, round(image.shape[1] * zoom)), max(1, round(image.shape[0] * zoom)))
            way = cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_CUBIC
            colour = cv2.resize(colour, size, interpolation=way)
        shown = np.asarray(colour, np.float32)
        shown = shown * _DIM if backdrop == "dark" else 255.0 - (255.0 - shown) * _FADED
        self.picture: NDArray[np.uint8] = shown.astype(np.uint8)
        self.unit = max(1, round(self.picture.shape[1] / 640))
        self._zoom = zoom
        self._on_light = backdrop == "light"

    def flow(
        self,
        tracks: Tracks,
        magnitudes: NDArray[np.float64],
        largest: float,
        *,
        smallest: float = 0.0,
        thickness: int = 1,
    ) -> None:
        """Draw flow vectors, each in the colour of its magnitude (:func:`detector.drawing.palette.magnitude_colours`)."""
        colours = magnitude_colours(magnitudes, largest, smallest=smallest, on_light=self._on_light)
        for start, end, (blue, green, red) in zip(tracks.start_px, tracks.end_px, colours, strict=True):
            self.vector(start, end, (int(blue), int(green), int(red)), thickness)

    def vector(
        self, start: NDArray[np.float64], end: NDArray[np.float64], colour: Colour, thickness: int = 1
    ) -> None:
        """Draw one flow vector: a line, with a dot at its end in the second frame."""
        ends = [tuple(round(v * 2**_SHIFT) for v in self._place((p[0], p[1]))) for p in (start, end)]
        cv2.line(self.picture, ends[0], ends[1], colour, thickness * self.unit, cv2.LINE_AA, _SHIFT)
        radius = round(1.2 * thickness * self.unit * 2**_SHIFT)
        cv2.circle(self.picture, ends[1], radius, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def line(
        self, start: tuple[float, float], end: tuple[float, float], colour: Colour, thickness: int = 2
    ) -> None:
        """Draw a line segment."""
        cv2.line(
            self.picture, self._at(start), self._at(end), colour, thickness * self.unit, lineType=cv2.LINE_AA
        )

    def disc(
        self, point: tuple[float, float], radius: int, colour: Colour, rim: Colour = BLACK, rim_width: int = 1
    ) -> None:
        """Draw a filled disc with a rim: a cluster centre, or the LMCC."""
        for size, shade in ((radius + rim_width, rim), (radius, colour)):
            cv2.circle(
                self.picture,
                self._at(point),
                size * self.unit,
                shade,
                thickness=cv2.FILLED,
                lineType=cv2.LINE_AA,
            )

    def square(
        self, point: tuple[float, float], half: int, colour: Colour, *, crossed_out: bool = False
    ) -> None:
        """Draw a hollow square: a vanishing-point candidate, crossed out where it was rejected."""
        x, y = self._at(point)
        reach = half * self.unit
        corners = (
            (x - reach, y - reach),
            (x + reach, y + reach),
            (x - reach, y + reach),
            (x + reach, y - reach),
        )
        for thickness, shade in ((4, BLACK), (2, colour)):
            width = thickness * self.unit
            cv2.rectangle(self.picture, corners[0], corners[1], shade, thickness=width)
            if crossed_out:
                for a, b in (corners[:2], corners[2:]):
                    cv2.line(self.picture, a, b, shade, thickness=width, lineType=cv2.LINE_AA)

    def diamond(self, point: tuple[float, float], half: int, colour: Colour) -> None:
        """Draw a hollow diamond: a candidate that the vote did not look at."""
        x, y = self._at(point)
        reach = round(1.3 * half * self.unit)
        corners = np.array([[x - reach, y], [x, y - reach], [x + reach, y], [x, y + reach]], np.int32)
        for thickness, shade in ((4, BLACK), (2, colour)):
            cv2.polylines(
                self.picture, [corners], True, shade, thickness=thickness * self.unit, lineType=cv2.LINE_AA
            )

    def cross(self, point: tuple[float, float]) -> None:
        """Draw the direction (x_d, y_d): a white cross with a black rim."""
        for thickness, colour in ((5, BLACK), (2, WHITE)):
            cv2.drawMarker(
                self.picture,
                self._at(point),
                colour,
                markerType=cv2.MARKER_CROSS,
                markerSize=30 * self.unit,
                thickness=thickness * self.unit,
                line_type=cv2.LINE_AA,
            )

    def label(self, point: tuple[float, float], words: str, away: int) -> None:
        """Write words beside a point, on white so that they can be read over anything."""
        x, y = self._at(point)
        scale = 0.6 * self.unit
        width, height = text_size(words, scale, self.unit)
        left = x + away * self.unit
        if left + width + 4 > self.picture.shape[1]:
            left = x - away * self.unit - width
        pad = 3 * self.unit
        corner = (left + width + pad, y + height // 2 + pad)
        cv2.rectangle(self.picture, (left - pad, y - height // 2 - pad), corner, WHITE, thickness=cv2.FILLED)
        put_text(
            self.picture, words, (left, y), scale=scale, colour=INK, thickness=self.unit, anchor=(0.0, 0.5)
        )

    def border(self, colour: Colour) -> None:
        """Draw a border round the picture."""
        height, width = self.picture.shape[:2]
        cv2.rectangle(self.picture, (0, 0), (width - 1, height - 1), colour, thickness=4 * self.unit)

    def band(self, rows: Sequence[str], *, at_the_bottom: bool) -> None:
        """Write rows of text on a dark band at the top or bottom, each shrunk where it would not fit."""
        unit, width = self.unit, self.picture.shape[1]
        pitch = 20 * unit
        high = min(pitch * len(rows) + 4 * unit, self.picture.shape[0])
        top = self.picture.shape[0] - high if at_the_bottom else 0
        band = self.picture[top : top + high]
        band[:] = band // 4
        for index, words in enumerate(rows):
            at = (4 * unit, top + pitch * (index + 1) - 4 * unit)
            put_text(
                self.picture,
                words,
                at,
                scale=0.5 * unit,
                colour=WHITE,
                thickness=unit,
                room_px=width - 8 * unit,
            )

    def _place(self, point: tuple[float, float]) -> tuple[float, float]:
        # A pixel's middle is at its whole coordinate.
        x, y = (
            min(max((float(value) + 0.5) * self._zoom - 0.5, -_FAR_PX), _FAR_PX)
            for value in (point[0], point[1])
        )
        return x, y

    def _at(self, point: tuple[float, float]) -> tuple[int, int]:
        x, y = self._place(point)
        return round(x), round(y)
