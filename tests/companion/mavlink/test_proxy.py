"""The inline proxy over loopback sockets, and its rules on single frames."""

import asyncio
import math
import random
import socket
import struct
from functools import partial

import pytest
from pymavlink.dialects.v20 import common

from companion.guidance.setpoint import (
    Drop,
    Forward,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Unprotected,
)
from companion.mavlink.framing import Framer
from companion.mavlink.link import LinkCounters, UdpEndpoint
from companion.mavlink.proxy import InlineProxy
from companion.mavlink.telemetry import Attitude, Heartbeat, LocalPosition, Unusable

NAN = math.nan
POSITION_ONLY = 3576
PLANNER = common.MAVLink(None, 255, 190)
VEHICLE = common.MAVLink(None, 1, 1)
PX4_HEARTBEAT = bytes(common.MAVLink_heartbeat_message(2, 12, 209, 6 << 16, 4, 3).pack(VEHICLE))


def setpoint_message(x=1.0, y=2.0, z=-3.0, mask=POSITION_ONLY, vx=0.0, yaw=0.5, target=(1, 1), frame=1):
    return common.MAVLink_set_position_target_local_ned_message(
        1234, *target, frame, mask, x, y, z, vx, 0, 0, 0, 0, 0, yaw, 0
    )


def packed(message, sender=PLANNER, *, v1=False, seq=0) -> bytes:
    sender.seq = seq
    return bytes(message.pack(sender, force_mavlink1=v1))


def signed(data: bytes) -> bytes:
    """Return a MAVLink 2 frame as a signing sender would send it (the key is nobody's business here)."""
    covered = data[1:2] + bytes([data[2] | 1]) + data[3:-2]
    message_id = int.from_bytes(data[7:10], "little")
    crc = common.x25crc(covered + bytes([common.mavlink_map[message_id].crc_extra])).crc
    return data[:1] + covered + crc.to_bytes(2, "little") + bytes(range(13))


def unknown_frame(rng: random.Random, seq: int, system: int, component: int) -> bytes:
    body = rng.randbytes(rng.randint(1, 80))
    head = bytes([len(body), 0, 0, seq, system, component]) + (433).to_bytes(3, "little")
    return b"\xfd" + head + body + rng.randbytes(2)


class FakeSide:
    """One side of the proxy without a socket."""

    def __init__(self):
        self.on_frames = None
        self.counters = LinkCounters()
        self.sent = []
        self._framer = Framer(self.counters.framing)

    def send(self, datagram):
        self.sent.append(datagram)
        return 1

    def receive(self, datagram):
        frames = self._framer.feed(datagram)
        if frames:
            self.on_frames(frames)


class ScriptedHandler:
    """Gives the verdict it was told and keeps what it was given."""

    def __init__(self, verdict=None):
        self.verdict = Forward() if verdict is None else verdict
        self.telemetry_ns = []
        self.setpoints, self.telemetry, self.unprotected, self.requests, self.rivals, self.refused = (
            [],
            [],
            [],
            [],
            [],
            [],
        )

    def on_setpoint(self, setpoint, system_id, component_id, now_ns):
        self.setpoints.append((setpoint, system_id, component_id, now_ns))
        if isinstance(self.verdict, Exception):
            raise self.verdict
        return self.verdict

    def on_unprotected(self, kind, detail):
        self.unprotected.append((kind, detail))

    def on_engage_request(self, request, now_ns):
        self.requests.append(request)

    def on_rivals(self, sources, now_ns):
        self.rivals.append(sources)

    def on_refused_signature(self, source, reason):
        self.refused.append((source, reason))

    def on_telemetry(self, message, now_ns):
        self.telemetry.append(message)
        self.telemetry_ns.append(now_ns)
        if isinstance(self.verdict, Exception):
            raise self.verdict


class Bench:
    def __init__(self, verdict=None):
        self.planner, self.autopilot = FakeSide(), FakeSide()
        self.handler = ScriptedHandler(verdict)
        self.now_ns = 5
        self.proxy = InlineProxy(self.planner, self.autopilot, self.handler, now_ns=lambda: self.now_ns)
        self.counters = self.proxy.counters

    def through(self, datagram: bytes) -> list[bytes]:
        self.planner.receive(datagram)
        sent, self.autopilot.sent = self.autopilot.sent, []
        return sent


def floats(data: bytes) -> tuple[float, ...]:
    return struct.unpack("<11f", Framer().feed(data)[0].payload.ljust(53, b"\0")[4:48])


def test_a_datagram_without_setpoints_is_sent_on_as_the_same_datagram():
    rng = random.Random(3)
    heartbeat = packed(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    datagram = heartbeat + unknown_frame(rng, 1, 255, 190) + signed(heartbeat) + packed(
        common.MAVLink_ping_message(1, 2, 0, 0), v1=True
    )  # fmt: skip
    bench = Bench()
    assert bench.through(datagram) == [datagram]
    bench.autopilot.receive(datagram)
    assert bench.planner.sent == [datagram]
    assert (bench.counters.to_autopilot_frames, bench.counters.to_planner_frames) == (4, 4)


def test_a_setpoint_between_others_is_replaced_in_its_place():
    heartbeat = packed(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    bench = Bench(Rewrite(7.0, 8.0, 1.0, "substituted"))
    (out,) = bench.through(heartbeat + packed(setpoint_message(), seq=9) + heartbeat)
    first, new, last = [f.data for f in Framer().feed(out)]
    assert first == last == heartbeat
    message = common.MAVLink(None).decode(bytearray(new))
    assert (message.x, message.y, message.z, message.yaw) == (7.0, 8.0, -3.0, 1.0)
    assert (message.get_seq(), message.get_srcSystem(), message.get_srcComponent()) == (9, 255, 190)
    given, system_id, component_id, now_ns = bench.handler.setpoints[0]
    assert (given.x, given.y, given.z, system_id, component_id, now_ns) == (1.0, 2.0, -3.0, 255, 190, 5)
    assert bench.counters.rewritten == {"substituted": 1}


@pytest.mark.parametrize("v1", [False, True])
def test_forward_is_byte_for_byte(v1):
    data = packed(setpoint_message(vx=1.5), v1=v1)
    bench = Bench()
    assert bench.through(data) == [data]
    assert (bench.counters.setpoints_in, bench.counters.forwarded) == (1, 1)


def test_forward_zeroes_a_nan_that_the_mask_ignores_and_keeps_the_rest():
    data = packed(setpoint_message(vx=NAN, yaw=math.inf))
    (out,) = Bench().through(data)
    assert floats(out) == (1.0, 2.0, -3.0) + (0.0,) * 8


def test_drop_sends_nothing_in_its_place_and_counts_the_reason():
    heartbeat = packed(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    bench = Bench(Drop("no pose"))
    assert bench.through(packed(setpoint_message())) == []
    assert bench.through(heartbeat + packed(setpoint_message()) + heartbeat) == [heartbeat * 2]
    assert bench.counters.dropped == {"no pose": 2}


def global_int(mask=POSITION_ONLY, alt=5.0, target=1):
    return common.MAVLink_set_position_target_global_int_message(
        1, target, 1, 6, mask, 1, 2, alt, 0, 0, 0, 0, 0, 0, 0, 0
    )


def attitude_target(q=(1, 0, 0, 0)):
    return common.MAVLink_set_attitude_target_message(1, 1, 1, 7, list(q), 0, 0, 0, 0.5)


@pytest.mark.parametrize(
    "message",
    [setpoint_message(x=NAN), setpoint_message(z=math.inf), setpoint_message(mask=3576 & ~8, vx=NAN),
     setpoint_message(mask=3527, vx=-math.inf), setpoint_message(frame=9, y=NAN), global_int(alt=NAN),
     attitude_target(q=(NAN, 0, 0, 0)), setpoint_message(target=(9, 1), x=NAN)],
)  # fmt: skip
def test_a_value_that_is_used_and_not_finite_never_leaves(message):
    bench = Bench()
    bench.autopilot.receive(PX4_HEARTBEAT)
    assert bench.through(packed(message)) == []
    assert bench.through(signed(packed(message))) == []
    assert bench.counters.dropped == {"not finite": 2}
    assert bench.handler.setpoints == []


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (setpoint_message(frame=9), "LOCAL_NED"),
        (setpoint_message(mask=3527, x=NAN, vx=1.0), "LOCAL_NED"),
        (global_int(), "GLOBAL_INT"),
    ],
)
def test_what_the_handler_does_not_treat_passes_untouched_and_is_announced(message, kind):
    data = packed(message)
    bench = Bench(Unprotected("of this kind"))
    assert bench.through(data) == [data]
    assert bench.handler.unprotected == [(kind, "of this kind")]
    assert bench.counters.unprotected == {kind: 1}
    assert (bench.counters.setpoints_in, bench.counters.forwarded) == (1, 1)


def test_an_attitude_passes_untouched_and_is_announced_without_asking():
    data = packed(attitude_target())
    bench = Bench(Drop("never asked"))
    assert bench.through(data) == [data]
    assert bench.handler.unprotected == [("ATTITUDE", "not handled")]
    assert (bench.counters.setpoints_in, bench.counters.forwarded) == (0, 0)


@pytest.mark.parametrize(
    ("message", "verdict", "field", "value"),
    [
        (setpoint_message(mask=3527, vx=1.0), RewriteVelocity(0.5, -0.25, 1.0, "substituted"), "vx", 0.5),
        (setpoint_message(frame=9), RewriteOffset(0.5, -0.25, 0.0, 1.0, "held"), "z", 0.0),
        (global_int(), RewriteGlobal(7, -9, 1.0, "turned"), "lon_int", -9),
    ],
)
def test_every_kind_of_replacement_is_carried_out_and_counted(message, verdict, field, value):
    bench = Bench(verdict)
    (out,) = bench.through(packed(message))
    (parsed,) = common.MAVLink(None).parse_buffer(bytearray(out))
    assert getattr(parsed, field) == value
    assert bench.counters.rewritten == {verdict.action: 1}
    assert bench.counters.setpoints_in == 1


def test_a_global_setpoint_is_sanitised_like_a_local_one():
    bench = Bench()
    message = global_int(alt=5.0)
    message.vx, message.yaw = NAN, math.inf
    (out,) = bench.through(packed(message))
    (parsed,) = common.MAVLink(None).parse_buffer(bytearray(out))
    assert (parsed.lat_int, parsed.lon_int, parsed.alt, parsed.vx, parsed.yaw) == (1, 2, 5.0, 0.0, 0.0)


def test_rivals_are_told_to_the_handler_whatever_they_send():
    bench = Bench()
    for i in range(6):
        sender = (PLANNER, common.MAVLink(None, 245, 190))[i % 2]
        message = setpoint_message() if i % 2 else attitude_target()
        bench.now_ns += 50_000_000
        bench.through(packed(message, sender))
    assert bench.handler.rivals == [((245, 190), (255, 190))]
    assert bench.counters.as_dict()["rivalries"] == 1


def test_senders_for_another_system_are_no_rivals():
    bench = Bench()
    bench.autopilot.receive(PX4_HEARTBEAT)
    for i in range(6):
        bench.now_ns += 50_000_000
        bench.through(
            packed(setpoint_message(target=(1 + i % 2, 1)), (PLANNER, common.MAVLink(None, 245, 190))[i % 2])
        )
    assert bench.handler.rivals == []


def test_a_signed_setpoint_passes_untouched_with_an_alarm():
    data = signed(packed(setpoint_message()))
    bench = Bench(Rewrite(7, 8, None, "held"))
    assert bench.through(data) == [data]
    assert bench.handler.unprotected == [("signed", "LOCAL_NED")]
    assert bench.counters.forwarded == 1


def test_a_setpoint_with_an_unknown_incompatibility_flag_is_never_rewritten():
    plain = packed(setpoint_message())
    covered = plain[1:2] + b"\x02" + plain[3:-2]
    data = b"\xfd" + covered + common.x25crc(covered + bytes([143])).crc.to_bytes(2, "little")
    bench = Bench(Rewrite(7, 8, None, "held"))
    assert bench.through(data) == [data]
    assert bench.handler.unprotected == [("LOCAL_NED", "incompatibility flags 0x2")]


def test_a_corrupt_setpoint_never_comes_through():
    data = bytearray(packed(setpoint_message()))
    data[20] ^= 1
    bench = Bench()
    assert bench.through(bytes(data)) == []
    assert bench.handler.setpoints == []
    assert bench.counters.as_dict()["planner_crc_errors"] == 1


def test_only_setpoints_for_the_vehicle_count():
    elsewhere = packed(setpoint_message(target=(2, 1)))
    bench = Bench(Rewrite(7, 8, None, "held"))
    assert bench.through(elsewhere) != [elsewhere]  # no autopilot heard yet: it may be this one
    bench.autopilot.receive(PX4_HEARTBEAT)
    assert bench.through(elsewhere) == [elsewhere]
    for target in ((1, 1), (0, 0), (1, 0)):
        data = packed(setpoint_message(target=target))
        assert bench.through(data) != [data]
    assert (bench.counters.setpoints_in, bench.counters.setpoints_elsewhere) == (4, 1)


@pytest.mark.parametrize(
    "verdict", [ZeroDivisionError("boom"), Rewrite(NAN, 0, None, "held"), Rewrite(1, 2, 3, "danced"), "yes"]
)
def test_a_failing_handler_holds_the_setpoint_back_and_stops_nothing_else(verdict, caplog):
    heartbeat = packed(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    bench = Bench(verdict)
    for _ in range(3):
        assert bench.through(heartbeat + packed(setpoint_message()) + heartbeat) == [heartbeat * 2]
    assert bench.counters.handler_errors == 3
    assert bench.counters.dropped == {"handler error": 3}
    assert len(caplog.records) == 1  # said once, not at the rate of the setpoints
    bench.handler.verdict = Forward()
    assert bench.through(packed(setpoint_message())) == [packed(setpoint_message())]


def test_telemetry_of_the_vehicle_is_decoded_after_it_was_forwarded():
    bench = Bench()
    attitude = packed(common.MAVLink_attitude_message(9, 0.1, 0.2, NAN, 0, 0, 1), VEHICLE)
    position = packed(common.MAVLink_local_position_ned_message(9, 1, 2, 3, 0, 0, 0), VEHICLE)
    other = packed(common.MAVLink_local_position_ned_message(9, 4, 5, 6, 0, 0, 0), common.MAVLink(None, 2, 1))
    gimbal = packed(common.MAVLink_attitude_message(9, 0, 1, 0, 0, 0, 1), common.MAVLink(None, 1, 154))
    bench.autopilot.receive(attitude)  # nobody knows yet whose it is
    assert bench.handler.telemetry == []
    for data in (PX4_HEARTBEAT, attitude, position, other, gimbal):
        bench.autopilot.receive(data)
    assert bench.planner.sent == [attitude, PX4_HEARTBEAT, attitude, position, other, gimbal]
    heartbeat, unusable, local = bench.handler.telemetry
    assert isinstance(heartbeat, Heartbeat)
    assert unusable == Unusable(30, "not finite")
    assert local == LocalPosition(9, 1, 2, 3, 0, 0, 0)
    assert bench.proxy.vehicle == heartbeat


def test_attitudes_that_come_fast_are_read_together_each_with_its_own_time():
    bench = Bench()
    bench.autopilot.receive(PX4_HEARTBEAT)
    begin_ns = bench.now_ns = 1_000_000_000
    for ms in range(0, 20, 2):
        bench.now_ns = begin_ns + ms * 1_000_000
        bench.autopilot.receive(packed(common.MAVLink_attitude_message(ms, 0, 0, 0, 0, 0, 0), VEHICLE))
        read = [message.time_boot_ms for message in bench.handler.telemetry[1:]]
        assert read == list(range(0, ms // 8 * 8 + 2, 2)), (
            "at once when the last was 8 ms ago, else with the next"
        )
    assert bench.handler.telemetry_ns[1:] == [begin_ns + ms * 1_000_000 for ms in range(0, 18, 2)]
    assert len(bench.planner.sent) == 11, "all were sent on when they came"


@pytest.mark.parametrize(
    "then",
    [
        lambda bench: bench.autopilot.receive(
            packed(common.MAVLink_local_position_ned_message(9, 1, 2, 3, 0, 0, 0), VEHICLE)
        ),
        lambda bench: bench.planner.receive(packed(setpoint_message())),
        lambda bench: bench.planner.receive(
            packed(common.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
        ),
    ],
    ids=["a position", "a setpoint", "a request to arm"],
)
def test_attitudes_that_wait_are_read_before_anything_else_is_read_or_decided(then):
    bench = Bench()
    order = []

    def noted(call, name, *args):
        order.append(type(args[0]).__name__ if name == "on_telemetry" else name)
        return call(*args)

    for name in ("on_telemetry", "on_setpoint", "on_engage_request"):
        setattr(bench.handler, name, partial(noted, getattr(bench.handler, name), name))
    bench.autopilot.receive(PX4_HEARTBEAT)
    for ms in (1, 2, 3):
        bench.autopilot.receive(packed(common.MAVLink_attitude_message(ms, 0, 0, 0, 0, 0, 0), VEHICLE))
    assert order == ["Heartbeat", "Attitude"]
    then(bench)
    assert order[:4] == ["Heartbeat", "Attitude", "Attitude", "Attitude"]
    assert len(order) == 5


def test_another_autopilot_takes_over_only_when_the_first_is_silent():
    second = packed(common.MAVLink_heartbeat_message(2, 12, 209, 6 << 16, 4, 3), common.MAVLink(None, 2, 1))
    bench = Bench()
    bench.autopilot.receive(PX4_HEARTBEAT)
    bench.autopilot.receive(second)
    assert bench.proxy.vehicle.system_id == 1
    bench.now_ns += 6_000_000_000
    bench.autopilot.receive(second)
    assert bench.proxy.vehicle.system_id == 2


def test_a_failing_telemetry_handler_stops_nothing(caplog):
    bench = Bench(RuntimeError("boom"))
    bench.autopilot.receive(PX4_HEARTBEAT)
    bench.autopilot.receive(PX4_HEARTBEAT)
    assert bench.planner.sent == [PX4_HEARTBEAT] * 2
    assert bench.counters.handler_errors == 2
    assert "on_telemetry" in caplog.text


def test_a_setpoint_hidden_in_garbage_does_not_leak_past_the_handler():
    bench = Bench(Rewrite(7.0, 8.0, None, "held"))
    for stray in (b"\xfd", b"\xfe\x05", b"\xfd\xff\x00\x00", b"\xfd\x3f\x00\x00\x00\x01\x01\x70\x11\x01"):
        (out,) = bench.through(stray + packed(setpoint_message()))
        assert [floats(f.data)[:3] for f in Framer().feed(out)] == [(7.0, 8.0, -3.0)]


# ---------------------------------------------------------------------- over sockets


class SubstituteAll:
    """Answers each setpoint with x + 100, y - 100, except every third, which is forwarded."""

    def __init__(self):
        self.seen = 0
        self.telemetry = []

    def on_setpoint(self, setpoint, system_id, component_id, now_ns):
        self.seen += 1
        if self.seen % 3 == 0:
            return Forward()
        action = "held" if self.seen % 3 == 1 else "turned"
        return Rewrite(setpoint.x + 100.0, setpoint.y - 100.0, None, action)

    def on_unprotected(self, kind, detail):
        pass

    def on_engage_request(self, request, now_ns):
        pass

    def on_rivals(self, sources, now_ns):
        pass

    def on_refused_signature(self, source, reason):
        pass

    def on_telemetry(self, message, now_ns):
        self.telemetry.append(message)


def mixed(rng: random.Random, count: int, sender: common.MAVLink, *, setpoints: bool) -> list[bytes]:
    """Return known, unknown, signed and MAVLink 1 frames, with position setpoints in between."""
    frames = []
    for seq in range(count):
        sender.seq = seq % 256
        kind = rng.random()
        v1 = rng.random() < 0.3
        if setpoints and kind < 0.3:
            message = setpoint_message(rng.uniform(-50, 50), rng.uniform(-50, 50), rng.uniform(-20, 0))
            frames.append(packed(message, sender, v1=v1, seq=seq % 256))
        elif kind < 0.4:
            frames.append(unknown_frame(rng, seq % 256, sender.srcSystem, sender.srcComponent))
        elif kind < 0.5:
            message = common.MAVLink_attitude_message(seq, rng.random(), 0, 0, 0, 0, 0)
            frames.append(signed(packed(message, sender, seq=seq % 256)))
        elif kind < 0.75:
            message = common.MAVLink_attitude_message(seq, rng.random(), rng.random(), 0, 0, 0, rng.random())
            frames.append(packed(message, sender, v1=v1, seq=seq % 256))
        else:
            message = common.MAVLink_statustext_message(
                6, rng.randbytes(rng.randint(1, 50)).replace(b"\0", b"x")
            )
            frames.append(packed(message, sender, v1=v1, seq=seq % 256))
    return frames


def datagrams_of(rng: random.Random, frames: list[bytes]) -> list[bytes]:
    out, at = [], 0
    while at < len(frames):
        step = rng.randint(1, 6)
        out.append(b"".join(frames[at : at + step]))
        at += step
    return out


def expected_at_autopilot(frames: list[bytes]) -> list[bytes]:
    handler, out = SubstituteAll(), []
    for data in frames:
        message_id = data[5] if data[0] == 0xFE else int.from_bytes(data[7:10], "little")
        if message_id != 84:
            out.append(data)
            continue
        message = common.MAVLink(None).decode(bytearray(data))
        if not isinstance(handler.on_setpoint(message, 0, 0, 0), Forward):
            message.x, message.y, message.yaw, message.type_mask = message.x + 100, message.y - 100, 0.0, 3576
        # Packed anew by pymavlink: an opinion on the right bytes that is not ours.
        sender = common.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
        sender.seq = message.get_seq()
        out.append(bytes(message.pack(sender, force_mavlink1=data[0] == 0xFE)))
    return out


async def pump(sock: socket.socket, datagrams: list[bytes], received: list[int]) -> None:
    """Send all, never more than 64 datagrams ahead of what came out: socket buffers are not tested here."""
    loop = asyncio.get_running_loop()
    for number, datagram in enumerate(datagrams):
        while number - received[0] > 64:  # noqa: ASYNC110  what is waited for crosses the kernel
            await asyncio.sleep(0.001)
        await loop.sock_sendall(sock, datagram)


async def collect(sock: socket.socket, count: int, received: list[int]) -> list[bytes]:
    loop = asyncio.get_running_loop()
    out = []
    while len(out) < count:
        out.append(await loop.sock_recv(sock, 65535))
        received[0] = len(out)
    return out


async def test_ten_thousand_mixed_messages_each_way_arrive_and_only_setpoints_change():
    rng = random.Random(20)
    down = mixed(rng, 10_000, PLANNER, setpoints=True)
    up = mixed(rng, 10_000, VEHICLE, setpoints=False)
    down_datagrams, up_datagrams = datagrams_of(rng, down), datagrams_of(rng, up)
    handler = SubstituteAll()
    async with (
        UdpEndpoint("udpin:127.0.0.1:0") as planner_side,
        UdpEndpoint("udpin:127.0.0.1:0") as autopilot_side,
    ):
        proxy = InlineProxy(planner_side, autopilot_side, handler, now_ns=lambda: 0)
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        ):
            for sock, endpoint in ((planner, planner_side), (vehicle, autopilot_side)):
                sock.setblocking(False)
                sock.connect(endpoint.local_address)
            planner.send(packed(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)))
            vehicle.send(PX4_HEARTBEAT)
            async with asyncio.timeout(60):
                while not (planner_side.peers and autopilot_side.peers):  # noqa: ASYNC110  crosses the kernel
                    await asyncio.sleep(0.001)
                # The first heartbeats may have been passed on, or came before anyone was there to hear them.
                await asyncio.sleep(0.01)
                for sock in (planner, vehicle):
                    while True:
                        try:
                            sock.recv(65535)
                        except BlockingIOError:
                            break
                down_count, up_count = [0], [0]
                _, _, at_vehicle, at_planner = await asyncio.gather(
                    pump(planner, down_datagrams, down_count),
                    pump(vehicle, up_datagrams, up_count),
                    collect(vehicle, len(down_datagrams), down_count),
                    collect(planner, len(up_datagrams), up_count),
                )
    assert at_planner == up_datagrams
    expected = expected_at_autopilot(down)
    assert b"".join(at_vehicle) == b"".join(expected)
    setpoints_in = sum(1 for data in down if (data[5] if data[0] == 0xFE else data[7]) == 84)
    counters = proxy.counters.as_dict()
    assert counters["setpoints_in"] == setpoints_in == handler.seen
    assert counters["forwarded"] + counters["held"] + counters["turned"] == setpoints_in
    for name in (
        "planner_garbage_bytes",
        "autopilot_garbage_bytes",
        "planner_send_drops",
        "autopilot_send_drops",
    ):
        assert counters[name] == 0
    assert sum(isinstance(m, Attitude) for m in handler.telemetry) == sum(
        1 for data in up if (data[5] if data[0] == 0xFE else int.from_bytes(data[7:10], "little")) == 30
    )


async def test_every_planner_side_peer_hears_the_autopilot_and_garbage_stops_nothing():
    handler = ScriptedHandler()
    rng = random.Random(4)
    async with (
        UdpEndpoint("udpin:127.0.0.1:0") as planner_side,
        UdpEndpoint("udpin:127.0.0.1:0") as autopilot_side,
    ):
        InlineProxy(planner_side, autopilot_side, handler, now_ns=lambda: 0)
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        ):
            loop = asyncio.get_running_loop()
            for sock, endpoint in (
                (planner, planner_side), (station, planner_side), (vehicle, autopilot_side),
            ):  # fmt: skip
                sock.setblocking(False)
                sock.connect(endpoint.local_address)
                for _ in range(50):
                    sock.send(
                        rng.randbytes(rng.randint(0, 200)).replace(b"\xfd", b"\0").replace(b"\xfe", b"\0")
                    )
            heartbeat = packed(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            async with asyncio.timeout(10):
                vehicle.send(PX4_HEARTBEAT)
                while not autopilot_side.peers:  # noqa: ASYNC110  crosses the kernel
                    await asyncio.sleep(0.001)
                for sock in (planner, station):
                    sock.send(heartbeat)
                    assert await loop.sock_recv(vehicle, 1000) == heartbeat
                vehicle.send(PX4_HEARTBEAT)
                for sock in (planner, station):
                    assert await loop.sock_recv(sock, 1000) == PX4_HEARTBEAT
    assert planner_side.counters.framing.garbage_bytes > 0
    assert autopilot_side.counters.framing.garbage_bytes > 0
