"""Draw the answer to a pair on its second frame, as in the paper's Figs. 3, 5 and 6. Drawing only: nothing is computed here."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.flow import Tracks
from detector.pipeline import PairResult
from detector.results import Detection, Diagnostics, Direction, DirectionKind, NoDetection, SinglePlane

Colour = tuple[int, int, int]

_WHITE: Final[Colour] = (255, 255, 255)
_BLACK: Final[Colour] = (0, 0, 0)
_GREEN: Final[Colour] = (60, 220, 60)
_YELLOW: Final[Colour] = (0, 235, 255)
_RED: Final[Colour] = (60, 60, 255)
_BLUE: Final[Colour] = (255, 130, 30)
_ORANGE: Final[Colour] = (40, 160, 255)

_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_DIM: Final = 0.6
"""The frame is darkened to this share, so that the drawing stands out on bright walls too."""
_LENGTH_QUANTILE: Final = 95.0
"""Flow of this percentile and more has the last colour: a few wild vectors do not take the scale from the rest."""


def draw(image: NDArray[np.uint8], result: PairResult, *, zoom: int = 1) -> NDArray[np.uint8]:
    """Return a colour picture of an answer.

    ============================  ===============================================
    flow vectors N'               blue (short) over green to red (long)
    lines behind the angle gate   orange
    cluster centres               green dots
    LMCC                          yellow disc
    candidates                    squares: elected white, examined and rejected red, others blue
    direction (x_d, y_d)          white cross with a black rim
    ============================  ===============================================

    Parameters
    ----------
    image
        (H, W) grey or (H, W, 3) BGR uint8, the second frame; it is not changed.
    result
        Answer of the pipeline, with its tracks.
    zoom
        Whole factor by which the frame is enlarged first; the text of frames below some 480 px needs it to be read.

    Returns
    -------
    (zoom * H, zoom * W, 3) uint8, BGR.

    Raises
    ------
    ValueError
        When the image is not (H, W) or (H, W, 3) uint8, or the zoom is less than 1.
    """
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"image: expected (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
    if zoom < 1:
        raise ValueError(f"zoom: expected 1 or more, got {zoom}")
    canvas = _Canvas(image, zoom)
    detection, diagnostics = result.detection, result.detection.diagnostics
    canvas.flow(result.tracks)
    for x1, y1, x2, y2 in diagnostics.lines_px:
        canvas.line((x1, y1), (x2, y2), _ORANGE, 2)
    for point in diagnostics.centre_points_px:
        canvas.disc(point, 4, _GREEN)
    for point, colour in _candidates(detection):
        canvas.square(point, 6, colour)
    if diagnostics.lmcc_px is not None:
        canvas.disc(diagnostics.lmcc_px, 6, _YELLOW)
    if isinstance(detection, Direction):
        canvas.cross((detection.x_px, detection.y_px))
    # The text goes where the direction is not.
    at_the_bottom = isinstance(detection, Direction) and detection.y_px < 0.25 * image.shape[0]
    canvas.band([headline(detection), *_figures(diagnostics)], at_the_bottom=at_the_bottom)
    return canvas.picture


def headline(detection: Detection) -> str:
    """Return the answer in one line of plain ASCII, which is all that the drawing font has."""
    if isinstance(detection, NoDetection):
        return f"no detection: {detection.reason.value}"
    if isinstance(detection, SinglePlane):
        words = "SINGLE PLANE"
    else:
        name = "vanishing point" if detection.kind is DirectionKind.VANISHING_POINT else "lowest flow"
        words = f"{name} at ({detection.x_px:.0f}, {detection.y_px:.0f})"
    contact = detection.time_to_contact
    if contact is None:
        return f"{words}, time to contact unknown"
    return f"{words}, contact in {contact.frames:.1f} +- {contact.spread_frames:.1f} frames"


def _figures(diagnostics: Diagnostics) -> list[str]:
    """Return what is known of N..N''', p, n, k and the single-plane test, in at most one line."""
    parts: list[str] = []
    if diagnostics.n_tracks:
        parts.append(
            f"N {diagnostics.n_tracks} > {diagnostics.n_after_distribution}"
            f" > {diagnostics.n_after_length} > {diagnostics.n_after_angle}"
        )
    parts += [
        f"{name} {value}"
        for name, value in (("p", diagnostics.p), ("n", diagnostics.n), ("k", diagnostics.k))
        if value is not None
    ]
    if diagnostics.plane_statistic is not None and diagnostics.plane_threshold is not None:
        parts.append(f"plane {diagnostics.plane_statistic:.2f} / {diagnostics.plane_threshold:.2f}")
    return ["  ".join(parts)] if parts else []


def _candidates(detection: Detection) -> list[tuple[tuple[float, float], Colour]]:
    """Return each candidate with its colour; the one nearest to the LMCC, which the vote examines, last."""
    diagnostics = detection.diagnostics
    points, lmcc = diagnostics.candidates_px, diagnostics.lmcc_px
    if not points or lmcc is None:
        return []
    squared = [(x - lmcc[0]) ** 2 + (y - lmcc[1]) ** 2 for x, y in points]
    examined = squared.index(min(squared))
    elected = isinstance(detection, Direction) and detection.kind is DirectionKind.VANISHING_POINT
    others = [(point, _BLUE) for index, point in enumerate(points) if index != examined]
    return [*others, (points[examined], _WHITE if elected else _RED)]


class _Canvas:
    """A darkened, perhaps enlarged copy of the frame; coordinates are px of the frame."""

    def __init__(self, image: NDArray[np.uint8], zoom: int) -> None:
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        picture = np.asarray(colour, np.uint8).repeat(zoom, axis=0).repeat(zoom, axis=1)
        self.picture: NDArray[np.uint8] = (picture * _DIM).astype(np.uint8)
        self._zoom = zoom
        self._unit = max(1, round(self.picture.shape[1] / 640))  # thickness of a thin stroke

    def flow(self, tracks: Tracks) -> None:
        lengths = tracks.lengths_px
        if not len(lengths):
            return
        longest = max(float(np.percentile(lengths, _LENGTH_QUANTILE)), 1e-6)
        levels = np.clip(lengths / longest * 255.0, 0.0, 255.0).astype(np.uint8)
        colours = np.asarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)).reshape(-1, 3)
        for start, end, (blue, green, red) in zip(tracks.start_px, tracks.end_px, colours, strict=True):
            shade = (int(blue), int(green), int(red))
            self.line((start[0], start[1]), (end[0], end[1]), shade, 1)

    def line(
        self, start: tuple[float, float], end: tuple[float, float], colour: Colour, thickness: int
    ) -> None:
        cv2.line(
            self.picture, self._at(start), self._at(end), colour, thickness * self._unit, lineType=cv2.LINE_AA
        )

    def disc(self, point: tuple[float, float], radius: int, colour: Colour) -> None:
        for size, shade in ((radius + 1, _BLACK), (radius, colour)):
            cv2.circle(
                self.picture,
                self._at(point),
                size * self._unit,
                shade,
                thickness=cv2.FILLED,
                lineType=cv2.LINE_AA,
            )

    def square(self, point: tuple[float, float], half: int, colour: Colour) -> None:
        x, y = self._at(point)
        reach = half * self._unit
        for thickness, shade in ((4, _BLACK), (2, colour)):
            cv2.rectangle(
                self.picture,
                (x - reach, y - reach),
                (x + reach, y + reach),
                shade,
                thickness=thickness * self._unit,
            )

    def cross(self, point: tuple[float, float]) -> None:
        for thickness, colour in ((5, _BLACK), (2, _WHITE)):
            cv2.drawMarker(
                self.picture,
                self._at(point),
                colour,
                markerType=cv2.MARKER_CROSS,
                markerSize=30 * self._unit,
                thickness=thickness * self._unit,
                line_type=cv2.LINE_AA,
            )

    def band(self, rows: list[str], *, at_the_bottom: bool) -> None:
        """Write rows of text on a dark band at the top or bottom, each shrunk where it would not fit."""
        unit, width = self._unit, self.picture.shape[1]
        pitch = 20 * unit
        high = min(pitch * len(rows) + 4 * unit, self.picture.shape[0])
        top = self.picture.shape[0] - high if at_the_bottom else 0
        band = self.picture[top : top + high]
        band[:] = band // 4
        for index, text in enumerate(rows):
            scale = 0.5 * unit
            (length, _), _ = cv2.getTextSize(text, _FONT, scale, unit)
            scale *= min(1.0, max(width - 8 * unit, 1) / max(length, 1))
            at = (4 * unit, top + pitch * (index + 1) - 4 * unit)
            cv2.putText(self.picture, text, at, _FONT, scale, _WHITE, thickness=unit, lineType=cv2.LINE_AA)

    def _at(self, point: tuple[float, float]) -> tuple[int, int]:
        # Points far outside would overflow the drawing routines' integers. A pixel's middle is at its whole coordinate.
        x, y = (
            min(max((value + 0.5) * self._zoom - 0.5, -20000.0), 20000.0)
            for value in (float(point[0]), float(point[1]))
        )
        return round(x), round(y)
