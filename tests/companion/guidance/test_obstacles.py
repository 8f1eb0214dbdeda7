"""What has left the camera's view is still there."""

import math

import pytest

from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.guidance.obstacles import NearObstacles

SEC = 1_000_000_000


def pose(north=0.0, east=0.0):
    return Pose(0, north, east, -1.2, (1.0, 0.0, 0.0, 0.0))


def seen(*places, seq=0, at_ns=0):
    return DetectionReport(seq, at_ns, "lowest_flow", obstacles=places)


def remembered(*places):
    memory = NearObstacles(0.4)
    memory.add(seen(*places))
    memory.add(seen(*places, seq=1))
    return memory


def test_an_obstacle_in_the_way_limits_it_and_one_beside_it_does_not():
    memory = remembered((2.0, 0.1))
    assert memory.free_m(0.0, pose(), SEC) == pytest.approx(2.0)
    assert memory.free_m(math.radians(30), pose(), SEC) is None
    assert memory.free_m(math.pi, pose(), SEC) is None
    assert memory.free_m(0.0, pose(north=1.5), SEC) == pytest.approx(0.5)


def test_a_single_sighting_is_not_believed():
    memory = NearObstacles(0.4)
    memory.add(seen((2.0, 0.0)))
    assert memory.free_m(0.0, pose(), SEC) is None


def test_beside_a_wall_the_way_along_it_and_away_from_it_is_free_and_into_it_is_not():
    wall = [(0.1 * i, 0.42) for i in range(-10, 20)]
    memory = remembered(*wall)
    assert memory.free_m(0.0, pose(), SEC) is None
    assert memory.free_m(-math.pi / 2, pose(), SEC) is None
    assert memory.free_m(math.pi / 2, pose(), SEC) == pytest.approx(0.42)
    assert memory.free_m(math.radians(20), pose(), SEC) < 1.5


def test_very_near_an_edge_it_may_go_away_from_it():
    memory = remembered((0.05, 0.3))
    assert memory.free_m(-math.pi / 2, pose(), SEC) is None
    assert memory.free_m(0.0, pose(), SEC) is None  # abeam: it gets no nearer


def test_after_a_minute_or_five_metres_it_is_forgotten():
    memory = remembered((2.0, 0.0))
    assert memory.free_m(0.0, pose(), 61 * SEC) is None
    memory = remembered((2.0, 0.0))
    assert memory.free_m(0.0, pose(north=-3.5), SEC) is None
    assert memory.free_m(0.0, pose(), SEC) is None


def test_what_is_measured_free_behind_it_erases_a_wrong_sighting_in_time():
    memory = remembered((2.0, 0.0))
    memory.add(seen((2.0, 0.0), seq=2))
    through = DetectionReport(9, 9, "lowest_flow", pose=pose(), bearings=(BearingRange(0.0, 4.0, 0.0, 9),))
    memory.add(through)
    assert memory.free_m(0.0, pose(), 0) is not None, "one measurement is not enough"
    memory.add(through)
    assert memory.free_m(0.0, pose(), 0) is None


def test_a_thing_close_by_is_not_erased_by_what_is_seen_past_it():
    memory = remembered((0.8, 0.1))
    for seq in range(5):
        bearings = (BearingRange(0.1, 4.0, 0.0, 9),)
        memory.add(DetectionReport(9 + seq, 9, "lowest_flow", pose=pose(), bearings=bearings))
    assert memory.free_m(0.0, pose(), 0) == pytest.approx(0.8)


def test_the_way_between_two_jambs_is_their_middle():
    azimuth, room_m = remembered((1.0, -0.35), (1.0, 0.75)).clearer(0.0, pose(), 0)
    assert math.degrees(azimuth) == pytest.approx(11.3, abs=3.0)
    assert room_m > 0.5


def test_an_open_way_is_not_moved():
    assert NearObstacles(0.4).clearer(0.3, pose(), 0)[0] == 0.3
