"""What answers and flights are worth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.tune.score import RIGHT, SILENT, WRONG, answer_score, flight_scores
from detector.evaluation.judgement import Verdict

UNKNOWN = Verdict(**{field.name: None for field in dataclasses.fields(Verdict)})


def verdict(kind, **known):
    return dataclasses.replace(UNKNOWN, kind=kind, near_wall_limit=False, **known)


@pytest.mark.parametrize(
    ("answer", "worth"),
    [
        (verdict("none", no_motion_truth=True), RIGHT),
        (verdict("none", single_plane_truth=False), SILENT),
        (verdict("lowest_flow", no_motion_truth=True), WRONG),
        (verdict("single_plane", single_plane_truth=True), RIGHT),
        (verdict("single_plane", single_plane_truth=False), SILENT),
        (verdict("lowest_flow", single_plane_truth=True, right=True), WRONG),
        (verdict("lowest_flow", single_plane_truth=False, right=True), RIGHT),
        (verdict("gap", single_plane_truth=False, right=False), WRONG),
        (verdict("gap", single_plane_truth=False), RIGHT),
    ],
)
def test_what_an_answer_is_worth(answer, worth):
    assert answer_score(answer) == worth


def test_just_at_the_limit_a_wall_is_as_good_as_none():
    near = dataclasses.replace(verdict("single_plane", single_plane_truth=False), near_wall_limit=True)
    assert answer_score(near) == RIGHT


def mean(outcomes, times_s=None, reachable=None):
    count = len(outcomes)
    return float(
        np.mean(
            flight_scores(
                outcomes,
                times_s or [50.0] * count,
                [100.0] * count,
                reachable=reachable or [True] * count,
            )
        )
    )


def test_one_collision_outweighs_whatever_else_is_gained():
    safe_and_idle = mean(["stuck"] * 20)
    fast_with_one_collision = mean(["reached"] * 19 + ["collided"], times_s=[0.0] * 20)
    assert safe_and_idle > fast_with_one_collision
    assert mean(["collided", "stuck"]) > mean(["collided", "collided"])


def test_then_arriving_counts_and_then_its_time():
    assert mean(["reached"], [100.0]) > mean(["timeout"])
    assert mean(["reached"], [20.0]) > mean(["reached"], [30.0])
    assert mean(["stuck"], reachable=[False]) == 1.0
