"""When a datagram came to this machine, as the kernel noted it: what waited in the socket is older than it looks."""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

_SIOCGSTAMPNS: Final = 0x8907
"""Linux: time of arrival of the datagram that was read last, as a timespec in native longs (socket(7))."""
_TIMESPEC: Final = struct.Struct("@ll")

_MOST_NS: Final = 10_000_000_000
"""Nothing waits longer: the watchdog has ended a service that was held up for so long. It is the clock that was set."""

DatagramWait = Callable[[], int]
"""Tells how long the datagram that was read last had waited, in ns; 0 where the kernel does not know."""


def datagram_wait(of: socket.socket) -> DatagramWait:
    """Return how to ask a datagram socket how long what was just read had waited in it.

    The kernel is asked only then, not with each datagram. It stamps by the clock that shows the date, and nothing else here goes
    by it: a wait that is negative or longer than ten seconds says that this clock was set, and counts as none.

    Parameters
    ----------
    of
        An open UDP socket; from this call on the kernel stamps what arrives.

    Returns
    -------
    Callable
        Waiting time in ns of the datagram read last.
    """
    buffer = bytearray(_TIMESPEC.size)
    fd = of.fileno()

    def waited_ns() -> int:
        try:
            fcntl.ioctl(fd, _SIOCGSTAMPNS, buffer)
        except OSError:  # nothing was read yet, or this kernel keeps no time
            return 0
        seconds, nanoseconds = _TIMESPEC.unpack(buffer)
        arrived_ns: int = seconds * 1_000_000_000 + nanoseconds
        waited = time.time_ns() - arrived_ns
        return waited if 0 <= waited <= _MOST_NS else 0

    with suppress(OSError):
        fcntl.ioctl(fd, _SIOCGSTAMPNS, buffer)  # the first question, unanswered, turns stamping on
    return waited_ns
