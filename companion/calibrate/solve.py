"""From views of a board to a camera model, and how well it is known. Pure.

The model is OpenCV's pinhole camera with k1, k2, p1, p2 and k3 (``detector.camera_model``), fitted by ``calibrateCameraExtended``:
Zhang, "A Flexible New Technique for Camera Calibration", 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibrate.board import View
from companion.errors import CompanionError
from detector.camera_model import CameraError, CameraModel

LEAST_VIEWS: Final = 6
_OUTLIER_RATIO: Final = 3.0
"""A view with this many times the median error was blurred, or its board bent: it is left out."""
_GRID: Final = (8, 6)
"""The image's cells in which corners are counted."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """Where in the image corners were seen.

    Attributes
    ----------
    cells
        (6, 8) bool: cells of the image with a corner in them.
    """

    cells: NDArray[np.bool_]

    @property
    def fraction(self) -> float:
        """Part of the cells that have been seen."""
        return float(self.cells.mean())

    @property
    def emptiest_place(self) -> str:
        """Where the board should be held next, in words."""
        rows, columns = self.cells.shape
        thirds = (("upper", "middle", "lower"), ("left", "middle", "right"))
        worst, place = 2.0, ""
        for i, vertical in enumerate(thirds[0]):
            for j, horizontal in enumerate(thirds[1]):
                part = self.cells[
                    i * rows // 3 : (i + 1) * rows // 3, j * columns // 3 : -(-(j + 1) * columns // 3)
                ]
                if part.mean() < worst:
                    worst = float(part.mean())
                    place = "middle" if vertical == horizontal else f"{vertical} {horizontal}"
        return place


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibrated camera.

    Attributes
    ----------
    model
        The camera.
    rms_px
        Root mean square distance of the corners from where the model puts them.
    view_rms_px
        The same for each view that was used.
    focal_sigma
        Standard deviation of the focal length as a part of it.
    centre_sigma_px
        Standard deviation of the principal point.
    used
        The views that the model comes from.
    left_out
        How many were left out because they did not fit.
    """

    model: CameraModel
    rms_px: float
    view_rms_px: tuple[float, ...]
    focal_sigma: float
    centre_sigma_px: float
    used: tuple[View, ...]
    left_out: int


def calibrate(views: Sequence[View], width_px: int, height_px: int) -> Calibration:
    """Fit a camera to views of a board.

    Parameters
    ----------
    views
        At least six, from different sides.
    width_px, height_px
        Size of the images.

    Raises
    ------
    companion.errors.CompanionError
        When there are too few, or no camera fits.
    """
    if len(views) < LEAST_VIEWS:
        raise CompanionError(f"the board was found in {len(views)} views; at least {LEAST_VIEWS} are needed")
    first = _solved(views, width_px, height_px)
    limit_px = _OUTLIER_RATIO * float(np.median(first.view_rms_px))
    kept = [view for view, rms_px in zip(views, first.view_rms_px, strict=True) if rms_px <= limit_px]
    if len(kept) == len(views) or len(kept) < LEAST_VIEWS:
        return first
    second = _solved(kept, width_px, height_px)
    return Calibration(
        second.model,
        second.rms_px,
        second.view_rms_px,
        second.focal_sigma,
        second.centre_sigma_px,
        second.used,
        len(views) - len(kept),
    )


def coverage(views: Sequence[View], width_px: int, height_px: int) -> Coverage:
    """Return where in the image the corners of some views lie."""
    columns, rows = _GRID
    cells = np.zeros((rows, columns), dtype=np.bool_)
    for view in views:
        x = np.clip(view.image_px[:, 0] * columns / width_px, 0, columns - 1).astype(int)
        y = np.clip(view.image_px[:, 1] * rows / height_px, 0, rows - 1).astype(int)
        cells[y, x] = True
    return Coverage(cells)


def view_errors_px(model: CameraModel, view: View) -> NDArray[np.float64]:
    """Return how far each corner of a view is from where a model puts it, the board being where it fits best.

    Returns
    -------
    (N,) in px; infinite where no pose of the board fits at all.
    """
    distortion = np.array(model.distortion or (0.0,) * 4)
    board_m, image_px = view.board_m.astype(np.float64), view.image_px.astype(np.float64)
    try:
        solved, rotation, translation = cv2.solvePnP(board_m, image_px, model.matrix, distortion)
        if not solved:
            return np.full(len(board_m), np.inf)
        projected, _ = cv2.projectPoints(board_m, rotation, translation, model.matrix, distortion)
    except cv2.error:
        return np.full(len(board_m), np.inf)
    return np.asarray(np.linalg.norm(projected.reshape(-1, 2) - image_px, axis=1), dtype=np.float64)


def _solved(views: Sequence[View], width_px: int, height_px: int) -> Calibration:
    """Fit with as many distortion coefficients as give every pixel one ray: a sparse border can bend a polynomial over."""
    fault = ""
    for flags, terms in ((0, 5), (cv2.CALIB_FIX_K3, 4), (cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_K2, 4)):
        try:
            rms_px, matrix, distortion, _, _, sigma, _, view_rms = cv2.calibrateCameraExtended(
                [view.board_m for view in views],
                [view.image_px for view in views],
                (width_px, height_px),
                np.eye(3),
                np.zeros(5),
                flags=flags,
            )
            coefficients = tuple(float(value) for value in np.ravel(distortion)[:terms])
            model = CameraModel(
                width_px,
                height_px,
                float(matrix[0, 0]),
                float(matrix[1, 1]),
                float(matrix[0, 2]),
                float(matrix[1, 2]),
                coefficients,
            )
        except (CameraError, cv2.error) as error:
            fault = error.err if isinstance(error, cv2.error) else str(error)
            continue
        sigma = np.ravel(sigma)
        return Calibration(
            model,
            float(rms_px),
            tuple(float(value) for value in np.ravel(view_rms)),
            float(max(sigma[0] / model.fx_px, sigma[1] / model.fy_px)),
            float(max(sigma[2], sigma[3])),
            tuple(views),
            0,
        )
    raise CompanionError(
        f"no camera fits these views: {fault}; hold the board at different angles and near the corners"
    )
