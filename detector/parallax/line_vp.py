"""The vanishing point of the lines of the whole image, by least squares, with its covariance: evidence where parallax is weak.

Line segments come from LSD (von Gioi et al. 2010, OpenCV's LineSegmentDetector). The intersections of the longest ones vote, and iteratively reweighted least squares over all of
them finds the point that their lines miss least. It is the direction of a building's axis, not of the void: a corridor's, not a
doorway's. So it says where to look only where parallax says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

_LONGEST: Final = 60
_LEAST_LENGTH_SHARE: Final = 0.03
"""Of the image's width."""
_UPRIGHT_DEG: Final = 10.0
_LEVEL_DEG: Final = 3.0
"""Lines this near to upright or level are those of walls and door frames that the camera looks at squarely: they meet elsewhere."""
_LEAST_ANGLE_RAD: Final = math.radians(5.0)
_INLIER_RAD: Final = math.radians(2.0)
_LEAST_SEGMENTS: Final = 5
_ROUNDS: Final = 10
_REACH: Final = 0.75
"""Intersections further than this share of the image's size outside of it are not tried."""
_SEGMENT_SIGMA_RAD: Final = math.radians(0.5)


@dataclass(frozen=True, slots=True)
class LineVanishingPoint:
    """Where lines of the scene meet.

    Attributes
    ----------
    x_px, y_px
        In the image, perhaps outside of it.
    covariance_px2
        (2, 2).
    segments_px
        (K, 4) x1, y1, x2, y2 of the lines that run through it.
    share
        Of the length of all segments that were looked at, what runs through it.
    """

    x_px: float
    y_px: float
    covariance_px2: NDArray[np.float64]
    segments_px: NDArray[np.float64]
    share: float

    @property
    def sigma_px(self) -> float:
        """Standard deviation along its less certain axis."""
        return math.sqrt(max(0.0, float(np.linalg.eigvalsh(self.covariance_px2)[-1])))


def line_segments(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the (K, 4) segments x1, y1, x2, y2 of an image (H, W) uint8, the longest first."""
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(image)[0]
    # None where there is none, whatever OpenCV's annotations say.
    segments = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    return np.asarray(segments[np.argsort(-_lengths(segments))])


def line_vanishing_point(image: NDArray[np.uint8], *, longest: int = _LONGEST) -> LineVanishingPoint | None:
    """Return the vanishing point of an image's lines, or None where too few of them meet in or near it.

    Parameters
    ----------
    image
        (H, W) uint8, without strong distortion.
    longest
        So many of the longest segments count. Larger: slower, by its square.
    """
    height, width = image.shape
    return meeting_point(line_segments(image), (width, height), longest=longest)


def meeting_point(
    segments_px: NDArray[np.float64], size_px: tuple[int, int], *, longest: int = _LONGEST
) -> LineVanishingPoint | None:
    """Return the point that most of the segments' length runs through.

    Parameters
    ----------
    segments_px
        (K, 4).
    size_px
        Width and height of the image.
    longest
        As :func:`line_vanishing_point` takes it.
    """
    width, height = size_px
    length = _lengths(segments_px)
    angle = (
        np.degrees(np.arctan2(segments_px[:, 3] - segments_px[:, 1], segments_px[:, 2] - segments_px[:, 0]))
        % 180.0
    )
    useful = (length >= _LEAST_LENGTH_SHARE * width) & (np.abs(angle - 90.0) > _UPRIGHT_DEG)
    useful &= (angle > _LEVEL_DEG) & (angle < 180.0 - _LEVEL_DEG)
    segments, length = segments_px[useful], length[useful]
    order = np.argsort(-length)[:longest]
    segments, length = segments[order], length[order]
    if len(segments) < _LEAST_SEGMENTS:
        return None
    middle = 0.5 * (segments[:, :2] + segments[:, 2:])
    along = (segments[:, 2:] - segments[:, :2]) / length[:, None]
    point = _best_intersection(middle, along, length, (width, height))
    if point is None:
        return None
    for _ in range(_ROUNDS):
        missed, slope = _missed(middle, along, point)
        weight = _weights(missed, length)
        matrix = slope.T @ (slope * weight[:, None])
        if np.linalg.cond(matrix) > 1e10:
            return None
        step = np.linalg.solve(matrix, slope.T @ (weight * missed))
        point = point - step
        if float(np.linalg.norm(step)) < 0.01:
            break
    missed, slope = _missed(middle, along, point)
    through = np.abs(missed) < _INLIER_RAD
    if int(np.count_nonzero(through)) < _LEAST_SEGMENTS or not np.isfinite(point).all():
        return None
    # Lines of two directions at least: those of one bundle of parallels in the image fix no point.
    matrix = slope[through].T @ slope[through]
    if np.linalg.cond(matrix) > 1e10:
        return None
    scatter = max(_SEGMENT_SIGMA_RAD, 1.4826 * float(np.median(np.abs(missed[through]))))
    return LineVanishingPoint(
        float(point[0]),
        float(point[1]),
        np.asarray(np.linalg.inv(matrix) * scatter**2, np.float64),
        segments[through],
        float(length[through].sum() / length.sum()),
    )


def _best_intersection(
    middle: NDArray[np.float64],
    along: NDArray[np.float64],
    length: NDArray[np.float64],
    size: tuple[int, int],
) -> NDArray[np.float64] | None:
    """Return the intersection of two lines that most length runs through."""
    first, second = np.triu_indices(len(middle), k=1)
    cross = along[first, 0] * along[second, 1] - along[first, 1] * along[second, 0]
    meet = np.abs(cross) > math.sin(_LEAST_ANGLE_RAD)
    first, second, cross = first[meet], second[meet], cross[meet]
    between = middle[second] - middle[first]
    away = (between[:, 0] * along[second, 1] - between[:, 1] * along[second, 0]) / cross
    points = middle[first] + away[:, None] * along[first]
    extent = np.array(size, np.float64)
    near = (points > -_REACH * extent).all(axis=1) & (points < (1.0 + _REACH) * extent).all(axis=1)
    points = points[near]
    if len(points) == 0:
        return None
    offset_x = points[:, None, 0] - middle[None, :, 0]
    offset_y = points[:, None, 1] - middle[None, :, 1]
    across = np.abs(along[None, :, 0] * offset_y - along[None, :, 1] * offset_x)
    missed = across / np.maximum(np.hypot(offset_x, offset_y), 1e-6)
    support = np.maximum(0.0, 1.0 - (missed / _INLIER_RAD) ** 2) @ length
    return np.asarray(points[int(np.argmax(support))], np.float64)


def _missed(
    middle: NDArray[np.float64], along: NDArray[np.float64], point: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return by which angle (sine) each segment misses a point, (N,), and how that changes with the point, (N, 2)."""
    offset = point - middle
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1.0)
    missed = (along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]) / distance
    slope = np.column_stack([-along[:, 1], along[:, 0]]) / distance[:, None]
    slope -= (missed / distance**2)[:, None] * offset
    return missed, slope


def _weights(missed: NDArray[np.float64], length: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Tukey's weights, the longer segments more: their direction is surer."""
    inside = np.maximum(0.0, 1.0 - (missed / _INLIER_RAD) ** 2) ** 2
    return np.asarray(inside * length / float(length.max()), np.float64)


def _lengths(segments_px: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.hypot(*(segments_px[:, 2:] - segments_px[:, :2]).T), np.float64)
