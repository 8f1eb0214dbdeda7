"""How sure an answer of the void map is: a figure in [0, 1] that says how often answers like it were right.

Three things are put together into a score: how far the last profiles agree on the answer's direction, how many samples it is known by, and
how far they scatter. The score's meaning was measured: a monotone table takes it to the share of answers with such a score that were
right on rendered pairs (docs/methods.md shows the reliability plot and the command).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.parallax.map_memory import RememberedMap
from detector.parallax.void_map import BINS, Gap

_ENOUGH_SAMPLES: Final = 40.0
_ENOUGH_PROFILES: Final = 4.0
_AROUND: Final = 3
_WIDE_RAD: Final = math.radians(6.0)
CALIBRATION: Final = (
    (0.3, 0.559),
    (0.494, 0.768),
    (0.669, 0.818),
    (0.779, 0.879),
    (0.92, 0.909),
)
"""Score, and the share of answers that were right there."""


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Answers of about the same confidence.

    Attributes
    ----------
    confidence
        Their mean.
    right
        The share of them that was right.
    answers
        How many.
    """

    confidence: float
    right: float
    answers: int


def score(remembered: RememberedMap, gap: Gap) -> float:
    """Return what speaks for an answer, in [0, 1]; not yet a probability.

    Parameters
    ----------
    remembered
        The profiles' common map.
    gap
        The answer from it.
    """
    around = (remembered.found.at(gap.azimuth_rad) + np.arange(-_AROUND, _AROUND + 1)) % BINS
    known = remembered.found.known[around]
    profiles = remembered.profiles[around][known]
    if profiles.size == 0:
        return 0.0
    agreement = float(np.mean(remembered.agreeing[around][known] / np.maximum(profiles, 1)))
    many = min(1.0, float(profiles.mean()) / _ENOUGH_PROFILES)
    counted = 1.0 - math.exp(-float(remembered.found.count[around][known].mean()) / _ENOUGH_SAMPLES)
    spread = float(np.median(remembered.found.sigma_m[around][known])) / max(gap.free_m, 1e-6)
    steady = 1.0 / (1.0 + (spread / 0.3) ** 2) if math.isfinite(spread) else 0.0
    roomy = min(1.0, gap.width_rad / _WIDE_RAD)
    seen = float(known.mean())
    return (
        (0.25 + 0.75 * many)
        * (0.1 + 0.9 * agreement)
        * (0.5 + 0.5 * counted)
        * (0.4 + 0.6 * steady)
        * (0.6 + 0.4 * roomy)
        * seen
    )


def confidence(
    remembered: RememberedMap, gap: Gap, table: Sequence[tuple[float, float]] = CALIBRATION
) -> float:
    """Return how often an answer like this one is right.

    Parameters
    ----------
    remembered, gap
        As for :func:`score`.
    table
        Score and share of right answers, both growing.
    """
    return calibrated(score(remembered, gap), table)


def calibrated(value: float, table: Sequence[tuple[float, float]] = CALIBRATION) -> float:
    """Return the table's figure for a score; straight lines between its points, constant beyond its ends.

    Raises
    ------
    ValueError
        When the table is empty, not monotone, or leaves [0, 1].
    """
    scores, shares = np.array(table, np.float64).reshape(-1, 2).T
    if scores.size == 0 or (np.diff(scores) <= 0.0).any() or (np.diff(shares) < 0.0).any():
        raise ValueError("expected a table of growing scores and shares")
    if shares[0] < 0.0 or shares[-1] > 1.0:
        raise ValueError(f"expected shares in [0, 1], got {shares[0]} to {shares[-1]}")
    return float(np.interp(value, scores, shares))


def fitted_table(
    scores: NDArray[np.float64], right: NDArray[np.bool_], *, points: int = 8
) -> tuple[tuple[float, float], ...]:
    """Return the monotone table that scores and outcomes ask for: shares of equally many answers, pooled where they would fall.

    Parameters
    ----------
    scores
        (N,) in [0, 1].
    right
        (N,) whether the answer was right.
    points
        At most so many.

    Raises
    ------
    ValueError
        With fewer than two answers a point.
    """
    if len(scores) != len(right) or len(scores) < 2 * points:
        raise ValueError(
            f"expected at least {2 * points} scores and as many outcomes, got {len(scores)} and {len(right)}"
        )
    order = np.argsort(scores)
    # One answer right and one wrong in front of each group: a share of 0 or 1 is never what a few answers say.
    groups = [
        [float(scores[part].sum()), float(right[part].sum()) + 1.0, float(part.size), float(part.size) + 2.0]
        for part in np.array_split(order, points)
    ]
    pooled: list[list[float]] = []
    for group in groups:
        pooled.append(group)
        while len(pooled) > 1 and pooled[-2][1] / pooled[-2][3] >= pooled[-1][1] / pooled[-1][3]:
            last = pooled.pop()
            pooled[-1] = [a + b for a, b in zip(pooled[-1], last, strict=True)]
    table: list[tuple[float, float]] = []
    for total, good, size, weighted in pooled:
        middle = round(total / size, 3)
        if not table or middle > table[-1][0]:
            table.append((middle, round(good / weighted, 3)))
    return tuple(table)


def reliability(
    confidences: NDArray[np.float64], right: NDArray[np.bool_], *, bins: int = 8
) -> tuple[ReliabilityBin, ...]:
    """Return a reliability diagram: answers in bins of equal numbers, from the least confident on.

    Parameters
    ----------
    confidences
        (N,) in [0, 1].
    right
        (N,) outcomes.
    bins
        At most so many.
    """
    if len(confidences) == 0:
        return ()
    order = np.argsort(confidences)
    return tuple(
        ReliabilityBin(float(confidences[part].mean()), float(right[part].mean()), int(part.size))
        for part in np.array_split(order, min(bins, len(order)))
    )
