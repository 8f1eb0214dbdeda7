"""Cut bytes into MAVLink 1 and 2 frames without changing one of them.

Every frame keeps its exact bytes, whether its message is known or not. A frame of a known message is
*verified* by its checksum; a frame of an unknown message cannot be, because the checksum covers a byte
that only the message's definition tells (CRC_EXTRA). So two kinds of evidence are kept apart:

- A verified frame always wins: it comes out with the bytes that complete it, and nothing that merely
  looks like a frame, complete or not, can hide, delay or swallow it. Where bytes that no checksum covers (an
  unknown frame, a signature) were taken for good too early, the verified frame that began in them still
  comes out.
- A frame of an unknown message, without unknown incompatibility flags, is accepted by its place: the walk behind it lands on the end of a datagram
  or on another frame; or it stands directly behind a frame (or at the start of a datagram). In the second
  case it must name a sender that this peer's verified frames have named before; in the first such a one
  wins over one that does not.

Sixteen bits of checksum are right by chance too: in a long burst of start markers one candidate does fit now and then. So
a verified frame that stands behind garbage, and behind which nothing follows, does not win over one that begins in it.
Where it stands in its place, it does: a frame may carry another one as its payload.

A candidate of a known message with a wrong checksum is given up one byte at a time, so that a stray 0xFD or
0xFE costs itself alone.

https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from pymavlink.dialects.v20.common import mavlink_map, mcrf4xx, x25crc

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
HEADER_V1: Final = 6
HEADER_V2: Final = 10
CHECKSUM_BYTES: Final = 2
SIGNATURE_BYTES: Final = 13
INCOMPAT_SIGNED: Final = 0x01
_V1: Final = struct.Struct("<6B")
_V2: Final = struct.Struct("<7BHB")
_V1_OVERHEAD: Final = HEADER_V1 + CHECKSUM_BYTES
_V2_OVERHEAD: Final = HEADER_V2 + CHECKSUM_BYTES
MAX_FRAME_BYTES: Final = HEADER_V2 + 255 + CHECKSUM_BYTES + SIGNATURE_BYTES

CURRENT_MODE: Final = 436
EKF_STATUS_REPORT: Final = 193
_NOT_IN_DIALECT: Final = {CURRENT_MODE: 193, EKF_STATUS_REPORT: 71}
"""Messages that are read here and that pymavlink 2.4.50's dialect lacks, with their CRC_EXTRA."""

_CRC_EXTRA: Final[dict[int, bytes]] = {
    **{message_id: bytes([message.crc_extra]) for message_id, message in mavlink_map.items()},
    **{message_id: bytes([extra]) for message_id, extra in _NOT_IN_DIALECT.items()},
}
_MAGIC: Final = re.compile(rb"[\xfd\xfe]")
_START: Final = re.compile(
    rb"\xfd(?!.[^\x00\x01].{6}[^\x00])"  # unknown flags and an id above all that are known: see `_classify`
    rb"|\xfe(?!\xfe{261})",  # a frame of nothing but 0xFE has a wrong checksum
    re.DOTALL,
)
"""Start markers at which a frame can begin. Bursts of one marker (a line that floats) are passed over at the speed of this."""


class RawFrame(NamedTuple):
    """One MAVLink frame as it came.

    Attributes
    ----------
    data
        All of its bytes, from the start marker to the checksum or signature.
    message_id, system_id, component_id
        From its header.
    verified
        Its message is known and its checksum is right. False: the message is unknown.
    """

    data: bytes
    message_id: int
    system_id: int
    component_id: int
    verified: bool

    @property
    def is_v1(self) -> bool:
        """Whether this is a MAVLink 1 frame."""
        return self.data[0] == MAGIC_V1

    @property
    def incompat_flags(self) -> int:
        """Incompatibility flags; 0 in MAVLink 1."""
        return 0 if self.data[0] == MAGIC_V1 else self.data[2]

    @property
    def is_signed(self) -> bool:
        """Whether a signature follows the checksum."""
        return bool(self.incompat_flags & INCOMPAT_SIGNED)

    @property
    def payload(self) -> bytes:
        """The payload as sent: in MAVLink 2 without its trailing zeros."""
        start = HEADER_V1 if self.data[0] == MAGIC_V1 else HEADER_V2
        return self.data[start : start + self.data[1]]


def checksum(covered: bytes, message_id: int) -> int:
    """Return the checksum (CRC-16/MCRF4XX) of a frame of a known message.

    Parameters
    ----------
    covered
        The frame's bytes behind the start marker up to the end of the payload.
    message_id
        Decides CRC_EXTRA.

    Raises
    ------
    KeyError
        When the message is unknown.
    """
    return _crc(_CRC_EXTRA[message_id], _crc(covered, 0xFFFF))


def _plain_crc(data: bytes, start: int) -> int:
    accumulator = x25crc()
    accumulator.crc = start
    accumulator.accumulate(data)
    return int(accumulator.crc)


_crc: Final[Callable[[bytes, int], int]] = _plain_crc if mcrf4xx is None else mcrf4xx
"""CRC-16/MCRF4XX of bytes, going on from a start; compiled where pymavlink is: 0.2 us whatever the length."""


@dataclass(slots=True)
class FramingCounters:
    """What framing saw; shared by the framers of one endpoint.

    Attributes
    ----------
    frames
        Frames that came out.
    unverified_frames
        Those of them whose message is unknown.
    garbage_bytes
        Bytes that belonged to no good frame, those of corrupt frames included.
    crc_errors
        Candidates of known messages that fit their surroundings but for the checksum: corrupt frames.
    """

    frames: int = 0
    unverified_frames: int = 0
    garbage_bytes: int = 0
    crc_errors: int = 0


class _Kind(IntEnum):
    INCOMPLETE = 0
    VERIFIED = 1
    UNKNOWN = 2
    CORRUPT = 3
    NOTHING = 4


class _Candidate(NamedTuple):
    """What could begin at one start marker, and what stands around it."""

    kind: _Kind
    end: int
    message_id: int
    lands: bool
    """The walk behind it reaches a datagram's end or another frame's start."""
    hides_verified: bool
    """A verified frame starts inside it, where its own checksum does not cover (INCOMPLETE: anywhere)."""
    is_doubtful: bool
    """A verified frame starts inside its covered bytes, and the walk behind it reaches nothing."""
    hides_trusted: bool
    """An unknown frame that lands and names a known sender starts inside it."""
    hides_landing: bool
    """An unknown frame that lands starts inside it."""


def _classify(buffer: bytes, start: int, size: int) -> tuple[_Kind, int, int]:
    """Return kind, end and message id of the candidate at a start marker.

    An unknown message with unknown incompatibility flags is nothing: such a flag may change where the frame ends, and
    receivers discard what carries one (https://mavlink.io/en/guide/serialization.html#incompat_flags).
    """
    if buffer[start] == MAGIC_V2:
        payload = start + HEADER_V2
        if payload > size:
            return _Kind.INCOMPLETE, size, -1
        covered_end = payload + buffer[start + 1]
        end = covered_end + CHECKSUM_BYTES
        if buffer[start + 2] & INCOMPAT_SIGNED:
            end += SIGNATURE_BYTES
        message_id = buffer[start + 7] | buffer[start + 8] << 8 | buffer[start + 9] << 16
    else:
        payload = start + HEADER_V1
        if payload > size:
            return _Kind.INCOMPLETE, size, -1
        covered_end = payload + buffer[start + 1]
        end = covered_end + CHECKSUM_BYTES
        message_id = buffer[start + 5]
    if end > size:
        return _Kind.INCOMPLETE, size, message_id
    extra = _CRC_EXTRA.get(message_id)
    if extra is None:
        is_known_form = buffer[start] == MAGIC_V1 or buffer[start + 2] <= INCOMPAT_SIGNED
        return (_Kind.UNKNOWN if is_known_form else _Kind.NOTHING), end, message_id
    crc = _crc(extra, _crc(buffer[start + 1 : covered_end], 0xFFFF))
    good = crc == buffer[covered_end] | buffer[covered_end + 1] << 8
    return _Kind.VERIFIED if good else _Kind.CORRUPT, end, message_id


def _walk(buffer: bytes, position: int, frames: list[RawFrame]) -> int:
    """Append the verified frames that stand one behind the other from ``position`` on; return where they end.

    It does what `_classify` and `_frame` do, for the one case that nearly every frame is: every frame that is forwarded comes
    through here, and calls are what it costs. A signature in which a frame may begin is left to be weighed.
    """
    size = len(buffer)
    while position < size:
        magic = buffer[position]
        if magic == MAGIC_V2 and position + _V2_OVERHEAD <= size:
            _, length, flags, _, _, system_id, component_id, low, high = _V2.unpack_from(buffer, position)
            message_id = high << 16 | low
            end = position + length + _V2_OVERHEAD
        elif magic == MAGIC_V1 and position + _V1_OVERHEAD <= size:
            _, length, _, system_id, component_id, message_id = _V1.unpack_from(buffer, position)
            flags = 0
            end = position + length + _V1_OVERHEAD
        else:
            break
        extra = _CRC_EXTRA.get(message_id)
        if extra is None or end > size:
            break
        crc = _crc(extra, _crc(buffer[position + 1 : end - CHECKSUM_BYTES], 0xFFFF))
        if crc != buffer[end - 2] | buffer[end - 1] << 8:
            break
        if flags & INCOMPAT_SIGNED:
            end += SIGNATURE_BYTES
            if end > size or _MAGIC.search(buffer, end - SIGNATURE_BYTES, end):
                break
        frames.append(RawFrame(buffer[position:end], message_id, system_id, component_id, True))
        position = end
    return position


def _sender(buffer: bytes, start: int) -> tuple[int, int]:
    """Return system and component id of the frame at ``start``, whose header must be complete."""
    at = start + (5 if buffer[start] == MAGIC_V2 else 3)
    return buffer[at], buffer[at + 1]


def _frame(buffer: bytes, start: int, end: int, message_id: int, verified: bool) -> RawFrame:
    system_id, component_id = _sender(buffer, start)
    return RawFrame(buffer[start:end], message_id, system_id, component_id, verified)


class Framer:
    """Cuts what one peer sends into frames.

    It keeps at most one incomplete frame (less than 280 bytes) for the peer's next datagram.

    Parameters
    ----------
    counters
        Where to count; its own when not given.
    """

    def __init__(self, counters: FramingCounters | None = None) -> None:
        self.counters = FramingCounters() if counters is None else counters
        self._held = b""
        self._held_is_anchored = True
        self._senders: set[tuple[int, int]] = set()
        # Bytes from the first start marker on that was passed over inside uncovered bytes while the frame it
        # may begin was not complete; and how many of them were passed over so.
        self._passed = b""
        self._passed_over = 0

    @property
    def held_bytes(self) -> int:
        """Bytes of an incomplete frame that wait for the next datagram."""
        return len(self._held)

    def feed(self, datagram: bytes) -> list[RawFrame]:
        """Return the frames that these bytes complete, in their order."""
        boundary = len(self._held)
        buffer = self._held + datagram if boundary else datagram
        self._held = b""
        frames: list[RawFrame] = []
        position = self._look_back(datagram, len(buffer), frames) if self._passed else 0
        size = len(buffer)
        # The usual case, a walk over verified frames. Anything else is weighed with all that follows it.
        anchored = not boundary or self._held_is_anchored
        if anchored:
            walked = _walk(buffer, position, frames)
            if walked > position:
                position = walked
                self._passed = b""
        if position < size:
            self._weigh(buffer, position, boundary, frames, anchored or position > 0)
        self.counters.frames += len(frames)
        for _, _, system_id, component_id, verified in frames:
            if verified:
                self._senders.add((system_id, component_id))
        return frames

    def _look_back(self, datagram: bytes, size: int, frames: list[RawFrame]) -> int:
        """Append the verified frame that began in what was passed over, if the datagram completes one.

        Returns where to go on in the buffer of ``size`` bytes that ends with this datagram.
        """
        passed = self._passed + datagram
        candidates = _survey(passed, 0, 0, self._senders)
        watched_from, watched_to = 0, self._passed_over
        for start, candidate in candidates.items():
            if start >= watched_to:
                break
            if candidate.kind is _Kind.VERIFIED and not candidate.hides_verified:
                frame = _frame(passed, start, candidate.end, candidate.message_id, verified=True)
                frames.append(frame)
                watched_to = candidate.end
                watched_from = watched_to - (SIGNATURE_BYTES if frame.is_signed else 0)
                break
        self._watch(passed, candidates, watched_from, watched_to)
        return size - (len(passed) - watched_to) if frames else 0

    def _watch(
        self, buffer: bytes, candidates: dict[int, _Candidate], watched_from: int, watched_to: int
    ) -> None:
        """Remember the first start in these uncovered bytes that later bytes may still complete."""
        self._passed = b""
        for start, candidate in candidates.items():
            if start >= watched_to:
                break
            if start >= watched_from and candidate.kind is _Kind.INCOMPLETE:
                self._passed = buffer[start:]
                self._passed_over = watched_to - start
                break

    def _weigh(
        self, buffer: bytes, position: int, boundary: int, frames: list[RawFrame], anchored: bool
    ) -> None:
        """Append the frames from ``position`` on, where there is more than verified frames.

        ``anchored``: the position is where a frame begins if all is well.
        """
        size = len(buffer)
        senders = self._senders | {(f.system_id, f.component_id) for f in frames}
        candidates = _survey(buffer, position, boundary, senders)
        uncovered_from = position
        for start, candidate in candidates.items():
            if start < position:
                continue
            if start > position:
                self.counters.garbage_bytes += start - position
                anchored = False
            position = start
            anchored = anchored or start == boundary
            match candidate.kind:
                case _Kind.VERIFIED:
                    accepted = not candidate.hides_verified and (anchored or not candidate.is_doubtful)
                case _Kind.UNKNOWN:
                    trusted = _sender(buffer, start) in senders
                    accepted = (
                        not candidate.hides_verified
                        and (trusted or not candidate.hides_trusted)
                        and (candidate.lands or (anchored and trusted and not candidate.hides_landing))
                    )
                case _Kind.NOTHING:
                    accepted = False
                case _Kind.CORRUPT:
                    accepted = False
                    self.counters.crc_errors += candidate.lands and not candidate.hides_verified
                case _Kind.INCOMPLETE:
                    if not (candidate.hides_verified or candidate.hides_trusted):
                        self._held = buffer[start:]
                        self._held_is_anchored = anchored
                        break
                    accepted = False
            if accepted:
                frame = _frame(
                    buffer, start, candidate.end, candidate.message_id, candidate.kind is _Kind.VERIFIED
                )
                frames.append(frame)
                position = candidate.end
                if frame.verified:
                    senders.add((frame.system_id, frame.component_id))
                    uncovered_from = position - (SIGNATURE_BYTES if frame.is_signed else 0)
                    self._passed = b""
                else:
                    self.counters.unverified_frames += 1
            else:  # give up this one byte and look again behind it
                self.counters.garbage_bytes += 1
                position = start + 1
            anchored = accepted
        else:
            self.counters.garbage_bytes += size - position
        if self._passed:  # older bytes are watched already: go on to here
            self._passed_over = len(self._passed) - (size - position)
        else:
            self._watch(buffer, candidates, uncovered_from, position)


def _survey(
    buffer: bytes, position: int, boundary: int, senders: set[tuple[int, int]]
) -> dict[int, _Candidate]:
    """Return all candidates from ``position`` on by their start, each judged once, in ascending order.

    Going backwards, what a candidate's walk lands on is already known: the cost is linear in the bytes.
    """
    size = len(buffer)
    candidates: dict[int, _Candidate] = {}
    next_verified = next_trusted = next_landing = size
    starts = [match.start() for match in _START.finditer(buffer, position)]
    for start in reversed(starts):
        kind, end, message_id = _classify(buffer, start, size)
        behind = candidates.get(end)
        lands = kind is not _Kind.INCOMPLETE and (
            end in (size, boundary)
            or (behind is not None and (behind.lands or behind.kind in (_Kind.VERIFIED, _Kind.INCOMPLETE)))
        )
        hides_verified = next_verified < end
        if kind is _Kind.VERIFIED and hides_verified:
            # The checksum speaks for all but a signature: a frame cut short there would swallow the next one.
            is_signed = buffer[start] == MAGIC_V2 and buffer[start + 2] & INCOMPAT_SIGNED
            hides_verified = bool(is_signed) and next_verified >= end - SIGNATURE_BYTES
        is_doubtful = kind is _Kind.VERIFIED and not lands and next_verified < end
        candidates[start] = _Candidate(
            kind, end, message_id, lands, hides_verified, is_doubtful, next_trusted < end, next_landing < end
        )
        if kind is _Kind.VERIFIED and not hides_verified and not is_doubtful:
            next_verified = start
        elif kind is _Kind.UNKNOWN and lands:
            next_landing = start
            if _sender(buffer, start) in senders:
                next_trusted = start
    return dict(reversed(candidates.items()))
