"""Framing: every good frame comes out byte for byte and in order, whatever lies around it."""

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from companion.mavlink.framing import CURRENT_MODE, MAX_FRAME_BYTES, Framer, checksum

RELAXED = settings(max_examples=300, deadline=None)  # a loaded machine is not a failure
UNKNOWN_IDS = (433, 411, 60000, 0xFFFFFF)


def _v2(
    message_id: int, payload: bytes, seq: int, *, signed: bool, extra: int | None, flags: int = 0
) -> bytes:
    flags |= 1 if signed else 0
    head = bytes([len(payload), flags, 0, seq, 1, 1]) + message_id.to_bytes(3, "little")
    crc = common.x25crc(head + payload + bytes([0xA7 if extra is None else extra])).crc
    signature = bytes(range(13)) if signed else b""
    return b"\xfd" + head + payload + crc.to_bytes(2, "little") + signature


def _v1(message_id: int, payload: bytes, seq: int, extra: int | None) -> bytes:
    head = bytes([len(payload), seq, 1, 1, message_id])
    crc = common.x25crc(head + payload + bytes([0xA7 if extra is None else extra])).crc
    return b"\xfe" + head + payload + crc.to_bytes(2, "little")


def _known(message_id: int, payload: bytes, seq: int, form: str) -> bytes:
    extra = common.mavlink_map[message_id].crc_extra
    if form == "v1" and message_id < 256:
        return _v1(message_id, payload, seq, extra)
    return _v2(message_id, payload, seq, signed=form == "signed", extra=extra)


def _unknown(message_id: int, payload: bytes, seq: int, form: str) -> bytes:
    if form == "v1":
        return _v1(199, payload, seq, None)
    return _v2(message_id, payload, seq, signed=form == "signed", extra=None)


forms = st.sampled_from(["v1", "v2", "signed"])
payloads = st.binary(min_size=1, max_size=60) | st.binary(min_size=200, max_size=255)
seqs = st.integers(0, 255)
known = st.builds(_known, st.sampled_from([0, 30, 32, 84, 331]), payloads, seqs, forms)
unknown = st.builds(_unknown, st.sampled_from(UNKNOWN_IDS), payloads, seqs, forms)
truncated = st.tuples(known | unknown, st.integers(1, 60)).map(lambda t: t[0][: max(1, len(t[0]) - t[1])])
markers = st.lists(st.sampled_from([0xFD, 0xFE, 0x00, 0xFF]), min_size=1, max_size=100).map(bytes)
noise = st.binary(min_size=1, max_size=40) | markers


def _chunks(stream: bytes, cuts: list[int]) -> list[bytes]:
    chunks, at, i = [], 0, 0
    while at < len(stream):
        step = cuts[i % len(cuts)]
        chunks.append(stream[at : at + step])
        at, i = at + step, i + 1
    return chunks


def _is_subsequence(expected: list[bytes], got: list[bytes]) -> bool:
    rest = iter(got)
    return all(frame in rest for frame in expected)


cuts = st.lists(st.integers(1, 300), min_size=1, max_size=8)


@RELAXED
@given(st.lists(known | unknown, min_size=1, max_size=12), cuts)
def test_without_garbage_exactly_the_frames_come_out_however_the_bytes_are_cut(frames, cuts):
    framer = Framer()
    got = [f.data for chunk in _chunks(b"".join(frames), cuts) for f in framer.feed(chunk)]
    assert got == frames
    assert framer.counters.garbage_bytes == 0
    assert framer.counters.crc_errors == 0
    assert framer.held_bytes == 0


@RELAXED
@given(
    st.lists(
        st.tuples(st.just(True), known) | st.tuples(st.just(False), noise | truncated),
        max_size=20,
    ),
    cuts,
)
def test_no_verifiable_frame_is_lost_to_any_garbage_however_the_bytes_are_cut(parts, cuts):
    framer = Framer()
    stream = b"".join(data for _, data in parts)
    got = [f.data for chunk in _chunks(stream, cuts) for f in framer.feed(chunk)]
    assert _is_subsequence([data for good, data in parts if good], got)
    # Bytes taken for an unknown frame too early may come out a second time, never not at all.
    assert sum(map(len, got)) + framer.counters.garbage_bytes + framer.held_bytes >= len(stream)


@RELAXED
@given(noise | truncated, st.lists(noise | truncated, max_size=5), known)
def test_a_verifiable_frame_comes_out_with_the_datagram_that_completes_it(first, before, frame):
    framer = Framer()
    for datagram in [first, *before]:
        framer.feed(datagram)
    assert frame in [f.data for f in framer.feed(frame)]


def _quiet(data: bytes) -> bytes:
    return data.replace(b"\xfd", b"\x00").replace(b"\xfe", b"\x00")


quiet = st.binary(min_size=1, max_size=40).map(_quiet)
quiet_unknown = st.builds(
    _unknown, st.sampled_from((433, 411, 60000)), payloads.map(_quiet), st.integers(0, 252), forms
)


@RELAXED
@given(
    st.lists(st.lists(known | quiet_unknown, min_size=1, max_size=5), max_size=6),
    st.lists(quiet, min_size=6, max_size=6),
)
def test_frames_of_unknown_messages_survive_garbage_without_start_markers(datagrams, between):
    framer = Framer()
    framer.feed(_known(0, bytes(9), 0, "v2"))  # introduces the sender 1/1
    for frames, noise in zip(datagrams, between, strict=False):
        assert [f.data for f in framer.feed(noise + b"".join(frames))] == frames
        assert [f.data for f in framer.feed(b"".join(frames) + noise)] == frames
        assert framer.feed(noise) == []


@pytest.mark.parametrize("seed", range(20))
def test_stray_markers_cost_no_good_frame_of_a_long_stream(seed):
    rng = random.Random(seed)
    framer = Framer()
    sent: list[bytes] = []
    got: list[bytes] = []
    for seq in range(400):
        frames = []
        for _ in range(rng.randint(1, 4)):
            form = rng.choice(["v1", "v2", "signed"])
            payload = rng.randbytes(rng.randint(1, 60))
            frames.append(_known(rng.choice([0, 30, 84]), payload, seq % 256, form))
        stray = bytes(rng.choices([0xFD, 0xFE], k=rng.randint(0, 3)))
        sent += frames
        got += [f.data for f in framer.feed(stray + b"".join(frames) + stray[:1])]
    assert _is_subsequence(sent, got)


def test_a_dangling_start_does_not_hold_up_unknown_messages_of_a_known_sender():
    framer = Framer()
    framer.feed(_known(0, bytes(9), 0, "v2"))
    assert framer.feed(b"\xfd\xff\x00") == []
    for seq in range(5):
        frame = _unknown(433, b"\x01\x02\x03", seq, "v2")
        assert [f.data for f in framer.feed(frame)] == [frame]
    assert framer.counters.garbage_bytes == 3


def test_a_dangling_start_delays_unknown_messages_of_an_unknown_sender_but_loses_none():
    framer = Framer()
    framer.feed(b"\xfd\xff\x00")
    frames = [_unknown(433, b"\x01\x02\x03", seq, "v2") for seq in range(40)]
    got = [f.data for frame in frames for f in framer.feed(frame)]
    assert got == frames


def test_a_frame_split_over_datagrams_is_joined():
    frame = _known(32, bytes(range(1, 29)), 7, "v2")
    framer = Framer()
    assert framer.feed(frame[:11]) == []
    assert framer.held_bytes == 11
    assert [f.data for f in framer.feed(frame[11:])] == [frame]


def test_what_is_held_is_bounded():
    framer = Framer()
    for _ in range(50):
        framer.feed(b"\xfd" * 1000)
        assert framer.held_bytes < MAX_FRAME_BYTES


def test_a_corrupt_frame_is_counted_and_never_comes_out():
    good = _known(84, bytes(range(1, 54)), 1, "v2")
    corrupt = bytearray(good)
    corrupt[20] ^= 0x40
    framer = Framer()
    assert [f.data for f in framer.feed(good + bytes(corrupt) + good)] == [good, good]
    assert framer.counters.crc_errors == 1
    assert framer.counters.garbage_bytes == len(good)


def test_a_setpoint_inside_what_looks_like_an_unknown_frame_is_found():
    inner = _known(84, bytes(range(1, 54)), 1, "v2")
    outer = b"\xfd" + bytes([len(inner), 0, 0, 0, 9, 9]) + b"\x70\x11\x01" + inner + b"\0\0"
    assert inner in [f.data for f in Framer().feed(outer)]


def _recorded() -> list[bytes]:
    """Return the frames of a recorded link, cut by the recording's own rule: MAVLink 2 only, none signed."""
    data = (Path(__file__).parents[2] / "data" / "px4_offboard_excerpt.tlog").read_bytes()
    frames, at = [], 0
    while at < len(data):
        at += 8  # time stamp
        assert data[at] == 0xFD
        assert data[at + 2] == 0
        end = at + 12 + data[at + 1]
        frames.append(data[at:end])
        at = end
    return frames


@pytest.mark.parametrize("step", [1, 7, 279, 1400])
def test_a_recorded_link_comes_out_whole_however_it_is_cut(step):
    frames = _recorded()
    stream = b"".join(frames)
    framer = Framer()
    got = [f for at in range(0, len(stream), step) for f in framer.feed(stream[at : at + step])]
    assert [f.data for f in got] == frames
    assert {f.message_id for f in got if not f.verified} == {8, 380, 411}
    assert framer.counters.garbage_bytes == framer.counters.crc_errors == 0
    assert sum(f.message_id == CURRENT_MODE and f.verified for f in got) > 0  # PX4's own checksum


def test_a_recorded_link_survives_garbage_before_every_frame():
    rng = random.Random(11)
    framer = Framer()
    for frame in _recorded():
        strays = bytes(rng.choices([0xFD, 0xFE, 0x00, 0x13], k=rng.randint(0, 6)))
        assert frame in [f.data for f in framer.feed(strays + frame)]


def test_header_fields():
    v1 = Framer().feed(_v1(0, bytes(9), 5, common.mavlink_map[0].crc_extra))[0]
    assert (v1.is_v1, v1.is_signed, v1.verified, v1.payload) == (True, False, True, bytes(9))
    signed = Framer().feed(_known(30, b"abc", 5, "signed"))[0]
    assert (signed.is_v1, signed.is_signed, signed.message_id, signed.payload) == (False, True, 30, b"abc")
    assert (signed.system_id, signed.component_id) == (1, 1)
    unknown = Framer().feed(_unknown(433, b"abc", 5, "v2"))[0]
    assert not unknown.verified


def test_an_unknown_incompatibility_flag_is_kept():
    frame = _v2(84, b"\x01" * 53, 1, signed=False, extra=143, flags=0x04)
    (got,) = Framer().feed(frame)
    assert got.data == frame
    assert got.incompat_flags == 0x04


def test_checksum_agrees_with_pymavlink():
    message = common.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 1.0)
    data = message.pack(common.MAVLink(None, 1, 1))
    assert checksum(data[1:-2], 30) == int.from_bytes(data[-2:], "little")


@pytest.mark.parametrize(
    "burst", [b"\xfd" * 65000, b"\xfe" * 65000, b"\xfd\xfe" * 32000, b"\xfe\xfd\xfd" * 20000]
)
def test_a_burst_of_start_markers_hides_nothing_behind_it_or_within(burst):
    frames = [_known(84, bytes(range(1, 54)), seq, "v2") for seq in range(6)]
    framer = Framer()
    half = len(burst) // 2
    got = framer.feed(frames[0] + burst[:half] + frames[1] + frames[2] + burst[half:] + frames[3])
    got += framer.feed(burst[:1000])
    got += framer.feed(frames[4] + frames[5])
    assert _is_subsequence(frames, [f.data for f in got])


def test_what_is_passed_over_at_a_glance_could_not_have_been_a_frame():
    assert (
        max(common.mavlink_map) < 1 << 16
    )  # so that a third byte of the id that is not 0 means an unknown message
    run = b"\xfe" * 262  # a start, a length of 254, the id 254, and a checksum
    assert checksum(run[1:260], 254) != 0xFEFE
    for tail in (b"", b"\x00", b"\x13\x37"):
        assert Framer().feed(run + tail) == []


def test_an_unknown_message_with_unknown_flags_is_garbage_as_every_receiver_treats_it():
    frame = _v2(60000, b"\x01" * 20, 1, signed=False, extra=None, flags=0x04)
    framer = Framer()
    assert framer.feed(frame) == []
    assert framer.counters.garbage_bytes == len(frame)
