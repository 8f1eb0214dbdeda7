"""Length and angular filters of the flow field (paper section 2.2): N' -> N'' -> N'''."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

P_RANGE = range(2, 10)
"""p runs to 9; below 2 there is no narrower filter to compare with."""

AngleStatistics = Literal["linear", "circular"]


@dataclass(frozen=True, slots=True)
class AngleSpread:
    """Centre and standard deviation of the angles of a flow field, and each angle's distance from the centre.

    Attributes
    ----------
    mean_deg, sigma_deg
        Mean and standard deviation.
    deviation_deg
        (N,) absolute distance of each angle from the mean.
    """

    mean_deg: float
    sigma_deg: float
    deviation_deg: NDArray[np.float64]


def length_filter(lengths_px: NDArray[np.float64], shortest_fraction: float = 0.1) -> NDArray[np.bool_]:
    """Drop the shortest vectors: floor(fraction * N') of them (N' -> N'').

    Among equal lengths the earlier vector goes first.

    Returns
    -------
    (N,) bool, True for those that stay, in their order.
    """
    # The small term keeps 0.29 * 100 from falling to 28 in binary floating point.
    n_dropped = int(np.floor(shortest_fraction * len(lengths_px) + 1e-9))
    kept = np.ones(len(lengths_px), np.bool_)
    kept[np.argsort(lengths_px, kind="stable")[:n_dropped]] = False
    return kept


def angle_spread(angles_deg: NDArray[np.float64], statistics: AngleStatistics = "linear") -> AngleSpread:
    """Return mean, deviation and distances of angles in [0, 360).

    ``linear`` treats them as numbers, as printed: 1 and 359 are far apart. ``circular`` takes the direction of
    the mean unit vector and the root mean square of the distances round the circle.
    """
    if len(angles_deg) == 0:
        return AngleSpread(0.0, 0.0, np.zeros(0))
    if statistics == "linear":
        mean = float(np.mean(angles_deg))
        deviation = np.abs(angles_deg - mean)
        return AngleSpread(mean, float(np.std(angles_deg)), deviation)
    radians = np.radians(angles_deg)
    mean = float(np.degrees(np.arctan2(np.sin(radians).mean(), np.cos(radians).mean()))) % 360.0
    deviation = np.abs((angles_deg - mean + 180.0) % 360.0 - 180.0)
    return AngleSpread(mean, float(np.sqrt(np.mean(deviation**2))), deviation)


def angular_filter(spread: AngleSpread, p: int) -> NDArray[np.bool_]:
    """Keep the vectors within p standard deviations of the mean angle (N'' -> N''').

    A field without any spread has no outliers, and is kept whole.
    """
    if spread.sigma_deg == 0.0:
        return np.ones(len(spread.deviation_deg), np.bool_)
    kept: NDArray[np.bool_] = spread.deviation_deg < p * spread.sigma_deg
    return kept


def choose_p(spread: AngleSpread, gain: float = 0.10) -> int:
    """Return the smallest p in 2..9 for which widening from p - 1 gains less than ``gain`` more survivors; else 9."""
    for p in P_RANGE:
        before = int(angular_filter(spread, p - 1).sum())
        after = int(angular_filter(spread, p).sum())
        if after - before < gain * before:
            return p
    return P_RANGE[-1]
