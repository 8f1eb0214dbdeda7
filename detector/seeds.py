"""Where the optical flow starts: SIFT locations (paper section 2.1), looked for no more than is needed.

SIFT is what the paper's method spends its time on, in proportion to the pixels. So the fast path

- keeps only so many locations, evenly over the frame, so that the density stays that of SIFT;
- carries locations from pair to pair: the ends of the vectors found in a frame are the starts when that frame is the earlier one. A few
  tiles of the frame are looked at anew: those that lost most, and each in its turn, so that new things come in and old locations go;
- only counts in the later frame of a first loop, in a reduced frame where that holds enough. (A frame with too few key points is always one
  that was looked at whole, so "too few features" means the same as in the paper.)

Looking for the locations themselves in a reduced frame was tried: SIFT's finest octave has most of them, and without it the answers differ.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.features import feature_locations
from detector.params import DetectorParams

_TILE_COLUMNS: Final = 8
_TILE_ROWS: Final = 6
_TILES: Final = _TILE_COLUMNS * _TILE_ROWS
_TILE_STRIDE: Final = 19
"""From one tile to the next: coprime to their number, so that each has its turn, and neighbours are not looked at one after the other."""
_TILE_MARGIN_PX: Final = 16
"""SIFT finds nothing near a border."""
_BLOCK_PX: Final = 640
_BLOCK_MARGIN_PX: Final = 48
"""A large frame is looked at in blocks: its scale space does not fit a cache."""
_ENOUGH_LEFT: Final = 0.6
"""Share of the locations last found in a whole frame; with fewer left, more tiles are looked at ..."""
_MORE_TILES: Final = 3
"""... so many times as many ..."""
_LEAST_LEFT: Final = 0.3
"""... and with fewer than this share, a whole frame."""
_LEAST_WIDTH_PX: Final = 160
"""Frames are not reduced below this: structure gets lost."""


class SeedFinder:
    """Finds the locations that the flow starts from, and keeps them fresh from pair to pair.

    Parameters
    ----------
    params
        Settings.
    """

    def __init__(self, params: DetectorParams) -> None:
        self._params = params
        self.reset()

    def reset(self) -> None:
        """Forget what is known of the scene."""
        self._turn = 0
        self._kept_of_whole = 0
        self._in_tile = np.zeros(_TILES)

    def all_of(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return every SIFT location of a frame, (N, 2) px: the exact path."""
        return self._locations(image)

    def count(self, image: NDArray[np.uint8], least: int) -> int:
        """Return the number of locations in a frame, or at least ``least`` where a reduced frame holds as many."""
        found = 0
        for reduction in (4, 2, 1):
            if reduction == 1:
                found = len(self._locations(image))
            elif image.shape[1] >= reduction * _LEAST_WIDTH_PX:
                height, width = image.shape
                size = (width // reduction, max(1, height // reduction))
                reduced = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
                found = len(self._locations(reduced))
            if found >= least:
                break
        return found

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], int]:
        """Return the locations to start from in a frame that nothing is known of, and how many were found.

        Returns
        -------
        (N, 2) float32 px, N at most ``fast_first_points``; and the number before they were thinned.
        """
        height, width = image.shape
        rows, columns = math.ceil(height / _BLOCK_PX), math.ceil(width / _BLOCK_PX)
        found = np.concatenate(
            [
                self._part(image, _box(index, rows, columns, image), _BLOCK_MARGIN_PX)
                for index in range(rows * columns)
            ]
        )
        kept = _thinned(found, self._params.fast_first_points)
        self._kept_of_whole = min(len(found), self._params.fast_points)
        self._in_tile = np.bincount(_tile_of(found, image), minlength=_TILES).astype(np.float64)
        return kept, len(found)

    def renew(self, image: NDArray[np.uint8], carried_px: NDArray[np.floating]) -> NDArray[np.float32] | None:
        """Return the locations of a frame that the vectors of a pair end in: theirs, and new ones in some tiles.

        Parameters
        ----------
        image
            (H, W) uint8, the later frame of the pair.
        carried_px
            (N, 2) ends of the vectors.

        Returns
        -------
        (N, 2) float32 px; None where so many were lost that the frame has to be looked at whole, or nothing is known of the scene.
        """
        if self._kept_of_whole == 0:
            return None
        params = self._params
        carried = _thinned(np.asarray(carried_px, np.float32), params.fast_points)
        tile_of = _tile_of(carried, image)
        for tile in self._tiles_to_renew(np.bincount(tile_of, minlength=_TILES)):
            fresh = self._part(image, _box(tile, _TILE_ROWS, _TILE_COLUMNS, image), _TILE_MARGIN_PX)
            self._in_tile[tile] = len(fresh)
            fresh = _thinned(fresh, math.ceil(self._share() * len(fresh)))
            carried = np.concatenate([carried[tile_of != tile], fresh])
            tile_of = np.concatenate([tile_of[tile_of != tile], np.full(len(fresh), tile)])
        return carried if len(carried) >= _LEAST_LEFT * self._kept_of_whole else None

    def _share(self) -> float:
        """Return the share of a tile's locations that is wanted: that of all."""
        return min(1.0, self._params.fast_points / max(1.0, float(self._in_tile.sum())))

    def _tiles_to_renew(self, have: NDArray[np.intp]) -> list[int]:
        """Return the tile whose turn it is, and those that lack most of what was found in them."""
        lacking = self._share() * self._in_tile - have
        tiles = self._params.fast_tiles
        if have.sum() < _ENOUGH_LEFT * self._kept_of_whole:
            tiles *= _MORE_TILES
        worst = np.argsort(-lacking, kind="stable")[:tiles]
        turn = self._turn
        self._turn = (self._turn + _TILE_STRIDE) % _TILES
        return [turn, *(int(tile) for tile in worst if lacking[tile] >= 1.0 and tile != turn)][:tiles]

    def _part(
        self, image: NDArray[np.uint8], box: tuple[int, int, int, int], margin_px: int
    ) -> NDArray[np.float32]:
        """Return the locations within left, top, right, bottom (exclusive)."""
        left, top, right, bottom = box
        x0, y0 = max(0, left - margin_px), max(0, top - margin_px)
        found = self._locations(image[y0 : bottom + margin_px, x0 : right + margin_px])
        found += np.array([x0, y0], np.float32)
        x, y = found[:, 0], found[:, 1]
        return found[(x >= left) & (x < right) & (y >= top) & (y < bottom)]

    def _locations(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        params = self._params
        return feature_locations(
            image,
            octave_layers=params.sift_octave_layers,
            contrast=params.sift_contrast,
            unique=params.unique_locations,
        )


def _box(index: int, rows: int, columns: int, image: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of one of rows x columns parts of a frame."""
    height, width = image.shape
    row, column = divmod(index, columns)
    return (
        column * width // columns,
        row * height // rows,
        (column + 1) * width // columns,
        (row + 1) * height // rows,
    )


def _tile_of(points_px: NDArray[np.float32], image: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return the (N,) number of the tile that each point lies in."""
    height, width = image.shape
    column = np.clip(points_px[:, 0] * _TILE_COLUMNS / width, 0, _TILE_COLUMNS - 1).astype(np.intp)
    row = np.clip(points_px[:, 1] * _TILE_ROWS / height, 0, _TILE_ROWS - 1).astype(np.intp)
    return np.asarray(row * _TILE_COLUMNS + column, np.intp)


def _thinned(points_px: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """Return at most so many points: every m-th along a curve that keeps neighbours together (Morton's), so evenly over the frame."""
    if len(points_px) <= most:
        return points_px
    along = np.argsort(
        _interleaved(points_px[:, 0]) | (_interleaved(points_px[:, 1]) << np.uint64(1)), kind="stable"
    )
    return points_px[along[np.linspace(0, len(points_px) - 1, most).round().astype(np.intp)]]


def _interleaved(coordinates_px: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return cells of 4 px, their numbers' bits apart by one place."""
    bits = np.clip(coordinates_px / 4.0, 0, 0xFFFF).astype(np.uint64)
    for shift, mask in (
        (16, 0x0000FFFF0000FFFF),
        (8, 0x00FF00FF00FF00FF),
        (4, 0x0F0F0F0F0F0F0F0F),
        (2, 0x3333333333333333),
        (1, 0x5555555555555555),
    ):
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    return np.asarray(bits, np.uint64)
