"""Rates over the last two seconds, nearest-rank percentiles, and the summary of a run."""

import pytest

from companion.run_statistics import Newest, RateMeter, RunStatistics, percentile, percentiles

SEC = 1_000_000_000


def test_a_rate_counts_only_the_last_two_seconds_and_falls_to_zero_by_itself():
    meter = RateMeter()
    for i in range(100):
        meter.tick(i * SEC // 10)
    now = 99 * SEC // 10
    assert meter.rate_hz(now) == pytest.approx(10, abs=0.5)
    assert meter.rate_hz(now + SEC) == pytest.approx(5, abs=0.5)
    assert meter.rate_hz(now + 3 * SEC) == 0


@pytest.mark.parametrize(
    ("share", "expected"), [(0.0, 1.0), (0.25, 1.0), (0.5, 2.0), (0.51, 3.0), (0.95, 4.0), (1.0, 4.0)]
)
def test_percentiles_are_values_that_occurred_nearest_rank(share, expected):
    assert percentile([4.0, 1.0, 3.0, 2.0], share) == expected


def test_no_values_have_no_percentile():
    assert percentile([], 0.5) is None
    assert percentiles(iter(())) == {"p50": None, "p95": None}


def test_percentiles_read_an_iterator_once_and_round():
    assert percentiles(iter([1.04, 2.06, 3.0])) == {"p50": 2.1, "p95": 3.0}


def test_the_newest_are_kept_in_the_order_in_which_they_came():
    newest = Newest(3)
    assert (len(newest), list(newest)) == (0, [])
    newest.extend([1.0, 2.0])
    assert list(newest) == [1.0, 2.0]
    newest.extend([3.0, 4.0, 5.0, 6.0, 7.0])
    assert (len(newest), list(newest)) == (3, [5.0, 6.0, 7.0])


def test_the_summary_has_the_totals():
    statistics = RunStatistics()
    statistics.frames_total = 3
    statistics.detections.update(["none", "none", "lowest_flow"])
    statistics.reasons["no_motion"] = 2
    statistics.detection_ms.extend([10.0, 20.0, 30.0])
    assert statistics.summary() == {
        "frames": 3,
        "detections": {"none": 2, "lowest_flow": 1},
        "reasons": {"no_motion": 2},
        "detection_ms": {"p50": 20.0, "p95": 30.0},
        "frame_to_setpoint_ms": {"p50": None, "p95": None},
    }
