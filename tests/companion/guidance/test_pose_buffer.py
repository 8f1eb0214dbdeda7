"""The pose at the frame's time: interpolated where known, refused where not."""

import math

import pytest

from companion.guidance.coordinates import heading_rad, quaternion_from_euler
from companion.guidance.pose_buffer import BootClock, PoseBuffer

MS = 1_000_000
BOOT_AT = 5_000_000_000_000
DELAY = 3 * MS


def filled(rate_rad_s=0.5, speed=1.0, until_ms=1000):
    buffer = PoseBuffer(jump_m=1.0)
    for ms in range(0, until_ms + 1, 10):
        yaw = rate_rad_s * ms / 1000
        buffer.add_attitude(
            ms, BOOT_AT + ms * MS + DELAY, quaternion_from_euler(0, 0, yaw), (0, 0, rate_rad_s)
        )
        if ms % 30 == 0:
            buffer.add_position(ms, BOOT_AT + ms * MS + DELAY, (speed * ms / 1000, 2.0, -1.0), (speed, 0, 0))
    return buffer


def test_a_pose_between_samples_is_interpolated_at_its_own_time():
    pose = filled().at(BOOT_AT + DELAY + 505 * MS)
    assert pose.north_m == pytest.approx(0.505, abs=1e-6)
    assert pose.east_m == 2.0
    assert heading_rad(pose.q_ned_from_body) == pytest.approx(0.5 * 0.505, abs=1e-6)


def test_a_little_past_the_newest_is_extrapolated_and_further_is_refused():
    buffer = filled()
    pose = buffer.at(BOOT_AT + DELAY + 1060 * MS)
    assert pose.north_m == pytest.approx(1.06, abs=1e-6)
    assert heading_rad(pose.q_ned_from_body) == pytest.approx(0.53, abs=1e-6)
    assert buffer.at(BOOT_AT + DELAY + 1200 * MS) is None


def test_before_the_oldest_and_in_an_empty_buffer_there_is_no_pose():
    assert filled().at(BOOT_AT - 100 * MS) is None
    assert PoseBuffer(jump_m=1.0).at(BOOT_AT) is None
    assert PoseBuffer(jump_m=1.0).newest() is None


def test_a_gap_of_half_a_second_is_not_interpolated_across():
    buffer = filled(until_ms=300)
    buffer.add_position(1000, BOOT_AT + 1000 * MS + DELAY, (1.0, 2.0, -1.0), (1, 0, 0))
    buffer.add_attitude(1000, BOOT_AT + 1000 * MS + DELAY, (1, 0, 0, 0), (0, 0, 0))
    assert buffer.at(BOOT_AT + DELAY + 700 * MS) is None


def test_a_jump_is_reported_and_nothing_from_before_it_is_kept():
    buffer = filled()
    assert buffer.add_position(1030, BOOT_AT + 1030 * MS + DELAY, (4.0, 2.0, -1.0), (1, 0, 0))
    assert buffer.at(BOOT_AT + DELAY + 500 * MS) is None


def test_fast_flight_is_not_a_jump():
    buffer = PoseBuffer(jump_m=1.0)
    for ms in range(0, 1000, 100):
        assert not buffer.add_position(ms, BOOT_AT + ms * MS, (12.0 * ms / 1000, 0, 0), (12.0, 0, 0))


def test_nan_and_unusable_quaternions_are_ignored():
    buffer = filled()
    before = buffer.newest()
    assert not buffer.add_position(1030, BOOT_AT + 1030 * MS, (math.nan, 0, 0), (0, 0, 0))
    assert not buffer.add_attitude(1030, BOOT_AT + 1030 * MS, (0, 0, 0, 0), (0, 0, 0))
    assert buffer.newest() == before


def test_the_least_delay_decides_the_clock_offset():
    clock = BootClock()
    clock.to_ours_ns(0, BOOT_AT + 30 * MS)
    clock.to_ours_ns(100, BOOT_AT + 101 * MS)
    time_ns, restarted = clock.to_ours_ns(200, BOOT_AT + 260 * MS)
    assert time_ns == pytest.approx(BOOT_AT + 201 * MS, abs=0.1 * MS)
    assert not restarted


def test_a_restart_of_the_autopilot_starts_the_mapping_anew():
    clock = BootClock()
    clock.to_ours_ns(100_000, BOOT_AT)
    time_ns, restarted = clock.to_ours_ns(500, BOOT_AT + 9_000 * MS)
    assert restarted
    assert time_ns == BOOT_AT + 9_000 * MS


def test_slow_drift_between_the_clocks_is_followed():
    clock = BootClock()
    for s in range(600):
        arrival = BOOT_AT + int(s * 1e9 * (1 + 50e-6))
        time_ns, _ = clock.to_ours_ns(s * 1000, arrival)
    assert abs(time_ns - arrival) < 2 * MS
