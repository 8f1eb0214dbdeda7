"""What a calibration leaves behind: the camera file, and a picture of where the board was seen."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibrate.board import View
from companion.calibrate.judge import Judgement
from companion.calibrate.solve import Calibration, Coverage
from detector.camera_model import CameraModel

_WORST_PX = 2.0
_CELL_GREY = (70, 110, 70)


def camera_file(found: Calibration, seen: Coverage, judgement: Judgement, source: str) -> str:
    """Return the camera file (docs/camera-file.md) of a calibration, with its error in comments."""
    model = found.model
    known = (
        f"focal length known to {found.focal_sigma:.2%}, principal point to {found.centre_sigma_px:.1f} px"
    )
    lines = [
        f"# Calibrated from {len(found.used)} views ({found.left_out} left out): {source}",
        f"# {judgement.grade}: error {found.rms_px:.3f} px; {known}; corners in {seen.fraction:.0%} of the image",
        *(f"# {advice}" for advice in judgement.advice),
        f"width_px = {model.width_px}",
        f"height_px = {model.height_px}",
        f"fx_px = {model.fx_px:.4f}",
        f"fy_px = {model.fy_px:.4f}",
        f"cx_px = {model.cx_px:.4f}",
        f"cy_px = {model.cy_px:.4f}",
        f"distortion = [{', '.join(f'{value:.7g}' for value in model.distortion)}]",
    ]
    return "\n".join(line.replace("\n", " ") for line in lines) + "\n"


def coverage_picture(
    model: CameraModel, views: Sequence[View], errors_px: Sequence[NDArray[np.float64]], seen: Coverage
) -> NDArray[np.uint8]:
    """Return a picture of the image's area: green where corners were seen, dots from white (no error) to red.

    Parameters
    ----------
    model
        The camera.
    views
        What was seen.
    errors_px
        For each view, (N,) errors of its corners.
    seen
        The cells.

    Returns
    -------
    (height_px, width_px, 3) uint8, blue first.
    """
    picture = np.zeros((model.height_px, model.width_px, 3), dtype=np.uint8)
    rows, columns = seen.cells.shape
    for row in range(rows):
        for column in range(columns):
            top, left = row * model.height_px // rows, column * model.width_px // columns
            bottom, right = (row + 1) * model.height_px // rows, (column + 1) * model.width_px // columns
            if seen.cells[row, column]:
                picture[top : bottom - 1, left : right - 1] = _CELL_GREY
    radius = max(2, model.width_px // 320)
    for view, errors in zip(views, errors_px, strict=True):
        for (x, y), error_px in zip(view.image_px.tolist(), errors.tolist(), strict=True):
            rest = round(255 * (1.0 - min(error_px / _WORST_PX, 1.0)))
            cv2.circle(picture, (round(x), round(y)), radius, (rest, rest, 255), -1, cv2.LINE_AA)
    return picture
