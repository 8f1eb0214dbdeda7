"""What counts as agreement between two runs, and which of two that differ is right."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import agreement, detector


def answer(kind="lowest_flow", x=100.0, y=50.0, *, right=None, plane=None, still=None):
    is_direction = kind in ("lowest_flow", "vanishing_point")
    return SimpleNamespace(
        kind=kind, x_px=x, y_px=y, width_px=200, right=right, single_plane_truth=plane, no_motion_truth=still,
        is_direction=is_direction, seconds=0.1,
    )  # fmt: skip


def test_directions_agree_within_a_twentieth_of_the_width_and_by_kind():
    assert agreement.same_answer(answer(), answer(x=110.0))
    assert not agreement.same_answer(answer(), answer(x=110.1))
    assert not agreement.same_answer(answer(), answer("vanishing_point"))
    assert agreement.same_answer(answer("none"), answer("none", x=None, y=None))
    assert not agreement.same_answer(answer("none"), answer("single_plane"))


@pytest.mark.parametrize(
    ("given", "verdict"),
    [
        (answer(right=True), "right"),
        (answer(right=False), "wrong"),
        (answer(), "unknown"),
        (answer(right=True, plane=True), "wrong"),
        (answer(still=True), "wrong"),
        (answer("single_plane", plane=True), "right"),
        (answer("single_plane", plane=False), "wrong"),
        (answer("single_plane"), "unknown"),
        (answer("none", still=True), "right"),
        (answer("none", plane=True), "silent"),
    ],
)
def test_answers_are_judged_by_what_the_scene_is(given, verdict):
    assert agreement.verdict_of(given) == verdict


def test_the_literal_methods_own_disagreement_is_the_measure():
    fast = [answer(right=True), answer("single_plane", plane=False), answer("none")]
    runs = [
        [answer(right=True), answer(right=True), answer("none")],
        [answer(x=150.0, right=False), answer(right=True), answer("none")],
    ]
    found = agreement.summary(fast, runs)
    assert found["answer"]["fast"] == pytest.approx((0.5 + 0.0 + 1.0) / 3)
    assert found["answer"]["literal_itself"] == pytest.approx(2 / 3)
    assert found["kind"]["fast"] == pytest.approx(2 / 3)
    assert found["direction"]["fast"] == pytest.approx(0.5)  # of the one pair where both say a direction
    assert found["direction"]["pairs_fast"] == 1
    low, high = found["answer"]["interval"]
    assert low <= found["answer"]["difference"] <= high
    assert found["disagreements_fast_slash_literal"] == {"right/wrong": 1, "wrong/right": 2}


def test_a_comparison_without_directions_is_not_a_number():
    found = agreement.agreement([answer("none")], [answer("none")])
    assert math.isnan(agreement.mean_of([found, found], "direction")[0])
    assert agreement.mean_of([found], "answer")[0] == 1.0


def test_the_column_profile_is_that_of_the_rooms_depth():
    depth_m = np.repeat(np.arange(1.0, 19.0), 10)[None, :].repeat(100, axis=0)
    assert agreement.profile(depth_m) == list(range(1, 19))


def test_figures_are_put_between_their_marks_and_nowhere_else():
    page = f"before\n{detector.BEGIN}\nold\n{detector.END}\nafter\n"
    assert detector.page_with(page, "new") == f"before\n{detector.BEGIN}\nnew\n{detector.END}\nafter\n"
    assert detector.PAGE.read_text(encoding="utf-8").count(detector.BEGIN) == 1
