"""The paper, transcribed slowly and literally: the oracle for the detector. Plain loops, scikit-learn for k-means.

It shares no code with the detector. OpenCV is called for what the paper takes ready-made: SIFT, Lucas-Kanade, Canny, Hough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from sklearn.cluster import KMeans
from sklearn.metrics import calinski_harabasz_score, davies_bouldin_score


@dataclass
class Answer:
    """What the transcription found; ``kind`` as in the detector's JSON."""

    kind: str
    at: tuple[float, float] | None = None
    counts: list[int] = field(default_factory=list)  # N', N'', N'''
    p: int | None = None
    n: int | None = None
    k: int | None = None
    magnitudes: list[float] = field(default_factory=list)
    deviation: float | None = None
    n_lines: int = 0
    candidates: list[tuple[float, float]] = field(default_factory=list)


def evenly_spaced(samples, n):
    """Return one deterministic set of initial centres: n samples, evenly spaced in their order of x, y, alpha."""
    order = sorted(range(len(samples)), key=lambda i: tuple(samples[i]))
    return [np.array([samples[order[(2 * j + 1) * len(order) // (2 * n)]] for j in range(n)])]


def run(image1, image2, starts):
    """Go through sections 2.1 to 2.4 on one pair, first loop, with the given initial centres of k-means."""
    height, width = image2.shape
    # 2.1
    sift = cv2.SIFT_create(nOctaveLayers=3)
    points1, points2 = sift.detect(image1, None), sift.detect(image2, None)
    if len(points1) < 100:
        return Answer("too_few_features_earlier")
    if len(points2) < 100:
        return Answer("too_few_features_later")

    # 2.2 flow, there and back
    seeds = np.array([[point.pt] for point in points1], np.float32)
    lk = {"winSize": (15, 15), "maxLevel": 5, "criteria": (3, 10, 0.03)}
    there, found_there, _ = cv2.calcOpticalFlowPyrLK(image1, image2, seeds, None, **lk)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(image2, image1, there, None, **lk)
    omega = []  # x1, y1, x2, y2, length, alpha
    for i in range(len(seeds)):
        x1, y1 = (float(v) for v in seeds[i, 0])
        x2, y2 = (float(v) for v in there[i, 0])
        xb, yb = (float(v) for v in back[i, 0])
        if found_there[i, 0] and found_back[i, 0] and abs(xb - x1) < 0.5 and abs(yb - y1) < 0.5:
            length = math.sqrt((x2 - x1) ** 2 + (y2 - y1) ** 2)
            alpha = math.degrees(math.atan2(y2 - y1, x2 - x1))
            omega.append((x1, y1, x2, y2, length, alpha if alpha >= 0 else alpha + 360.0))
    answer = Answer("", counts=[len(omega)])
    lengths = sorted(vector[4] for vector in omega)
    if lengths[len(lengths) // 2] < max(2.5 * width / 1280, 0.4):
        answer.kind = "no_motion"
        return answer

    # length filter: the first tenth of the vectors in ascending order
    ranked = sorted(range(len(omega)), key=lambda i: omega[i][4])
    dropped = set(ranked[: len(omega) // 10])
    omega2 = [vector for i, vector in enumerate(omega) if i not in dropped]
    answer.counts.append(len(omega2))

    # angular filter
    mean = sum(vector[5] for vector in omega2) / len(omega2)
    sigma = math.sqrt(sum((vector[5] - mean) ** 2 for vector in omega2) / len(omega2))

    def survivors(p):
        return [vector for vector in omega2 if abs(vector[5] - mean) < p * sigma]

    p = 2
    while p < 9 and len(survivors(p)) - len(survivors(p - 1)) >= 0.10 * len(survivors(p - 1)):
        p += 1
    omega3 = survivors(p)
    answer.p = p
    answer.counts.append(len(omega3))
    if len(omega3) < 100:
        answer.kind = "too_little_flow"
        return answer

    # clusters: the n with the largest CH / DB
    samples = np.array([[vector[2], vector[3], vector[5]] for vector in omega3])
    best_score, centres = -1.0, None
    for n in range(2, 16):
        initial = starts(samples, n)[0]
        means = KMeans(n, init=initial, n_init=1, tol=0.0, algorithm="lloyd").fit(samples)
        score = calinski_harabasz_score(samples, means.labels_) / davies_bouldin_score(samples, means.labels_)
        if score > best_score:
            best_score, centres, answer.n = score, means.cluster_centers_, n

    # magnitudes at a place: the k nearest ends
    def magnitude(x, y, k):
        near = sorted(omega3, key=lambda vector: (vector[2] - x) ** 2 + (vector[3] - y) ** 2)[:k]
        return sum(vector[4] for vector in near) / k

    k, before = 5, [magnitude(x, y, 5) for x, y, _ in centres]
    for i in range(2, 9):
        k, now = 5 * i, [magnitude(x, y, 5 * i) for x, y, _ in centres]
        if max(abs(a - b) / b for a, b in zip(now, before, strict=True)) < 0.05:
            break
        before = now
    answer.k = k
    answer.magnitudes = [magnitude(x, y, k) for x, y, _ in centres]
    lowest = min(range(len(centres)), key=lambda i: answer.magnitudes[i])
    lmcc = (float(centres[lowest][0]), float(centres[lowest][1]))

    # single plane: 500 degrees(px) at a width of 1280
    average = sum(answer.magnitudes) / len(answer.magnitudes)
    answer.deviation = math.sqrt(sum((m - average) ** 2 for m in answer.magnitudes) / len(answer.magnitudes))
    if answer.deviation < 8.73 * width / 1280:
        answer.kind = "single_plane"
        return answer

    # 2.3 lines of the lower half
    top = height // 2
    roi = image2[top:]
    grey = float(np.median(roi))
    canny = cv2.Canny(cv2.GaussianBlur(roi, (5, 5), 0), 0.67 * grey, 1.33 * grey)
    scale = width / 1280
    found = cv2.HoughLinesP(
        canny, 1, math.pi / 180, round(100 * scale), minLineLength=50 * scale, maxLineGap=10 * scale
    )
    gamma = []  # x1, y1, x2, y2, beta
    for x1, y1, x2, y2 in [] if found is None else np.asarray(found, float).reshape(-1, 4):
        beta = math.degrees(math.atan2(y2 - y1, x2 - x1)) % 180.0
        if 40 < beta < 140:
            gamma.append((x1, y1 + top, x2, y2 + top, beta))
    answer.n_lines = len(gamma)
    groups = [[] for _ in centres]
    for line in gamma:
        mx, my = (line[0] + line[2]) / 2, (line[1] + line[3]) / 2
        groups[min(range(len(centres)), key=lambda c: math.dist((mx, my), centres[c][:2]))].append(line)
    for centre, group in zip(centres, groups, strict=True):
        cells = {}
        for u in range(len(group)):
            for v in range(u + 1, len(group)):
                difference = abs(group[u][4] - group[v][4])
                if 5 < min(difference, 180 - difference) < 15:
                    x, y = _meet(group[u], group[v])
                    if 0 <= x < width and 0 <= y < height:
                        cell = (math.floor(x / 10), math.floor(y / 10))
                        cells[cell] = cells.get(cell, 0) + 1
        if cells:
            fullest = [cell for cell, count in cells.items() if count == max(cells.values())]
            middles = [(10 * (a + 0.5), 10 * (b + 0.5)) for a, b in sorted(fullest)]
            answer.candidates.append(min(middles, key=lambda m: math.dist(m, centre[:2])))

    # 2.4 vote
    answer.kind, answer.at = "lowest_flow", lmcc
    if answer.candidates:
        vp = min(answer.candidates, key=lambda c: math.dist(c, lmcc))
        if abs(magnitude(*vp, k) - answer.magnitudes[lowest]) < 0.05 * answer.magnitudes[lowest]:
            answer.kind, answer.at = "vanishing_point", vp
    return answer


def _meet(first, second):
    """Intersect two lines given by points, by Cramer's rule on a x + b y = c."""
    rows = []
    for x1, y1, x2, y2, _ in (first, second):
        a, b = y2 - y1, x1 - x2
        rows.append((a, b, a * x1 + b * y1))
    (a1, b1, c1), (a2, b2, c2) = rows
    determinant = a1 * b2 - a2 * b1
    return (c1 * b2 - c2 * b1) / determinant, (a1 * c2 - a2 * c1) / determinant
