"""The parallax method's figures for one pair: flow with its uncertainty, ranges, the void map over the image and from above."""

from __future__ import annotations

import itertools
import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.drawing import sheet
from detector.drawing.frame import FrameCanvas
from detector.drawing.palette import BLUE, GREY, RED, SKY, WHITE, Colour
from detector.drawing.void_map import BASELINE_M, draw_map_from_above, draw_map_over, range_colour
from detector.parallax.flow_field import FlowField
from detector.parallax.pipeline import PairGeometry, ParallaxResult

Picture = NDArray[np.uint8]

_PANEL_PX: Final = 720
"""Width of a frame in a figure, whatever the size of the image."""
_EVERY: Final = 3
"""Of the grid's columns and rows: more ellipses than these hide each other."""
_SIGMAS: Final = 2.0
_ROUND: Final = np.linspace(0.0, math.tau, 17)
_BAR_RANGES: Final = (0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
_BAR_WIDTH_PX: Final = 84


def figures(later: Picture, result: ParallaxResult) -> dict[str, Picture]:
    """Return the figures that the pair came far enough for, by name.

    ``flow`` needs a picture with texture, ``ranges``, ``map`` and ``polar`` a pair that moved.

    Parameters
    ----------
    later
        (H, W) uint8, the later frame.
    result
        The answer to the pair.
    """
    drawn: dict[str, Picture] = {}
    if result.field is not None and result.field.textured.any():
        drawn["flow"] = flow_figure(later, result.field, result.geometry)
    if result.geometry is not None and result.decision is not None:
        drawn["ranges"] = ranges_figure(later, result.geometry)
        drawn["map"] = map_figure(later, result)
        drawn["polar"] = polar_figure(result)
    return drawn


def flow_figure(later: Picture, field: FlowField, geometry: PairGeometry | None) -> Picture:
    """Return the flow that the rotation leaves, each vector with the two-sigma ellipse of its start, and the focus of expansion with its own.

    Parameters
    ----------
    later
        The later frame.
    field
        All samples.
    geometry
        For the motion; without it the flow is drawn as it was measured.
    """
    canvas = _canvas(later)
    camera = field.camera
    rays = camera.pixel_to_ray(field.earlier_px)
    start_px = (
        field.earlier_px if geometry is None else camera.ray_to_pixel(rays @ geometry.motion.correction.T)
    )
    chosen = field.textured & _thinned(field.later_px) & np.isfinite(start_px).all(axis=1)
    counts = {"believed": 0, "not believed": 0}
    for index in np.flatnonzero(chosen):
        is_believed = bool(field.believed[index])
        counts["believed" if is_believed else "not believed"] += 1
        colour = SKY if is_believed else RED
        if is_believed:
            _ellipse(canvas, start_px[index], np.linalg.inv(field.information[index]), BLUE)
        canvas.vector(start_px[index], field.later_px[index], colour)
    focus_words = "no focus of expansion"
    if geometry is not None:
        focus = camera.ray_to_pixel(geometry.motion.direction_later[None, :])[0]
        sigma_px = camera.fx_px * geometry.motion.direction_sigma_rad
        if geometry.motion.direction_later[2] > 0.0 and np.isfinite(focus).all():
            canvas.cross((float(focus[0]), float(focus[1])))
            _ellipse(canvas, focus, np.eye(2) * sigma_px**2, WHITE)
            focus_words = f"focus of expansion +- {sigma_px:.0f} px"
    rows: list[sheet.Entry] = [
        ("line", SKY, "flow, the rotation taken out; the dot lies in the later frame"),
        ("disc", BLUE, f"{_SIGMAS:g} sigma of its start"),
        ("line", RED, "not believed: the way back ends elsewhere"),
        ("cross", WHITE, f"{focus_words}; ring: {_SIGMAS:g} sigma"),
    ]
    words = f"every {_EVERY}rd column and row: {counts['believed']} believed, {counts['not believed']} not"
    return _figure(canvas.picture, words, rows)


def ranges_figure(later: Picture, geometry: PairGeometry) -> Picture:
    """Return the range of every sample that tells one, larger the surer it is; the others as small grey dots."""
    canvas = _canvas(later)
    samples = geometry.samples
    unit_m = 1.0 if samples.metric else BASELINE_M
    for pixel, inverse, sigma, tells in zip(
        samples.pixels_px, samples.inverse_range, samples.sigma, samples.informative, strict=True
    ):
        at = (float(pixel[0]), float(pixel[1]))
        if not tells:
            canvas.disc(at, 1, GREY, rim_width=0)
            continue
        size = 4 if sigma < 0.1 * abs(inverse) else 3 if sigma < 0.3 * abs(inverse) else 2
        canvas.disc(at, size, range_colour(unit_m / max(float(inverse), 1e-3)), rim_width=0)
    told = int(samples.informative.sum())
    words = f"{told} of {len(samples)} samples tell their range; large: surer than 10 %, middle: 30 %"
    bar = _range_bar(canvas.picture.shape[0], samples.metric)
    return sheet.framed(sheet.captioned(sheet.side_by_side([canvas.picture, bar]), words))


def map_figure(later: Picture, result: ParallaxResult) -> Picture:
    """Return the later frame with the map along its horizon, and the answer."""
    geometry, decision = result.geometry, result.decision
    if geometry is None or decision is None:
        raise ValueError("expected a result with a map, got one without")
    picture = draw_map_over(
        later,
        decision.void_map,
        geometry.camera,
        geometry.frame_from_later,
        samples=geometry.samples,
        gap=decision.gap,
        zoom=_PANEL_PX / later.shape[1],
    )
    known = int(decision.void_map.known.sum())
    words = f"free distance by azimuth: {known} directions known; hollow: unknown, which is not free"
    return sheet.framed(sheet.captioned(picture, words))


def polar_figure(result: ParallaxResult) -> Picture:
    """Return the map from above, the camera looking up."""
    geometry, decision = result.geometry, result.decision
    if geometry is None or decision is None:
        raise ValueError("expected a result with a map, got one without")
    axis = geometry.frame_from_later[:, 2]
    reach = 10.0 if decision.void_map.metric else 40.0
    picture = draw_map_from_above(
        decision.void_map,
        heading_rad=math.atan2(float(axis[1]), float(axis[0])),
        gap=decision.gap,
        size_px=600,
        reach_m=reach,
    )
    return sheet.framed(
        sheet.captioned(picture, "from above: coloured is known free for the vehicle, grey is unknown")
    )


def _canvas(later: Picture) -> FrameCanvas:
    return FrameCanvas(later, _PANEL_PX / later.shape[1])


def _thinned(points_px: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which samples (N,) lie in every third column and row of the grid."""
    keep = np.ones(len(points_px), np.bool_)
    for axis in range(2):
        _, place = np.unique(points_px[:, axis], return_inverse=True)
        keep &= place % _EVERY == _EVERY // 2
    return keep


def _ellipse(
    canvas: FrameCanvas, middle_px: NDArray[np.float64], covariance_px2: NDArray[np.float64], colour: Colour
) -> None:
    values, axes = np.linalg.eigh(covariance_px2)
    radii = _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    rim = middle_px + (np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) * radii) @ axes.T
    for begin, end in itertools.pairwise(rim):
        canvas.line((float(begin[0]), float(begin[1])), (float(end[0]), float(end[1])), colour, 1)


def _figure(picture: Picture, words: str, rows: list[sheet.Entry]) -> Picture:
    key = sheet.one_below_the_other([sheet.legend([row], _PANEL_PX) for row in rows])
    return sheet.framed(sheet.one_below_the_other([sheet.captioned(picture, words), key]))


def _range_bar(height_px: int, metric: bool) -> Picture:
    """Return the scale of colours beside the ranges."""
    bar = np.full((height_px, _BAR_WIDTH_PX, 3), 255, np.uint8)
    rows = np.linspace(0.0, 1.0, height_px)
    near, far = 1.0 / _BAR_RANGES[0], 1.0 / _BAR_RANGES[-1]
    for row, share in enumerate(rows):
        bar[row, :16] = range_colour(1.0 / (far + (near - far) * share))
    for range_m in _BAR_RANGES:
        row = round((1.0 / range_m - far) / (near - far) * (height_px - 1))
        value = range_m if metric else range_m / BASELINE_M
        at = (20, min(max(row, 6), height_px - 6) + 4)
        cv2.putText(bar, f"{value:g}", at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40), 1, cv2.LINE_AA)
    return sheet.captioned(bar, "m" if metric else "baselines")
