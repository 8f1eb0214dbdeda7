"""Signing against pymavlink's own, which makes and checks the signatures here."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from companion.config import LinkConfig
from companion.errors import ConfigError
from companion.guidance.setpoint import Drop, Forward, Rewrite, Unprotected
from companion.mavlink.framing import Framer, RawFrame
from companion.mavlink.identity import Identity, MavSeverity, MavState
from companion.mavlink.proxy import InlineProxy
from companion.mavlink.signing import Signatures, open_signatures, read_key, without_signature
from tests.companion.mavlink.test_proxy import FakeSide, ScriptedHandler

KEY = bytes(range(1, 33))
OUR_LINK, PLANNER_LINK = 200, 7
NOW_NS = 1_790_000_000_000_000_000
EPOCH_NS = 1_420_070_400_000_000_000


def stamp_of(unix_ns: int) -> int:
    return (unix_ns - EPOCH_NS) // 10_000


class Party:
    """A pymavlink sender or receiver that signs."""

    def __init__(self, system=245, component=190, *, key=KEY, link=PLANNER_LINK, unix_ns=NOW_NS) -> None:
        self.mav = common.MAVLink(None, system, component)
        self.mav.signing.secret_key = key
        self.mav.signing.link_id = link
        self.mav.signing.timestamp = stamp_of(unix_ns)
        self.mav.signing.sign_outgoing = True

    def pack(self, message) -> bytes:
        data = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def accepts(self, data: bytes) -> bool:
        try:
            return self.mav.decode(bytearray(data)).get_signed()
        except common.MAVError:
            return False


def setpoint(x=1.0, vx=0.0, mask=3576):
    return common.MAVLink_set_position_target_local_ned_message(
        1234, 1, 1, 1, mask, x, 2.0, -3.0, vx, 0, 0, 0, 0, 0, 0.5, 0
    )


def framed(data: bytes) -> RawFrame:
    (frame,) = Framer().feed(data)
    return frame


def ours(unix_ns: int = NOW_NS) -> Signatures:
    return Signatures(KEY, link_id=OUR_LINK, unix_ns=lambda: unix_ns)


# ---------------------------------------------------------------- signatures


@given(
    st.binary(min_size=32, max_size=32).filter(any), st.integers(0, 255), st.floats(width=32, allow_nan=False)
)
def test_what_we_sign_pymavlink_accepts_and_what_it_signs_we_accept(key, link, x):
    planner = Party(key=key, link=link)
    signatures = Signatures(key, link_id=link, unix_ns=lambda: NOW_NS)
    frame = framed(planner.pack(setpoint(x)))
    assert signatures.verify(frame) is None
    plain = without_signature(frame)
    assert plain.data == bytes(setpoint(x).pack(common.MAVLink(None, 245, 190)))
    assert Party(1, 1, key=key).accepts(signatures.sign(plain.data))
    assert not Party(1, 1, key=bytes(32 * [9])).accepts(signatures.sign(plain.data)) or key == bytes(32 * [9])


@given(st.integers(0, 80), st.integers(1, 255))
def test_one_changed_byte_is_a_wrong_signature_or_no_frame(place, change):
    data = bytearray(Party().pack(setpoint()))
    data[place % len(data)] ^= change
    frames = Framer().feed(bytes(data))
    assert all(ours().verify(frame) is not None for frame in frames)


def test_a_replay_is_refused_for_each_sender_and_link_by_itself():
    planner, other = Party(), Party(link=8)
    signatures = ours()
    first, second = planner.pack(setpoint()), planner.pack(setpoint())
    assert signatures.verify(framed(second)) is None
    assert signatures.verify(framed(second)) == "replayed"
    assert signatures.verify(framed(first)) == "replayed"
    assert signatures.verify(framed(other.pack(setpoint()))) is None
    assert signatures.verify(framed(Party(system=1).pack(setpoint()))) is None


def test_a_forged_time_stamp_of_the_future_does_not_block_genuine_frames():
    signatures, planner = ours(), Party()
    assert signatures.verify(framed(planner.pack(setpoint()))) is None
    forger = Party(key=bytes(range(2, 34)), unix_ns=NOW_NS + 3600 * 10**9)
    assert signatures.verify(framed(forger.pack(setpoint()))) == "wrong signature"
    assert signatures.verify(framed(planner.pack(setpoint()))) is None
    again = ours()
    assert again.verify(framed(forger.pack(setpoint()))) == "wrong signature"
    assert again.verify(framed(planner.pack(setpoint()))) is None, "nor of a sender not heard yet"


@pytest.mark.parametrize(("behind_s", "why"), [(0, None), (59, None), (61, "too old"), (-3600, None)])
def test_a_new_sender_may_be_a_minute_behind(behind_s, why):
    late = Party(unix_ns=NOW_NS - behind_s * 10**9)
    assert ours().verify(framed(late.pack(setpoint()))) == why


def test_an_unsigned_frame_is_not_signed():
    assert ours().verify(framed(bytes(setpoint().pack(common.MAVLink(None, 1, 1))))) == "not signed"


def test_our_time_stamps_grow_also_without_a_clock_and_follow_the_others():
    signatures = ours(unix_ns=0)  # no clock chip: 1970
    receiver = Party(1, 1)
    plain = bytes(setpoint().pack(common.MAVLink(None, 245, 190)))
    assert signatures.verify(framed(Party().pack(setpoint()))) is None
    stamps = []
    for _ in range(5):
        signed = signatures.sign(plain)
        assert receiver.accepts(signed)
        stamps.append(int.from_bytes(signed[-12:-6], "little"))
    assert stamps == sorted(set(stamps))
    assert stamps[0] > stamp_of(NOW_NS) - 1
    backwards = iter([NOW_NS, NOW_NS - 10**9, NOW_NS - 2 * 10**9])
    jumping = Signatures(KEY, link_id=1, unix_ns=lambda: next(backwards))
    times = [int.from_bytes(jumping.sign(plain)[-12:-6], "little") for _ in range(3)]
    assert times == sorted(set(times))


def test_it_never_signs_as_the_link_that_the_sender_uses():
    plain = bytes(setpoint().pack(common.MAVLink(None, 245, 190)))
    assert ours().sign(plain, other_link_id=OUR_LINK)[-13] != OUR_LINK
    assert ours().sign(plain, other_link_id=PLANNER_LINK)[-13] == OUR_LINK
    assert Signatures(KEY, link_id=255).sign(plain, other_link_id=255)[-13] == 0


def test_what_cannot_be_signed_and_what_is_no_key():
    v1 = bytes(setpoint().pack(common.MAVLink(None, 1, 1), force_mavlink1=True))
    for data in (v1, Party().pack(setpoint())):
        with pytest.raises(ValueError, match="MAVLink 2 frame"):
            ours().sign(data)
    with pytest.raises(ValueError, match="32 bytes"):
        Signatures(b"short", link_id=1)
    with pytest.raises(ValueError, match="link id"):
        Signatures(KEY, link_id=256)
    with pytest.raises(ValueError, match="flags"):
        without_signature(framed(bytes(setpoint().pack(common.MAVLink(None, 1, 1)))))
    assert KEY.hex() not in repr(ours())


# ---------------------------------------------------------------- the key's file


def key_file(folder: Path, data: bytes, mode: int = 0o600) -> Path:
    path = folder / "signing.key"
    path.write_bytes(data)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("data", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_a_key_is_32_bytes_or_64_digits(tmp_path, data):
    path = key_file(tmp_path, data)
    assert read_key(path) == KEY
    assert isinstance(open_signatures(LinkConfig(signing_key_file=str(path))), Signatures)
    assert open_signatures(LinkConfig()) is None


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644, 0o620, 0o601])
def test_a_key_that_others_may_use_is_refused_with_what_to_do(tmp_path, mode):
    path = key_file(tmp_path, KEY, mode)
    with pytest.raises(ConfigError, match=rf"signing.key: .*mode {mode:04o}.*chmod 600"):
        read_key(path)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "found 0 bytes"),
        (KEY[:31], "found 31 bytes"),
        (KEY.hex()[:-1].encode(), "found 63 bytes"),
        (b"g" * 64, "found 64 bytes"),
        (bytes(5000), "found 1024 bytes"),
        (bytes(32), "zeros"),
        (b"0" * 64, "zeros"),
    ],
)
def test_what_is_no_key_is_one_clear_line(tmp_path, data, words):
    with pytest.raises(ConfigError, match=words) as error:
        read_key(key_file(tmp_path, data))
    assert "\n" not in str(error.value)


def test_no_file_and_no_regular_file_are_clear_errors(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the signing key"):
        read_key(tmp_path / "none")
    with pytest.raises(ConfigError, match="signing key"):
        read_key(tmp_path)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(pipe, os.O_WRONLY)
    try:
        with pytest.raises(ConfigError, match="regular file"):
            read_key(pipe)
    finally:
        os.close(writer)
        os.close(reader)


# ---------------------------------------------------------------- through the proxy


class Bench:
    """A proxy with a key, a signing planner, and a receiver that accepts signed frames alone."""

    def __init__(self, verdict=None, *, signatures: Signatures | None = None) -> None:
        self.planner_side, self.autopilot_side = FakeSide(), FakeSide()
        self.handler = ScriptedHandler(verdict)
        self.proxy = InlineProxy(
            self.planner_side,
            self.autopilot_side,
            self.handler,
            now_ns=lambda: 5,
            signatures=signatures or ours(),
        )
        self.planner, self.receiver = Party(), Party(1, 1)

    def through(self, data: bytes) -> bytes:
        self.planner_side.receive(data)
        sent, self.autopilot_side.sent = self.autopilot_side.sent, []
        return b"".join(sent)


def test_a_rewritten_setpoint_is_signed_again_and_untouched_ones_keep_their_signature():
    bench = Bench()
    for i in range(40):
        bench.handler.verdict = Forward() if i % 3 == 0 else Rewrite(float(i), 8.0, None, "held")
        data = bench.planner.pack(setpoint())
        out = bench.through(data)
        assert bench.receiver.accepts(out), i
        message = common.MAVLink(None).decode(bytearray(out))
        assert (message.get_seq(), message.get_srcSystem(), message.get_srcComponent()) == (2 * i, 245, 190)
        if i % 3 == 0:
            assert out == data
        else:
            assert (message.x, message.y, message.z) == (float(i), 8.0, -3.0)
            assert out[-13] == OUR_LINK
        heartbeat = bench.planner.pack(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        assert bench.through(heartbeat) == heartbeat
        assert bench.receiver.accepts(heartbeat)
    assert bench.proxy.counters.unprotected == {}


def test_a_planner_with_our_link_id_is_not_taken_for_a_replay():
    bench = Bench(Rewrite(7.0, 8.0, None, "held"))
    bench.planner = Party(link=OUR_LINK, unix_ns=NOW_NS - 30 * 10**9)  # its clock is behind ours
    for _ in range(5):
        assert bench.receiver.accepts(bench.through(bench.planner.pack(setpoint())))
        heartbeat = bench.planner.pack(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        assert bench.receiver.accepts(bench.through(heartbeat))


def test_a_nan_is_zeroed_under_a_new_signature():
    bench = Bench()
    out = bench.through(bench.planner.pack(setpoint(vx=math.nan)))
    assert bench.receiver.accepts(out)
    assert common.MAVLink(None).decode(bytearray(out)).vx == 0.0


@pytest.mark.parametrize("kind", ["wrong signature", "replayed", "too old"])
def test_a_signature_that_is_not_accepted_drops_the_setpoint_and_says_so(kind):
    bench = Bench(Rewrite(7.0, 8.0, None, "held"))
    match kind:
        case "wrong signature":
            data = Party(key=bytes(range(2, 34))).pack(setpoint())
        case "replayed":
            data = bench.planner.pack(setpoint())
            bench.through(data)
        case "too old":
            data = Party(unix_ns=NOW_NS - 3600 * 10**9).pack(setpoint())
    asked = len(bench.handler.setpoints)
    assert bench.through(data) == b""
    assert bench.handler.refused == [((245, 190), kind)]
    assert bench.proxy.counters.dropped == {kind: 1}
    assert len(bench.handler.setpoints) == asked


def test_an_attitude_is_verified_too_and_then_passes_untouched():
    bench = Bench(Drop("never asked"))
    attitude = common.MAVLink_set_attitude_target_message(1, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5)
    data = bench.planner.pack(attitude)
    assert bench.through(data) == data
    assert bench.handler.unprotected == [("ATTITUDE", "not handled")]
    assert bench.through(data) == b""


def test_an_unsigned_setpoint_stays_unsigned():
    bench = Bench(Rewrite(7.0, 8.0, None, "held"))
    out = bench.through(bytes(setpoint().pack(common.MAVLink(None, 245, 190))))
    assert out[2] == 0
    assert not bench.receiver.accepts(out), "nothing unsigned gets a signature from us"
    bench.handler.verdict = Unprotected("of this kind")
    data = bench.planner.pack(setpoint())
    assert bench.through(data) == data


def test_our_own_messages_are_signed():
    side, receiver = FakeSide(), Party(1, 1)
    identity = Identity(side, FakeSide(), now_ns=lambda: 0, signatures=ours(unix_ns=time.time_ns()))
    receiver.mav.signing.timestamp = stamp_of(time.time_ns())
    identity.heartbeat(MavState.ACTIVE)
    identity.status_text(MavSeverity.INFO, "a text that is longer than the fifty bytes of one message, twice")
    assert len(side.sent) >= 3
    assert all(receiver.accepts(frame) for frame in side.sent)
