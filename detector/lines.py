"""Line segments in the lower half of the second frame (paper section 2.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.params import DetectorParams, scaled_px

_VOTES_MIN = 5
"""Fewer votes than this find lines in noise."""


@dataclass(frozen=True, slots=True)
class HoughSettings:
    """Settings of the probabilistic Hough transform, in px of this image."""

    votes: int
    min_length_px: float
    max_gap_px: float


@dataclass(frozen=True, slots=True)
class AngleGate:
    """Lines count when their angle to the horizontal lies strictly between the two, and not too near to vertical."""

    min_deg: float = 40.0
    max_deg: float = 140.0
    vertical_gap_deg: float = 0.0


class Lines(NamedTuple):
    """Segments of the lower half.

    Attributes
    ----------
    segments_px
        (K', 4) x1, y1, x2, y2 of those that pass the gate, in px of the full image.
    found
        K, the number before the gate.
    votes
        For the next frame.
    """

    segments_px: NDArray[np.float64]
    found: int
    votes: int


def edges(lower_half: NDArray[np.uint8], low: float = 0.67, high: float = 1.33) -> NDArray[np.uint8]:
    """Return Canny edges after a 5 x 5 Gaussian blur, thresholds relative to the median grey of the region."""
    median = _median_grey(lower_half)
    blurred = cv2.GaussianBlur(lower_half, (5, 5), 0)
    return np.asarray(cv2.Canny(blurred, low * median, high * median), dtype=np.uint8)


def _median_grey(image: NDArray[np.uint8]) -> float:
    """Return the median from the histogram: the same figure as by sorting, at a fraction of the time."""
    up_to = np.cumsum(cv2.calcHist([image], [0], None, [256], [0.0, 256.0]), dtype=np.float64)
    below, above = (image.size - 1) // 2, image.size // 2  # ranks of the middle, the same for an odd count
    return 0.5 * float(np.searchsorted(up_to, below, "right") + np.searchsorted(up_to, above, "right"))


def find_segments(edge_image: NDArray[np.uint8], top_px: int, settings: HoughSettings) -> NDArray[np.float64]:
    """Return the (K, 4) segments x1, y1, x2, y2 in px of the full image, rho 1 px and theta 1 degree.

    ``top_px`` is the row of the full image where ``edge_image`` begins.
    """
    found = cv2.HoughLinesP(
        edge_image,
        1.0,
        np.pi / 180.0,
        settings.votes,
        minLineLength=settings.min_length_px,
        maxLineGap=settings.max_gap_px,
    )
    # OpenCV gives None for no line at all, whatever its annotations say.
    segments = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    return np.asarray(segments + np.array([0.0, top_px, 0.0, top_px]), np.float64)


def angles_deg(segments_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle beta of each segment to the horizontal, in [0, 180)."""
    delta = segments_px[:, 2:] - segments_px[:, :2]
    angles: NDArray[np.float64] = np.degrees(np.arctan2(delta[:, 1], delta[:, 0])) % 180.0
    angles[angles >= 180.0] = 0.0
    return angles


def gate(segments_px: NDArray[np.float64], gate_: AngleGate) -> NDArray[np.bool_]:
    """Return which segments are neither nearly horizontal nor, if so asked, nearly vertical."""
    beta = angles_deg(segments_px)
    kept = (beta > gate_.min_deg) & (beta < gate_.max_deg)
    if gate_.vertical_gap_deg > 0.0:
        kept &= np.abs(beta - 90.0) >= gate_.vertical_gap_deg
    return kept


def lower_half_lines(
    image: NDArray[np.uint8],
    settings: HoughSettings,
    gate_: AngleGate,
    *,
    edge_low: float = 0.67,
    edge_high: float = 1.33,
    wanted: int = 0,
    known_votes: int | None = None,
) -> Lines:
    """Return the segments that pass the gate and the number found before it.

    Parameters
    ----------
    image
        (H, W) uint8, the whole second frame.
    settings
        Hough settings; with ``wanted`` the votes are only the starting point.
    gate_
        Rule on beta.
    edge_low, edge_high
        Canny thresholds over the median grey.
    wanted
        0: votes fixed. Else: the largest number of votes for which at least ``wanted`` segments pass the gate. The
        paper tunes the transform by hand to reach about 10.

    known_votes
        The number that was right for the frame before. Then it is moved by an eighth where it no longer is, and the transform
        runs once.

    Returns
    -------
    (K', 4) segments in px of the full image, K, and the votes that found them.
    """
    top = image.shape[0] // 2
    edge_image = edges(image[top:], edge_low, edge_high)

    def with_votes(votes: int) -> Lines:
        found = find_segments(
            edge_image, top, HoughSettings(votes, settings.min_length_px, settings.max_gap_px)
        )
        return Lines(found[gate(found, gate_)], len(found), votes)

    if wanted and known_votes is not None:
        found = with_votes(known_votes)
        step = max(1, known_votes // 8)
        if len(found.segments_px) < wanted:
            return found._replace(votes=max(_VOTES_MIN, known_votes - step))
        if len(found.segments_px) > 2 * wanted:
            return found._replace(votes=known_votes + step)
        return found
    best = with_votes(settings.votes)
    if wanted == 0 or len(best.segments_px) == wanted:
        return best
    # Fewer votes find more lines: bisect between what gives too few and what gives enough.
    if len(best.segments_px) > wanted:
        low, high = settings.votes, max(settings.votes + 1, int(np.hypot(*edge_image.shape)))
    else:
        low, high = min(_VOTES_MIN, settings.votes), settings.votes
        best = with_votes(low)
        if len(best.segments_px) <= wanted:
            return best
    while high - low > max(1, low // 8):  # within an eighth is near enough, and each try costs a transform
        middle = (low + high) // 2
        tried = with_votes(middle)
        if len(tried.segments_px) >= wanted:
            low, best = middle, tried
        else:
            high = middle
    return best


def lines_by(params: DetectorParams, image: NDArray[np.uint8], known_votes: int | None = None) -> Lines:
    """Return :func:`lower_half_lines` with a detector's settings, its pixel figures scaled to the image.

    Parameters
    ----------
    params
        Settings of edges, Hough transform and angles.
    image
        (H, W) uint8, the whole second frame.
    known_votes
        As :func:`lower_half_lines` takes it.
    """
    width_px = image.shape[1]
    return lower_half_lines(
        image,
        HoughSettings(
            votes=max(1, round(scaled_px(params.hough_votes_at_1280, width_px))),
            min_length_px=scaled_px(params.hough_min_length_px_at_1280, width_px),
            max_gap_px=scaled_px(params.hough_max_gap_px_at_1280, width_px),
        ),
        AngleGate(params.line_angle_min_deg, params.line_angle_max_deg, params.vertical_gap_deg),
        edge_low=params.edge_low,
        edge_high=params.edge_high,
        wanted=params.lines_wanted,
        known_votes=known_votes,
    )
