"""Draw a detection on its frame, as in the paper's Figs. 3, 5 and 6. Drawing only."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.flow import Tracks
from detector.results import Detection, Direction, NoDetection, SinglePlane

Colour = tuple[int, int, int]

_GREEN: Final[Colour] = (60, 220, 60)
_BLUE: Final[Colour] = (255, 120, 30)
_YELLOW: Final[Colour] = (40, 230, 250)
_RED: Final[Colour] = (60, 60, 250)
_WHITE: Final[Colour] = (255, 255, 255)
_BLACK: Final[Colour] = (0, 0, 0)


def draw(image: NDArray[np.uint8], detection: Detection, tracks: Tracks | None = None) -> NDArray[np.uint8]:
    """Return a colour picture of a detection.

    Flow is coloured by length (dark: short), cluster centres are green dots, the LMCC is blue, lines are yellow,
    candidates are red squares, and the direction is a white-rimmed cross.

    Parameters
    ----------
    image
        (H, W) grey or (H, W, 3) BGR uint8, the second frame; it is not changed.
    detection
        Answer and diagnostics.
    tracks
        The flow vectors; none are drawn when not given.

    Returns
    -------
    (H, W, 3) uint8, BGR.
    """
    picture = np.array(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    unit = max(1, round(picture.shape[1] / 540))
    if tracks is not None and len(tracks):
        _draw_flow(picture, tracks, unit)
    diagnostics = detection.diagnostics
    for x1, y1, x2, y2 in diagnostics.lines_px:
        cv2.line(picture, _whole(x1, y1), _whole(x2, y2), _YELLOW, unit, cv2.LINE_AA)
    for x, y in diagnostics.centre_points_px:
        cv2.circle(picture, _whole(x, y), 4 * unit, _GREEN, cv2.FILLED, cv2.LINE_AA)
    for x, y in diagnostics.candidates_px:
        corner, opposite = _whole(x - 5 * unit, y - 5 * unit), _whole(x + 5 * unit, y + 5 * unit)
        cv2.rectangle(picture, corner, opposite, _RED, 2 * unit)
    if diagnostics.lmcc_px is not None:
        cv2.circle(picture, _whole(*diagnostics.lmcc_px), 6 * unit, _BLUE, cv2.FILLED, cv2.LINE_AA)
    if isinstance(detection, Direction):
        at = _whole(detection.x_px, detection.y_px)
        for colour, thickness in ((_BLACK, 5 * unit), (_WHITE, 2 * unit)):
            cv2.drawMarker(picture, at, colour, cv2.MARKER_CROSS, 28 * unit, thickness, cv2.LINE_AA)
            cv2.circle(picture, at, 12 * unit, colour, thickness, cv2.LINE_AA)
    _write(picture, caption(detection), unit)
    return picture


def caption(detection: Detection) -> str:
    """Return the one line of text for a detection."""
    if isinstance(detection, NoDetection):
        return f"NONE: {detection.reason.value}"
    contact = detection.time_to_contact
    suffix = (
        "" if contact is None else f", contact in {contact.frames:.1f} +- {contact.spread_frames:.1f} frames"
    )
    if isinstance(detection, SinglePlane):
        return f"SINGLE PLANE{suffix}"
    return f"{detection.kind.value} ({detection.x_px:.0f}, {detection.y_px:.0f}){suffix}"


def _draw_flow(picture: NDArray[np.uint8], tracks: Tracks, unit: int) -> None:
    lengths = tracks.lengths_px
    brightest = max(float(np.percentile(lengths, 95.0)), 1e-6)
    levels = np.clip(lengths / brightest * 255.0, 0.0, 255.0).astype(np.uint8)
    colours = np.asarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)).reshape(-1, 3)
    for start, end, (blue, green, red) in zip(tracks.start_px, tracks.end_px, colours.tolist(), strict=True):
        cv2.line(picture, _whole(*start), _whole(*end), (blue, green, red), unit, cv2.LINE_AA)


def _write(picture: NDArray[np.uint8], text: str, unit: int) -> None:
    """Write a line on a dark band at the top, shrunk where it would not fit."""
    scale = 0.5 * unit
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, unit)
    room = picture.shape[1] - 12 * unit
    if width > room > 0:
        scale *= room / width
    band = picture[: height + 12 * unit]
    band[:] = (band * 0.35).astype(np.uint8)
    at = (6 * unit, height + 6 * unit)
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, _WHITE, unit, cv2.LINE_AA)


def _whole(x: float, y: float) -> tuple[int, int]:
    # Points far outside the image would overflow the drawing routines' integers.
    return round(min(max(x, -20000.0), 20000.0)), round(min(max(y, -20000.0), 20000.0))
