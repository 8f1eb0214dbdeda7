"""k-means over the flow field, its number of clusters, centre magnitudes and the single-plane test (paper section 2.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Starts = Callable[[NDArray[np.float64], int], Sequence[NDArray[np.float64]]]
"""Given the samples and n, the (n, D) initial centres of each k-means run."""


@dataclass(frozen=True, slots=True)
class Clustering:
    """One k-means result.

    Attributes
    ----------
    centres
        (n, D).
    labels
        (N,) index of each sample's cluster.
    inertia
        Sum of squared distances to the centres.
    """

    centres: NDArray[np.float64]
    labels: NDArray[np.intp]
    inertia: float

    @property
    def n(self) -> int:
        """Number of clusters."""
        return len(self.centres)


def samples_of(end_px: NDArray[np.float64], angles_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N, 3) samples (x, y, alpha) in px, px and degrees, unscaled as in the paper."""
    return np.column_stack([end_px, angles_deg])


def seeded_starts(seed: int, restarts: int) -> Starts:
    """Return k-means++ starts drawn from ``seed``: the same samples and n always give the same starts."""

    def starts(samples: NDArray[np.float64], n: int) -> list[NDArray[np.float64]]:
        rng = np.random.default_rng([seed, n])
        return [_spread_out(samples, n, rng) for _ in range(restarts)]

    return starts


def kmeans(
    samples: NDArray[np.float64], initial: NDArray[np.float64], max_iterations: int = 300
) -> Clustering:
    """Lloyd's algorithm from given centres until no sample changes its cluster.

    Parameters
    ----------
    samples
        (N, D), N >= n.
    initial
        (n, D) initial centres.
    max_iterations
        Most rounds.

    Returns
    -------
    Clustering
        A cluster that runs empty takes the sample that is furthest from its centre.
    """
    if len(samples) < len(initial):
        raise ValueError(f"expected at least as many samples as centres, got {len(samples)}, {len(initial)}")
    centres = np.array(initial, dtype=np.float64)
    n = len(centres)
    labels = np.full(len(samples), -1, dtype=np.intp)
    for _ in range(max_iterations):
        distances = _squared_distances(samples, centres)
        new_labels = np.argmin(distances, axis=1)
        if np.array_equal(new_labels, labels):
            break
        labels = new_labels
        centres = _means(samples, labels, distances[np.arange(len(samples)), labels], n)
    distances = _squared_distances(samples, centres)
    labels = np.argmin(distances, axis=1)
    return Clustering(centres, labels, float(distances[np.arange(len(samples)), labels].sum()))


def best_of(samples: NDArray[np.float64], n: int, starts: Starts, max_iterations: int = 300) -> Clustering:
    """Run k-means from every start and return the result with the least inertia (the first of equals)."""
    runs = [kmeans(samples, initial, max_iterations) for initial in starts(samples, n)]
    return min(runs, key=lambda run: run.inertia)


def calinski_harabasz(samples: NDArray[np.float64], clustering: Clustering) -> float:
    """Return the Calinski-Harabasz index: dispersion between over dispersion within; larger is better."""
    used, sizes, centres = _used(samples, clustering)
    n_samples, n = len(samples), len(sizes)
    if n < 2 or n_samples <= n:
        return 0.0
    between = float((sizes * ((centres - samples.mean(axis=0)) ** 2).sum(axis=1)).sum())
    within = float(((samples - centres[used]) ** 2).sum())
    if within == 0.0:
        return 1.0  # as scikit-learn defines it
    return between * (n_samples - n) / (within * (n - 1))


def davies_bouldin(samples: NDArray[np.float64], clustering: Clustering) -> float:
    """Return the Davies-Bouldin index: mean over clusters of the worst (spread + spread) / distance; smaller is better."""
    used, sizes, centres = _used(samples, clustering)
    if len(sizes) < 2:
        return 0.0
    distances = np.sqrt(((samples - centres[used]) ** 2).sum(axis=1))
    spreads = np.bincount(used, weights=distances, minlength=len(sizes)) / sizes
    apart = np.sqrt(_squared_distances(centres, centres))
    np.fill_diagonal(apart, np.inf)
    apart[apart == 0.0] = np.inf  # two centres in one place: scikit-learn's rule
    return float(((spreads[:, None] + spreads[None, :]) / apart).max(axis=1).mean())


def choose_n(
    samples: NDArray[np.float64],
    starts: Starts,
    *,
    n_min: int = 2,
    n_max: int = 15,
    max_iterations: int = 300,
) -> Clustering:
    """Return the clustering whose n has the largest CH / DB.

    The paper wants "the biggest CH and the lowest DB"; their quotient joins the two. The smaller n wins a tie.

    Raises
    ------
    ValueError
        With fewer than ``n_min + 1`` samples, for which no index is defined.
    """
    n_max = min(n_max, len(samples) - 1)
    if n_max < n_min:
        raise ValueError(f"expected at least {n_min + 1} samples, got {len(samples)}")
    best: tuple[float, Clustering] | None = None
    for n in range(n_min, n_max + 1):
        clustering = best_of(samples, n, starts, max_iterations)
        spread = davies_bouldin(samples, clustering)
        score = calinski_harabasz(samples, clustering) / spread if spread > 0.0 else 0.0
        if best is None or score > best[0]:
            best = (score, clustering)
    assert best is not None  # noqa: S101 - the range above is not empty
    return best[1]


def nearest_magnitudes(
    at_px: NDArray[np.float64], end_px: NDArray[np.float64], magnitudes: NDArray[np.float64], k: int
) -> NDArray[np.float64]:
    """Return the mean magnitude of the k vectors whose ends are nearest to each point.

    Parameters
    ----------
    at_px
        (M, 2) points of the second frame.
    end_px
        (N, 2) ends of the vectors.
    magnitudes
        (N,) their magnitudes.
    k
        Neighbours; all of them where there are fewer.

    Returns
    -------
    (M,).
    """
    k = min(k, len(end_px))
    order = np.argsort(_squared_distances(at_px, end_px), axis=1, kind="stable")[:, :k]
    means: NDArray[np.float64] = magnitudes[order].mean(axis=1)
    return means


def choose_k(
    centres_px: NDArray[np.float64],
    end_px: NDArray[np.float64],
    magnitudes: NDArray[np.float64],
    *,
    step: int = 5,
    steps: int = 8,
    change: float = 0.05,
) -> int:
    """Return the first k = step * i whose estimates all differ by less than ``change`` from those of i - 1; else the last."""
    before = nearest_magnitudes(centres_px, end_px, magnitudes, step)
    for i in range(2, steps + 1):
        now = nearest_magnitudes(centres_px, end_px, magnitudes, step * i)
        if np.all(np.abs(now - before) < change * before):
            return step * i
        before = now
    return step * steps


def plane_deviation(centre_magnitudes: NDArray[np.float64]) -> float:
    """Return the standard deviation of the centre magnitudes, the paper's measure of "only one plane"."""
    return float(np.std(centre_magnitudes))


def plane_ratio(centre_magnitudes: NDArray[np.float64]) -> float:
    """Return standard deviation over median: free of resolution, of the distance flown and of depth."""
    median = float(np.median(centre_magnitudes))
    return float(np.std(centre_magnitudes)) / median if median > 0.0 else 0.0


def _squared_distances(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    squared: NDArray[np.float64] = ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2)
    return squared


def _means(
    samples: NDArray[np.float64], labels: NDArray[np.intp], squared: NDArray[np.float64], n: int
) -> NDArray[np.float64]:
    labels = labels.copy()
    sizes = np.bincount(labels, minlength=n)
    empty = np.flatnonzero(sizes == 0)
    if len(empty):
        furthest = np.argsort(-squared, kind="stable")[: len(empty)]
        labels[furthest] = empty
        sizes = np.bincount(labels, minlength=n)
    sums = np.column_stack(
        [np.bincount(labels, weights=samples[:, d], minlength=n) for d in range(samples.shape[1])]
    )
    # A cluster of one can lose its sample to an empty one; then it keeps no mean and sits on that sample.
    means: NDArray[np.float64] = sums / np.maximum(sizes, 1)[:, None]
    for lost in np.flatnonzero(sizes == 0):
        means[lost] = samples[int(np.argmax(squared))]
    return means


def _used(
    samples: NDArray[np.float64], clustering: Clustering
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return labels renumbered without gaps, sizes and true means of the clusters that hold samples."""
    _, labels, counts = np.unique(clustering.labels, return_inverse=True, return_counts=True)
    sizes = counts.astype(np.float64)
    sums = np.column_stack(
        [np.bincount(labels, weights=samples[:, d], minlength=len(sizes)) for d in range(samples.shape[1])]
    )
    return labels.astype(np.intp), sizes, sums / sizes[:, None]


def _spread_out(samples: NDArray[np.float64], n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """k-means++ (Arthur and Vassilvitskii 2007): each next centre with a chance as its squared distance."""
    chosen = [int(rng.integers(len(samples)))]
    squared = ((samples - samples[chosen[0]]) ** 2).sum(axis=1)
    for _ in range(n - 1):
        total = float(squared.sum())
        if total > 0.0:
            reached = int(np.searchsorted(np.cumsum(squared), rng.random() * total, side="right"))
            index = min(reached, len(samples) - 1)
        else:
            index = int(rng.integers(len(samples)))  # fewer distinct samples than clusters
        chosen.append(index)
        squared = np.minimum(squared, ((samples - samples[index]) ** 2).sum(axis=1))
    return samples[chosen].copy()
