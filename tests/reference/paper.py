"""Sections 2.1 to 2.4 of the paper, transcribed step by step.

This is the oracle: it shares no code with the detector, and it does nothing the paper does not do. OpenCV finds key points,
optical flow, edges and segments (as in the paper); scikit-learn clusters and rates the clusterings; the rest is numpy where numpy
says it as the paper does, and a loop where it does not. So its time is that of the method as printed, not that of a slow language:
both frames' key points are found anew for each pair, every k-means starts cold and runs until nothing moves, and each of the
n_init runs (one for every start that comes from outside, since the paper leaves starts and their number to chance) is a run in full.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans, kmeans_plusplus
from sklearn.metrics import calinski_harabasz_score, davies_bouldin_score

Starts = Callable[[NDArray[np.float64], int], Sequence[NDArray[np.float64]]]


class Kept(NamedTuple):
    """What the first loop estimates and the others keep (section 3, Table 2)."""

    p: int
    n: int
    k: int


@dataclass(frozen=True)
class Settings:
    """The paper's numbers; pixel figures marked 1280 belong to its images of that width."""

    sift_contrast: float = 0.04
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
class _Vectors:
    """Optical flow vectors: starts and ends, (N, 2) in px."""

    start: NDArray[np.float64]
    end: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.start)

    def only(self, these: NDArray[np.bool_]) -> _Vectors:
        return _Vectors(self.start[these], self.end[these])

    @property
    def length(self) -> NDArray[np.float64]:
        return np.hypot(*(self.end - self.start).T)

    @property
    def alpha_deg(self) -> NDArray[np.float64]:
        dx, dy = (self.end - self.start).T
        return np.degrees(np.arctan2(dy, dx)) % 360.0


def settings_of(params: Any) -> Settings:
    """Say to the oracle what a preset of the detector says, as far as the paper can be read that way."""
    by_ratio = params.plane_test != "deviation_px"
    return Settings(
        sift_contrast=params.sift_contrast,
        min_features=params.min_features,
        min_vectors=params.min_flow_vectors,
        each_location_once=params.unique_locations,
        round_trip_px=params.round_trip_px,
        shortest_tenths=params.shortest_fraction,
        circular_angles=params.angle_statistics == "circular",
        angle_gain=params.angle_gain,
        n_first=params.clusters_min,
        n_last=params.clusters_max,
        k_change=params.nearest_change,
        plane_by_ratio=by_ratio,
        plane_threshold=params.plane_ratio if by_ratio else params.plane_deviation_px_at_1280,
        still_px_1280=params.still_flow_px_at_1280,
        still_floor_px=params.still_flow_floor_px,
        votes_1280=params.hough_votes_at_1280,
        shortest_line_px_1280=params.hough_min_length_px_at_1280,
        longest_gap_px_1280=params.hough_max_gap_px_at_1280,
        vertical_gap_deg=params.vertical_gap_deg,
        cell_px=params.cell_px,
        vote_tolerance=params.vote_tolerance,
    )


def random_starts(seed: int, n_init: int) -> Starts:
    """Draw ``n_init`` k-means++ starts, scikit-learn's own default, anew for each number of clusters."""

    def starts(samples: NDArray[np.float64], n: int) -> list[NDArray[np.float64]]:
        random = np.random.RandomState([seed, n])
        return [kmeans_plusplus(samples, n, random_state=random)[0] for _ in range(n_init)]

    return starts


def void_of_pair(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    starts: Starts,
    settings: Settings,
    kept: Kept | None = None,
) -> Answer:
    """Answer one pair: as a first loop, or as one of the others with the p, n and k of a first one."""
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
    if np.median(vectors.length) < still:
        answer.kind = "no_motion"
        return answer
    vectors = _without_shortest(vectors, settings)
    answer.n_after_length = len(vectors)
    vectors, answer.p = _without_odd_angles(vectors, settings, None if kept is None else kept.p)
    answer.n_after_angle = len(vectors)
    if len(vectors) < settings.min_vectors:
        answer.kind = "too_little_flow"
        return answer

    # 2.2: clusters, their magnitudes, the lowest of them, and the single plane.
    centres = _clusters(vectors, starts, settings, None if kept is None else kept.n)
    answer.n = len(centres)
    answer.k = _neighbours(centres, vectors, settings) if kept is None else kept.k
    magnitudes = [_lengths_nearest_first(centre, vectors)[: answer.k].mean() for centre in centres]
    lmcc, lmcc_length = centres[np.argmin(magnitudes)], min(magnitudes)
    answer.centre_magnitudes_px = [float(magnitude) for magnitude in magnitudes]
    answer.lmcc_px, answer.lmcc_magnitude_px = (float(lmcc[0]), float(lmcc[1])), float(lmcc_length)
    deviation = float(np.std(magnitudes))
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
        nearest = min(answer.candidates_px, key=lambda candidate: math.dist(candidate, lmcc))
        flow_there = _lengths_nearest_first(np.array(nearest), vectors)[: answer.k].mean()
        if abs(flow_there - lmcc_length) < settings.vote_tolerance * lmcc_length:
            answer.kind, (answer.x_px, answer.y_px) = "vanishing_point", nearest
            return answer
    answer.kind, (answer.x_px, answer.y_px) = "lowest_flow", answer.lmcc_px
    return answer


def _key_points(image: NDArray[np.uint8], settings: Settings) -> list[tuple[float, float]]:
    found = [
        key_point.pt
        for key_point in cv2.SIFT.create(nOctaveLayers=3, contrastThreshold=settings.sift_contrast).detect(
            image, None
        )
    ]
    return list(dict.fromkeys(found)) if settings.each_location_once else found


def _there_and_back(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    seeds: list[tuple[float, float]],
    settings: Settings,
    answer: Answer,
) -> _Vectors:
    """Lucas-Kanade there and back; start and return differ by less than half a pixel on each axis (N -> N')."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
    start = np.array(seeds, np.float32).reshape(-1, 1, 2)
    end, there, _ = cv2.calcOpticalFlowPyrLK(
        earlier, later, start, None, winSize=(15, 15), maxLevel=5, criteria=criteria
    )
    home, back, _ = cv2.calcOpticalFlowPyrLK(
        later, earlier, end, None, winSize=(15, 15), maxLevel=5, criteria=criteria
    )
    answer.n_tracks = int(there.sum())
    missed = np.abs(home.astype(np.float64) - start.astype(np.float64))[:, 0, :]
    came_home = (there[:, 0] == 1) & (back[:, 0] == 1) & (missed < settings.round_trip_px).all(axis=1)
    return _Vectors(start[:, 0, :].astype(np.float64), end[:, 0, :].astype(np.float64)).only(came_home)


def _without_shortest(vectors: _Vectors, settings: Settings) -> _Vectors:
    """Drop the tenth part of the vectors, the shortest (N' -> N'')."""
    shortest_first = np.argsort(vectors.length, kind="stable")
    stays = np.ones(len(vectors), np.bool_)
    stays[shortest_first[: math.floor(settings.shortest_tenths * len(vectors))]] = False
    return vectors.only(stays)


def _without_odd_angles(vectors: _Vectors, settings: Settings, kept_p: int | None) -> tuple[_Vectors, int]:
    """Keep |alpha - mean| < p sigma (N'' -> N'''); p is the first whose widening gains less than a tenth."""
    angles = vectors.alpha_deg
    if settings.circular_angles:
        across, along = np.sin(np.radians(angles)).sum(), np.cos(np.radians(angles)).sum()
        mean = math.degrees(math.atan2(across, along)) % 360.0
        away = np.minimum((angles - mean) % 360.0, (mean - angles) % 360.0)
    else:
        away = np.abs(angles - angles.mean())
    sigma = math.sqrt((away * away).mean())
    chosen = 9
    if kept_p is not None:
        chosen = kept_p
    else:
        for p in range(2, 10):
            narrow = np.count_nonzero(away < (p - 1) * sigma)
            wide = np.count_nonzero(away < p * sigma)
            if wide - narrow < settings.angle_gain * narrow:
                chosen = p
                break
    return vectors.only(away < chosen * sigma), chosen


def _clusters(
    vectors: _Vectors, starts: Starts, settings: Settings, kept_n: int | None
) -> NDArray[np.float64]:
    """k-means on (x, y, alpha) of the vectors' ends; n in 2..15 with the largest CH / DB. Return the centres, (n, 2) in px."""
    samples = np.column_stack([vectors.end, vectors.alpha_deg])
    if kept_n is not None:
        return _best_run(samples, min(kept_n, len(vectors) - 1), starts).cluster_centers_[:, :2]
    best_score, best_centres = -math.inf, np.zeros((0, 3))
    for n in range(settings.n_first, min(settings.n_last, len(vectors) - 1) + 1):
        run = _best_run(samples, n, starts)
        score = calinski_harabasz_score(samples, run.labels_) / davies_bouldin_score(samples, run.labels_)
        if score > best_score:
            best_score, best_centres = score, run.cluster_centers_
    return best_centres[:, :2]


def _best_run(samples: NDArray[np.float64], n: int, starts: Starts) -> KMeans:
    runs = [
        KMeans(n, init=initial, n_init=1, max_iter=300, tol=0.0, algorithm="lloyd").fit(samples)
        for initial in starts(samples, n)
    ]
    return min(runs, key=lambda run: run.inertia_)


def _lengths_nearest_first(point: NDArray[np.float64], vectors: _Vectors) -> NDArray[np.float64]:
    """Return the vectors' lengths in the order of their ends' distance from a point."""
    squared = ((vectors.end - point) ** 2).sum(axis=1)
    return vectors.length[np.argsort(squared, kind="stable")]


def _neighbours(centres: NDArray[np.float64], vectors: _Vectors, settings: Settings) -> int:
    """The first of 5, 10 .. 40 whose estimates all moved by less than 5 % against the one before."""
    ordered = [_lengths_nearest_first(centre, vectors) for centre in centres]
    before = np.array([lengths[:5].mean() for lengths in ordered])
    for k in range(10, 41, 5):
        now = np.array([lengths[:k].mean() for lengths in ordered])
        if (np.abs(now - before) / before < settings.k_change).all():
            return k
        before = now
    return 40


def _candidates(
    later: NDArray[np.uint8], centres: NDArray[np.float64], settings: Settings, answer: Answer
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
    segments = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    answer.n_lines = len(segments)
    segments[:, 1::2] += height // 2  # from the lower half to the whole image
    x1, y1, x2, y2 = segments.T
    beta = np.degrees(np.arctan2(y2 - y1, x2 - x1)) % 180.0
    steep = (beta > 40.0) & (beta < 140.0) & (np.abs(beta - 90.0) >= settings.vertical_gap_deg)
    lines = np.column_stack([x1, y1, x2, y2, beta])[steep]
    middles = (lines[:, 0:2] + lines[:, 2:4]) / 2.0
    group = ((middles[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2).argmin(axis=1)
    candidates = [
        _fullest_cell(lines[group == i], centre, width, height, settings.cell_px)
        for i, centre in enumerate(centres)
    ]
    return [candidate for candidate in candidates if candidate is not None]


def _fullest_cell(
    lines: NDArray[np.float64], centre: NDArray[np.float64], width: int, height: int, cell: float
) -> tuple[float, float] | None:
    """Return the middle of the cell with the most intersections of lines 5 to 15 degrees apart; of equals, the nearest."""
    first, second = np.triu_indices(len(lines), 1)
    apart = np.abs(lines[first, 4] - lines[second, 4])
    these = (apart > 5.0) & (apart < 15.0)
    x, y = _meet(lines[first[these]], lines[second[these]])
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    if not inside.any():
        return None
    cells = np.floor(np.column_stack([x[inside], y[inside]]) / cell)
    used, counts = np.unique(cells, axis=0, return_counts=True)
    middles = (used[counts == counts.max()] + 0.5) * cell
    nearest = middles[((middles - centre) ** 2).sum(axis=1).argmin()]
    return float(nearest[0]), float(nearest[1])


def _meet(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where a1 x + b1 y = c1 and a2 x + b2 y = c2 meet, by Cramer's rule, for (M, 5) lines each."""
    a1, b1 = first[:, 3] - first[:, 1], first[:, 0] - first[:, 2]
    a2, b2 = second[:, 3] - second[:, 1], second[:, 0] - second[:, 2]
    c1, c2 = a1 * first[:, 0] + b1 * first[:, 1], a2 * second[:, 0] + b2 * second[:, 1]
    determinant = a1 * b2 - a2 * b1
    return (c1 * b2 - c2 * b1) / determinant, (a1 * c2 - a2 * c1) / determinant
