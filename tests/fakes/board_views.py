"""Pictures of a calibration board by a camera whose figures are known: ray by ray, so no calibration code is involved."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel

CELL_PX = 40
STEP_PX = 8
MARGIN = 1
"""White around the board, in squares."""


def chessboard_texture(columns: int, rows: int) -> NDArray[np.uint8]:
    """A board of that many inner corners, with its white margin, CELL_PX a square."""
    y, x = np.mgrid[: rows + 1, : columns + 1]
    squares = np.where((x + y) % 2 == 0, 25, 230).astype(np.uint8)
    board = np.kron(squares, np.ones((CELL_PX, CELL_PX), np.uint8))
    return np.pad(board, MARGIN * CELL_PX, constant_values=230)


def charuco_texture(columns: int, rows: int) -> NDArray[np.uint8]:
    """A ChArUco board of that many squares with markers of 0.75 of them, 4X4_50, with its white margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.75, dictionary)
    picture = board.generateImage((columns * CELL_PX, rows * CELL_PX), None, 0, 1)
    return np.pad(picture, MARGIN * CELL_PX, constant_values=255)


class BoardStudio:
    """A camera before which a board is held."""

    def __init__(self, camera: CameraModel, texture: NDArray[np.uint8], square_m: float) -> None:
        self._camera = camera
        self._texture = cv2.GaussianBlur(texture, (0, 0), 1.5)
        self._square_m = square_m
        fine = camera.scaled_to(2 * camera.width_px, 2 * camera.height_px)
        # Exact on a grid; between its points, less than a hundredth of a pixel beside it.
        y, x = np.mgrid[0 : fine.height_px + STEP_PX : STEP_PX, 0 : fine.width_px + STEP_PX : STEP_PX]
        rays = fine.pixel_to_ray(np.column_stack((x.ravel(), y.ravel())).astype(float)).reshape(*x.shape, 3)
        y, x = (place.astype(np.float32) / STEP_PX for place in np.mgrid[: fine.height_px, : fine.width_px])
        self._rays = np.dstack(
            [cv2.remap(rays[..., i].astype(np.float32), x, y, cv2.INTER_LINEAR) for i in range(3)]
        )

    def picture(
        self, offset_px: tuple[float, float], distance_m: float, tilt_deg: tuple[float, float, float]
    ) -> NDArray[np.uint8]:
        """The board's middle at an offset from the image's middle, at a distance, turned about x, y and z."""
        camera = self._camera
        middle = np.array(
            [offset_px[0] / camera.fx_px * distance_m, offset_px[1] / camera.fy_px * distance_m, distance_m]
        )
        rotation = cv2.Rodrigues(np.radians(tilt_deg))[0]
        normal = rotation[:, 2]
        with np.errstate(divide="ignore"):
            reach = (middle @ normal) / (self._rays @ normal)
        on_board = (self._rays * reach[..., None] - middle) @ rotation  # metres from its middle
        height, width = self._texture.shape
        scale = CELL_PX / self._square_m
        x = (on_board[..., 0] * scale + 0.5 * (width - 1)).astype(np.float32)
        y = (on_board[..., 1] * scale + 0.5 * (height - 1)).astype(np.float32)
        fine = cv2.remap(
            self._texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
        )
        return cv2.resize(fine, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)


def poses(camera: CameraModel) -> list[tuple[tuple[float, float], float, tuple[float, float, float]]]:
    """Sixteen ways to hold the board that see the whole image, tilted each way."""
    w, h = camera.width_px, camera.height_px
    places = [(0, 0), (-0.24, -0.2), (0.24, -0.2), (-0.24, 0.2), (0.24, 0.2), (0, -0.2), (0, 0.2), (-0.26, 0)]
    tilts = [
        (0, 35, 0),
        (30, 0, 10),
        (-30, 10, 0),
        (0, -35, -10),
        (20, 25, 5),
        (-20, -25, 0),
        (25, -20, 0),
        (-15, 30, 8),
    ]
    return [
        ((x * w, y * h), distance, tuple(map(float, tilt)))
        for distance, turn in ((0.36, 0), (0.5, 3))
        for (x, y), tilt in zip(places, tilts[turn:] + tilts[:turn], strict=True)
    ]
