"""The calibration board, and where it is in an image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError

_LEAST_CORNERS: Final = 8
"""Fewer corners of a board that is partly out of the image fix no pose well."""
_UNITS_M: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True, slots=True)
class View:
    """The board in one image.

    Attributes
    ----------
    board_m
        (N, 3) float32, the corners on the board; z is 0.
    image_px
        (N, 2) float32, the same corners in the image; pixel centres have whole coordinates.
    """

    board_m: NDArray[np.float32]
    image_px: NDArray[np.float32]


class Board(Protocol):
    """A board that can be found in an image."""

    def find(self, image: NDArray[np.uint8]) -> View | None:
        """Return where the board is in a grey image, (H, W) uint8, or None."""
        ...


class Chessboard:
    """A chessboard, seen whole.

    Parameters
    ----------
    columns, rows
        Inner corners: one fewer than squares.
    square_m
        Side of a square.
    """

    def __init__(self, columns: int, rows: int, square_m: float) -> None:
        self._pattern = (columns, rows)
        y, x = np.mgrid[:rows, :columns]
        corners = np.column_stack((x.ravel(), y.ravel(), np.zeros(columns * rows))) * square_m
        self._board_m = corners.astype(np.float32)

    def find(self, image: NDArray[np.uint8]) -> View | None:
        """Return where the board is, or None where it is not seen whole."""
        found, corners = cv2.findChessboardCornersSB(image, self._pattern, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        return View(self._board_m, _refined(image, np.asarray(corners, dtype=np.float32).reshape(-1, 2)))


def _refined(image: NDArray[np.uint8], corners_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return corners to a fortieth of a pixel; the search that found them leaves a seventh (on rendered boards)."""
    distances = np.linalg.norm(corners_px[:, None] - corners_px[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    # Within the four squares around a corner, and no other one.
    half_px = int(np.clip(0.35 * distances.min(), 2, 5))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 0.001)
    refined = cv2.cornerSubPix(
        image, corners_px.reshape(-1, 1, 2).copy(), (half_px, half_px), (-1, -1), criteria
    )
    return np.asarray(refined, dtype=np.float32).reshape(-1, 2)


class CharucoBoard:
    """A chessboard with markers in its white squares: known also where it is partly out of the image.

    Parameters
    ----------
    columns, rows
        Squares.
    square_m, marker_m
        Sides of a square and of a marker.
    dictionary
        Of the markers, such as ``4X4_50``.

    Raises
    ------
    companion.errors.CompanionError
        When there is no such dictionary, or the markers do not fit into the squares.
    """

    def __init__(self, columns: int, rows: int, square_m: float, marker_m: float, dictionary: str) -> None:
        number = getattr(cv2.aruco, f"DICT_{dictionary.upper()}", None)
        if not isinstance(number, int):
            known = sorted(name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise CompanionError(f"--charuco: found {dictionary!r}; allowed: {', '.join(known)}")
        if not 0 < marker_m < square_m:
            raise CompanionError(
                f"--marker: found {marker_m * 1e3:g} mm; allowed: above 0 and below the square's {square_m * 1e3:g} mm"
            )
        self._board = cv2.aruco.CharucoBoard(
            (columns, rows), square_m, marker_m, cv2.aruco.getPredefinedDictionary(number)
        )
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, image: NDArray[np.uint8]) -> View | None:
        """Return which of its corners are where, or None where too few are seen."""
        corners, ids, *_ = self._detector.detectBoard(image)
        if corners is None or ids is None or len(ids) < _LEAST_CORNERS:
            return None
        all_m = np.asarray(self._board.getChessboardCorners(), dtype=np.float32).reshape(-1, 3)
        board_m = all_m[np.ravel(ids)]
        if np.linalg.matrix_rank(board_m[:, :2] - board_m[0, :2]) < 2:
            return None  # all on one line
        return View(board_m, np.asarray(corners, dtype=np.float32).reshape(-1, 2))


def board_from_words(board: str, square: str, charuco: str, marker: str) -> Board:
    """Return the board that the command line describes.

    Parameters
    ----------
    board
        ``9x6``: inner corners of a chessboard, squares of a ChArUco board.
    square, marker
        Sides with a unit, ``24mm``.
    charuco
        Dictionary of the markers; "" for a plain chessboard.

    Raises
    ------
    companion.errors.CompanionError
        When one of them is not right.
    """
    match = re.fullmatch(r"([0-9]{1,2})x([0-9]{1,2})", board.lower())
    if match is None or not (3 <= int(match[1]) <= 50 and 3 <= int(match[2]) <= 50):
        raise CompanionError(
            f"--board: found {board!r}; allowed: COLUMNSxROWS from 3x3 to 50x50, such as 9x6"
        )
    columns, rows = int(match[1]), int(match[2])
    square_m = _length_m("--square", square)
    if not charuco:
        return Chessboard(columns, rows, square_m)
    if not marker:
        raise CompanionError("--marker: needed with --charuco: the side of a marker, such as 18mm")
    return CharucoBoard(columns, rows, square_m, _length_m("--marker", marker), charuco)


def _length_m(option: str, text: str) -> float:
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*(mm|cm|m)", text.strip().lower())
    length_m = float(match[1]) * _UNITS_M[match[2]] if match else 0.0
    if not 1e-3 <= length_m <= 1.0:
        raise CompanionError(f"{option}: found {text!r}; allowed: 1mm to 1m with its unit, such as 24mm")
    return length_m
