"""Sections 2.1 to 2.4 of the paper, transcribed step by step with plain loops.

This is the oracle: it shares no code with the detector, it is slow, and it does nothing the paper does not do. OpenCV finds key
points, optical flow, edges and segments (as in the paper); scikit-learn clusters and rates the clusterings; the rest is loops.
Only the starts of k-means come from outside, since the paper leaves them to chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from sklearn.metrics import calinski_harabasz_score, davies_bouldin_score

Starts = Callable[[NDArray[np.float64], int], Sequence[NDArray[np.float64]]]


@dataclass(frozen=True)
class Settings:
    """The paper's numbers; pixel figures marked 1280 belong to its images of that width."""

    min_features: int = 100
    min_vectors: int = 100
    each_location_once: bool = False
    round_trip_px: float = 0.5
    shortest_tenths: float = 0.1
    circular_angles: bool = False
    angle_gain: float = 0.10
    n_first: int = 2
    n_last: int = 15
    k_change: float = 0.05
    plane_by_ratio: bool = False
    plane_threshold: float = 8.73  # px at 1280, or the ratio itself
    still_px_1280: float = 2.5  # not in the paper: a standing camera is no wall
    still_floor_px: float = 0.4
    votes_1280: float = 100.0
    shortest_line_px_1280: float = 50.0
    longest_gap_px_1280: float = 10.0
    vertical_gap_deg: float = 0.0
    cell_px: float = 10.0
    vote_tolerance: float = 0.05


@dataclass
class Answer:
    """What the oracle found, step by step; ``kind`` is a word of the detector's results."""

    kind: str = ""
    x_px: float = math.nan
    y_px: float = math.nan
    n_tracks: int = 0
    n_after_distribution: int = 0
    n_after_length: int = 0
    n_after_angle: int = 0
    p: int | None = None
    n: int | None = None
    k: int | None = None
    lmcc_px: tuple[float, float] | None = None
    lmcc_magnitude_px: float | None = None
    centre_magnitudes_px: list[float] = field(default_factory=list)
    n_lines: int = 0
    candidates_px: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class _Vector:
    """One optical flow vector: start, end, length and angle alpha."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def length(self) -> float:
        return math.hypot(self.x1 - self.x0, self.y1 - self.y0)

    @property
    def alpha_deg(self) -> float:
        return math.degrees(math.atan2(self.y1 - self.y0, self.x1 - self.x0)) % 360.0


def void_of_pair(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], starts: Starts, settings: Settings
) -> Answer:
    """Answer one pair, as a first loop (p, n and k are estimated)."""
    answer = Answer()
    width = later.shape[1]

    # 2.1: SIFT key points in both frames, at least 100 in each.
    seeds = _key_points(earlier, settings)
    if len(seeds) < settings.min_features:
        answer.kind = "too_few_features_earlier"
        return answer
    if len(_key_points(later, settings)) < settings.min_features:
        answer.kind = "too_few_features_later"
        return answer

    # 2.2: optical flow, and its three filters.
    vectors = _there_and_back(earlier, later, seeds, settings, answer)
    answer.n_after_distribution = len(vectors)
    still = max(settings.still_px_1280 * width / 1280.0, settings.still_floor_px)
    if len(vectors) < 10:
        answer.kind = "too_little_flow"
        return answer
    if np.median([v.length for v in vectors]) < still:
        answer.kind = "no_motion"
        return answer
    vectors = _without_shortest(vectors, settings)
    answer.n_after_length = len(vectors)
    vectors, answer.p = _without_odd_angles(vectors, settings)
    answer.n_after_angle = len(vectors)
    if len(vectors) < settings.min_vectors:
        answer.kind = "too_little_flow"
        return answer

    # 2.2: clusters, their magnitudes, the lowest of them, and the single plane.
    centres = _clusters(vectors, starts, settings)
    answer.n = len(centres)
    answer.k = _neighbours(centres, vectors, settings)
    magnitudes = [_mean_of_nearest(x, y, vectors, answer.k) for x, y in centres]
    lowest = min(range(len(centres)), key=lambda i: magnitudes[i])
    lmcc, lmcc_length = centres[lowest], magnitudes[lowest]
    answer.centre_magnitudes_px, answer.lmcc_px, answer.lmcc_magnitude_px = magnitudes, lmcc, lmcc_length
    mean = sum(magnitudes) / len(magnitudes)
    deviation = math.sqrt(sum((m - mean) ** 2 for m in magnitudes) / len(magnitudes))
    if settings.plane_by_ratio:
        one_plane = deviation / float(np.median(magnitudes)) < settings.plane_threshold
    else:
        one_plane = deviation < settings.plane_threshold * width / 1280.0
    if one_plane:
        answer.kind = "single_plane"
        return answer

    # 2.3: one vanishing-point candidate a cluster.
    answer.candidates_px = _candidates(later, centres, settings, answer)

    # 2.4: the candidate nearest to the LMCC, if the flow there is as low.
    if answer.candidates_px:
        x, y = min(answer.candidates_px, key=lambda c: math.dist(c, lmcc))
        if (
            abs(_mean_of_nearest(x, y, vectors, answer.k) - lmcc_length)
            < settings.vote_tolerance * lmcc_length
        ):
            answer.kind, answer.x_px, answer.y_px = "vanishing_point", x, y
            return answer
    answer.kind, (answer.x_px, answer.y_px) = "lowest_flow", lmcc
    return answer


def _key_points(image: NDArray[np.uint8], settings: Settings) -> list[tuple[float, float]]:
    found = [key_point.pt for key_point in cv2.SIFT.create(nOctaveLayers=3).detect(image, None)]
    if not settings.each_location_once:
        return found
    once: list[tuple[float, float]] = []
    for point in found:
        if point not in once:
            once.append(point)
    return once


def _there_and_back(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    seeds: list[tuple[float, float]],
    settings: Settings,
    answer: Answer,
) -> list[_Vector]:
    """Lucas-Kanade there and back; start and return differ by less than half a pixel on each axis (N -> N')."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
    start = np.array(seeds, np.float32).reshape(-1, 1, 2)
    end, there, _ = cv2.calcOpticalFlowPyrLK(
        earlier, later, start, None, winSize=(15, 15), maxLevel=5, criteria=criteria
    )
    home, back, _ = cv2.calcOpticalFlowPyrLK(
        later, earlier, end, None, winSize=(15, 15), maxLevel=5, criteria=criteria
    )
    vectors = []
    for i in range(len(seeds)):
        if not there[i, 0]:
            continue
        answer.n_tracks += 1
        if not back[i, 0]:
            continue
        (x0, y0), (x1, y1), (xb, yb) = start[i, 0].tolist(), end[i, 0].tolist(), home[i, 0].tolist()
        if abs(xb - x0) < settings.round_trip_px and abs(yb - y0) < settings.round_trip_px:
            vectors.append(_Vector(x0, y0, x1, y1))
    return vectors


def _without_shortest(vectors: list[_Vector], settings: Settings) -> list[_Vector]:
    """Drop the tenth part of the vectors, the shortest (N' -> N'')."""
    by_length = sorted(range(len(vectors)), key=lambda i: vectors[i].length)
    dropped = set(by_length[: math.floor(settings.shortest_tenths * len(vectors))])
    return [vector for i, vector in enumerate(vectors) if i not in dropped]


def _without_odd_angles(vectors: list[_Vector], settings: Settings) -> tuple[list[_Vector], int]:
    """Keep |alpha - mean| < p sigma (N'' -> N'''); p is the first whose widening gains less than a tenth."""
    angles = [v.alpha_deg for v in vectors]
    if settings.circular_angles:
        across = sum(math.sin(math.radians(a)) for a in angles)
        along = sum(math.cos(math.radians(a)) for a in angles)
        mean = math.degrees(math.atan2(across, along)) % 360.0
        away = [min((a - mean) % 360.0, (mean - a) % 360.0) for a in angles]
    else:
        mean = sum(angles) / len(angles)
        away = [abs(a - mean) for a in angles]
    sigma = math.sqrt(sum(d * d for d in away) / len(away))
    chosen = 9
    for p in range(2, 10):
        narrow = sum(1 for d in away if d < (p - 1) * sigma)
        wide = sum(1 for d in away if d < p * sigma)
        if wide - narrow < settings.angle_gain * narrow:
            chosen = p
            break
    return [v for v, d in zip(vectors, away, strict=True) if d < chosen * sigma], chosen


def _clusters(vectors: list[_Vector], starts: Starts, settings: Settings) -> list[tuple[float, float]]:
    """k-means on (x, y, alpha) of the vectors' ends; n in 2..15 with the largest CH / DB."""
    samples = np.array([[v.x1, v.y1, v.alpha_deg] for v in vectors])
    best_score, best_centres = -math.inf, np.zeros((0, 3))
    for n in range(settings.n_first, min(settings.n_last, len(vectors) - 1) + 1):
        runs = []
        for initial in starts(samples, n):
            run = KMeans(n, init=initial, n_init=1, max_iter=300, tol=0.0, algorithm="lloyd").fit(samples)
            runs.append(run)
        best_run = min(runs, key=lambda run: run.inertia_)
        score = calinski_harabasz_score(samples, best_run.labels_) / davies_bouldin_score(
            samples, best_run.labels_
        )
        if score > best_score:
            best_score, best_centres = score, best_run.cluster_centers_
    return [(float(x), float(y)) for x, y, _ in best_centres]


def _mean_of_nearest(x: float, y: float, vectors: list[_Vector], k: int) -> float:
    nearest = sorted(vectors, key=lambda v: (v.x1 - x) ** 2 + (v.y1 - y) ** 2)[:k]
    return sum(v.length for v in nearest) / len(nearest)


def _neighbours(centres: list[tuple[float, float]], vectors: list[_Vector], settings: Settings) -> int:
    """The first of 5, 10 .. 40 whose estimates all moved by less than 5 % against the one before."""
    for i in range(2, 9):
        settled = True
        for x, y in centres:
            before = _mean_of_nearest(x, y, vectors, 5 * (i - 1))
            now = _mean_of_nearest(x, y, vectors, 5 * i)
            if not abs(now - before) / before < settings.k_change:
                settled = False
        if settled:
            return 5 * i
    return 40


def _candidates(
    later: NDArray[np.uint8], centres: list[tuple[float, float]], settings: Settings, answer: Answer
) -> list[tuple[float, float]]:
    """Lines of the lower half, grouped by the nearest centre; in each group the fullest cell of intersections."""
    height, width = later.shape
    scale = width / 1280.0
    lower = later[height // 2 :, :]
    grey = float(np.median(lower))
    found = cv2.HoughLinesP(
        cv2.Canny(cv2.GaussianBlur(lower, (5, 5), 0), 0.67 * grey, 1.33 * grey),
        1,
        math.pi / 180,
        max(1, round(settings.votes_1280 * scale)),
        minLineLength=settings.shortest_line_px_1280 * scale,
        maxLineGap=settings.longest_gap_px_1280 * scale,
    )
    segments = [] if found is None else np.asarray(found).reshape(-1, 4).tolist()
    answer.n_lines = len(segments)
    groups: list[list[tuple[float, float, float, float, float]]] = [[] for _ in centres]
    for x1, y1, x2, y2 in segments:
        y1, y2 = y1 + height // 2, y2 + height // 2  # noqa: PLW2901 - from the lower half to the whole image
        beta = math.degrees(math.atan2(y2 - y1, x2 - x1)) % 180.0
        if not 40.0 < beta < 140.0 or abs(beta - 90.0) < settings.vertical_gap_deg:
            continue
        middle = ((x1 + x2) / 2, (y1 + y2) / 2)
        group = min(range(len(centres)), key=lambda i: math.dist(middle, centres[i]))
        groups[group].append((x1, y1, x2, y2, beta))
    candidates = []
    for centre, group_lines in zip(centres, groups, strict=True):
        candidate = _fullest_cell(group_lines, centre, width, height, settings.cell_px)
        if candidate is not None:
            candidates.append(candidate)
    return candidates


def _fullest_cell(
    group: list[tuple[float, float, float, float, float]],
    centre: tuple[float, float],
    width: int,
    height: int,
    cell: float,
) -> tuple[float, float] | None:
    histogram: dict[tuple[int, int], int] = {}
    for i in range(len(group)):
        for j in range(i + 1, len(group)):
            if not 5.0 < abs(group[i][4] - group[j][4]) < 15.0:
                continue
            x, y = _meet(group[i], group[j])
            if 0 <= x < width and 0 <= y < height:
                key = (math.floor(x / cell), math.floor(y / cell))
                histogram[key] = histogram.get(key, 0) + 1
    if not histogram:
        return None
    most = max(histogram.values())
    middles = [
        ((column + 0.5) * cell, (row + 0.5) * cell)
        for (column, row), count in histogram.items()
        if count == most
    ]
    return min(middles, key=lambda middle: math.dist(middle, centre))


def _meet(
    first: tuple[float, float, float, float, float], second: tuple[float, float, float, float, float]
) -> tuple[float, float]:
    """Where a1 x + b1 y = c1 and a2 x + b2 y = c2 meet, by Cramer's rule."""
    a1, b1 = first[3] - first[1], first[0] - first[2]
    a2, b2 = second[3] - second[1], second[0] - second[2]
    c1, c2 = a1 * first[0] + b1 * first[1], a2 * second[0] + b2 * second[1]
    determinant = a1 * b2 - a2 * b1
    return (c1 * b2 - c2 * b1) / determinant, (a1 * c2 - a2 * c1) / determinant
