"""The feed: nothing for nobody, bounded by kind, newest wins; what comes out is what went in."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import Config
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport, Pose
from companion.io.feed import Feed
from companion.io.frame_ring import N_SLOTS, FrameRing, MappedRing
from companion.io.messages import Kind, PacketError, Wants, pack, pack_arrays, unpack, unpack_arrays
from companion.io.queues import LIMITS
from companion.io.receiver import Receiver

SEC = 1_000_000_000


def everything(**options) -> Wants:
    return Wants(frozenset(Kind), **options)


def drain(feed: Feed, receiver: Receiver | None = None):
    """Return what the feed holds as messages, as the I/O process would make them."""
    import os

    receiver = receiver or Receiver()
    found = []
    for packet, fd in feed.packets():
        found += receiver.messages(packet, () if fd is None else (os.dup(fd),))
    return found


def frame(seq: int, *, grey: int = 7, size=(48, 64)) -> Frame:
    return Frame(np.full(size, grey, np.uint8), seq * SEC, seq)


def test_nobody_listens_and_nothing_is_kept():
    feed = Feed()
    feed.mavlink(0, "in", b"x", 1)
    feed.pose(Pose(1, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0)), 0.0)
    feed.frame(frame(0), 0)
    assert drain(feed) == []
    assert not feed.wants(Kind.STATUS)


def test_what_comes_out_is_what_went_in():
    feed = Feed()
    feed.want(everything())
    report = DetectionReport(3, 5 * SEC, "none", reason="blurred", ray_body=(0.1, 0.2, 1 / 3))
    feed.mavlink(2, "out", b"\xfd\x00", 11)
    feed.pose(Pose(12, 0.1, -2.0, 1 / 3, (1.0, 0.0, 0.0, 0.0)), 0.25)
    feed.detection(report, 13)
    feed.state("follow", "hold", "no picture", 14)
    feed.log({"event": "odd", "value": float("nan"), "thing": object}, 15)
    feed.config(Config.model_validate({"guidance": {"agree_deg": 11.0}}), 16)
    mavlink, pose, detection, state, log, config = drain(feed)
    assert (mavlink.kind, mavlink.time_ns, mavlink.data) == (Kind.MAVLINK, 11, b"\xfd\x00")
    assert mavlink.fields == {"link": 2, "direction": "out"}
    assert pose.fields["down_m"] == 1 / 3
    assert pose.fields["speed_m_s"] == 0.25
    assert detection.fields["ray_body"] == [0.1, 0.2, 1 / 3]
    assert state.fields == {"previous": "follow", "state": "hold", "reason": "no picture"}
    assert log.fields["value"] == "nan"
    assert config.fields["set"] == {"guidance": {"agree_deg": 11.0}}
    assert config.fields["active"]["log"]["level"] == "info"
    assert [m.seq for m in (mavlink, pose, detection, state, log, config)] == list(range(1, 7))


def test_a_flood_is_bounded_and_the_newest_win():
    feed = Feed()
    feed.want(everything())
    feed.state("a", "b", "first of its kind", 0)
    most = LIMITS[Kind.MAVLINK]
    for number in range(most + 1000):
        feed.mavlink(0, "in", number.to_bytes(4, "big"), number)
    *found, lost = drain(feed)
    assert (lost.fields["name"], lost.fields["counts"]) == ("dropped", {"mavlink": 1000})
    assert len(found) == most + 1
    assert found[0].kind is Kind.STATE  # one kind's flood takes nothing from another
    assert found[-1].data == (most + 999).to_bytes(4, "big")
    assert feed.dropped == {"mavlink": 1000}


def test_what_waits_by_thousands_shares_its_fields():
    feed = Feed()
    feed.want(everything())
    for n in range(30):
        feed.mavlink(n % 2, "in", bytes(20), n)
    found = [m for m in drain(feed) if m.kind is Kind.MAVLINK]
    assert [dict(m.fields) for m in found] == [{"link": n % 2, "direction": "in"} for n in range(30)]
    assert len({id(m.fields) for m in found}) == 2
    with pytest.raises(TypeError):
        found[0].fields["link"] = 7  # of one is of all


def test_packets_hold_many_messages_and_stay_short():
    feed = Feed()
    feed.want(everything())
    for number in range(3000):
        feed.mavlink(0, "in", bytes(100), number)
    packets = [packet for packet, _ in feed.packets()]
    assert 2 < len(packets) < 20
    assert max(map(len, packets)) <= 60_000


def test_a_message_too_long_for_a_packet_is_counted():
    feed = Feed()
    feed.want(everything())
    feed.details(b"{}", bytes(1 << 18), 1)
    feed.state("a", "b", "c", 2)
    assert [message.kind for message in drain(feed)] == [Kind.STATE]
    assert feed.dropped == {"details": 1}


def test_who_begins_to_listen_is_told_what_holds():
    feed = Feed()
    feed.config(Config(), 1)
    feed.link("planner", "udpin:1", "open", 2)
    feed.state("a", "b", "old", 3)
    feed.state("b", "c", "new", 4)
    feed.want(everything())
    assert [m.fields.get("reason") for m in drain(feed) if m.kind is Kind.STATE] == ["new"]
    feed.want(everything())
    assert drain(feed) == []  # once
    feed.restart()
    feed.want(everything())
    assert {message.kind for message in drain(feed)} == {Kind.CONFIG, Kind.LINK, Kind.STATE}


def test_what_sinks_are_told_to_do_reaches_them_unasked():
    feed = Feed()
    feed.control("armed", {"on": True}, 1, retain=True)
    assert [message.fields for message in drain(feed)] == [{"name": "armed", "on": True}]
    feed.restart()
    assert [message.fields for message in drain(feed)] == [{"name": "armed", "on": True}]


def test_frames_cross_in_memory():
    feed, receiver = Feed(), Receiver()
    feed.want(everything())
    feed.frame(frame(0, grey=9), 1)
    feed.frame(frame(1, grey=10, size=(96, 128)), 2)  # a larger ring
    first_and_second = drain(feed, receiver)
    assert [int(message.image[0, 0]) for message in first_and_second if message.image is not None] == [10]
    feed.frame(frame(2, grey=11), 3)
    (third,) = drain(feed, receiver)
    assert third.image.shape == (48, 64)
    assert (third.image == 11).all()
    assert not third.image.flags.writeable
    assert third.time_ns == 2 * SEC
    receiver.close()
    feed.close()


def test_an_overwritten_frame_is_lost_never_torn():
    feed, receiver = Feed(), Receiver()
    feed.want(everything())
    for seq in range(N_SLOTS + 4):
        feed.frame(frame(seq, grey=seq), seq)
    found = [message for message in drain(feed, receiver) if message.kind is Kind.FRAME]
    assert all((message.image == message.fields["seq"]).all() for message in found)
    assert len(found) + receiver.lost_frames <= LIMITS[Kind.FRAME] + 1
    assert feed.dropped["frame"] > 0
    receiver.close()
    feed.close()


def test_a_reader_notices_that_its_slot_was_taken():
    import os

    ring = FrameRing(64 * 48)
    mapped = MappedRing(os.dup(ring.fd), 64 * 48)
    numbers = [ring.write(np.full((48, 64), grey, np.uint8)) for grey in range(N_SLOTS + 1)]
    assert mapped.read(numbers[0], 48, 64) is None
    assert (mapped.read(numbers[1], 48, 64) == 1).all()
    with pytest.raises(ValueError, match="at most"):
        mapped.read(numbers[1], 480, 640)
    mapped.close()
    ring.close()


@pytest.mark.parametrize(("rate_hz", "expected"), [(0.0, 90), (15.0, 45), (10.0, 30), (60.0, 90)])
def test_frames_are_copied_no_more_often_than_wanted(rate_hz, expected):
    feed = Feed()
    feed.want(everything(frames_hz=rate_hz))
    jitter = np.random.default_rng(1).integers(-3_000_000, 3_000_000, 90)
    told = 0
    for seq in range(90):
        feed.frame(frame(seq), 100 * SEC + seq * SEC // 30 + int(jitter[seq]))
        told += sum(message.kind is Kind.FRAME for message in unpack(b"".join(p for p, _ in feed.packets())))
    assert abs(told - expected) <= 2
    feed.close()


def test_arrays_cross_with_their_shape():
    arrays = {"flow": np.arange(12, dtype=np.float32).reshape(3, 4), "none": np.zeros((0, 2), np.int16)}
    layout, data = pack_arrays(arrays)
    again = unpack_arrays(layout, data)
    assert list(again) == ["flow", "none"]
    np.testing.assert_array_equal(again["flow"], arrays["flow"])
    assert again["none"].shape == (0, 2)
    with pytest.raises(PacketError, match="flow"):
        unpack_arrays(layout, data[:-1])


@pytest.mark.parametrize(
    "packet",
    [b"\xff" * 30, pack(Kind.STATE, 1, 1, b"{}")[:-1], pack(Kind.STATE, 1, 1, b"{"), b"short"],
)
def test_nonsense_is_refused(packet):
    with pytest.raises(PacketError):
        list(unpack(packet))
