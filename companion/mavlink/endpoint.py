"""What every endpoint of MAVLink has in common, whatever carries its bytes: counters, state, frames out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Final, Protocol, Self

from companion.errors import LinkError
from companion.mavlink.framing import FramingCounters, RawFrame

FrameReceiver = Callable[[list[RawFrame]], None]

_REOPEN_DELAYS_S: Final = (0.1, 0.2, 0.5, 1.0, 2.0)
_MOST_SENDERS: Final = 256
"""Senders whose sequence is watched: ids are the sender's choice, memory is ours."""


@dataclass(slots=True)
class LinkCounters:
    """What an endpoint has seen since the service began; reopening does not reset it.

    Attributes
    ----------
    received_datagrams, received_bytes
        Everything that arrived; of a stream, reads.
    framing
        Frames, garbage bytes and checksum errors.
    sequence_gaps
        Frames that the senders' sequence numbers say were lost before they came here. A router that sends on only
        what is addressed makes gaps too.
    sent_datagrams, sent_bytes
        Counted once for each peer.
    send_drops
        Datagrams that were not taken (buffer full, no route, too long).
    unheard_datagrams
        Datagrams to send while no peer was known or the endpoint was not open.
    filtered_frames
        Frames that a filter kept back, in either direction.
    late_setpoints
        Setpoints that had waited here too long to be passed on.
    socket_errors
        Errors that the kernel reported later (nobody listens there); the endpoint goes on.
    refused_peers
        Datagrams or connections of senders beyond the greatest number of peers.
    opened
        How often it was opened.
    """

    received_datagrams: int = 0
    received_bytes: int = 0
    framing: FramingCounters = field(default_factory=FramingCounters)
    sequence_gaps: int = 0
    sent_datagrams: int = 0
    sent_bytes: int = 0
    send_drops: int = 0
    unheard_datagrams: int = 0
    filtered_frames: int = 0
    late_setpoints: int = 0
    socket_errors: int = 0
    refused_peers: int = 0
    opened: int = 0


class Link(Protocol):
    """A way in and out, as the proxy sees it."""

    on_frames: FrameReceiver | None
    counters: LinkCounters

    def send(self, datagram: bytes) -> int:
        """Send whole frames to all peers and return how many took them. Never blocks, never raises."""
        ...


class Endpoint(ABC):
    """One endpoint; ``async with`` is its lifetime.

    Nothing a peer does ends it: it may send garbage, vanish and come back. Frames are handed to `on_frames` in the call
    that received them: order holds, and there is no queue.

    Parameters
    ----------
    url, name
        How status and errors call it.
    """

    def __init__(self, url: str, name: str) -> None:
        self.url = url
        self.name = name
        self.counters = LinkCounters()
        self.on_frames: FrameReceiver | None = None
        self.on_state: Callable[[Endpoint], None] | None = None
        """Called after each change of `state`."""
        self._state = "closed"
        self._sequences: dict[int, int] = {}

    @abstractmethod
    async def __aenter__(self) -> Self:
        """Open it; one that calls others goes on trying by itself where they are not there yet."""

    @abstractmethod
    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """Close it; what is sent afterwards is dropped."""

    @abstractmethod
    def send(self, datagram: bytes) -> int:
        """Send whole frames to all peers and return how many took them. Never blocks, never raises."""

    @property
    @abstractmethod
    def peer_names(self) -> tuple[str, ...]:
        """Those that are sent to."""

    @property
    def state(self) -> str:
        """``open``, ``closed``, or why it is not open and being tried again."""
        return self._state

    @property
    def local_address(self) -> tuple[str, int]:
        """Host and port of this side.

        Raises
        ------
        LinkError
            Where it is not open, or has none.
        """
        raise LinkError(f"{self.name}: {self.url} has no address of its own")

    @property
    def label(self) -> str:
        """What it is bound to or calls, for people."""
        return self.url

    def status(self) -> dict[str, Any]:
        """Return state and counts for the status line."""
        counters = self.counters
        return {
            "url": self.label,
            "state": self._state,
            "peers": len(self.peer_names),
            "received_bytes": counters.received_bytes,
            "received_frames": counters.framing.frames,
            "sent_bytes": counters.sent_bytes,
            "crc_errors": counters.framing.crc_errors,
            "sequence_gaps": counters.sequence_gaps,
            "drops": counters.send_drops,
            "filtered": counters.filtered_frames,
            "late_setpoints": counters.late_setpoints,
            "opened": counters.opened,
        }

    def _become(self, state: str) -> None:
        if state == self._state:
            return
        self.counters.opened += state == "open"
        self._state = state
        if self.on_state is not None:
            self.on_state(self)

    def _deliver(self, frames: list[RawFrame]) -> None:
        """Count what the senders' sequence numbers say is missing, and hand the frames on."""
        sequences = self._sequences
        for data, _, system_id, component_id, _ in frames:
            sender = system_id << 8 | component_id
            sequence = data[4] if data[0] == 0xFD else data[2]
            last = sequences.get(sender)
            if last is not None:
                # One more than before is the usual case; the same again is a copy, not 255 lost ones.
                step = (sequence - last) & 0xFF
                if step > 1:
                    self.counters.sequence_gaps += step - 1
            elif len(sequences) >= _MOST_SENDERS:
                continue
            sequences[sender] = sequence
        if self.on_frames is not None:
            self.on_frames(frames)


def reopen_delay_s(failures: int) -> float:
    """Return how long to wait before the next attempt, after so many that failed in a row."""
    return _REOPEN_DELAYS_S[min(failures, len(_REOPEN_DELAYS_S) - 1)]
