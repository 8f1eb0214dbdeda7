"""Grey frames to anyone who connects by TCP. Newest wins: a slow reader misses frames and holds nobody up.

The format of a frame is :func:`companion.frames.socket.frame_bytes`.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from companion.errors import LinkError
from companion.frames.socket import frame_bytes

Address = tuple[str, int]


class FrameServer:
    """A TCP server of frames; ``async with`` is its lifetime.

    Parameters
    ----------
    listen
        Address; port 0 lets the system choose, see ``address``.

    Raises
    ------
    companion.errors.LinkError
        On entering, when the address cannot be had.
    """

    def __init__(self, listen: Address = ("127.0.0.1", 0)) -> None:
        self._listen = listen
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._newest = b""
        self._published = asyncio.Event()
        self.frames_published = 0

    async def __aenter__(self) -> Self:
        host, port = self._listen
        try:
            self._server = await asyncio.start_server(self._welcome, host, port)
        except OSError as error:
            raise LinkError(f"the camera cannot listen on tcp {host}:{port}: {error}") from error
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        assert self._server is not None  # noqa: S101 - entered
        self._server.close()
        clients = list(self._clients)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)
        await self._server.wait_closed()

    @property
    def address(self) -> Address:
        """The address it listens on."""
        if self._server is None:
            raise RuntimeError("the frame server has not been entered: use 'async with'")
        host, port = self._server.sockets[0].getsockname()[:2]
        return host, port

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._clients)

    def publish(self, image: NDArray[np.uint8], time_ns: int) -> None:
        """Make a frame the newest; never waits.

        Raises
        ------
        ValueError
            When the image is not a grey image.
        """
        self._newest = frame_bytes(image, seq=self.frames_published, time_ns=time_ns)
        self.frames_published += 1
        self._published.set()
        self._published = asyncio.Event()

    async def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - a coroutine that runs has one
        self._clients.add(task)
        try:
            # The first to end ends the other: frames cannot be sent any more, or the reader is gone.
            sending = asyncio.ensure_future(self._send_frames(writer))
            leaving = asyncio.ensure_future(_until_closed(reader))
            try:
                await asyncio.wait({sending, leaving}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                sending.cancel()
                leaving.cancel()
                await asyncio.gather(sending, leaving, return_exceptions=True)
        except asyncio.CancelledError:
            # Only __aexit__ cancels this task, and waits for it: ending here is what it asked for.
            pass
        finally:
            self._clients.discard(task)
            writer.transport.abort()

    async def _send_frames(self, writer: asyncio.StreamWriter) -> None:
        sock = writer.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        writer.transport.set_write_buffer_limits(high=0)
        sent = self.frames_published
        buffer_bytes = 0
        while True:
            while self.frames_published == sent:
                await self._published.wait()
            sent = self.frames_published
            if len(self._newest) > buffer_bytes:
                # Room for one frame. More, and a slow reader would get what has waited in the kernel; less, and the rest of each
                # frame would wait for the reader's acknowledgement, which the kernel delays by 40 ms.
                buffer_bytes = len(self._newest)
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffer_bytes)
            writer.write(self._newest)
            await writer.drain()


async def _until_closed(reader: asyncio.StreamReader) -> None:
    """Return when the other side closes; what it sends meanwhile is not for us."""
    with contextlib.suppress(ConnectionError):
        while await reader.read(4096):
            pass
