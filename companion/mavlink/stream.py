"""One byte stream (a TCP connection or a serial line): frames in, whole frames out, nothing old waits long.

What the kernel does not take at once waits here, up to a limit; beyond it whole datagrams are dropped. A stream that
is slower than what is sent on it must lose frames, not grow late: a setpoint that waits is a setpoint that lies.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

from companion.mavlink.endpoint import LinkCounters
from companion.mavlink.framing import Framer, RawFrame

_READ_BYTES = 4096
_READS_PER_TURN = 8
"""Then the other links and the other loops get their turn."""


class ByteStream:
    """One open file descriptor, non-blocking.

    Parameters
    ----------
    fd
        It stays its owner's: `close` leaves it open.
    counters
        Where to count.
    on_frames
        Takes the frames of one read.
    on_lost
        Called once with the reason when the other side is gone.
    max_waiting_bytes
        What may wait here for the kernel.
    """

    def __init__(
        self,
        fd: int,
        counters: LinkCounters,
        *,
        on_frames: Callable[[list[RawFrame]], None],
        on_lost: Callable[[str], None],
        max_waiting_bytes: int,
    ) -> None:
        self._fd = fd
        self._counters = counters
        self._framer = Framer(counters.framing)
        self._on_frames = on_frames
        self._on_lost = on_lost
        self._max_waiting_bytes = max_waiting_bytes
        self._waiting = bytearray()
        self._loop = asyncio.get_running_loop()
        self._is_open = True
        self._loop.add_reader(fd, self._read)

    def close(self) -> None:
        """Stop reading and writing. A second call does nothing."""
        if not self._is_open:
            return
        self._is_open = False
        self._loop.remove_reader(self._fd)
        if self._waiting:
            self._loop.remove_writer(self._fd)
            self._waiting.clear()

    def send(self, datagram: bytes) -> bool:
        """Send whole frames; return whether they were taken. Never blocks, never raises."""
        if not self._is_open:
            return False
        if self._waiting:
            if len(self._waiting) + len(datagram) > self._max_waiting_bytes:
                self._counters.send_drops += 1
                return False
            self._waiting += datagram
            return True
        try:
            written = os.write(self._fd, datagram)
        except (BlockingIOError, InterruptedError):
            written = 0
        except OSError as error:
            self._counters.send_drops += 1
            self._lose(error.strerror or str(error))
            return False
        if written < len(datagram):
            self._waiting += datagram[written:]
            self._loop.add_writer(self._fd, self._write)
        return True

    def _write(self) -> None:
        try:
            written = os.write(self._fd, self._waiting)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error.strerror or str(error))
            return
        del self._waiting[:written]
        if not self._waiting:
            self._loop.remove_writer(self._fd)

    def _read(self) -> None:
        for _ in range(_READS_PER_TURN):
            if not self._is_open:  # closed by what a frame brought about
                return
            try:
                data = os.read(self._fd, _READ_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._lose(error.strerror or str(error))
                return
            if not data:
                self._lose("the other side has closed")
                return
            self._counters.received_datagrams += 1
            self._counters.received_bytes += len(data)
            if frames := self._framer.feed(data):
                self._on_frames(frames)
            if len(data) < _READ_BYTES:
                return

    def _lose(self, reason: str) -> None:
        if not self._is_open:
            return
        self.close()
        # Not in the call that sent: whoever sends must not find the endpoint closing under its hands.
        self._loop.call_soon(self._on_lost, reason)
