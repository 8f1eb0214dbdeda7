"""Two senders that fight, and two that take turns."""

from companion.mavlink.sources import SetpointSources

SEC = 1_000_000_000
PLANNER, STATION = (245, 190), (255, 190)


def announced(arrivals: list[tuple[float, tuple[int, int]]]) -> list[tuple]:
    sources = SetpointSources()
    return [found for at_s, who in arrivals if (found := sources.note(who, int(at_s * SEC)))]


def test_one_sender_and_a_handover_are_no_fight():
    alone = [(i / 20, PLANNER) for i in range(200)]
    assert announced(alone) == []
    handover = [(i / 20, PLANNER if i < 100 else STATION) for i in range(200)]
    assert announced(handover) == []
    to_and_fro = [(i / 20, STATION if 50 <= i < 60 else PLANNER) for i in range(200)]
    assert announced(to_and_fro) == []


def test_two_streams_are_announced_at_once_and_every_five_seconds():
    fight = [(i / 40, (PLANNER, STATION)[i % 2]) for i in range(40 * 12)]
    assert announced(fight) == [(PLANNER, STATION)] * 3
    assert announced(fight[:4]) == [(PLANNER, STATION)]


def test_slow_senders_fight_too_and_rare_changes_do_not():
    slow = [(i / 2, (PLANNER, STATION)[i % 2]) for i in range(6)]
    assert announced(slow) == [(PLANNER, STATION)]
    rare = [(float(i), (PLANNER, STATION)[i // 3 % 2]) for i in range(60)]
    assert announced(rare) == []


def test_three_rivals_are_all_named():
    third = (1, 191)
    fight = [(i / 30, (PLANNER, STATION, third)[i % 3]) for i in range(8)]
    assert announced(fight) == [(third, PLANNER, STATION)]
