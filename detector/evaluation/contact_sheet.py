"""The worst answers of an evaluation side by side, each on its later frame with the truth. Drawing only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.evaluation.dataset import ImageSet, Truth
from detector.evaluation.judgement import DEEP_SHARE, LineVerdict, Verdict
from detector.evaluation.methods import NONE, SINGLE_PLANE
from detector.evaluation.run import Evaluation

Colour = tuple[int, int, int]
Picture = NDArray[np.uint8]

_WHITE: Final[Colour] = (255, 255, 255)
_BLACK: Final[Colour] = (0, 0, 0)
_GREEN: Final[Colour] = (60, 200, 60)
_RED: Final[Colour] = (60, 60, 230)
_GREY: Final[Colour] = (110, 110, 110)
_YELLOW: Final[Colour] = (0, 235, 255)

_TILE_WIDTH_PX: Final = 360
_ROW_PX: Final = 17
_STRIP_PX: Final = 10
_TILES_A_ROW: Final = 4
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class _Tile:
    file: str
    point_px: tuple[float, float] | None
    words: tuple[str, str]


def contact_sheet(
    evaluation: Evaluation, read_image: Callable[[Path], Picture], *, most: int = 12
) -> Picture | None:
    """Return the worst answers, the worst first.

    =============================  ==========================================
    direction                      white cross with a black rim
    vanishing point, box           yellow ring, yellow frame
    depth of the columns           strip at the bottom: green is deep enough, red is not, grey is not known
    =============================  ==========================================

    Parameters
    ----------
    evaluation
        What to show.
    read_image
        Gives (H, W) uint8 of a file.
    most
        Tiles at most.

    Returns
    -------
    (H, W, 3) uint8, BGR; None where no answer was wrong.
    """
    shown = [_tile_of_pair(v) for v in worst_pairs(evaluation.verdicts)[:most]]
    shown += [_tile_of_frame(v) for v in worst_frames(evaluation.line_verdicts)[: most - len(shown)]]
    if not shown:
        return None
    tiles = [_draw(tile, evaluation.images, read_image) for tile in shown]
    height = max(tile.shape[0] for tile in tiles)
    blank = np.zeros((height, _TILE_WIDTH_PX, 3), np.uint8)
    padded = [np.vstack([tile, blank[tile.shape[0] :]]) for tile in tiles]
    columns = min(_TILES_A_ROW, len(padded))
    padded += [blank] * (-len(padded) % columns)
    rows = [np.hstack(padded[first : first + columns]) for first in range(0, len(padded), columns)]
    return np.vstack(rows)


def worst_pairs(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Return the wrong answers, the most dangerous first. Silence is not wrong.

    The order: an answer without motion, a direction where a wall is, a wall where none is, other directions by how little depth
    they have, or else how far off they are.
    """
    ranked = [(_badness(v), v) for v in verdicts]
    return [v for badness, v in sorted(ranked, key=lambda item: -item[0]) if badness > 0.0]


def worst_frames(verdicts: Sequence[LineVerdict]) -> list[LineVerdict]:
    """Return the vanishing points that are wrong or were not found, the furthest off first."""
    wrong = [v for v in verdicts if not v.within_tenth_width]
    return sorted(wrong, key=lambda v: -(v.error_width or 0.0))


def _badness(verdict: Verdict) -> float:
    if verdict.kind == NONE:
        return 0.0
    if verdict.no_motion_truth:
        return 4.0
    if verdict.single_plane_truth is True and verdict.is_direction:
        return 3.0
    if verdict.single_plane_truth is False and verdict.kind == SINGLE_PLANE:
        return 2.0
    if verdict.right is not False:
        return 0.0
    missing = 1.0 - verdict.profile_ratio if verdict.profile_ratio is not None else verdict.error_width
    return min(1.0, max(missing or 0.0, 1e-3))


def _tile_of_pair(verdict: Verdict) -> _Tile:
    truth = {True: "single plane", False: "open", None: "scene not labelled"}[verdict.single_plane_truth]
    if verdict.no_motion_truth:
        truth = "no motion"
    parts = [f"truth: {truth}"]
    if verdict.profile_ratio is not None:
        parts.append(f"depth {verdict.profile_ratio:.2f} of best")
    if verdict.error_width is not None:
        parts.append(f"{verdict.error_width:.2f} W off")
    point = None if verdict.x_px is None or verdict.y_px is None else (verdict.x_px, verdict.y_px)
    return _Tile(verdict.b, point, (f"{verdict.b}: {verdict.kind}", ", ".join(parts)))


def _tile_of_frame(verdict: LineVerdict) -> _Tile:
    found = "nothing found" if verdict.error_width is None else f"{verdict.error_width:.2f} W off"
    point = None if verdict.x_px is None or verdict.y_px is None else (verdict.x_px, verdict.y_px)
    return _Tile(verdict.frame, point, (f"{verdict.frame}: lines alone", found))


def _draw(tile: _Tile, images: ImageSet, read_image: Callable[[Path], Picture]) -> Picture:
    image = read_image(images.folder / tile.file)
    scale = _TILE_WIDTH_PX / image.shape[1]
    height = max(1, round(image.shape[0] * scale))
    small = cv2.resize(image, (_TILE_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    picture = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), np.uint8)
    _draw_truth(picture, images.frames[tile.file], scale)
    if tile.point_px is not None:
        at = _at(tile.point_px, scale)
        for thickness, colour in ((4, _BLACK), (2, _WHITE)):
            cv2.drawMarker(
                picture, at, colour, markerType=cv2.MARKER_CROSS, markerSize=24, thickness=thickness
            )
    text = np.zeros((2 * _ROW_PX + 4, _TILE_WIDTH_PX, 3), np.uint8)
    for row, words in enumerate(tile.words):
        _write(text, words, row)
    return np.vstack([text, picture])


def _draw_truth(picture: Picture, truth: Truth, scale: float) -> None:
    for box in (truth.far_box, truth.doorway_box):
        if box is not None:
            cv2.rectangle(picture, _at(box[:2], scale), _at(box[2:], scale), _YELLOW, 2)
    if truth.vp is not None:
        cv2.circle(picture, _at(truth.vp, scale), 9, _YELLOW, 2)
    profile = None if truth.depth is None else truth.depth.column_profile_m
    known = [depth_m for depth_m in profile or () if depth_m is not None]
    if not profile or not known:
        return
    edges = np.linspace(0, picture.shape[1], len(profile) + 1).round().astype(int)
    for depth_m, left, right in zip(profile, edges[:-1], edges[1:], strict=True):
        deep = depth_m is not None and depth_m >= DEEP_SHARE * max(known)
        picture[-_STRIP_PX:, left:right] = _GREY if depth_m is None else _GREEN if deep else _RED


def _write(band: Picture, words: str, row: int) -> None:
    size = 0.42
    (length, _), _ = cv2.getTextSize(words, _FONT, size, 1)
    size *= min(1.0, (_TILE_WIDTH_PX - 8) / max(length, 1))
    cv2.putText(band, words, (4, _ROW_PX * (row + 1) - 3), _FONT, size, _WHITE, 1, cv2.LINE_AA)


def _at(point_px: Sequence[float], scale: float) -> tuple[int, int]:
    # Points far outside would overflow the drawing routines' integers.
    x, y = (min(max((value + 0.5) * scale - 0.5, -20000.0), 20000.0) for value in point_px)
    return round(x), round(y)
