"""Free distances by azimuth: a narrow way is as free as its own bearing says, not as its neighbours do."""

from __future__ import annotations

import math

import pytest

from companion.config import GuidanceConfig
from companion.guidance.memory import SeenBearings
from companion.guidance.observation import BearingRange, DetectionReport, Pose

HERE = Pose(0, 0.0, 0.0, -1.0, (1.0, 0.0, 0.0, 0.0))


def seen(
    free_by_deg: dict[float, float], obstacles: tuple[tuple[float, float], ...] = (), *, times: int = 1
) -> SeenBearings:
    known = SeenBearings(GuidanceConfig(), vehicle_width_m=0.9)
    bearings = tuple(BearingRange(math.radians(a), m, 0.1, 9) for a, m in free_by_deg.items())
    for seq in range(times):
        known.add(DetectionReport(seq, 0, "gap", pose=HERE, bearings=bearings, obstacles=obstacles))
    return known


def free_m(known: SeenBearings, azimuth_deg: float) -> float | None:
    return known.free_m(math.radians(azimuth_deg), HERE, 0.0, 0)


DOOR = {9.0: 1.2, 12.0: 5.7, 15.0: 1.6}
"""A metre before a doorway: one bearing leads through it."""


def test_the_bearing_that_leads_through_a_door_is_free_as_far_as_it_was_measured():
    assert free_m(seen(DOOR), 12.4) == pytest.approx(5.6)


def test_between_two_bearings_the_shorter_one_counts():
    assert free_m(seen(DOOR), 10.5) == pytest.approx(1.1)
    assert free_m(seen(DOOR), 13.7) == pytest.approx(1.5)


def test_where_none_is_near_those_within_four_degrees_stand_for_it_and_beyond_it_is_unknown():
    known = seen({-3.0: 4.0, 3.0: 2.0})
    assert free_m(known, 0.0) == pytest.approx(1.9)
    assert free_m(known, 8.0) is None


def test_what_is_remembered_to_stand_there_ends_it_earlier():
    known = seen(DOOR, ((2.0, 0.4),), times=2)
    found = free_m(known, 12.0)
    assert found is not None
    assert found < 2.1
    assert known.remembered_m(math.radians(12.0), HERE, 0) == pytest.approx(found)
    assert known.remembered_m(math.radians(-60.0), HERE, 0) is None
