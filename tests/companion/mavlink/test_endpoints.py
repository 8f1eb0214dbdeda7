"""Endpoints over real TCP connections and pseudo-terminals: what goes through, and how they come back."""

import asyncio
import os
import pty
import socket
import tty
from collections.abc import Callable
from contextlib import contextmanager

import pytest
from pymavlink.dialects.v20 import common

from companion.errors import LinkError
from companion.mavlink.endpoints import make_endpoint, make_side
from companion.mavlink.link import UdpEndpoint
from companion.mavlink.serial_line import SerialEndpoint
from companion.mavlink.tcp import TcpEndpoint, TcpServerEndpoint

SENDER = common.MAVLink(None, 1, 1)


def numbered(seq: int) -> bytes:
    SENDER.seq = seq % 256
    return bytes(common.MAVLink_attitude_message(seq + 1, 0.1, 0, 0, 0, 0, 1.0).pack(SENDER))


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():  # noqa: ASYNC110  what is waited for has no event: it crosses the kernel
            await asyncio.sleep(0.005)


def collect(endpoint) -> list[bytes]:
    got: list[bytes] = []
    endpoint.on_frames = lambda frames: got.extend(frame.data for frame in frames)
    return got


async def test_a_tcp_client_and_a_server_carry_frames_both_ways():
    async with TcpServerEndpoint("tcpin:127.0.0.1:0") as server:
        port = server.local_address[1]
        async with (
            TcpEndpoint(f"tcp:127.0.0.1:{port}") as first,
            TcpEndpoint(f"tcp:127.0.0.1:{port}") as second,
        ):
            at_server, at_first, at_second = collect(server), collect(first), collect(second)
            await until(lambda: len(server.peer_names) == 2 and first.state == second.state == "open")
            frames = [numbered(i) for i in range(200)]
            for data in frames:
                assert first.send(data) == 1
            assert server.send(frames[0] + frames[1]) == 2
            await until(lambda: len(at_server) == 200 and len(at_first) == len(at_second) == 2)
            assert at_server == frames
            assert at_first == at_second == frames[:2]
            assert server.counters.sequence_gaps == 0
        await until(lambda: server.peer_names == ())


async def test_a_tcp_client_waits_for_its_server_and_comes_back_to_it():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    states: list[str] = []
    async with TcpEndpoint(f"tcp:127.0.0.1:{port}") as client:
        client.on_state = lambda endpoint: states.append(endpoint.state)
        got = collect(client)
        await until(lambda: client.state.startswith("waiting"))
        assert client.send(numbered(0)) == 0
        assert client.counters.unheard_datagrams == 1
        for round_number in range(3):
            async with TcpServerEndpoint(f"tcpin:127.0.0.1:{port}") as server:
                await until(lambda server=server: server.peer_names != ())
                server.send(numbered(round_number))
                await until(lambda round_number=round_number: len(got) == round_number + 1)
            await until(lambda: client.state.startswith("waiting"))
        assert client.counters.opened == 3
        assert client.status()["opened"] == 3
    assert states[-1] == "closed"


async def test_a_slow_reader_costs_whole_frames_and_never_half_of_one():
    async with TcpServerEndpoint("tcpin:127.0.0.1:0") as server:
        with socket.socket() as slow:
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            slow.connect(server.local_address)
            await until(lambda: server.peer_names != ())
            taken = [data for data in map(numbered, range(20000)) if server.send(data)]
            assert server.counters.send_drops == 20000 - len(taken) > 0
            slow.setblocking(False)
            received = bytearray()
            wanted = sum(map(len, taken))
            async with asyncio.timeout(20):
                while len(received) < wanted:
                    received += await asyncio.get_running_loop().sock_recv(slow, 65536)
            assert bytes(received) == b"".join(taken)


async def test_too_many_clients_are_refused():
    async with TcpServerEndpoint("tcpin:127.0.0.1:0") as server:
        clients = [socket.create_connection(server.local_address) for _ in range(17)]
        try:
            await until(lambda: server.counters.refused_peers == 1)
            assert len(server.peer_names) == 16
        finally:
            for client in clients:
                client.close()


@contextmanager
def terminal(link):
    """A pseudo-terminal whose far end is the autopilot; ``link`` names its device, as by-id names do."""
    far, near = pty.openpty()
    tty.setraw(near)
    tty.setraw(far)
    os.set_blocking(far, False)
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(near))
    os.close(near)
    try:
        yield far
    finally:
        link.unlink(missing_ok=True)
        os.close(far)


async def test_a_serial_line_carries_frames_and_is_found_again_under_another_number(tmp_path):
    device = tmp_path / "usb-autopilot"
    async with SerialEndpoint(f"serial:{device}:921600") as line:
        got = collect(line)
        await until(lambda: "no such device" in line.state)
        for round_number in range(3):
            with terminal(device) as far:
                await until(lambda: line.state == "open")
                os.write(far, b"\xfd\xff" + numbered(2 * round_number) + numbered(2 * round_number + 1))
                await until(lambda round_number=round_number: len(got) == 2 * round_number + 2)
                assert line.send(numbered(7)) == 1
                received = bytearray()

                def far_has_it(far=far, received=received) -> bool:
                    try:
                        received.extend(os.read(far, 4096))
                    except BlockingIOError:
                        return False
                    return bytes(received) == numbered(7)

                await until(far_has_it)
            await until(lambda: line.state.startswith("waiting"))
        assert got == [numbered(i) for i in range(6)]
        assert line.counters.opened == 3
        assert line.counters.framing.garbage_bytes == 6
    assert line.state == "closed"


async def test_a_serial_line_that_takes_nothing_drops_frames_instead_of_keeping_them(tmp_path):
    device = tmp_path / "usb-autopilot"
    with terminal(device):
        async with SerialEndpoint(f"serial:{device}:57600") as line:
            await until(lambda: line.state == "open")
            for i in range(3000):
                line.send(numbered(i))
            assert line.counters.send_drops > 0
            assert line.counters.sent_datagrams + line.counters.send_drops == 3000


async def test_sequence_gaps_are_counted_by_sender():
    async with UdpEndpoint("udpin:127.0.0.1:0") as endpoint:
        got = collect(endpoint)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.connect(endpoint.local_address)
            for seq in (250, 251, 255, 0, 0, 2):
                peer.send(numbered(seq))
            await until(lambda: len(got) == 6)
        assert endpoint.counters.sequence_gaps == 3 + 1
        assert endpoint.status()["sequence_gaps"] == 4
        assert endpoint.status()["received_frames"] == 6


async def test_a_host_that_moves_is_followed(monkeypatch):
    now_ns = 0
    address = "127.0.0.1"
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as old,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as new,
    ):
        old.bind(("127.0.0.1", 0))
        port = old.getsockname()[1]
        new.bind(("127.0.0.2", port))
        new.setblocking(False)

        async def look_up(host, *_, **__):
            assert host == "autopilot.example"
            return [(None, None, None, "", (address, port))]

        monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", look_up)
        async with UdpEndpoint(f"udpout:autopilot.example:{port}", now_ns=lambda: now_ns) as endpoint:
            endpoint.send(numbered(0))
            address = "127.0.0.2"
            now_ns = 6_000_000_000
            endpoint.send(numbered(1))
            await until(lambda: endpoint.peers == (("127.0.0.2", port),))
            endpoint.send(numbered(2))
            async with asyncio.timeout(20):
                assert await asyncio.get_running_loop().sock_recv(new, 1000) == numbered(2)
            assert endpoint.state == "open"


async def test_a_lost_route_is_opened_again(monkeypatch):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.setblocking(False)
        async with UdpEndpoint(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as endpoint:

            def no_route(*_):
                raise OSError(101, "Network is unreachable")

            with monkeypatch.context() as patched:
                patched.setattr(endpoint, "_send_connected", no_route)
                assert endpoint.send(numbered(0)) == 0
                assert endpoint.state == "waiting: Network is unreachable"
            await until(lambda: endpoint.state == "open")
            assert endpoint.send(numbered(1)) == 1
            async with asyncio.timeout(20):
                assert await asyncio.get_running_loop().sock_recv(peer, 1000) == numbered(1)
            assert endpoint.counters.opened == 2


@pytest.mark.parametrize(
    "url",
    ["", "tcp:h", "tcp:h:0", "tcpin:h:70000", "serial:x:57600", "serial:/dev/x:5", "ws:h:1", "serial:/dev/x"],
)
def test_a_url_that_cannot_be_used_is_a_clear_error(url):
    with pytest.raises(LinkError, match="link: cannot read"):
        make_endpoint(url)


def test_the_links_of_a_side_have_names():
    assert [link.name for link in make_side("planner", ["udpin:h:1"])] == ["link.planner"]
    two = make_side("planner", ["tcpin:h:1", "serial:/dev/x:57600"])
    assert [link.name for link in two] == ["link.planner.1", "link.planner.2"]
    assert [type(link) for link in two] == [TcpServerEndpoint, SerialEndpoint]
