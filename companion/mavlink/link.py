"""UDP endpoints of MAVLink: datagrams in, frames out, and the other way round.

``udpin:HOST:PORT`` listens and learns its peers from what arrives; ``udpout:HOST:PORT`` has one peer and sends
first. Nothing a peer does ends an endpoint: it may send garbage, vanish and come back, from the same port or
from another one.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Final, Self

from companion.config.endpoint_url import parse_endpoint_url
from companion.errors import LinkError
from companion.mavlink import codec
from companion.mavlink.arrival import DatagramWait, datagram_wait
from companion.mavlink.endpoint import Endpoint, FrameReceiver, LinkCounters, reopen_delay_s
from companion.mavlink.framing import Framer, FramingCounters, RawFrame

__all__ = ["Address", "FrameReceiver", "LinkCounters", "UdpEndpoint"]

Address = tuple[str, int]

_RECEIVE_BUFFER_BYTES: Final = 4 << 20
"""Bursts wait in the kernel while this process is busy (the kernel may grant less)."""
_SEND_BUFFER_BYTES: Final = 1 << 20
_MAX_DATAGRAM_BYTES: Final = 65535
_DATAGRAMS_PER_TURN: Final = 64
"""Then the other side and the other loops get their turn."""
_BURST_NS: Final = 100_000
"""Datagrams that follow each other faster are read until none is left; otherwise to look for another one, which is hardly
ever there, costs a tenth of what the one that came did. One that is there after all is read in the loop's next turn."""
_NEVER_NS: Final = 1 << 62
_SILENT_NS: Final = 5_000_000_000
"""A host called by its name that is silent for so long is looked up again: it may have moved."""
_SETPOINTS: Final = frozenset(
    {codec.SET_ATTITUDE_TARGET, codec.SET_POSITION_TARGET_LOCAL_NED, codec.SET_POSITION_TARGET_GLOBAL_INT}
)
_ADDRESS_LOST: Final = frozenset(
    {errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EADDRNOTAVAIL, errno.EINVAL, errno.ENODEV}
)
"""Our own address is gone, or there is no way from it: a connected socket keeps its address for good, a new one gets another."""


class _Peer:
    """One sender, and the start of a frame it may have left unfinished."""

    __slots__ = ("framer", "has_sent_frames", "heard_ns")

    def __init__(self, counters: FramingCounters, heard_ns: int) -> None:
        self.framer = Framer(counters)
        self.heard_ns = heard_ns
        self.has_sent_frames = False


class UdpEndpoint(Endpoint):
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
    late_after_s
        Setpoints that waited longer than this in the kernel, because this process was held up, are dropped and counted:
        answered now, an old wish would look new. Other frames go on however late. None: nothing is late.

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
        late_after_s: float | None = None,
    ) -> None:
        super().__init__(url, name)
        try:
            parsed = parse_endpoint_url(url)
        except ValueError as error:
            raise LinkError(f"{name}: cannot read {url!r}; expected {error}") from error
        if parsed.kind not in ("udpin", "udpout"):
            raise LinkError(f"{name}: cannot read {url!r}; expected udpin:HOST:PORT or udpout:HOST:PORT")
        self._listens = parsed.listens
        self._host, self._port = parsed.where, parsed.number
        self._peer_timeout_ns = int(peer_timeout_s * 1e9)
        self._max_peers = max_peers
        self._now_ns = now_ns
        self._late_after_ns = None if late_after_s is None else int(late_after_s * 1e9)
        self._waited_ns: DatagramWait = _no_wait
        self._socket: socket.socket | None = None
        self._peers: dict[Address, _Peer] = {}
        self._addresses: tuple[Address, ...] = ()
        self._forget_due_ns = _NEVER_NS
        self._received_into = bytearray(_MAX_DATAGRAM_BYTES)
        self._received_view = memoryview(self._received_into)
        self._read_ns = -_NEVER_NS
        self._reopening: asyncio.Task[None] | None = None
        self._looked_up_ns = now_ns()
        self._may_move = not self._listens and not _is_number(self._host)

    async def __aenter__(self) -> Self:
        """Open the socket.

        Raises
        ------
        LinkError
            When the host is unknown or the port cannot be had; the message says what to do.
        """
        try:
            address = await self._look_up()
        except OSError as error:
            raise LinkError(f"{self.name}: unknown host {self._host!r} in {self.url!r}") from error
        try:
            self._open(address)
        except OSError as error:
            verb = "listen on" if self._listens else "send to"
            hint = (
                "; another program has this port (is the companion running already?)"
                if error.errno == errno.EADDRINUSE
                else ""
            )
            raise LinkError(
                f"{self.name}: cannot {verb} {self._host}:{self._port}: {error.strerror}{hint}"
            ) from error
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """Close the socket; what is sent afterwards is dropped."""
        task, self._reopening = self._reopening, None
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        self._close()
        self._become("closed")

    async def _look_up(self) -> Address:
        found = await asyncio.get_running_loop().getaddrinfo(
            self._host, self._port, family=socket.AF_INET, type=socket.SOCK_DGRAM
        )
        return str(found[0][4][0]), self._port

    def _open(self, address: Address) -> None:
        """Open a socket in place of the one that there may be."""
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            if self._listens:
                opened.bind(address)
            else:
                opened.connect(address)
        except OSError:
            opened.close()
            raise
        self._close()
        self._socket = opened
        if self._late_after_ns is not None:
            self._waited_ns = datagram_wait(opened)
        if not self._listens:
            self._peers = {address: _Peer(self.counters.framing, self._now_ns())}
            self._peers[address].has_sent_frames = True  # sent to from the start
            self._addresses = (address,)
        asyncio.get_running_loop().add_reader(opened.fileno(), self._read)
        self._become("open")

    def _close(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket.fileno())
            self._socket.close()
            self._socket = None

    def _open_anew(self, reason: str) -> None:
        """Begin to open the socket again; until that succeeds the old one goes on being tried."""
        if self._reopening is None:
            self._become(f"waiting: {reason}")
            self._reopening = asyncio.get_running_loop().create_task(self._reopen(), name=self.name)

    async def _reopen(self) -> None:
        failures = 0
        while True:
            await asyncio.sleep(reopen_delay_s(failures))
            failures += 1
            try:
                self._open(await self._look_up())
            except OSError as error:
                self._become(f"waiting: {error.strerror or error}")
                continue
            self._reopening = None
            return

    async def _follow(self) -> None:
        """Look whether the host's name means another address now; called while it is silent."""
        try:
            address = await self._look_up()
            if address not in self._peers:
                self._open(address)
        except OSError as error:  # the name server is away as well: the old address is as good as any
            self.counters.socket_errors += 1
            self._become(f"waiting: {error.strerror or error}")
        self._reopening = None

    def _follow_when_silent(self) -> None:
        now_ns = self._now_ns()
        silent_since_ns = max(self._looked_up_ns, *(peer.heard_ns for peer in self._peers.values()))
        if now_ns - silent_since_ns > _SILENT_NS and self._reopening is None:
            self._looked_up_ns = now_ns
            self._reopening = asyncio.get_running_loop().create_task(self._follow(), name=self.name)

    @property
    def local_address(self) -> Address:
        """Host and port of this side."""
        if self._socket is None:
            raise LinkError(f"{self.name}: not open")
        host, port = self._socket.getsockname()
        return host, port

    @property
    def label(self) -> str:
        """The address that is listened on, or called."""
        return "{}:{}".format(*self.local_address) if self._socket is not None and self._listens else self.url

    @property
    def peer_names(self) -> tuple[str, ...]:
        """Addresses that are sent to."""
        return tuple(f"{host}:{port}" for host, port in self.peers)

    @property
    def peers(self) -> tuple[Address, ...]:
        """Addresses that are sent to: those that have sent a frame, or the one of ``udpout``."""
        self._forget_silent_peers()
        return self._addresses

    def send(self, datagram: bytes) -> int:
        """Send a datagram to all peers and return how many took it. Never blocks, never raises."""
        opened = self._socket
        if opened is None or not datagram:
            return 0
        taken = 0
        if self._listens:
            if self._now_ns() > self._forget_due_ns:
                self._forget_silent_peers()
        elif self._may_move:
            self._follow_when_silent()
        counters, addresses = self.counters, self._addresses
        for address in addresses:
            try:
                if self._listens:
                    opened.sendto(datagram, address)
                else:
                    self._send_connected(opened, datagram)
            except OSError as error:  # full buffer, no route, a closed port reported by an earlier datagram
                counters.send_drops += 1
                if error.errno in _ADDRESS_LOST and not self._listens:
                    self._open_anew(error.strerror or str(error))
            else:
                taken += 1
        if not addresses:
            counters.unheard_datagrams += 1
        counters.sent_datagrams += taken
        counters.sent_bytes += taken * len(datagram)
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
        counters, view = self.counters, self._received_view
        for _ in range(_DATAGRAMS_PER_TURN):
            if self._socket is None:  # closed by what a frame brought about
                return
            try:
                size, address = self._socket.recvfrom_into(self._received_into)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                counters.socket_errors += 1
                continue
            now_ns = self._now_ns()
            is_burst, self._read_ns = now_ns - self._read_ns < _BURST_NS, now_ns
            counters.received_datagrams += 1
            counters.received_bytes += size
            peer = self._peers.get(address) or self._admit(address)
            if peer is None:
                counters.refused_peers += 1
            else:
                peer.heard_ns = now_ns
                frames = peer.framer.feed(bytes(view[:size]))
                if self._late_after_ns is not None:
                    for frame in frames:
                        if frame[1] in _SETPOINTS:
                            frames = self._in_time(frames, self._late_after_ns)
                            break
                if frames:
                    if not peer.has_sent_frames:
                        peer.has_sent_frames = True
                        self._peers_changed()
                    self._deliver(frames)
            if not is_burst:
                return

    def _in_time(self, frames: list[RawFrame], late_after_ns: int) -> list[RawFrame]:
        """Return the frames of the datagram just read, without its setpoints where it waited too long."""
        if self._waited_ns() <= late_after_ns:
            return frames
        left = [frame for frame in frames if frame.message_id not in _SETPOINTS]
        self.counters.late_setpoints += len(frames) - len(left)
        return left

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
        self._peers_changed()
        return peer

    def _forget_silent_peers(self) -> None:
        if not self._listens:
            return
        oldest_ns = self._now_ns() - self._peer_timeout_ns
        for address in [a for a, peer in self._peers.items() if peer.heard_ns < oldest_ns]:
            del self._peers[address]
        self._peers_changed()

    def _peers_changed(self) -> None:
        """Note who is sent to, and when the first of them has been silent for too long unless he is heard again."""
        self._addresses = tuple(address for address, peer in self._peers.items() if peer.has_sent_frames)
        heard_ns = min((peer.heard_ns for peer in self._peers.values()), default=_NEVER_NS)
        self._forget_due_ns = heard_ns + self._peer_timeout_ns


def _no_wait() -> int:
    return 0


def _is_number(host: str) -> bool:
    try:
        socket.inet_aton(host)
    except OSError:
        return False
    return True
