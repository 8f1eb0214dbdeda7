"""k-means over the flow field, its number of clusters, centre magnitudes and the single-plane test (paper section 2.2).

k-means and the two indices are scikit-learn's here. :mod:`detector.fast_clusters` has the same steps for the flight rate.
scikit-learn is imported when it is first used: a worker that never needs it starts sooner and stays smaller.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Starts = Callable[[NDArray[np.float64], int], Sequence[NDArray[np.float64]]]
"""Given the samples and n, the (n, D) initial centres of each k-means run."""

Quality = Callable[["Clustering"], float]
"""How good a clustering is; larger is better."""


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
        from sklearn.cluster import kmeans_plusplus

        random = np.random.RandomState([seed % (1 << 32), n])
        return [
            np.asarray(kmeans_plusplus(samples, n, random_state=random)[0], np.float64)
            for _ in range(restarts)
        ]

    return starts


def kmeans(
    samples: NDArray[np.float64], initial: NDArray[np.float64], max_iterations: int = 300
) -> Clustering:
    """Lloyd's algorithm (scikit-learn's) from given centres until no sample changes its cluster.

    Parameters
    ----------
    samples
        (N, D), N >= n.
    initial
        (n, D) initial centres.
    max_iterations
        Most rounds.
    """
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    if len(samples) < len(initial):
        raise ValueError(f"expected at least as many samples as centres, got {len(samples)}, {len(initial)}")
    model = KMeans(len(initial), init=initial, n_init=1, max_iter=max_iterations, tol=0.0, algorithm="lloyd")
    with warnings.catch_warnings():
        # Fewer distinct samples than clusters, or rounds used up: the result is what there is.
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(samples)
    return Clustering(
        np.asarray(model.cluster_centers_, np.float64),
        np.asarray(model.labels_, np.intp),
        float(model.inertia_),
    )


def best_of(samples: NDArray[np.float64], n: int, starts: Starts, max_iterations: int = 300) -> Clustering:
    """Run k-means from every start and return the result with the least inertia (the first of equals)."""
    runs = [kmeans(samples, initial, max_iterations) for initial in starts(samples, n)]
    return min(runs, key=lambda run: run.inertia)


def calinski_harabasz(samples: NDArray[np.float64], clustering: Clustering) -> float:
    """Return the Calinski-Harabasz index: dispersion between over dispersion within; larger is better."""
    from sklearn.metrics import calinski_harabasz_score

    if not _is_defined(samples, clustering):
        return 0.0
    return float(calinski_harabasz_score(samples, clustering.labels))


def davies_bouldin(samples: NDArray[np.float64], clustering: Clustering) -> float:
    """Return the Davies-Bouldin index: mean over clusters of the worst (spread + spread) / distance; smaller is better."""
    from sklearn.metrics import davies_bouldin_score

    if not _is_defined(samples, clustering):
        return 0.0
    return float(davies_bouldin_score(samples, clustering.labels))


def _is_defined(samples: NDArray[np.float64], clustering: Clustering) -> bool:
    """Whether the indices are: at least two clusters hold samples, and not each sample is one of its own."""
    used = len(np.unique(clustering.labels))
    return 2 <= used < len(samples)


def quality_of(samples: NDArray[np.float64], clustering: Clustering) -> float:
    """Return CH / DB; infinite where every sample lies on its centre, 0 where the indices are not defined.

    The paper wants "the biggest CH and the lowest DB"; their quotient joins the two.
    """
    if not _is_defined(samples, clustering):
        return 0.0
    spread = davies_bouldin(samples, clustering)
    return calinski_harabasz(samples, clustering) / spread if spread > 0.0 else math.inf


def search_n(
    cluster: Callable[[int], Clustering],
    quality: Quality,
    n_samples: int,
    *,
    n_min: int = 2,
    n_max: int = 15,
) -> Clustering:
    """Return the clustering whose n has the best quality.

    The smaller n wins a tie, and the first that leaves nothing within its clusters ends the search.

    Parameters
    ----------
    cluster
        Gives the clustering into n.
    quality
        CH / DB, see :func:`quality_of`.
    n_samples
        Number of samples: n stays below it.
    n_min, n_max
        Range of n.

    Raises
    ------
    ValueError
        With fewer than ``n_min + 1`` samples, for which no index is defined.
    """
    n_max = min(n_max, n_samples - 1)
    if n_max < n_min:
        raise ValueError(f"expected at least {n_min + 1} samples, got {n_samples}")
    best, best_quality = cluster(n_min), -math.inf
    for n in range(n_min, n_max + 1):
        clustering = best if n == n_min else cluster(n)
        found = quality(clustering)
        if math.isinf(found):
            return clustering  # every sample on its centre: no other n can be better
        if found > best_quality:
            best, best_quality = clustering, found
    return best


def choose_n(
    samples: NDArray[np.float64],
    starts: Starts,
    *,
    n_min: int = 2,
    n_max: int = 15,
    max_iterations: int = 300,
) -> Clustering:
    """Return the clustering whose n has the largest CH / DB, by scikit-learn's k-means: :func:`search_n`."""
    return search_n(
        lambda n: best_of(samples, n, starts, max_iterations),
        lambda clustering: quality_of(samples, clustering),
        len(samples),
        n_min=n_min,
        n_max=n_max,
    )


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
