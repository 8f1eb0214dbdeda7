"""The void map as pictures: over the image, as a strip of free distances where they are seen; and from above, as a polar plot."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.drawing.frame import FrameCanvas
from detector.drawing.palette import BLACK, GREY, INK, PALE, WHITE, Colour
from detector.drawing.text import put_text
from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import BINS, Gap, VoidMap

_FAR_M: Final = 8.0
_NEAR_M: Final = 0.7
_STRIP_SHARE: Final = 0.05
_RINGS_M: Final = (1.0, 2.0, 4.0, 8.0, 16.0)
_RINGS_BASELINES: Final = (5.0, 10.0, 20.0, 40.0, 80.0)
BASELINE_M: Final = 0.2
"""What colours take a baseline for where its length is not known."""
_HALF_BIN_RAD: Final = math.pi / BINS


def range_colour(range_m: float) -> Colour:
    """Return the colour (BGR) of a range: near vermillion, far blue, as evenly as 1/range goes; the colour-blind can tell them apart."""
    far = (1.0 / _NEAR_M - 1.0 / min(max(range_m, _NEAR_M), _FAR_M)) / (1.0 / _NEAR_M - 1.0 / _FAR_M)
    near_bgr, middle_bgr, far_bgr = (
        np.array([30.0, 80.0, 235.0]),
        np.array([120.0, 220.0, 240.0]),
        np.array([230.0, 150.0, 50.0]),
    )
    mixed = (
        near_bgr + (middle_bgr - near_bgr) * far / 0.5
        if far < 0.5
        else middle_bgr + (far_bgr - middle_bgr) * (far - 0.5) / 0.5
    )
    blue, green, red = (round(float(value)) for value in mixed)
    return blue, green, red


def draw_map_over(
    image: NDArray[np.uint8],
    found: VoidMap,
    camera: CameraModel,
    level_from_camera: NDArray[np.float64],
    *,
    samples: RangedSamples | None = None,
    gap: Gap | None = None,
    zoom: float = 1.0,
) -> NDArray[np.uint8]:
    """Return a frame with the map along its horizon: each known direction in the colour of its free distance, unknown ones hollow.

    Parameters
    ----------
    image
        (H, W) uint8.
    found
        The map, in the level frame.
    camera, level_from_camera
        Its model, and (3, 3) from the camera's axes to the level frame.
    samples
        Drawn as dots in the colour of their range, where they are informative.
    gap
        The answer: a white cross, with its distance.
    zoom
        Of the picture.

    Returns
    -------
    (H zoom, W zoom, 3) uint8, BGR.
    """
    canvas = FrameCanvas(image, zoom)
    unit_m = _unit_m(found.metric)
    if samples is not None:
        for (x, y), inverse, tells in zip(
            samples.pixels_px, samples.inverse_range, samples.informative, strict=True
        ):
            if tells:
                canvas.disc((x, y), 1, range_colour(unit_m / max(float(inverse), 1e-3)), rim_width=0)
    height = _STRIP_SHARE * image.shape[0]
    for index in range(BINS):
        azimuth = float(found.azimuth_rad[index])
        left, right = (
            _pixel_at(azimuth + side * _HALF_BIN_RAD, camera, level_from_camera) for side in (-1, 1)
        )
        if left is None or right is None:
            continue
        corners = np.array(
            [left, right, (right[0], right[1] + height), (left[0], left[1] + height)], np.float64
        )
        placed = np.rint(corners * zoom).astype(np.int32)
        if found.known[index]:
            cv2.fillPoly(
                canvas.picture, [placed], range_colour(unit_m * float(found.free_m[index])), cv2.LINE_AA
            )
        else:
            cv2.polylines(canvas.picture, [placed], True, GREY, 1, cv2.LINE_AA)
    if gap is not None:
        at = _pixel_at(gap.azimuth_rad, camera, level_from_camera)
        if at is not None:
            canvas.cross(at)
            canvas.label(at, f"{gap.free_m:.1f} {'m' if found.metric else 'baselines'}", 20)
    return canvas.picture


def draw_map_from_above(
    found: VoidMap,
    *,
    heading_rad: float = 0.0,
    gap: Gap | None = None,
    confidence: float | None = None,
    size_px: int = 480,
    reach_m: float = 10.0,
) -> NDArray[np.uint8]:
    """Return the map as a polar plot, the camera looking up: what is known free is coloured, what is not known stays grey.

    Parameters
    ----------
    found
        The map, in the level frame.
    heading_rad
        Azimuth that points up.
    gap, confidence
        The answer, and how sure it is.
    size_px
        Side of the picture.
    reach_m
        Distance at its rim, in the map's unit.

    Returns
    -------
    (size_px, size_px, 3) uint8, BGR.
    """
    picture = np.full((size_px, size_px, 3), 255, np.uint8)
    middle, scale = 0.5 * size_px, 0.46 * size_px / reach_m
    unit_m = _unit_m(found.metric)

    def place(azimuth: float, metres: float) -> tuple[int, int]:
        turned = azimuth - heading_rad
        return (
            round(middle + scale * metres * math.sin(turned)),
            round(middle - scale * metres * math.cos(turned)),
        )

    cv2.circle(picture, place(0.0, 0.0), round(scale * reach_m), PALE, cv2.FILLED, cv2.LINE_AA)
    for index in np.flatnonzero(found.known):
        azimuth, free = float(found.azimuth_rad[index]), min(float(found.free_m[index]), reach_m)
        wedge = [
            place(azimuth, 0.0),
            place(azimuth - _HALF_BIN_RAD, free),
            place(azimuth + _HALF_BIN_RAD, free),
        ]
        cv2.fillPoly(picture, [np.array(wedge, np.int32)], range_colour(unit_m * float(found.free_m[index])))
    unit = "m" if found.metric else "baselines"
    for ring_m in _RINGS_M if found.metric else _RINGS_BASELINES:
        if ring_m <= reach_m:
            cv2.circle(picture, place(0.0, 0.0), round(scale * ring_m), GREY, 1, cv2.LINE_AA)
            put_text(
                picture,
                f"{ring_m:g} {unit}",
                place(heading_rad + math.pi, ring_m),
                scale=0.4,
                colour=INK,
                anchor=(0.5, 1.0),
            )
    if gap is not None:
        end = place(gap.azimuth_rad, min(gap.free_m, reach_m))
        for thickness, colour in ((5, BLACK), (2, WHITE)):
            cv2.arrowedLine(picture, place(0.0, 0.0), end, colour, thickness, cv2.LINE_AA, tipLength=0.06)
    cv2.circle(picture, place(0.0, 0.0), 5, INK, cv2.FILLED, cv2.LINE_AA)
    words = "no gap" if gap is None else f"{gap.free_m:.1f} {unit}"
    if confidence is not None:
        words += f", confidence {confidence:.2f}"
    put_text(picture, words, (8, size_px - 10), scale=0.5, colour=INK)
    return picture


def _unit_m(metric: bool) -> float:
    return 1.0 if metric else BASELINE_M


def _pixel_at(
    azimuth_rad: float, camera: CameraModel, level_from_camera: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Return where the horizon lies in a direction; None outside the picture."""
    ray = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0]) @ level_from_camera
    x_px, y_px = camera.ray_to_pixel([ray])[0]
    if not (0 <= x_px <= camera.width_px - 1 and 0 <= y_px <= camera.height_px - 1):
        return None
    return float(x_px), float(y_px)
