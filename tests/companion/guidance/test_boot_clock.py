"""The autopilot's time since boot in ours: by the least delay, and by TIMESYNC."""

from __future__ import annotations

import random

from companion.guidance.pose_buffer import BootClock, PoseBuffer

MS = 1_000_000
SEC = 1_000_000_000
OFFSET = 700 * SEC


def heard(clock: BootClock, boot_ms: int, delay_ms: float) -> int:
    """Take a message sent at ``boot_ms``; return by how much its time is later than the truth, ns."""
    sent_ns = boot_ms * MS + OFFSET
    return clock.to_ours_ns(boot_ms, sent_ns + int(delay_ms * MS))[0] - sent_ns


def test_without_timesync_every_pose_is_late_by_the_least_delay():
    clock, rng = BootClock(), random.Random(1)
    errors = [heard(clock, 1000 + 20 * k, 12 + 10 * rng.random()) for k in range(200)]
    assert 12 * MS <= errors[-1] < 13 * MS


def test_with_timesync_it_is_right():
    clock, rng = BootClock(), random.Random(1)
    for k in range(50):
        heard(clock, 1000 + 20 * k, 12 + 10 * rng.random())
    assert clock.synchronise(OFFSET + 300_000, OFFSET + 2 * SEC)
    errors = [heard(clock, 2100 + 20 * k, 12 + 10 * rng.random()) for k in range(50)]
    assert {abs(error) for error in errors} == {300_000}


def test_no_message_arrives_before_it_was_sent():
    clock = BootClock()
    heard(clock, 1000, 1.0)
    assert clock.synchronise(OFFSET + 3 * MS, OFFSET + SEC)
    assert heard(clock, 1020, 1.0) == 1 * MS


def test_an_offset_of_another_clock_is_refused():
    clock = BootClock()
    assert not clock.synchronise(OFFSET, OFFSET)  # nothing to compare it with
    heard(clock, 1000, 5.0)
    assert not clock.synchronise(OFFSET - 5 * SEC, OFFSET + SEC)
    assert not clock.synchronise(OFFSET + 60 * MS, OFFSET + SEC)
    assert not clock.synchronise(1_700_000_000 * SEC, OFFSET + SEC)
    assert heard(clock, 1020, 5.0) == 5 * MS


def test_an_offset_ends_with_its_age_and_with_a_restart():
    clock = BootClock()
    heard(clock, 1000, 10.0)
    assert clock.synchronise(OFFSET, OFFSET + SEC)
    assert heard(clock, 2000, 10.0) == 0
    assert heard(clock, 70_000, 10.0) == 10 * MS
    assert clock.synchronise(OFFSET, OFFSET + 70 * SEC)
    _, restarted = clock.to_ours_ns(100, OFFSET + 80 * SEC)
    assert restarted
    assert clock.to_ours_ns(120, OFFSET + 80 * SEC + 20 * MS)[0] == OFFSET + 80 * SEC + 20 * MS


def test_the_pose_of_a_moment_is_where_the_vehicle_was_then():
    """1 m/s north over a link of 40 ms: without TIMESYNC the pose is 4 cm ahead of the picture."""
    places = {}
    for synced in (False, True):
        poses = PoseBuffer(jump_m=1.0)
        for k in range(60):
            boot_ms = 1000 + 20 * k
            arrival = boot_ms * MS + OFFSET + 40 * MS
            poses.add_attitude(boot_ms, arrival, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            poses.add_position(boot_ms, arrival, (boot_ms / 1000, 0.0, -1.0), (1.0, 0.0, 0.0))
            if synced and k == 5:
                assert poses.synchronise(OFFSET, arrival)
        places[synced] = poses.at(2000 * MS + OFFSET).north_m
    assert abs(places[True] - 2.0) < 1e-6
    assert abs(places[False] - 1.96) < 1e-6
