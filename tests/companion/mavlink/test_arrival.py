"""The kernel's time of arrival of what was read from a UDP socket."""

import socket
import time

import pytest

from companion.mavlink.arrival import datagram_wait


def test_it_tells_how_long_a_datagram_waited():
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        waited_ns = datagram_wait(receiver)
        assert waited_ns() == 0
        while not waited_ns():  # the kernel begins to stamp a moment after it was asked to
            sender.sendto(b"any", receiver.getsockname())
            time.sleep(0.02)
            receiver.recv(100)
        sender.sendto(b"old", receiver.getsockname())
        time.sleep(0.2)
        sender.sendto(b"new", receiver.getsockname())
        assert receiver.recv(100) == b"old"
        old_ns = waited_ns()
        assert receiver.recv(100) == b"new"
        assert old_ns >= 200_000_000
        assert waited_ns() < old_ns


@pytest.mark.parametrize("jump_s", [-3600, 3600, 11])
def test_a_clock_that_was_set_is_no_wait(monkeypatch, jump_s):
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        waited_ns = datagram_wait(receiver)
        sender.sendto(b"any", receiver.getsockname())
        receiver.recv(100)
        set_ns = time.time_ns() + jump_s * 1_000_000_000
        monkeypatch.setattr(time, "time_ns", lambda: set_ns)
        assert waited_ns() == 0
