"""OBSTACLE_DISTANCE: bins about the nose, unknown ones as unknown, as a receiver reads them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.config import Config
from companion.guidance.coordinates import quaternion_from_euler
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.mavlink.obstacle_distance import (
    BINS,
    NO_OBSTACLE_CM,
    UNKNOWN,
    distances_cm,
    obstacle_distance,
)


def bearing(deg: float, metres: float) -> BearingRange:
    return BearingRange(math.radians(deg), metres, 0.1, 9)


def fan(first: int, last: int, metres: float) -> tuple[BearingRange, ...]:
    return tuple(bearing(deg, metres) for deg in range(first, last + 1, 3))


def at(heading_deg: float) -> Pose:
    return Pose(5, 0.0, 0.0, -1.0, quaternion_from_euler(0.0, 0.0, math.radians(heading_deg)))


def test_what_is_seen_ahead_is_in_the_bins_about_the_nose_and_the_rest_is_unknown() -> None:
    found = distances_cm(fan(-30, 30, 4.0), 0.0)
    assert len(found) == BINS
    for index in range(BINS):
        from_nose = index * 5 if index <= 36 else index * 5 - 360
        if abs(from_nose) <= 30:
            assert found[index] == 400, from_nose
        elif abs(from_nose) > 34:
            assert found[index] == UNKNOWN, from_nose


def test_bins_go_clockwise_from_the_nose() -> None:
    right = distances_cm((*fan(-30, 30, 6.0), bearing(20.0, 2.0)), 0.0)
    assert right[4] == 200
    assert right[BINS - 4] == 600
    turned = distances_cm((bearing(110.0, 3.0),), math.radians(90.0))
    assert turned[4] == 300
    across = distances_cm((bearing(-175.0, 3.0),), math.radians(175.0))
    assert across[2] == 300


def test_the_nearest_of_a_bins_bearings_counts() -> None:
    assert distances_cm((bearing(-1.0, 5.0), bearing(1.0, 3.0)), 0.0)[0] == 300


def test_far_is_no_obstacle_and_touching_is_the_least_that_can_be_said() -> None:
    assert distances_cm((bearing(0.0, 40.0),), 0.0)[0] == NO_OBSTACLE_CM
    assert distances_cm((bearing(0.0, 0.01),), 0.0)[0] == 20
    assert distances_cm((), 0.0) == (UNKNOWN,) * BINS


def test_a_receiver_reads_it_back() -> None:
    report = DetectionReport(
        1,
        2_000_000_000,
        "gap",
        pose=at(0.0),
        bearings=fan(-30, 30, 4.0),
        remembered=fan(60, 90, 7.0),
    )
    message = obstacle_distance(report, at(30.0))
    assert message is not None
    packed = message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=191))
    (read,) = mavlink.MAVLink(None).parse_buffer(packed)
    assert read.get_type() == "OBSTACLE_DISTANCE"
    assert read.time_usec == 2_000_000
    assert read.frame == mavlink.MAV_FRAME_BODY_FRD
    assert read.increment_f == 5.0
    assert (read.min_distance, read.max_distance) == (20, 1500)
    assert read.distances[0] == 400, "30 degrees in local NED is ahead now"
    assert read.distances[9] == 700, "75 degrees, remembered"
    assert read.distances[36] == UNKNOWN


def test_without_metres_there_is_no_message() -> None:
    report = DetectionReport(1, 2, "gap", pose=at(0.0))
    assert obstacle_distance(report, at(0.0)) is None
    measured = replace(report, bearings=fan(-30, 30, 4.0))
    assert obstacle_distance(measured, None) is not None
    assert obstacle_distance(replace(measured, pose=None), None) is None


@pytest.mark.parametrize("value", [True, False])
def test_it_is_off_unless_asked_for(value: bool) -> None:
    assert Config.model_validate({"link": LINK}).detector.send_obstacle_distance is False
    asked = Config.model_validate({"link": LINK, "detector": {"send_obstacle_distance": value}})
    assert asked.detector.send_obstacle_distance is value


LINK = {"planner": "udpin:127.0.0.1:14540", "autopilot": "udpout:127.0.0.1:14580"}
