"""What is searched, and within which limits."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from companion.tune.errors import TuneError
from companion.tune.space import USUAL, USUAL_IN_FLIGHT, dimensions, params_model, usual_params


def searched(*asked, method="parallax", spread=4.0, with_tables=False):
    return dimensions(asked, usual_params(method, "default"), spread=spread, with_tables=with_tables)


@pytest.mark.parametrize("method", ["paper", "parallax"])
def test_both_ends_of_every_usual_range_are_allowed_by_the_model(method):
    usual = usual_params(method, "default")
    for each in searched(*USUAL[method], method=method):
        ends = each.choices or tuple(int(end) if each.whole else end for end in (each.low, each.high))
        assert len(ends) >= 2
        for end in ends:
            params_model(method).model_validate({**usual.model_dump(), each.name: each.tidy(end)})
        assert each.choices or each.low <= each.usual <= each.high


def test_the_spread_ends_at_the_fields_limits():
    (share,) = searched("plane_share", spread=2.0)
    assert (share.low, share.high) == (0.425, 1.0)
    (angle,) = searched("shortest_fraction", method="paper", spread=100.0)
    assert angle.high < 1.0  # the limit itself is not allowed
    with pytest.raises(ValidationError):
        params_model("paper").model_validate({"shortest_fraction": 1.0})


def test_a_window_stays_odd():
    (window,) = searched("lk_window_px=4..20", method="paper")
    assert (window.low % 2, window.high % 2, window.step) == (1, 1, 2)


def test_a_given_range_always_holds_the_usual_value_which_is_tried_first():
    (found,) = searched("round_trip_px=1..2")
    assert (found.low, found.high, found.usual) == (0.7, 2.0, 0.7)


def test_numbers_are_written_with_four_digits_and_stay_in_range():
    (found,) = searched("round_trip_px=0.7..1.23456")
    assert found.tidy(0.98765432) == 0.9877
    assert found.tidy(1.23456) == 1.23456 or found.tidy(1.23456) <= found.high


def test_keys_of_the_configuration_are_searched_in_flights_alone():
    found = searched(*USUAL_IN_FLIGHT, with_tables=True)
    assert [each.name for each in found] == list(USUAL_IN_FLIGHT)
    with pytest.raises(TuneError, match="no such setting"):
        searched("guidance.max_step_m")


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (("nonsense",), "nonsense: no such setting; allowed are width_px"),
        (("round_trip_px", "round_trip_px=1..2"), "named twice"),
        (("round_trip_px=2..1",), "allowed is LOW..HIGH"),
        (("round_trip_px=-1..2",), "allowed is LOW..HIGH"),
        (("round_trip_px=1..nan",), "needed is LOW..HIGH"),
        (("round_trip_px=5",), "needed is LOW..HIGH"),
        (("step_px=2.5..8",), "whole numbers"),
    ],
)
def test_what_cannot_be_searched_is_said(asked, words):
    with pytest.raises(TuneError, match=words):
        searched(*asked)


def test_choices_may_be_picked():
    (found,) = searched("plane_test=plane_share,deviation_px", method="paper")
    assert set(found.choices) == {"plane_share", "deviation_px"}
    with pytest.raises(TuneError, match="two or more of"):
        searched("plane_test=plane_share", method="paper")
    with pytest.raises(TuneError, match="no such setting"):
        searched("guidance.nonsense", with_tables=True)
