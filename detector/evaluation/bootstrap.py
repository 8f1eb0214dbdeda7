"""Percentile bootstrap intervals, of shares and of the difference between two evaluations of the same pairs.

Pairs are drawn with replacement, and count as independent: in a slow walk neighbouring ones are not, so the true intervals are
wider. Where all of a share's cases agree the interval has no width, which says that the bootstrap cannot tell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

RESAMPLES: Final = 2000
_LEVELS: Final = (2.5, 97.5)
_MIN_DEFINED: Final = 0.5
"""Share of the resamples in which a figure must exist for its interval to mean anything."""

Statistic = Callable[[NDArray[np.intp]], NDArray[np.float64]]
"""A figure of each row of (R, N) indices of cases, (R,), NaN where they do not define it."""


def resampled(count: int, statistic: Statistic, *, seed: int = 0) -> tuple[float, float] | None:
    """Return the 95 % interval of a statistic over resamples of ``count`` cases; None where too few resamples define it."""
    if count == 0:
        return None
    values = statistic(np.random.default_rng(seed).integers(0, count, (RESAMPLES, count)))
    values = values[np.isfinite(values)]
    if len(values) < _MIN_DEFINED * RESAMPLES:
        return None
    low, high = np.percentile(values, _LEVELS)
    return float(low), float(high)


def share_interval(hits: NDArray[np.bool_], *, seed: int = 0) -> tuple[float, float] | None:
    """Return the 95 % interval of a share.

    Parameters
    ----------
    hits
        (N,), one entry a case; None comes back where N is zero.
    seed
        Same cases, same seed: same interval.
    """
    return resampled(len(hits), lambda drawn: known_mean(hits[drawn].astype(np.float64)), seed=seed)


def known_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each row of (R, N) values without its NaN, NaN where nothing else stands there."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def known_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of each row of (R, N) values without its NaN, NaN where nothing else stands there."""
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf), axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    rows = np.arange(len(values))
    lower, upper = (
        ordered[rows, np.maximum(count - 1, 0) // 2],
        ordered[rows, np.minimum(count // 2, values.shape[1] - 1)],
    )
    return np.where(count > 0, 0.5 * (lower + upper), np.nan)
