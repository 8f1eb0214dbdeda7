"""Flow on a grid, for ranges where SIFT finds nothing: pillars, door frames, plain walls with an edge.

The paper's method answers from SIFT locations (section 2.2), and so does this project's; but how far the way is free is measured, and a pillar
without key points must not be a gap. Dense inverse search (Kroeger et al. 2016, OpenCV's DISOpticalFlow) gives flow everywhere. It is believed where it comes
back to where it started, and where the picture has a gradient **along the epipolar line**: a plain surface shows no flow, and that
must not read as "infinitely far".

Everything happens in a reduced image and in the later camera's orientation: the earlier frame is turned into it first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.flow import Tracks

_MAP_STEP_PX: Final = 16
"""The turned picture's map is worked out at every so many pixels and interpolated: a lens is smooth."""
_WINDOW_PX: Final = 9
"""Of the structure tensor."""


@dataclass(frozen=True, slots=True)
class DenseFlowParams:
    """Settings.

    Attributes
    ----------
    width_px
        Images are reduced to about this width. Larger: finer, slower (10 ms at 320 px on one core).
    step_px
        Of the grid, in the reduced image. Larger: fewer samples.
    round_trip_px
        There and back must end within this, in the reduced image.
    off_line_px
        A vector that leaves its epipolar line by more, where the picture fixes it in that direction too, is a wrong match or something
        that moves.
    least_gradient
        Root mean square of the grey gradient along the epipolar line, grey values a reduced pixel. Larger: stricter.
    sigma_px
        Noise of the flow, in the reduced image.
    """

    width_px: int = 320
    step_px: int = 6
    round_trip_px: float = 0.5
    off_line_px: float = 2.0
    least_gradient: float = 4.0
    sigma_px: float = 0.45

    def __post_init__(self) -> None:
        for name in ("width_px", "step_px", "round_trip_px", "off_line_px", "least_gradient", "sigma_px"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be above 0, found {getattr(self, name)}")


def grid_tracks(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    camera: CameraModel,
    later_from_earlier: NDArray[np.float64],
    translation_later: NDArray[np.float64],
    params: DenseFlowParams,
) -> tuple[Tracks, float]:
    """Return flow vectors on a grid of the later frame, and the noise of one in px of the frame.

    Parameters
    ----------
    earlier, later
        (H, W) uint8.
    camera
        Of both.
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one.
    translation_later
        (3,) from the earlier to the later position, in the later camera's axes, any length.
    params
        Settings.

    Returns
    -------
    Tracks whose starts are in the later camera's orientation (as :func:`detector.flow.derotate` leaves them) and whose ends are
    grid points of the later frame; only those to be believed.
    """
    reduction = max(1, round(later.shape[1] / params.width_px))
    size = (later.shape[1] // reduction, later.shape[0] // reduction)
    small = camera.scaled_to(*size)
    before, now = (
        np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        for image in (earlier, later)
    )
    turned, seen = turned_picture(before, small, later_from_earlier)
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    back = np.asarray(search.calc(now, turned, None), np.float32)  # type: ignore[call-overload]  # no start is allowed
    forth = np.asarray(search.calc(turned, now, None), np.float32)  # type: ignore[call-overload]

    half = params.step_px // 2
    columns, rows = np.meshgrid(
        np.arange(half, size[0], params.step_px), np.arange(half, size[1], params.step_px)
    )
    end = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float32)
    along, across = _epipolar(end, small, translation_later)
    found = back[rows.ravel(), columns.ravel()]
    # An upright edge fixes the flow across itself only: what it says along the epipolar line counts, the rest is noise there.
    start = (end + np.einsum("ij,ij->i", found, along)[:, None] * along).astype(np.float32)
    home = cv2.remap(forth, start[:, None, 0], start[:, None, 1], cv2.INTER_LINEAR).reshape(-1, 2)
    inside = cv2.remap(seen, start[:, None, 0], start[:, None, 1], cv2.INTER_NEAREST, borderValue=0.0)
    believed = np.abs(np.einsum("ij,ij->i", found + home, along)) < params.round_trip_px
    believed &= inside.reshape(-1) > 0
    gradient_along, gradient_across = _gradients(now, end, along, across)
    believed &= gradient_along > params.least_gradient
    off_line = np.abs(np.einsum("ij,ij->i", found, across)) > params.off_line_px
    believed &= ~(off_line & (gradient_across > params.least_gradient))
    to_full, offset = float(reduction), 0.5 * (reduction - 1)
    tracks = Tracks(
        start[believed].astype(np.float64) * to_full + offset,
        end[believed].astype(np.float64) * to_full + offset,
    )
    return tracks, params.sigma_px * to_full


def turned_picture(
    image: NDArray[np.uint8], camera: CameraModel, later_from_earlier: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the earlier picture as the later camera's orientation would have seen it, and where it saw anything (255)."""
    height, width = image.shape
    x = np.linspace(0.0, width - 1.0, max(2, width // _MAP_STEP_PX + 1))
    y = np.linspace(0.0, height - 1.0, max(2, height // _MAP_STEP_PX + 1))
    at = np.stack(np.meshgrid(x, y), axis=-1)
    rays = camera.pixel_to_ray(at.reshape(-1, 2)) @ later_from_earlier
    source = camera.ray_to_pixel(rays).reshape(at.shape)
    offset = np.nan_to_num(source - at, nan=4.0 * width).astype(np.float32)
    # Corner to corner, as linspace has it: cv2.resize would take its grid for cell middles.
    map_x, map_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    to_x, to_y = map_x * ((len(x) - 1) / (width - 1)), map_y * ((len(y) - 1) / (height - 1))
    offset = np.asarray(cv2.remap(offset, to_x, to_y, cv2.INTER_LINEAR), np.float32)
    map_x += offset[..., 0]
    map_y += offset[..., 1]
    turned = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (map_x >= 0) & (map_x <= width - 1) & (map_y >= 0) & (map_y <= height - 1)
    return np.asarray(turned, np.uint8), inside.astype(np.uint8) * 255


def _epipolar(
    points_px: NDArray[np.float32], camera: CameraModel, translation_later: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors along and across the epipolar line at each point, (N, 2); zero on the focus of expansion itself."""
    rays = camera.pixel_to_ray(points_px)
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    along = np.column_stack(
        [
            camera.fx_px * (translation_later[0] - x * translation_later[2]),
            camera.fy_px * (translation_later[1] - y * translation_later[2]),
        ]
    )
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.divide(along, length, out=np.zeros_like(along), where=length > 0.0)
    return along, np.column_stack([-along[:, 1], along[:, 0]])


def _gradients(
    image: NDArray[np.uint8],
    points_px: NDArray[np.float32],
    along: NDArray[np.float64],
    across: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (N,) root mean squares of the grey gradient in two directions, about each point."""
    d_x = cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1.0 / 32.0)
    d_y = cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1.0 / 32.0)
    window = (_WINDOW_PX, _WINDOW_PX)
    column, row = points_px.T.astype(np.intp)
    xx, xy, yy = (
        np.asarray(cv2.blur(product, window), np.float64)[row, column]
        for product in (d_x * d_x, d_x * d_y, d_y * d_y)
    )

    def towards(unit: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = unit.T
        return np.asarray(np.sqrt(np.maximum(0.0, u * u * xx + 2.0 * u * v * xy + v * v * yy)))

    return towards(along), towards(across)
