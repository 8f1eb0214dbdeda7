"""TCP endpoints of MAVLink: ``tcp:HOST:PORT`` calls, ``tcpin:HOST:PORT`` is called."""

from __future__ import annotations

import asyncio
import errno
import socket
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Final, Self

from companion.config.endpoint_url import parse_endpoint_url
from companion.errors import LinkError
from companion.mavlink.caller import CallingEndpoint
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.stream import ByteStream

Address = tuple[str, int]

_WAITING_BYTES: Final = 32 << 10
_SEND_BUFFER_BYTES: Final = 32 << 10
"""Small: what waits in the kernel cannot be taken back, and grows old."""
_RECEIVE_BUFFER_BYTES: Final = 1 << 20
_GONE_MS: Final = 5000
"""What is sent and not acknowledged for this long ends a connection: a cable that was pulled says nothing."""
_CONNECT_S: Final = 5.0
_MAX_CLIENTS: Final = 16


class TcpEndpoint(CallingEndpoint):
    """Calls one server, for ever: one that is not there yet, or goes, is called again.

    Parameters
    ----------
    url
        ``tcp:HOST:PORT``. The name is looked up at each call, so that a server may move.
    name
        How errors call it.

    Raises
    ------
    LinkError
        When the URL cannot be read.
    """

    def __init__(self, url: str, *, name: str = "link") -> None:
        super().__init__(url, name, max_waiting_bytes=_WAITING_BYTES)
        self._host, self._port = _address_of(url, "tcp", name)
        self._socket: socket.socket | None = None

    async def _open(self) -> int:
        loop = asyncio.get_running_loop()
        opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            _prepare(opened)
            found = await loop.getaddrinfo(
                self._host, self._port, family=socket.AF_INET, type=socket.SOCK_STREAM
            )
            async with asyncio.timeout(_CONNECT_S):
                await loop.sock_connect(opened, (str(found[0][4][0]), self._port))
        except BaseException:  # cancellation too must not leave it open
            opened.close()
            raise
        self._socket = opened
        return opened.fileno()

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class TcpServerEndpoint(Endpoint):
    """Listens, and sends to every client that has connected.

    Parameters
    ----------
    url
        ``tcpin:HOST:PORT``; port 0 takes a free one (`local_address`).
    name
        How errors call it.

    Raises
    ------
    LinkError
        When the URL cannot be read.
    """

    def __init__(self, url: str, *, name: str = "link") -> None:
        super().__init__(url, name)
        self._host, self._port = _address_of(url, "tcpin", name)
        self._socket: socket.socket | None = None
        self._clients: dict[Address, tuple[socket.socket, ByteStream]] = {}

    async def __aenter__(self) -> Self:
        """Listen.

        Raises
        ------
        LinkError
            When the host is unknown or the port cannot be had; the message says what to do.
        """
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(
                self._host, self._port, family=socket.AF_INET, type=socket.SOCK_STREAM
            )
        except OSError as error:
            raise LinkError(f"{self.name}: unknown host {self._host!r} in {self.url!r}") from error
        opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind((str(found[0][4][0]), self._port))
            opened.listen()
        except OSError as error:
            opened.close()
            hint = "; another program has this port" if error.errno == errno.EADDRINUSE else ""
            raise LinkError(
                f"{self.name}: cannot listen on {self._host}:{self._port}: {error.strerror}{hint}"
            ) from error
        self._socket = opened
        loop.add_reader(opened.fileno(), self._accept)
        self._become("open")
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket.fileno())
            self._socket.close()
            self._socket = None
        for address in list(self._clients):
            self._drop(address, "closing")
        self._become("closed")

    @property
    def local_address(self) -> Address:
        """Host and port of this side."""
        if self._socket is None:
            raise LinkError(f"{self.name}: not open")
        host, port = self._socket.getsockname()
        return host, port

    @property
    def label(self) -> str:
        """The address that is listened on."""
        return self.url if self._socket is None else "{}:{}".format(*self.local_address)

    @property
    def peer_names(self) -> tuple[str, ...]:
        """Addresses of the clients."""
        return tuple(f"{host}:{port}" for host, port in self._clients)

    def send(self, datagram: bytes) -> int:
        """Send whole frames to every client and return how many took them. Never blocks, never raises."""
        if not datagram:
            return 0
        taken = sum([stream.send(datagram) for _, stream in self._clients.values()])
        self.counters.unheard_datagrams += not self._clients
        self.counters.sent_datagrams += taken
        self.counters.sent_bytes += taken * len(datagram)
        return taken

    def _accept(self) -> None:
        if self._socket is None:
            return
        try:
            opened, address = self._socket.accept()
        except OSError:  # gone before it was accepted, or no descriptor left: the next one may do
            self.counters.socket_errors += 1
            return
        if len(self._clients) >= _MAX_CLIENTS:
            self.counters.refused_peers += 1
            opened.close()
            return
        try:
            _prepare(opened)
        except OSError:
            self.counters.socket_errors += 1
            opened.close()
            return
        stream = ByteStream(
            opened.fileno(),
            self.counters,
            on_frames=self._deliver,
            on_lost=partial(self._drop, address),
            max_waiting_bytes=_WAITING_BYTES,
        )
        self._clients[address] = (opened, stream)

    def _drop(self, address: Address, _reason: str) -> None:
        client = self._clients.pop(address, None)
        if client is not None:
            opened, stream = client
            stream.close()
            opened.close()


def _address_of(url: str, kind: str, name: str) -> Address:
    try:
        parsed = parse_endpoint_url(url)
    except ValueError as error:
        raise LinkError(f"{name}: cannot read {url!r}; expected {error}") from error
    if parsed.kind != kind:
        raise LinkError(f"{name}: cannot read {url!r}; expected {kind}:HOST:PORT")
    return parsed.where, parsed.number


def _prepare(opened: socket.socket) -> None:
    opened.setblocking(False)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    with suppress(AttributeError):  # Linux; elsewhere the system's own, longer, times hold
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _GONE_MS)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
