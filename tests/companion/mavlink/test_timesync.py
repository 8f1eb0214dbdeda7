"""Offset and round trip of the autopilot's clock."""

from __future__ import annotations

from companion.mavlink.timesync import TimeSync

MS = 1_000_000
SEC = 1_000_000_000
TRUE_OFFSET = 500 * SEC  # ours less theirs


def exchange(sync: TimeSync, at_ns: int, there_ms: float, back_ms: float, offset: int = TRUE_OFFSET):
    """One question and its answer, with delays of their own."""
    ts1 = sync.ask(at_ns)
    tc1 = at_ns + int(there_ms * MS) - offset
    return sync.on_answer(tc1, ts1, at_ns + int((there_ms + back_ms) * MS))


def test_a_symmetric_link_gives_the_offset_exactly():
    found = exchange(TimeSync(), 1000 * SEC, 8, 8)
    assert (found.offset_ns, found.round_trip_ns) == (TRUE_OFFSET, 16 * MS)


def test_the_error_is_at_most_half_of_the_round_trip():
    for there, back in ((20, 1), (1, 20), (0, 5)):
        found = exchange(TimeSync(), 1000 * SEC, there, back)
        assert abs(found.offset_ns - TRUE_OFFSET) <= (there + back) * MS / 2


def test_the_shortest_round_trip_wins_and_an_old_one_is_forgotten():
    sync = TimeSync()
    exchange(sync, 1000 * SEC, 2, 2)
    assert exchange(sync, 1001 * SEC, 90, 5).round_trip_ns == 4 * MS
    assert exchange(sync, 1040 * SEC, 90, 5).round_trip_ns == 95 * MS


def test_answers_that_are_not_ours_repeated_late_or_early_are_refused():
    sync = TimeSync()
    ts1 = sync.ask(1000 * SEC)
    assert sync.on_answer(5 * SEC, ts1 + 1, 1000 * SEC + MS) is None
    assert sync.on_answer(5 * SEC, ts1, 999 * SEC) is None
    assert sync.on_answer(5 * SEC, ts1, 1002 * SEC) is None
    assert sync.on_answer(0, ts1, 1000 * SEC + MS) is None
    assert sync.on_answer(5 * SEC, ts1, 1000 * SEC + MS) is not None
    assert sync.on_answer(5 * SEC, ts1, 1000 * SEC + MS) is None
    assert sync.refused == 5


def test_a_restart_of_the_autopilot_begins_anew():
    sync = TimeSync()
    exchange(sync, 1000 * SEC, 1, 1)
    after = exchange(sync, 1003 * SEC, 30, 30, offset=1002 * SEC)
    assert after.offset_ns == 1002 * SEC
