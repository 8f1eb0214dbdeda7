"""k-means and indices at flight rate agree with scikit-learn's."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import calinski_harabasz_score, davies_bouldin_score

from detector import clusters, fast_clusters
from detector.clusters import Clustering


def blobs(seed: int, n: int = 5, per_blob: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    middles = rng.uniform((0, 0, 0), (640, 480, 360), (n, 3))
    return np.concatenate([rng.normal(middle, 12.0, (per_blob, 3)) for middle in middles])


@pytest.mark.parametrize("seed", range(6))
def test_as_good_as_scikit_learns(seed: int) -> None:
    samples = blobs(seed)
    for n in (2, 5, 9):
        fast = fast_clusters.kmeans(samples, n, seed=0, attempts=8)
        exact = clusters.best_of(samples, n, clusters.seeded_starts(0, 8))
        assert fast.inertia <= 1.05 * exact.inertia
        assert fast.n == n


def test_the_same_seed_gives_the_same_clusters_whatever_ran_before() -> None:
    samples = blobs(1)
    first = fast_clusters.kmeans(samples, 7, seed=3, attempts=2)
    fast_clusters.kmeans(blobs(2), 4, seed=9, attempts=1)
    second = fast_clusters.kmeans(samples, 7, seed=3, attempts=2)
    np.testing.assert_array_equal(first.centres, second.centres)
    np.testing.assert_array_equal(first.labels, second.labels)


def test_other_seeds_start_elsewhere() -> None:
    samples = np.random.default_rng(0).uniform(0, 400, (300, 3))
    found = {fast_clusters.kmeans(samples, 9, seed=seed, attempts=1).inertia for seed in range(5)}
    assert len(found) > 1


def test_a_warm_start_follows_its_centres() -> None:
    samples = blobs(4)
    before = fast_clusters.kmeans(samples, 5, seed=0, attempts=4)
    moved = samples + np.array([6.0, -3.0, 0.0])
    after = fast_clusters.from_centres(moved, before.centres)
    np.testing.assert_allclose(after.centres, before.centres + np.array([6.0, -3.0, 0.0]), atol=1e-2)
    np.testing.assert_array_equal(after.labels, before.labels)


@given(st.integers(0, 1000), st.integers(2, 9), st.integers(12, 80))
def test_quality_is_ch_over_db(seed: int, n: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    samples = rng.uniform(0, 300, (count, 3))
    labels = np.concatenate([np.arange(n), rng.integers(0, n, count - n)])
    found = fast_clusters.quality_of(samples, Clustering(np.zeros((n, 3)), labels, 0.0))
    expected = calinski_harabasz_score(samples, labels) / davies_bouldin_score(samples, labels)
    assert found == pytest.approx(expected, rel=1e-6)


def test_quality_where_the_indices_are_not_defined() -> None:
    samples = blobs(0)
    one = Clustering(np.zeros((1, 3)), np.zeros(len(samples), np.intp), 0.0)
    assert fast_clusters.quality_of(samples, one) == clusters.quality_of(samples, one) == 0.0
    apart = np.repeat([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], 5, axis=0)
    exact = Clustering(apart[[0, 5]], np.repeat([0, 1], 5), 0.0)
    assert fast_clusters.quality_of(apart, exact) == clusters.quality_of(apart, exact) == math.inf


def test_fewer_samples_than_clusters_is_an_error() -> None:
    with pytest.raises(ValueError, match="as many samples as clusters, got 3, 4"):
        fast_clusters.kmeans(np.zeros((3, 3)), 4, seed=0, attempts=1)


def test_the_fast_path_never_loads_scikit_learn() -> None:
    pairs = Path(__file__).parents[1] / "data" / "pairs" / "office"
    images = [str(pairs / name) for name in ("00068.jpg", "00069.jpg")]
    code = f"import sys; from detector.cli import main; main(['detect', *{images!r}]); sys.exit('sklearn' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
