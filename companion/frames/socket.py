"""Raw grey frames over a TCP connection, from a simulator or another program.

Each frame is a header of 32 bytes, little-endian, and the pixels, row by row::

    magic    4 bytes  b"VCF1"
    width    u16      px
    height   u16      px
    seq      u32      number of the frame at the sender
    time_ns  u64      CLOCK_MONOTONIC of the exposure, on this machine
    reserved u64      0
    payload  u32      bytes that follow: width x height
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import threading
from collections.abc import AsyncGenerator, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from companion.clock import Clock
from companion.frames.counts import FrameCounts
from companion.frames.mailbox import NewestMailbox
from companion.frames.source import Frame
from companion.log import Log

HEADER = struct.Struct("<4sHHIQQI")
MAGIC = b"VCF1"
MAX_SIDE_PX = 8192
FUTURE_TOLERANCE_NS = 5_000_000
"""An exposure later than this after our own clock is refused: it is not our clock's time."""
OLDEST_NS = 2_000_000_000
"""An exposure further back than this is refused: nobody could use it."""

_FIRST_RETRY_S = 0.1
_LAST_RETRY_S = 2.0


class FrameStreamError(Exception):
    """What came over the connection is not a frame; the connection is closed and made again."""


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """The header of one frame on the wire."""

    width_px: int
    height_px: int
    seq: int
    time_ns: int

    def pack(self) -> bytes:
        """Return the header's 32 bytes."""
        payload = self.width_px * self.height_px
        return HEADER.pack(MAGIC, self.width_px, self.height_px, self.seq, self.time_ns, 0, payload)

    @classmethod
    def unpack(cls, data: bytes | bytearray) -> FrameHeader:
        """Read a header.

        Raises
        ------
        FrameStreamError
            When it is none, or describes a frame that cannot be.
        """
        magic, width_px, height_px, seq, time_ns, _, payload = HEADER.unpack(data)
        if magic != MAGIC:
            raise FrameStreamError(f"found {magic!r} where a frame starts with {MAGIC!r}")
        if not (1 <= width_px <= MAX_SIDE_PX and 1 <= height_px <= MAX_SIDE_PX):
            raise FrameStreamError(
                f"found a frame of {width_px} x {height_px} px; allowed: 1 to {MAX_SIDE_PX} px a side"
            )
        if payload != width_px * height_px:
            raise FrameStreamError(
                f"found a payload of {payload} bytes for {width_px} x {height_px} px of one byte each"
            )
        return cls(width_px, height_px, seq, time_ns)


class SocketSource:
    """Connects to HOST:PORT and takes frames from there; connects again, with back-off, whenever that ends.

    One thread waits and copies. It never ends by itself: a sender that is not there yet, goes away, falls
    silent for ``timeout_s`` or sends garbage is announced once and tried again.

    Parameters
    ----------
    host, port
        Where the frames come from.
    clock
        What exposure times are checked against.
    log
        Takes ``frame_stream_connected``, ``frame_stream_lost`` and ``frame_time_refused``.
    timeout_s
        Silence after which the connection is made again.

    Attributes
    ----------
    counts
        What became of the frames.
    """

    def __init__(self, host: str, port: int, *, clock: Clock, log: Log, timeout_s: float = 1.0) -> None:
        self._address = (host, port)
        self._clock = clock
        self._log = log.bind(source=f"{host}:{port}")
        self._timeout_s = timeout_s
        self.counts = FrameCounts()
        self._mailbox: NewestMailbox[Frame] | None = None
        self._receiver: _Receiver | None = None

    async def __aenter__(self) -> Self:
        """Start to connect and receive."""
        self._mailbox = NewestMailbox()
        self._receiver = _Receiver(
            self._address, self._clock, self._log, self.counts, self._mailbox, self._timeout_s
        )
        self._receiver.start()
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """Close the connection and end the thread."""
        receiver, self._receiver, self._mailbox = self._receiver, None, None
        if receiver is not None:
            await asyncio.to_thread(receiver.stop)

    async def frames(self) -> AsyncGenerator[Frame, None]:
        """Yield the newest frame each time; does not end by itself."""
        mailbox = self._mailbox
        if mailbox is None:
            raise RuntimeError("the source is not open; use it in `async with`")
        while True:
            frame = await mailbox.get()
            self.counts.delivered += 1
            yield frame


class _Receiver:
    """The receiving thread."""

    def __init__(
        self,
        address: tuple[str, int],
        clock: Clock,
        log: Log,
        counts: FrameCounts,
        mailbox: NewestMailbox[Frame],
        timeout_s: float,
    ) -> None:
        self._address = address
        self._clock = clock
        self._log = log
        self._counts = counts
        self._mailbox = mailbox
        self._timeout_s = timeout_s
        self._stopping = threading.Event()
        # A daemon: a name look-up that hangs must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="frame-receiver", daemon=True)
        self._connection: socket.socket | None = None
        self._last_time_ns = -1
        self._refusal_announced = False

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread: at once where it waits for data or to try again, else within its time-out."""
        self._stopping.set()
        connection = self._connection
        if connection is not None:
            with contextlib.suppress(OSError):  # it may have ended by itself in the meantime
                connection.shutdown(socket.SHUT_RDWR)  # wakes the thread out of recv
        self._thread.join(self._timeout_s)

    def _run(self) -> None:
        retry_s = _FIRST_RETRY_S
        announced = ""
        connected_before = False
        while not self._stopping.is_set():
            delivered = False
            try:
                with socket.create_connection(self._address, timeout=self._timeout_s) as connection:
                    self._connection = connection
                    self._counts.reconnects += connected_before
                    connected_before = True
                    for frame in self._received(connection):
                        if not delivered:
                            delivered, retry_s, announced = True, _FIRST_RETRY_S, ""
                            self._log.info(
                                "frame_stream_connected",
                                width_px=frame.image.shape[1],
                                height_px=frame.image.shape[0],
                            )
                        self._counts.skipped_late += self._mailbox.put(frame) is not None
                    reason = "closed by the sender"
            except (OSError, FrameStreamError) as error:
                reason = str(error) or type(error).__name__
                if isinstance(error, TimeoutError):
                    reason = f"nothing for {self._timeout_s} s"
            finally:
                self._connection = None
            if self._stopping.is_set():
                return
            if reason != announced:  # said once, not at every attempt
                announced = reason
                self._log.warning("frame_stream_lost", reason=reason)
            self._stopping.wait(retry_s)
            retry_s = min(2 * retry_s, _LAST_RETRY_S)

    def _received(self, connection: socket.socket) -> Iterator[Frame]:
        """Yield usable frames until the connection is closed between two of them."""
        head = bytearray(HEADER.size)
        while not self._stopping.is_set() and _fill(connection, memoryview(head)):
            header = FrameHeader.unpack(head)
            # A buffer of its own for each frame: it is handed over, not copied again.
            image = np.empty((header.height_px, header.width_px), dtype=np.uint8)
            if not _fill(connection, image.data.cast("B")):
                raise FrameStreamError("closed by the sender within a frame")
            if self._time_is_usable(header):
                yield Frame(image, header.time_ns, header.seq)

    def _time_is_usable(self, header: FrameHeader) -> bool:
        now_ns = self._clock.now_ns()
        if header.time_ns > now_ns + FUTURE_TOLERANCE_NS:
            reason = "in the future: not CLOCK_MONOTONIC of this machine"
        elif header.time_ns < now_ns - OLDEST_NS:
            reason = "too far in the past"
        elif header.time_ns <= self._last_time_ns:
            reason = "not after the frame before"
        else:
            self._last_time_ns = header.time_ns
            return True
        self._counts.time_refused += 1
        if not self._refusal_announced:
            self._refusal_announced = True
            self._log.warning(
                "frame_time_refused", reason=reason, seq=header.seq, ahead_s=(header.time_ns - now_ns) / 1e9
            )
        return False


def _fill(connection: socket.socket, buffer: memoryview) -> bool:
    """Fill the buffer; return False when the connection is closed before its first byte.

    Raises
    ------
    FrameStreamError
        When it is closed further on.
    """
    filled = 0
    while filled < len(buffer):
        received = connection.recv_into(buffer[filled:])
        if received == 0:
            if filled:
                raise FrameStreamError("closed by the sender within a frame")
            return False
        filled += received
    return True


def frame_bytes(image: NDArray[np.uint8], *, seq: int, time_ns: int) -> bytes:
    """Return one frame as it goes over the wire: what a sender has to send.

    Parameters
    ----------
    image
        (H, W) uint8, sides of 1 to 8192 px.
    seq
        Number of the frame, modulo 2^32.
    time_ns
        CLOCK_MONOTONIC of the exposure.

    Raises
    ------
    ValueError
        When the image is not such a grey image.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"expected an (H, W) uint8 image, got {image.shape} {image.dtype}")
    height_px, width_px = image.shape
    if not (1 <= width_px <= MAX_SIDE_PX and 1 <= height_px <= MAX_SIDE_PX):
        raise ValueError(f"expected sides of 1 to {MAX_SIDE_PX} px, got {width_px} x {height_px}")
    return FrameHeader(width_px, height_px, seq % (1 << 32), time_ns).pack() + image.tobytes()
