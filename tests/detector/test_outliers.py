"""Laws of the length and angular filters; single cases are in test_steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.outliers import AngleSpread, angle_spread, angular_filter, choose_p, length_filter

degrees = st.integers(0, 3599).map(lambda tenths: tenths / 10.0)


@given(lengths=st.lists(st.floats(0.0, 100.0), max_size=80), tenths=st.integers(0, 9))
def test_the_length_filter_drops_exactly_the_shortest(lengths: list[float], tenths: int) -> None:
    values = np.array(lengths)
    kept = length_filter(values, tenths / 10)
    assert (
        len(values) - kept.sum() == tenths * len(values) // 10
    )  # in whole numbers, whatever 0.1 is in binary
    if not kept.all():
        assert values[~kept].max() <= values[kept].min()


def test_of_equal_lengths_the_earlier_go_first() -> None:
    assert length_filter(np.ones(20), 0.1).tolist() == [False, False] + [True] * 18


@pytest.mark.parametrize(("n", "hundredths"), [(100, 29), (100, 57), (200, 29), (50, 58), (30, 10), (30, 20)])
def test_a_whole_share_is_dropped_whole_whatever_it_is_in_binary(n: int, hundredths: int) -> None:
    assert (~length_filter(np.arange(n, dtype=float), hundredths / 100)).sum() == n * hundredths // 100


@given(angles=st.lists(degrees, min_size=3, max_size=60), turn=degrees)
def test_circular_statistics_turn_with_the_field(angles: list[float], turn: float) -> None:
    values = np.array(angles)
    resultant = abs(np.exp(1j * np.radians(values)).mean())
    if resultant < 0.05:
        return  # no mean direction to speak of
    before, after = (angle_spread(a, "circular") for a in (values, (values + turn) % 360.0))
    assert math.cos(math.radians(after.mean_deg - before.mean_deg - turn)) == pytest.approx(1.0, abs=1e-6)
    # exactly opposite the mean, the two ways round are equally long
    np.testing.assert_allclose(after.deviation_deg, before.deviation_deg, atol=1e-6)
    assert after.sigma_deg == pytest.approx(before.sigma_deg)


@given(angles=st.lists(st.floats(100.0, 200.0), min_size=2, max_size=60))
def test_far_from_zero_the_linear_figures_are_numpys(angles: list[float]) -> None:
    values = np.array(angles)
    spread = angle_spread(values, "linear")
    assert (spread.mean_deg, spread.sigma_deg) == (pytest.approx(values.mean()), pytest.approx(values.std()))
    np.testing.assert_allclose(spread.deviation_deg, np.abs(values - values.mean()))


def test_about_zero_linear_keeps_an_opposite_vector_that_circular_drops() -> None:
    field = np.concatenate([np.linspace(345.0, 359.0, 50), np.linspace(1.0, 15.0, 50), [180.0]])
    linear, circular = angle_spread(field, "linear"), angle_spread(field, "circular")
    assert angular_filter(linear, 1)[-1]  # 180 is the very mean of them
    assert angular_filter(circular, 5).tolist() == [True] * 100 + [False]


def test_the_angular_limit_is_strict() -> None:
    spread = AngleSpread(0.0, 1.0, np.array([1.9, 2.0, 2.1]))
    assert angular_filter(spread, 2).tolist() == [True, False, False]


@given(
    deviations=st.lists(st.floats(0.0, 12.0), min_size=1, max_size=80), gain=st.sampled_from([0.05, 0.1, 0.5])
)
def test_p_is_the_first_of_2_to_9_that_gains_little(deviations: list[float], gain: float) -> None:
    spread = AngleSpread(0.0, 1.0, np.array(deviations))
    p = choose_p(spread, gain)
    assert 2 <= p <= 9

    def gains_enough(candidate: int) -> bool:
        before, after = (int(angular_filter(spread, q).sum()) for q in (candidate - 1, candidate))
        return after - before >= gain * before

    assert all(gains_enough(smaller) for smaller in range(2, p))
    assert p == 9 or not gains_enough(p)


def test_an_empty_field_is_no_error() -> None:
    for statistics in ("linear", "circular"):
        spread = angle_spread(np.zeros(0), statistics)  # type: ignore[arg-type]
        assert angular_filter(spread, choose_p(spread)).shape == (0,)
    assert length_filter(np.zeros(0)).shape == (0,)


@pytest.mark.parametrize(("before", "after"), [(1725, 1553), (331, 298), (1192, 1073), (538, 485)])
def test_the_length_filter_gives_the_counts_of_the_papers_table_1(before: int, after: int) -> None:
    lengths = np.random.default_rng(0).random(before)
    kept = length_filter(lengths)
    assert kept.sum() == after
    assert lengths[~kept].max() < lengths[kept].min()
