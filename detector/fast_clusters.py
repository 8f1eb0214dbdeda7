"""k-means and its indices at flight rate: OpenCV's k-means on float32, and the two indices by array operations.

The same steps as in :mod:`detector.clusters` (paper section 2.2), tens of times faster on a few hundred samples, where scikit-learn's
checks of its input cost more than the work.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.clusters import Clustering

_MOST_ITERATIONS: Final = 100
"""OpenCV's own limit."""
_SETTLED: Final = 0.1
"""A run ends when no centre moves by more than this (px, or degrees)."""


def kmeans(
    samples: NDArray[np.float64], n: int, *, seed: int, attempts: int, max_iterations: int = _MOST_ITERATIONS
) -> Clustering:
    """Return the best of several k-means runs from k-means++ starts.

    Parameters
    ----------
    samples
        (N, D), N >= n.
    n
        Number of clusters.
    seed
        The same samples, n and seed always give the same clustering.
    attempts
        Number of runs.
    max_iterations
        Most rounds of a run.
    """
    cv2.setRNGSeed((seed * 1009 + n) % (1 << 31))  # of this thread's generator, which k-means++ draws from
    return _run(samples, n, None, attempts, max_iterations, cv2.KMEANS_PP_CENTERS)


def from_centres(
    samples: NDArray[np.float64], centres: NDArray[np.float64], max_iterations: int = _MOST_ITERATIONS
) -> Clustering:
    """Return the k-means run that starts from given centres.

    Parameters
    ----------
    samples
        (N, D), N >= n.
    centres
        (n, D), for example those of the pair before.
    max_iterations
        Most rounds.
    """
    squared = ((samples[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2)
    labels = np.argmin(squared, axis=1).astype(np.int32).reshape(-1, 1)
    return _run(samples, len(centres), labels, 1, max_iterations, cv2.KMEANS_USE_INITIAL_LABELS)


def quality_of(samples: NDArray[np.float64], clustering: Clustering) -> float:
    """Return CH / DB as :func:`detector.clusters.quality_of` does.

    CH is the dispersion between the clusters over that within, each over its degrees of freedom; DB the mean over the clusters of the
    worst (mean distance + mean distance) / distance of the centres (Calinski and Harabasz 1974, Davies and Bouldin 1979).
    """
    used, labels = np.unique(clustering.labels, return_inverse=True)
    n, count = len(used), len(samples)
    if not 2 <= n < count:
        return 0.0
    sizes = np.bincount(labels)
    centres = np.column_stack([np.bincount(labels, column) for column in samples.T]) / sizes[:, None]
    away = samples - centres[labels]
    squared = np.einsum("ij,ij->i", away, away)
    within = float(squared.sum())
    middle = samples.mean(axis=0)
    between = float((sizes * ((centres - middle) ** 2).sum(axis=1)).sum())
    spread = np.bincount(labels, np.sqrt(squared)) / sizes
    apart = np.sqrt(((centres[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2))
    np.fill_diagonal(apart, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = np.nan_to_num((spread[:, None] + spread[None, :]) / apart, posinf=0.0).max(axis=1)
    davies_bouldin = float(worst.mean())
    if within <= 0.0 or davies_bouldin <= 0.0:
        return math.inf
    return between * (count - n) / (within * (n - 1.0)) / davies_bouldin


def _run(
    samples: NDArray[np.float64],
    n: int,
    labels: NDArray[np.int32] | None,
    attempts: int,
    max_iterations: int,
    flags: int,
) -> Clustering:
    if len(samples) < n:
        raise ValueError(f"expected at least as many samples as clusters, got {len(samples)}, {n}")
    criteria = (
        cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT,
        min(max_iterations, _MOST_ITERATIONS),
        _SETTLED,
    )
    inertia, found, centres = cv2.kmeans(
        samples.astype(np.float32),
        n,
        labels,  # type: ignore[arg-type]  # the annotation leaves out None, which the k-means++ start takes
        criteria,
        attempts,
        flags,
    )
    return Clustering(np.asarray(centres, np.float64), np.asarray(found, np.intp).reshape(-1), float(inertia))
