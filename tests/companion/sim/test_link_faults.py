from __future__ import annotations

import pytest

from companion.sim.link_faults import FaultyLink, LinkFaults

DATAGRAMS = [bytes([i % 256, i // 256, 7, 8, 9]) for i in range(2000)]


def carried(faults: LinkFaults) -> tuple[FaultyLink, list[tuple[float, bytes]]]:
    link = FaultyLink(faults)
    return link, [arrival for datagram in DATAGRAMS for arrival in link.pass_on(datagram)]


def test_a_good_link_changes_nothing() -> None:
    _, arrivals = carried(LinkFaults())
    assert arrivals == [(0.0, datagram) for datagram in DATAGRAMS]


def test_rates_are_kept_and_counted() -> None:
    link, arrivals = carried(LinkFaults(drop_rate=0.2, corrupt_rate=0.1, duplicate_rate=0.05, seed=3))
    assert link.dropped == pytest.approx(400, abs=60)
    assert link.corrupted == pytest.approx(160, abs=40)
    assert link.duplicated == pytest.approx(80, abs=30)
    assert len(arrivals) == len(DATAGRAMS) - link.dropped + link.duplicated
    known = set(DATAGRAMS)
    strangers = {content for _, content in arrivals if content not in known}
    assert len(strangers) == pytest.approx(link.corrupted, abs=link.corrupted // 2)


def test_the_same_seed_gives_the_same_faults() -> None:
    faults = LinkFaults(drop_rate=0.3, corrupt_rate=0.3, jitter_s=0.1, seed=5)
    assert carried(faults)[1] == carried(faults)[1]
    other = LinkFaults(drop_rate=0.3, corrupt_rate=0.3, jitter_s=0.1, seed=6)
    assert carried(faults)[1] != carried(other)[1]


def test_a_corrupted_datagram_differs_in_one_byte() -> None:
    _, arrivals = carried(LinkFaults(corrupt_rate=1.0))
    for datagram, (_, content) in zip(DATAGRAMS, arrivals, strict=True):
        assert sum(a != b for a, b in zip(datagram, content, strict=True)) == 1


def test_delays_lie_in_their_range() -> None:
    _, arrivals = carried(LinkFaults(delay_s=0.1, jitter_s=0.05))
    assert all(0.1 <= delay_s <= 0.15 for delay_s, _ in arrivals)
    assert max(d for d, _ in arrivals) - min(d for d, _ in arrivals) > 0.04


def test_impossible_faults_are_refused() -> None:
    with pytest.raises(ValueError, match=r"drop_rate must be in \[0, 1\], got 1.5"):
        LinkFaults(drop_rate=1.5)
    with pytest.raises(ValueError, match="delay_s"):
        LinkFaults(delay_s=float("nan"))
