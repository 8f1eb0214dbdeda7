"""The setpoint codec against pymavlink's own, and the telemetry decoder."""

import math
import struct

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from companion.guidance.setpoint import Rewrite, RewriteGlobal, RewriteOffset, RewriteVelocity, TypeMask
from companion.mavlink import codec, telemetry
from companion.mavlink.framing import Framer, RawFrame

RELAXED = settings(max_examples=100, deadline=None)  # a loaded machine is not a failure
POSITION_ONLY = 3576
POSITION_AND_YAW = 2552
NAN = math.nan

float32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


def frame_of(message, *, v1=False, seq=0, system=255, component=190) -> RawFrame:
    sender = common.MAVLink(None, system, component)
    sender.seq = seq
    (frame,) = Framer().feed(bytes(message.pack(sender, force_mavlink1=v1)))
    return frame


def local(
    mask=POSITION_AND_YAW, x=1.0, y=2.0, z=-3.0, v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0), yaw=0.5, yaw_rate=0.0,
    time_boot_ms=1234, target=(1, 1), coordinate_frame=1,
):  # fmt: skip
    return common.MAVLink_set_position_target_local_ned_message(
        time_boot_ms, *target, coordinate_frame, mask, x, y, z, *v, *a, yaw, yaw_rate
    )


def parsed(data: bytes):
    (message,) = common.MAVLink(None).parse_buffer(data)
    return message


locals_ = st.builds(
    local,
    mask=st.integers(0, 0xFFFF).map(lambda m: m & ~7),
    x=float32, y=float32, z=float32,
    v=st.tuples(float32, float32, float32), a=st.tuples(float32, float32, float32),
    yaw=float32, yaw_rate=float32,
    time_boot_ms=st.integers(0, 0xFFFFFFFF),
    target=st.tuples(st.integers(0, 255), st.integers(0, 255)),
    coordinate_frame=st.integers(0, 20),
)  # fmt: skip


@RELAXED
@given(locals_, st.booleans())
def test_unpack_reads_what_pymavlink_packed(message, v1):
    setpoint = codec.unpack_local(frame_of(message, v1=v1))
    for name in message.fieldnames:
        assert getattr(setpoint, name) == getattr(message, name)


@RELAXED
@given(
    locals_, st.booleans(), st.integers(0, 255), float32, float32, st.none() | st.floats(-math.pi, math.pi)
)
def test_a_rewritten_frame_keeps_z_and_the_header_and_satisfies_pymavlink(message, v1, seq, x, y, yaw):
    frame = frame_of(message, v1=v1, seq=seq, system=7, component=9)
    data = codec.rewrite(frame, Rewrite(x, y, yaw, "substituted"))
    new = parsed(data)  # raises on a wrong checksum
    header = new.get_header()
    assert (header.seq, header.srcSystem, header.srcComponent) == (seq, 7, 9)
    assert data[0] == frame.data[0]
    for name in ("time_boot_ms", "target_system", "target_component", "coordinate_frame"):
        assert getattr(new, name) == getattr(message, name)
    assert (new.x, new.y) == (x, y)
    assert struct.pack("<f", new.z) == struct.pack("<f", message.z)
    assert [new.vx, new.vy, new.vz, new.afx, new.afy, new.afz, new.yaw_rate] == [0.0] * 7
    assert new.yaw == (0.0 if yaw is None else struct.unpack("<f", struct.pack("<f", yaw))[0])
    assert new.type_mask == (POSITION_ONLY if yaw is None else POSITION_AND_YAW)
    # The canonical form: what pymavlink itself would send (trimmed in v2, full in v1).
    sender = common.MAVLink(None, 7, 9)
    sender.seq = seq
    assert data == bytes(new.pack(sender, force_mavlink1=v1))


def test_z_keeps_its_bits_even_where_it_is_a_negative_zero_or_denormal():
    for bits in (b"\x00\x00\x00\x80", b"\x01\x00\x00\x00"):
        frame = frame_of(local(z=struct.unpack("<f", bits)[0]))
        data = codec.rewrite(frame, Rewrite(5.0, 6.0, None, "held"))
        assert Framer().feed(data)[0].payload[12:16] == bits


def test_v2_is_trimmed_and_v1_is_not():
    message = local(target=(0, 0), coordinate_frame=0)
    assert len(codec.rewrite(frame_of(message), Rewrite(1, 2, 3, "held"))) == 12 + 50
    assert len(codec.rewrite(frame_of(message, v1=True), Rewrite(1, 2, 3, "held"))) == 8 + 53


@pytest.mark.parametrize(
    "rewrite",
    [Rewrite(NAN, 0, None, "held"), Rewrite(0, math.inf, None, "held"), Rewrite(0, 0, NAN, "held"),
     Rewrite(1e300, 0, None, "held")],
)  # fmt: skip
def test_a_value_that_may_not_leave_is_refused(rewrite):
    with pytest.raises(ValueError, match=r"finite|float32"):
        codec.rewrite(frame_of(local()), rewrite)


@pytest.mark.parametrize("bit", [TypeMask.X_IGNORE, TypeMask.Y_IGNORE, TypeMask.Z_IGNORE])
def test_a_setpoint_without_a_whole_position_is_not_rewritten(bit):
    with pytest.raises(ValueError, match="type_mask"):
        codec.rewrite(frame_of(local(mask=POSITION_ONLY | bit)), Rewrite(1, 2, None, "held"))


def test_other_messages_signed_and_unverified_frames_are_not_rewritten():
    frame = frame_of(local())
    new = Rewrite(1, 2, None, "held")
    with pytest.raises(ValueError, match="expected message 84"):
        codec.rewrite(frame_of(common.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3)), new)
    for flags, word in ((1, "signed"), (4, "0x4")):
        changed = frame.data[:2] + bytes([flags]) + frame.data[3:] + bytes(13)
        with pytest.raises(ValueError, match=word):
            codec.rewrite(frame._replace(data=changed), new)
    with pytest.raises(ValueError, match="checksum"):
        codec.rewrite(frame._replace(verified=False), new)


def test_a_rewritten_frame_holds_no_nan_whatever_was_ignored():
    frame = frame_of(local(mask=POSITION_ONLY, v=(NAN, NAN, math.inf), a=(NAN,) * 3, yaw=NAN, yaw_rate=NAN))
    new = codec.unpack_local(Framer().feed(codec.rewrite(frame, Rewrite(1, 2, None, "held")))[0])
    assert all(
        math.isfinite(v) for v in (new.vx, new.vy, new.vz, new.afx, new.afy, new.afz, new.yaw, new.yaw_rate)
    )


def test_sanitise_zeroes_ignored_nans_and_nothing_else():
    frame = frame_of(local(mask=POSITION_ONLY, x=1.5, v=(NAN, 4.0, -math.inf), yaw=NAN))
    new = codec.unpack_local(Framer().feed(codec.sanitise(frame))[0])
    assert (new.x, new.vx, new.vy, new.vz, new.yaw, new.type_mask) == (1.5, 0.0, 4.0, 0.0, 0.0, POSITION_ONLY)


@RELAXED
@given(locals_, st.booleans())
def test_sanitise_leaves_finite_frames_byte_for_byte(message, v1):
    frame = frame_of(message, v1=v1)
    assert codec.sanitise(frame) is frame.data


def test_sanitise_does_not_touch_used_fields():
    frame = frame_of(local(mask=POSITION_ONLY, x=NAN))
    assert codec.sanitise(frame) == frame.data
    assert codec.unpack_local(frame).nonfinite_used_fields() == ("x",)


def glob(mask=POSITION_ONLY, lat=473000000, lon=-85000000, alt=5.0, v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0), yaw=0.5,
         yaw_rate=0.0, coordinate_frame=6):  # fmt: skip
    return common.MAVLink_set_position_target_global_int_message(
        1234, 1, 1, coordinate_frame, mask, lat, lon, alt, *v, *a, yaw, yaw_rate
    )


any_float32 = st.floats(width=32)
int32 = st.integers(-(2**31), 2**31 - 1)
yaws = st.none() | st.floats(-math.pi, math.pi)
triples = st.tuples(any_float32, any_float32, any_float32)
globals_ = st.builds(
    glob, mask=st.integers(0, 0xFFFF), lat=int32, lon=int32, alt=any_float32, v=triples, a=triples,
    yaw=any_float32, yaw_rate=any_float32, coordinate_frame=st.integers(0, 20),
)  # fmt: skip
wild_locals = st.builds(
    local, mask=st.integers(0, 0xFFFF), x=any_float32, y=any_float32, z=any_float32, v=triples, a=triples,
    yaw=any_float32, yaw_rate=any_float32, coordinate_frame=st.integers(0, 20),
)  # fmt: skip


def bits(value: float) -> bytes:
    return struct.pack("<f", value)


def ignored_are_zero(new) -> bool:
    names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
    masks = (1, 2, 4, 8, 16, 32, 64, 128, 256, 1024, 2048)
    return all(
        getattr(new, name, 0.0) == 0.0 for name, bit in zip(names, masks, strict=True) if new.type_mask & bit
    )


@RELAXED
@given(globals_, st.booleans())
def test_unpack_global_reads_what_pymavlink_packed(message, v1):
    setpoint = codec.unpack_global(frame_of(message, v1=v1))
    for name in message.fieldnames:
        packed, read = getattr(message, name), getattr(setpoint, name)
        assert packed == read or (math.isnan(packed) and math.isnan(read))


@RELAXED
@given(wild_locals | globals_, st.booleans(), float32, float32, yaws)
def test_a_rewritten_velocity_keeps_what_is_vertical_and_leaves_nothing_else(message, v1, vx, vy, yaw):
    frame = frame_of(message, v1=v1, seq=77)
    new = parsed(codec.rewrite(frame, RewriteVelocity(vx, vy, yaw, "substituted")))
    assert (new.get_seq(), new.time_boot_ms, new.coordinate_frame) == (77, 1234, message.coordinate_frame)
    assert (new.vx, new.vy) == (vx, vy)
    position = 1 | 2 | 4
    assert new.type_mask & (position | 32) == message.type_mask & (position | 32)
    assert new.type_mask & ~(position | 32) == 64 | 128 | 256 | 2048 | (1024 if yaw is None else 0)
    assert ignored_are_zero(new)
    height = "alt" if new.get_msgId() == 86 else "z"
    for name, bit in ((height, 4), ("vz", 32)):
        kept = bits(0.0) if message.type_mask & bit else bits(getattr(message, name))
        assert bits(getattr(new, name)) == kept
    if new.get_msgId() == 86:
        assert (new.lat_int, new.lon_int) == (message.lat_int, message.lon_int)


@RELAXED
@given(globals_, st.booleans(), int32, int32, yaws)
def test_a_rewritten_global_position_keeps_the_altitude_and_leaves_nothing_else(message, v1, lat, lon, yaw):
    message.type_mask &= ~7
    new = parsed(codec.rewrite(frame_of(message, v1=v1), RewriteGlobal(lat, lon, yaw, "held")))
    assert (new.lat_int, new.lon_int, bits(new.alt)) == (lat, lon, bits(message.alt))
    assert new.type_mask == (POSITION_ONLY if yaw is None else POSITION_AND_YAW)
    assert ignored_are_zero(new)


@RELAXED
@given(wild_locals, st.booleans(), float32, float32, st.none() | float32, yaws)
def test_a_rewritten_offset_keeps_z_or_sets_it(message, v1, x, y, z, yaw):
    message.type_mask &= ~7
    new = parsed(codec.rewrite(frame_of(message, v1=v1), RewriteOffset(x, y, z, yaw, "held")))
    assert (new.x, new.y, bits(new.z)) == (x, y, bits(message.z if z is None else z))
    assert new.type_mask == (POSITION_ONLY if yaw is None else POSITION_AND_YAW)
    assert ignored_are_zero(new)


def test_a_climb_rate_in_place_of_a_height_stays():
    frame = frame_of(local(mask=(POSITION_ONLY | 4) & ~32, z=NAN, v=(3.0, NAN, -0.25)))
    new = codec.unpack_local(Framer().feed(codec.rewrite(frame, Rewrite(1, 2, None, "held")))[0])
    assert (new.x, new.y, new.z, new.vx, new.vy, new.vz) == (1.0, 2.0, 0.0, 0.0, 0.0, -0.25)
    assert new.type_mask == (POSITION_ONLY | 4) & ~32


@pytest.mark.parametrize(
    ("message", "new", "why"),
    [
        (glob(), Rewrite(1, 2, None, "held"), "expected message 84"),
        (glob(), RewriteOffset(1, 2, None, None, "held"), "expected message 84"),
        (local(), RewriteGlobal(1, 2, None, "held"), "expected message 86"),
        (glob(mask=POSITION_ONLY | 1), RewriteGlobal(1, 2, None, "held"), "ignores x or y"),
        (glob(mask=(POSITION_ONLY | 4) & ~32), RewriteGlobal(1, 2, None, "held"), "ignores z"),
        (local(mask=(POSITION_ONLY | 4) & ~32), RewriteOffset(1, 2, None, None, "held"), "ignores z"),
        (glob(), RewriteGlobal(2**31, 0, None, "held"), "int32"),
        (glob(), RewriteGlobal(0, 0, NAN, "held"), "finite"),
        (local(mask=3527), RewriteVelocity(NAN, 0, None, "held"), "finite"),
        (local(mask=3527), RewriteVelocity(1e300, 0, None, "held"), "float32"),
        (local(), RewriteOffset(0, 0, math.inf, None, "held"), "finite"),
    ],
)
def test_a_replacement_that_does_not_fit_its_setpoint_is_refused(message, new, why):
    with pytest.raises(ValueError, match=why):
        codec.rewrite(frame_of(message), new)


def test_nonfinite_used_fields_of_the_other_setpoints():
    message = common.MAVLink_set_position_target_global_int_message(
        1, 1, 1, 6, POSITION_ONLY, 473000000, 85000000, NAN, 0, 0, 0, 0, 0, 0, NAN, 0
    )
    frame = frame_of(message)
    assert codec.unpack_global(frame).nonfinite_used_fields() == ("alt",)
    assert codec.target_system(frame) == 1
    attitude = common.MAVLink_set_attitude_target_message(1, 3, 1, 7, [1, NAN, 0, 0], NAN, 0, 0, 0.5)
    assert codec.attitude_nonfinite_used_fields(frame_of(attitude)) == ("q",)
    assert codec.target_system(frame_of(attitude)) == 3
    ignored = common.MAVLink_set_attitude_target_message(1, 1, 1, 128 | 3, [NAN] * 4, NAN, NAN, 0, NAN)
    assert codec.attitude_nonfinite_used_fields(frame_of(ignored)) == ("thrust",)


@RELAXED
@given(float32, float32, float32)
def test_telemetry_reads_what_pymavlink_packed(a, b, c):
    attitude = telemetry.decode(frame_of(common.MAVLink_attitude_message(77, a, b, c, 0, 0, 0)))
    assert attitude == telemetry.Attitude(77, a, b, c, 0, 0, 0)
    position = telemetry.decode(frame_of(common.MAVLink_local_position_ned_message(77, a, b, c, c, b, a)))
    assert position == telemetry.LocalPosition(77, a, b, c, c, b, a)


@pytest.mark.parametrize(("custom_mode", "trimmed"), [(6 << 16, 7), (4, 1), (0, 1), (0xFFFFFFFF, 9)])
def test_current_mode_is_read_and_checked_although_the_dialect_lacks_it(custom_mode, trimmed):
    payload = struct.pack("<IIB", custom_mode, custom_mode, 0)[:trimmed]
    covered = bytes([len(payload), 0, 0, 9, 1, 1]) + (436).to_bytes(3, "little") + payload
    crc = common.x25crc(covered + bytes([193])).crc.to_bytes(2, "little")
    (frame,) = Framer().feed(b"\xfd" + covered + crc)
    assert frame.verified
    assert telemetry.decode(frame) == telemetry.CurrentMode(custom_mode & (1 << 8 * trimmed) - 1)
    assert Framer().feed(b"\xfd" + covered + bytes([crc[0] ^ 1, crc[1]])) == []


@RELAXED
@given(st.tuples(*[st.floats(-1, 1)] * 4))
def test_a_quaternion_is_normalised_or_refused(q):
    length = math.hypot(*q)
    assume(length > 0.1)
    unit = [v / length for v in q]
    value = telemetry.decode(frame_of(common.MAVLink_attitude_quaternion_message(5, *unit, 0.1, 0.2, 0.3)))
    assert isinstance(value, telemetry.AttitudeQuaternion)
    assert value.q_ned_from_body == pytest.approx(unit, abs=1e-6)
    assert math.hypot(*value.q_ned_from_body) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (common.MAVLink_attitude_message(1, NAN, 0, 0, 0, 0, 0), "not finite"),
        (common.MAVLink_local_position_ned_message(1, 0, math.inf, 0, 0, 0, 0), "not finite"),
        (common.MAVLink_attitude_quaternion_message(1, NAN, 0, 0, 0, 0, 0, 0), "not finite"),
        (common.MAVLink_attitude_quaternion_message(1, 0, 0, 0, 0, 0, 0, 0), "quaternion of length 0"),
    ],
)
def test_what_is_not_finite_is_unusable(message, reason):
    assert telemetry.decode(frame_of(message)) == telemetry.Unusable(message.get_msgId(), reason)


def test_odometry_and_landed_state():
    odometry = common.MAVLink_odometry_message(
        10**15, 1, 12, 1, 2, 3, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [NAN] * 21, [NAN] * 21, reset_counter=7
    )
    assert telemetry.decode(frame_of(odometry)) == telemetry.Odometry(10**15, 7)
    state = telemetry.decode(frame_of(common.MAVLink_extended_sys_state_message(0, 2)))
    assert state == telemetry.ExtendedSysState(0, 2)
    with pytest.raises(ValueError, match="1 is not read"):
        telemetry.decode(frame_of(common.MAVLink_sys_status_message(*[0] * 13)))


@pytest.mark.parametrize(
    ("kind", "autopilot", "base_mode", "custom_mode", "expected"),
    [
        (2, 12, 1 | 128, 6 << 16, (True, True)),
        (2, 12, 1, 6 << 16, (False, True)),
        (2, 12, 1 | 128, 4 << 16 | 6 << 24, (True, False)),
        (2, 12, 128, 6 << 16, (True, False)),
        (2, 3, 1 | 128, 4, (True, True)),
        (2, 3, 1 | 128, 9, (True, False)),
        (10, 3, 1 | 128, 4, (True, False)),  # mode 4 of a rover is HOLD
        (2, 0, 1 | 128, 4, (True, False)),
    ],
)
def test_vehicle_mode(kind, autopilot, base_mode, custom_mode, expected):
    message = common.MAVLink_heartbeat_message(kind, autopilot, base_mode, custom_mode, 4, 3)
    heartbeat = telemetry.decode(frame_of(message, system=3, component=1))
    assert isinstance(heartbeat, telemetry.Heartbeat)
    assert (heartbeat.system_id, heartbeat.component_id) == (3, 1)
    assert telemetry.vehicle_mode(heartbeat) == expected
