"""Laws of the clustering and of the neighbourhood means; single cases are in test_steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector import clusters
from detector.clusters import Clustering, choose_k, choose_n, kmeans, nearest_magnitudes, seeded_starts


def field(seed: int, n: int = 120) -> np.ndarray:
    return np.random.default_rng(seed).uniform([0, 0, 0], [640, 480, 360], (n, 3))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), n=st.integers(2, 15))
def test_kmeans_ends_where_nothing_changes(seed: int, n: int) -> None:
    samples = field(seed)
    found = kmeans(samples, seeded_starts(seed, 1)(samples, n)[0])
    squared = ((samples[:, None] - found.centres[None]) ** 2).sum(axis=2)
    np.testing.assert_array_equal(found.labels, squared.argmin(axis=1))
    assert found.inertia == pytest.approx(squared.min(axis=1).sum())
    for label in range(n):
        np.testing.assert_allclose(found.centres[label], samples[found.labels == label].mean(axis=0))


def test_the_iterations_are_limited() -> None:
    samples = field(1)
    initial = samples[:8]
    inertia = [kmeans(samples, initial, limit).inertia for limit in (1, 2, 4, 300)]
    assert inertia == sorted(inertia, reverse=True)
    assert inertia[0] > inertia[-1]


def test_starts_are_samples_all_different_and_drawn_from_the_seed() -> None:
    samples = field(2)
    first, second = (seeded_starts(5, 3)(samples, 6) for _ in range(2))
    assert len(first) == 3
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
        assert len({tuple(row) for row in a} & {tuple(row) for row in samples}) == 6
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], seeded_starts(6, 3)(samples, 6)[0])


def test_fewer_different_samples_than_clusters_are_no_error() -> None:
    samples = np.repeat(field(3, 3), 40, axis=0)
    found = choose_n(samples, seeded_starts(0, 2))
    assert np.isfinite(found.centres).all()
    assert np.isfinite(found.inertia)


def test_one_place_is_no_error() -> None:
    found = choose_n(np.ones((20, 3)), seeded_starts(0, 2))
    np.testing.assert_array_equal(found.centres, np.ones((found.n, 3)))


def test_too_few_samples_for_the_centres_are_refused() -> None:
    with pytest.raises(ValueError, match="at least as many samples as centres, got 2, 3"):
        kmeans(np.zeros((2, 3)), np.zeros((3, 3)))


def test_n_never_reaches_the_number_of_samples() -> None:
    assert choose_n(field(4, 5), seeded_starts(0, 1), n_max=15).n <= 4
    assert choose_n(field(4, 3), seeded_starts(0, 1)).n == 2


def test_n_stays_in_its_range() -> None:
    blobs = np.array([[0.0, 0, 0], [600, 0, 0], [0, 400, 0], [600, 400, 0]])
    samples = np.repeat(blobs, 30, axis=0) + np.random.default_rng(0).normal(0, 3, (120, 3))
    assert choose_n(samples, seeded_starts(0, 4), n_min=2, n_max=3).n <= 3
    assert choose_n(samples, seeded_starts(0, 4), n_min=5, n_max=9).n >= 5


def test_indices_of_a_single_used_cluster_are_zero() -> None:
    samples = field(5, 10)
    lumped = Clustering(np.array([samples.mean(axis=0), [9e9] * 3]), np.zeros(10, np.intp), 1.0)
    assert clusters.calinski_harabasz(samples, lumped) == 0.0
    assert clusters.davies_bouldin(samples, lumped) == 0.0


def test_k_is_compared_with_the_one_before_for_every_centre() -> None:
    ends = np.column_stack([np.concatenate([np.arange(40.0), 1000.0 + np.arange(40.0)]), np.zeros(80)])
    centres = np.array([[0.0, 0.0], [1000.0, 0.0]])
    calm = np.ones(40)
    jumpy = np.array([1.0] * 5 + [3.0] * 5 + [2.0] * 30)
    assert choose_k(centres[:1], ends, np.concatenate([calm, jumpy])) == 10
    assert choose_k(centres, ends, np.concatenate([calm, jumpy])) == 15
    assert choose_k(centres, ends, np.concatenate([jumpy, calm])) == 15


def test_the_change_of_k_is_strictly_below_the_limit() -> None:
    ends = np.column_stack([np.arange(40.0), np.zeros(40)])
    grown = np.array([4.0] * 5 + [6.0] * 5 + [5.0] * 30)  # means 4, 5, 5: a change of just a quarter
    assert choose_k(np.zeros((1, 2)), ends, grown, change=0.25) == 15
    assert choose_k(np.zeros((1, 2)), ends, grown, change=0.26) == 10


def test_nearest_is_nearest_in_the_image_and_never_more_than_there_are() -> None:
    rng = np.random.default_rng(6)
    ends, lengths = rng.uniform(0, 640, (50, 2)), rng.uniform(1, 30, 50)
    at = np.array([[320.0, 240.0], [-50.0, 900.0]])
    for k in (1, 7, 50, 400):
        expected = [lengths[np.argsort(np.hypot(*(ends - place).T))[:k]].mean() for place in at]
        np.testing.assert_allclose(nearest_magnitudes(at, ends, lengths, k), expected)


def test_equal_magnitudes_have_neither_deviation_nor_ratio() -> None:
    assert clusters.plane_deviation(np.full(4, 3.0)) == 0.0
    assert clusters.plane_ratio(np.full(4, 3.0)) == 0.0
    assert clusters.plane_ratio(np.zeros(4)) == 0.0
    assert clusters.plane_ratio(np.array([1.0, 2.0, 2.0, 7.0])) == pytest.approx(np.std([1, 2, 2, 7]) / 2.0)
