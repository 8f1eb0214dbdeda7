"""UDP endpoints over loopback: peers come, go, send garbage; the endpoint stays."""

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import common

from companion.errors import LinkError
from companion.mavlink.link import UdpEndpoint

SENDER = common.MAVLink(None, 1, 1)
HEARTBEAT = bytes(common.MAVLink_heartbeat_message(2, 12, 81, 6 << 16, 4, 3).pack(SENDER))
ATTITUDE = bytes(common.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 0.5).pack(SENDER))


@contextlib.contextmanager
def udp_socket(connect_to=None):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(5)
        if connect_to is not None:
            opened.connect(connect_to)
        yield opened


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(5):
        while not condition():  # noqa: ASYNC110  what is waited for has no event: it crosses the kernel
            await asyncio.sleep(0.002)


async def test_it_learns_peers_from_their_frames_and_sends_to_all_of_them():
    async with UdpEndpoint("udpin:127.0.0.1:0") as endpoint:
        got = []
        endpoint.on_frames = got.append
        assert endpoint.local_address[1] > 0
        with udp_socket(endpoint.local_address) as planner, udp_socket(endpoint.local_address) as station:
            planner.send(HEARTBEAT + ATTITUDE)
            station.send(HEARTBEAT)
            await until(lambda: len(got) == 2)
            assert [f.data for f in got[0]] == [HEARTBEAT, ATTITUDE]
            assert set(endpoint.peers) == {planner.getsockname(), station.getsockname()}
            assert endpoint.send(b"hello") == 2
            assert planner.recv(100) == station.recv(100) == b"hello"
    counters = endpoint.counters
    assert (counters.received_datagrams, counters.framing.frames) == (2, 3)
    assert (counters.sent_datagrams, counters.sent_bytes) == (2, 10)


async def test_a_sender_of_garbage_is_counted_and_is_no_peer():
    async with UdpEndpoint("udpin:127.0.0.1:0") as endpoint:
        got = []
        endpoint.on_frames = got.append
        with udp_socket(endpoint.local_address) as noise, udp_socket(endpoint.local_address) as planner:
            noise.send(b"\x00garbage\xfd")
            noise.send(b"")
            planner.send(b"noise" + HEARTBEAT)
            await until(lambda: bool(got))
            assert [f.data for f in got[0]] == [HEARTBEAT]
            assert endpoint.peers == (planner.getsockname(),)
            assert endpoint.counters.framing.garbage_bytes == 8 + 5


async def test_sending_without_a_peer_or_after_the_end_does_not_raise():
    endpoint = UdpEndpoint("udpin:127.0.0.1:0")
    assert endpoint.send(b"early") == 0
    async with endpoint:
        assert endpoint.send(b"nobody") == 0
        assert endpoint.counters.unheard_datagrams == 1
    assert endpoint.send(b"late") == 0


async def test_a_datagram_that_is_too_long_is_a_counted_drop():
    async with UdpEndpoint("udpin:127.0.0.1:0") as endpoint:
        with udp_socket(endpoint.local_address) as planner:
            planner.send(HEARTBEAT)
            await until(lambda: bool(endpoint.peers))
            assert endpoint.send(bytes(70_000)) == 0
            assert endpoint.counters.send_drops == 1
            assert endpoint.send(b"still here") == 1


async def test_udpout_sends_first_and_survives_a_peer_that_is_not_there_yet():
    with udp_socket() as reserved:
        address = reserved.getsockname()
    got = []
    async with UdpEndpoint(f"udpout:{address[0]}:{address[1]}") as endpoint:
        endpoint.on_frames = got.append
        for _ in range(5):  # answered with "port unreachable"
            endpoint.send(HEARTBEAT)
            await asyncio.sleep(0.002)
        assert endpoint.counters.socket_errors > 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
            autopilot.settimeout(5)
            autopilot.bind(address)
            assert endpoint.send(ATTITUDE) == 1
            data, sender = autopilot.recvfrom(500)
            assert data == ATTITUDE
            autopilot.sendto(HEARTBEAT, sender)
            await until(lambda: bool(got))
        assert [f.data for f in got[0]] == [HEARTBEAT]


async def test_a_peer_that_vanished_costs_the_others_nothing_and_is_forgotten():
    now_ns = 0
    async with UdpEndpoint("udpin:127.0.0.1:0", peer_timeout_s=60, now_ns=lambda: now_ns) as endpoint:
        with udp_socket(endpoint.local_address) as planner:
            with udp_socket(endpoint.local_address) as gone:
                gone.send(HEARTBEAT)
                await until(lambda: len(endpoint.peers) == 1)
            now_ns = 59_000_000_000
            planner.send(HEARTBEAT)
            await until(lambda: len(endpoint.peers) == 2)
            for _ in range(3):
                endpoint.send(ATTITUDE)
                assert planner.recv(500) == ATTITUDE
            now_ns = 61_000_000_000
            assert endpoint.peers == (planner.getsockname(),)


async def test_the_number_of_peers_is_capped_and_one_without_frames_gives_way():
    async with UdpEndpoint("udpin:127.0.0.1:0", max_peers=2) as endpoint:
        with contextlib.ExitStack() as stack:
            sockets = [stack.enter_context(udp_socket(endpoint.local_address)) for _ in range(4)]
            sockets[0].send(HEARTBEAT)
            sockets[1].send(b"garbage")
            sockets[2].send(HEARTBEAT)
            await until(lambda: len(endpoint.peers) == 2)
            sockets[3].send(HEARTBEAT)
            await until(lambda: endpoint.counters.refused_peers == 1)
            assert set(endpoint.peers) == {sockets[0].getsockname(), sockets[2].getsockname()}


async def test_partial_frames_of_two_peers_do_not_mix():
    async with UdpEndpoint("udpin:127.0.0.1:0") as endpoint:
        got = []
        endpoint.on_frames = got.append
        with udp_socket(endpoint.local_address) as one, udp_socket(endpoint.local_address) as other:
            one.send(ATTITUDE[:20])
            other.send(HEARTBEAT[:9])
            one.send(ATTITUDE[20:])
            other.send(HEARTBEAT[9:])
            await until(lambda: len(got) == 2)
        assert [[f.data for f in frames] for frames in got] == [[ATTITUDE], [HEARTBEAT]]


async def test_a_port_in_use_is_a_clear_error():
    with udp_socket() as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            LinkError, match=rf"planner: cannot listen on 127\.0\.0\.1:{port}.*another program"
        ):
            async with UdpEndpoint(f"udpin:127.0.0.1:{port}", name="planner"):
                pass


async def test_an_unknown_host_is_a_clear_error():
    with pytest.raises(LinkError, match="unknown host"):
        async with UdpEndpoint("udpout:no-such-host.invalid:14550"):
            pass


async def test_an_address_of_another_machine_cannot_be_listened_on():
    with pytest.raises(LinkError, match="cannot listen on"):
        async with UdpEndpoint("udpin:192.0.2.1:14550"):
            pass


@pytest.mark.parametrize("url", ["", "tcp:1.2.3.4:5", "udpin:host", "udpin:host:99999", "udpout:127.0.0.1:0"])
def test_a_url_that_cannot_be_used_is_a_clear_error(url):
    with pytest.raises(LinkError):
        UdpEndpoint(url)


async def test_the_same_port_can_be_opened_again_at_once():
    async with UdpEndpoint("udpin:127.0.0.1:0") as first:
        port = first.local_address[1]
    async with UdpEndpoint(f"udpin:127.0.0.1:{port}") as again:
        assert again.local_address[1] == port


def setpoint(x: float) -> bytes:
    message = common.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0b110111111000, x, 0, -1, 0, 0, 0, 0, 0, 0, 0, 0
    )
    return bytes(message.pack(SENDER))


async def test_a_setpoint_that_waited_while_the_process_was_held_up_is_dropped_and_the_rest_of_it_passes():
    async with UdpEndpoint("udpin:127.0.0.1:0", late_after_s=0.1) as endpoint:
        got = []
        with udp_socket(endpoint.local_address) as planner:
            while (
                not endpoint.counters.late_setpoints
            ):  # the kernel begins to stamp a moment after it was asked to
                received = endpoint.counters.received_datagrams
                planner.send(setpoint(0.0))
                time.sleep(0.15)  # noqa: ASYNC251  as below
                await until(lambda: endpoint.counters.received_datagrams > received)  # noqa: B023  it ends in here
            endpoint.on_frames = got.append
            before = endpoint.counters.late_setpoints, endpoint.counters.received_datagrams
            planner.send(HEARTBEAT + setpoint(1.0) + ATTITUDE)
            planner.send(setpoint(2.0))
            planner.send(ATTITUDE)
            time.sleep(0.3)  # noqa: ASYNC251  the loop is held up: that is the test
            await until(lambda: endpoint.counters.received_datagrams == before[1] + 3)
    assert [[frame.data for frame in frames] for frames in got] == [[HEARTBEAT, ATTITUDE], [ATTITUDE]]
    assert endpoint.counters.late_setpoints == before[0] + 2
    assert endpoint.status()["late_setpoints"] == before[0] + 2


async def test_a_setpoint_behind_late_ones_passes_when_it_is_in_time_itself():
    async with UdpEndpoint("udpin:127.0.0.1:0", late_after_s=10.0) as endpoint:
        got = []
        endpoint.on_frames = got.append
        with udp_socket(endpoint.local_address) as planner:
            planner.send(setpoint(1.0))
            await until(lambda: bool(got))
    assert [frame.data for frame in got[0]] == [setpoint(1.0)]
    assert endpoint.counters.late_setpoints == 0


async def test_without_a_limit_nothing_is_late():
    async with UdpEndpoint("udpin:127.0.0.1:0") as endpoint:
        got = []
        endpoint.on_frames = got.append
        with udp_socket(endpoint.local_address) as planner:
            planner.send(setpoint(1.0))
            time.sleep(0.3)  # noqa: ASYNC251  the loop is held up: that is the test
            await until(lambda: bool(got))
    assert [frame.data for frame in got[0]] == [setpoint(1.0)]
