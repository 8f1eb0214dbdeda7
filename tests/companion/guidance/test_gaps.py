"""The best gap seen is kept as a place, and given up when it is reached, contradicted or old."""

from __future__ import annotations

import math

import pytest

from companion.guidance.gaps import Gap, Gaps, best_gap
from companion.guidance.observation import BearingRange, DetectionReport, Pose

LEVEL = (1.0, 0.0, 0.0, 0.0)
S = 1_000_000_000
GOAL = (10.0, 0.0)
MARGIN_M = 0.8


def pose_at(north_m: float, east_m: float, t_ns: int = 0) -> Pose:
    return Pose(t_ns, north_m, east_m, -1.0, LEVEL)


def report_of(
    free_by_deg: dict[float, float], *, pose: Pose | None = None, t_ns: int = 0, spread_m: float = 0.0
) -> DetectionReport:
    bearings = tuple(BearingRange(math.radians(a), m, spread_m, 9) for a, m in free_by_deg.items())
    return DetectionReport(1, t_ns, "lowest_flow", pose=pose or pose_at(0, 0), bearings=bearings)


def doorway(t_ns: int = 0) -> DetectionReport:
    """A wall 4 m ahead, and a door 12 degrees to the right of which one sees 7 m."""
    return report_of({**dict.fromkeys(range(-30, 31, 3), 4.0), 9: 7.0, 12: 7.2, 15: 7.0}, t_ns=t_ns)


def gaps() -> Gaps:
    return Gaps(margin_m=MARGIN_M, least_m=1.2)


def of(report: DetectionReport, **changes: object) -> Gap | None:
    asked: dict[str, object] = {
        "margin_m": MARGIN_M,
        "least_m": 1.2,
        "blocked": (),
        "anywhere": False,
        "now_ns": report.frame_ns,
    }
    return best_gap(report.bearings, pose_at(0, 0), GOAL, **{**asked, **changes})  # type: ignore[arg-type]


def test_a_doorway_is_entered_in_its_middle_and_to_the_margin_before_what_stands_behind_it():
    gap = of(doorway())
    assert gap is not None
    assert math.degrees(gap.azimuth_rad(pose_at(0, 0))) == pytest.approx(12.0)
    assert gap.left_m(pose_at(0, 0)) == pytest.approx(7.2 - MARGIN_M)
    assert gap.nearer_m(GOAL, pose_at(0, 0)) == pytest.approx(gap.worth_m)


def test_a_way_ends_where_the_goal_is():
    gap = of(report_of({0.0: 30.0}), margin_m=0.0)
    assert gap is not None
    assert gap.left_m(pose_at(0, 0)) <= 10.0


def test_a_spread_shortens_a_way_and_a_short_one_is_none():
    assert of(report_of({0.0: 2.1})) is not None
    assert of(report_of({0.0: 2.1}, spread_m=0.2)) is None


def test_what_was_found_blocked_is_not_looked_at_again():
    gap = of(report_of({0.0: 6.0, 60.0: 4.0}), blocked=(0.0,))
    assert gap is not None
    assert math.degrees(gap.azimuth_rad(pose_at(0, 0))) == pytest.approx(60.0)


def test_anywhere_takes_the_longest_way_also_away_from_the_goal():
    report = report_of({0.0: 3.0, 180.0: 7.0})
    toward, longest = of(report), of(report, anywhere=True)
    assert toward is not None
    assert longest is not None
    assert abs(toward.azimuth_rad(pose_at(0, 0))) < 0.1
    assert abs(longest.azimuth_rad(pose_at(0, 0))) > 3.0


def test_one_sighting_is_not_enough_and_two_are():
    kept = gaps()
    kept.add(doorway(0), GOAL)
    assert kept.usable(pose_at(0, 0), 0) is None
    kept.add(doorway(S), GOAL)
    assert kept.usable(pose_at(0, 0), S) is not None


def seen_twice() -> Gaps:
    kept = gaps()
    kept.add(doorway(0), GOAL)
    kept.add(doorway(1), GOAL)
    return kept


def test_it_stays_while_near_its_frame_nothing_is_seen():
    kept = seen_twice()
    kept.add(report_of({}, pose=pose_at(3, 0.6, S), t_ns=S), GOAL)
    gap = kept.usable(pose_at(3, 0.6), 2 * S)
    assert gap is not None
    assert gap.seen_ns == 1


def test_it_ends_when_reached_or_old():
    kept = seen_twice()
    gap = kept.usable(pose_at(0, 0), 1)
    assert gap is not None
    assert kept.usable(pose_at(gap.north_m - 0.3, gap.east_m), 2) is None

    kept = seen_twice()
    assert kept.usable(pose_at(0, 0), 13 * S) is None


def test_two_measurements_in_a_row_that_its_way_is_blocked_end_it_and_one_does_not():
    blocked = report_of({12.0: 0.6}, t_ns=S)
    free = report_of({12.0: 5.0}, t_ns=2 * S)
    kept = seen_twice()
    kept.add(blocked, GOAL, way_free_m=0.6)
    kept.add(free, GOAL, way_free_m=5.0)
    kept.add(blocked, GOAL, way_free_m=0.6)
    assert kept.usable(pose_at(0, 0), 3 * S) is not None
    kept.add(blocked, GOAL, way_free_m=0.6)
    assert kept.usable(pose_at(0, 0), 3 * S) is None


def test_only_a_clearly_better_gap_replaces_it():
    kept = seen_twice()
    for t in (2, 3):
        kept.add(report_of({-21.0: 7.3}, t_ns=t), GOAL)
    gap = kept.usable(pose_at(0, 0), 4)
    assert gap is not None
    assert math.degrees(gap.azimuth_rad(pose_at(0, 0))) == pytest.approx(12.0)

    for t in (5, 6):
        kept.add(report_of({-3.0: 9.5}, t_ns=t), GOAL)
    gap = kept.usable(pose_at(0, 0), 7)
    assert gap is not None
    assert math.degrees(gap.azimuth_rad(pose_at(0, 0))) == pytest.approx(-3.0)


def test_a_way_that_many_saw_through_is_not_shortened_by_one_that_sees_the_frame():
    kept = gaps()
    for t in range(4):
        kept.add(doorway(t), GOAL)
    far = kept.usable(pose_at(0, 0), 4)
    assert far is not None
    near_the_frame = report_of({9.0: 2.6, 12.0: 2.6, 15.0: 2.6}, pose=pose_at(1, 0.2, S), t_ns=S)
    kept.add(near_the_frame, GOAL, way_free_m=2.6)
    gap = kept.usable(pose_at(1, 0.2), S)
    assert gap is not None
    assert (gap.north_m, gap.east_m, gap.seen_ns) == (far.north_m, far.east_m, far.seen_ns)


def test_one_that_few_saw_is_shortened():
    kept = seen_twice()
    kept.add(report_of({9.0: 4.0, 12.0: 4.0, 15.0: 4.0}, t_ns=S), GOAL)
    gap = kept.usable(pose_at(0, 0), S)
    assert gap is not None
    assert gap.left_m(pose_at(0, 0)) == pytest.approx(4.0 - MARGIN_M)


def test_a_way_on_which_something_is_remembered_ends_before_it_or_is_none():
    def pillar(at_m: float) -> object:
        return lambda azimuth_rad: at_m if abs(azimuth_rad - math.radians(12.0)) < 0.1 else None

    shortened = of(doorway(), remembered_m=pillar(5.0))
    assert shortened is not None
    assert shortened.left_m(pose_at(0, 0)) <= 5.0 - MARGIN_M
    gap = of(doorway(), remembered_m=pillar(1.0))
    assert gap is not None
    assert abs(math.degrees(gap.azimuth_rad(pose_at(0, 0))) - 12.0) > 5.0
