"""A UDP endpoint of MAVLink: datagrams in, frames out, and the other way round.

``udpin:HOST:PORT`` listens and learns its peers from what arrives; ``udpout:HOST:PORT`` has one peer and sends
first. Nothing a peer does ends an endpoint: it may send garbage, vanish and come back, from the same port or
from another one.
"""

from __future__ import annotations

import asyncio
import errno
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Final, Self

from companion.errors import LinkError
from companion.mavlink.framing import Framer, FramingCounters, RawFrame

Address = tuple[str, int]
FrameReceiver = Callable[[list[RawFrame]], None]

_URL: Final = re.compile(r"udp(?P<direction>in|out):(?P<host>[^:]+):(?P<port>\d{1,5})")
_RECEIVE_BUFFER_BYTES: Final = 4 << 20
"""Bursts wait in the kernel while this process is busy (the kernel may grant less)."""
_SEND_BUFFER_BYTES: Final = 1 << 20
_MAX_DATAGRAM_BYTES: Final = 65535
_DATAGRAMS_PER_TURN: Final = 64
"""Then the other side and the other loops get their turn."""


@dataclass(slots=True)
class LinkCounters:
    """What an endpoint has seen since it was opened.

    Attributes
    ----------
    received_datagrams, received_bytes
        Everything that arrived.
    framing
        Frames, garbage bytes and checksum errors.
    sent_datagrams, sent_bytes
        Counted once for each peer.
    send_drops
        Datagrams that the kernel did not take (buffer full, no route, too long).
    unheard_datagrams
        Datagrams to send while no peer was known.
    socket_errors
        Errors that the kernel reported later (nobody listens there); the endpoint goes on.
    refused_peers
        Datagrams of senders beyond the greatest number of peers.
    """

    received_datagrams: int = 0
    received_bytes: int = 0
    framing: FramingCounters = field(default_factory=FramingCounters)
    sent_datagrams: int = 0
    sent_bytes: int = 0
    send_drops: int = 0
    unheard_datagrams: int = 0
    socket_errors: int = 0
    refused_peers: int = 0


class _Peer:
    """One sender, and the start of a frame it may have left unfinished."""

    __slots__ = ("framer", "has_sent_frames", "heard_ns")

    def __init__(self, counters: FramingCounters, heard_ns: int) -> None:
        self.framer = Framer(counters)
        self.heard_ns = heard_ns
        self.has_sent_frames = False


class UdpEndpoint:
    """One UDP socket and its peers. ``async with`` is the lifetime.

    Frames are handed to `on_frames` in the call that received them, one list a datagram: order holds, and
    there is no queue.

    Parameters
    ----------
    url
        ``udpin:HOST:PORT`` or ``udpout:HOST:PORT``; port 0 of ``udpin`` takes a free one (`local_address`).
    name
        How errors call it.
    peer_timeout_s
        ``udpin``: a peer that has been silent for longer is forgotten.
    max_peers
        ``udpin``: senders beyond that are refused until one is forgotten. A sender that has sent no frame yet
        gives way to a new one.
    now_ns
        Monotonic time; used only to forget silent peers.

    Raises
    ------
    LinkError
        When the URL cannot be read.
    """

    def __init__(
        self,
        url: str,
        *,
        name: str = "link",
        peer_timeout_s: float = 60.0,
        max_peers: int = 16,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        match = _URL.fullmatch(url)
        if match is None or int(match["port"]) > 65535:
            raise LinkError(f"{name}: cannot read {url!r}; expected udpin:HOST:PORT or udpout:HOST:PORT")
        if match["direction"] == "out" and int(match["port"]) == 0:
            raise LinkError(f"{name}: {url!r} needs a port to send to")
        self.url = url
        self.name = name
        self.counters = LinkCounters()
        self.on_frames: FrameReceiver | None = None
        self._listens = match["direction"] == "in"
        self._host, self._port = match["host"], int(match["port"])
        self._peer_timeout_ns = int(peer_timeout_s * 1e9)
        self._max_peers = max_peers
        self._now_ns = now_ns
        self._socket: socket.socket | None = None
        self._peers: dict[Address, _Peer] = {}

    async def __aenter__(self) -> Self:
        """Open the socket.

        Raises
        ------
        LinkError
            When the host is unknown or the port cannot be had; the message says what to do.
        """
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(
                self._host, self._port, family=socket.AF_INET, type=socket.SOCK_DGRAM
            )
        except OSError as error:
            raise LinkError(f"{self.name}: unknown host {self._host!r} in {self.url!r}") from error
        address: Address = (str(found[0][4][0]), self._port)
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            if self._listens:
                opened.bind(address)
            else:
                opened.connect(address)
                self._peers[address] = _Peer(self.counters.framing, self._now_ns())
                self._peers[address].has_sent_frames = True  # sent to from the start
        except OSError as error:
            opened.close()
            self._peers.clear()
            verb = "listen on" if self._listens else "send to"
            hint = (
                "; another program has this port (is the companion running already?)"
                if error.errno == errno.EADDRINUSE
                else ""
            )
            raise LinkError(
                f"{self.name}: cannot {verb} {self._host}:{self._port}: {error.strerror}{hint}"
            ) from error
        self._socket = opened
        loop.add_reader(opened.fileno(), self._read)
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """Close the socket; what is sent afterwards is dropped."""
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket.fileno())
            self._socket.close()
            self._socket = None

    @property
    def local_address(self) -> Address:
        """Host and port of this side."""
        if self._socket is None:
            raise LinkError(f"{self.name}: not open")
        host, port = self._socket.getsockname()
        return host, port

    @property
    def peers(self) -> tuple[Address, ...]:
        """Addresses that are sent to: those that have sent a frame, or the one of ``udpout``."""
        self._forget_silent_peers()
        return tuple(address for address, peer in self._peers.items() if peer.has_sent_frames)

    def send(self, datagram: bytes) -> int:
        """Send a datagram to all peers and return how many took it. Never blocks, never raises."""
        if self._socket is None or not datagram:
            return 0
        taken = 0
        addresses = self.peers
        for address in addresses:
            try:
                if self._listens:
                    self._socket.sendto(datagram, address)
                else:
                    self._send_connected(self._socket, datagram)
            except OSError:  # full buffer, no route, a closed port reported by an earlier datagram
                self.counters.send_drops += 1
            else:
                taken += 1
        self.counters.unheard_datagrams += not addresses
        self.counters.sent_datagrams += taken
        self.counters.sent_bytes += taken * len(datagram)
        return taken

    def _send_connected(self, connected: socket.socket, datagram: bytes) -> None:
        try:
            connected.send(datagram)
        except ConnectionRefusedError:
            # The answer to an earlier datagram; this one has not been tried. Once more: the peer may be back.
            self.counters.socket_errors += 1
            connected.send(datagram)

    def _read(self) -> None:
        """Take what has arrived, datagram by datagram."""
        for _ in range(_DATAGRAMS_PER_TURN):
            if self._socket is None:  # closed by what a frame brought about
                return
            try:
                datagram, address = self._socket.recvfrom(_MAX_DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                self.counters.socket_errors += 1
                continue
            self._received(datagram, address)

    def _received(self, datagram: bytes, address: Address) -> None:
        counters = self.counters
        counters.received_datagrams += 1
        counters.received_bytes += len(datagram)
        peer = self._peers.get(address)
        if peer is None:
            peer = self._admit(address)
            if peer is None:
                counters.refused_peers += 1
                return
        peer.heard_ns = self._now_ns()
        frames = peer.framer.feed(datagram)
        if frames:
            peer.has_sent_frames = True
            if self.on_frames is not None:
                self.on_frames(frames)

    def _admit(self, address: Address) -> _Peer | None:
        """Return a new peer, or None where there are too many."""
        self._forget_silent_peers()
        if len(self._peers) >= self._max_peers:
            idle = [known for known, peer in self._peers.items() if not peer.has_sent_frames]
            if not idle:
                return None
            del self._peers[min(idle, key=lambda known: self._peers[known].heard_ns)]
        peer = _Peer(self.counters.framing, self._now_ns())
        self._peers[address] = peer
        return peer

    def _forget_silent_peers(self) -> None:
        if not self._listens:
            return
        oldest_ns = self._now_ns() - self._peer_timeout_ns
        for address in [a for a, peer in self._peers.items() if peer.heard_ns < oldest_ns]:
            del self._peers[address]
