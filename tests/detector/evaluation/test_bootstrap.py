"""Bootstrap intervals: of the right size, repeatable, and honest where there is nothing to say."""

import math

import numpy as np
import pytest

from detector.evaluation.bootstrap import known_mean, known_median, resampled, share_interval


def test_the_interval_of_a_share_is_that_of_its_standard_error():
    hits = np.arange(400) % 4 == 0
    low, high = share_interval(hits)
    expected = 1.96 * math.sqrt(0.25 * 0.75 / 400)
    assert (0.25 - low, high - 0.25) == (pytest.approx(expected, rel=0.15), pytest.approx(expected, rel=0.15))


def test_the_same_seed_gives_the_same_interval():
    hits = np.random.default_rng(3).random(60) < 0.4
    assert share_interval(hits, seed=5) == share_interval(hits, seed=5)
    assert share_interval(hits, seed=5) != share_interval(hits[:-7], seed=5)


def test_about_nineteen_of_twenty_intervals_hold_the_truth():
    rng = np.random.default_rng(0)
    held = 0
    for trial in range(60):
        low, high = share_interval(rng.random(80) < 0.3, seed=trial)
        held += low <= 0.3 <= high
    assert 50 <= held <= 60


def test_no_case_has_no_interval():
    assert share_interval(np.zeros(0, np.bool_)) is None
    assert resampled(5, lambda drawn: np.full(len(drawn), np.nan)) is None


def test_unknown_values_do_not_count():
    rows = np.array([[1.0, np.nan, 4.0, 2.0], [np.nan] * 4, [5.0, 1.0, 2.0, 100.0]])
    np.testing.assert_equal(known_mean(rows), [7 / 3, np.nan, 27.0])
    np.testing.assert_equal(known_median(rows), [2.0, np.nan, 3.5])


def test_the_interval_of_a_median_holds_it():
    values = np.random.default_rng(1).normal(7.0, 1.0, 200)
    low, high = resampled(200, lambda drawn: known_median(values[drawn]))
    assert low < 7.0 < high
    assert high - low < 0.8
