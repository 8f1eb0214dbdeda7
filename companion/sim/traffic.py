"""What became of every frame between a planner and a fake autopilot: nothing lost, nothing altered, z kept."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from companion.mavlink.component import TIMESYNC, TIMESYNC_FIELDS
from companion.mavlink.framing import Framer, FramingCounters, RawFrame

_SETPOINT = 84
_Z = slice(12, 16)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Setpoints and other frames at both ends.

    Attributes
    ----------
    setpoints_sent, setpoints_received
        SET_POSITION_TARGET_LOCAL_NED that left the planner and that reached the autopilot.
    setpoints_lost
        Sent, not received (those that the companion dropped on purpose included).
    z_changed
        Received with other bytes of z than were sent.
    other_sent
        All other frames that left either end.
    other_lost, other_altered
        Of those, the ones that did not arrive at all, and the ones that arrived with other bytes.
    """

    setpoints_sent: int
    setpoints_received: int
    setpoints_lost: int
    z_changed: int
    other_sent: int
    other_lost: int
    other_altered: int


def compare(
    planner_sent: Iterable[bytes],
    autopilot_received: Iterable[bytes],
    autopilot_sent: Iterable[bytes],
    planner_received: Iterable[bytes],
    *,
    not_judged: Iterable[bytes] = (),
) -> Comparison:
    """Compare what left each end with what reached the other; frames as bytes, in order.

    Frames of other senders (the companion's own HEARTBEAT and STATUSTEXT) are left out of what was received, and
    answers to a TIMESYNC that the other end never asked out of what was sent: they are for the companion.

    Parameters
    ----------
    planner_sent, autopilot_sent
        From when both ends were joined, up to a moment that lies long enough back for all of it to have arrived.
    autopilot_received, planner_received
        Up to now.
    not_judged
        What left either end before or after: it may have arrived, and nothing is lost where it has not.
    """
    unjudged = Counter(frame.data for frame in _frames(not_judged))
    up_sent, up_received = _frames(planner_sent), _frames(autopilot_received)
    sent = [frame for frame in up_sent if frame.message_id == _SETPOINT]
    received = [frame for frame in up_received if frame.message_id == _SETPOINT]
    lost, z_changed = _match_setpoints(sent, received)
    down_sent = _frames(autopilot_sent)
    up = _match_others(_for_the_other_end(up_sent, down_sent), up_received, unjudged)
    down = _match_others(_for_the_other_end(down_sent, up_sent), _frames(planner_received), unjudged)
    return Comparison(
        setpoints_sent=len(sent),
        setpoints_received=len(received),
        setpoints_lost=lost,
        z_changed=z_changed,
        other_sent=up[0] + down[0],
        other_lost=up[1] + down[1],
        other_altered=up[2] + down[2],
    )


def _frames(chunks: Iterable[bytes]) -> list[RawFrame]:
    framer = Framer(FramingCounters())
    return [frame for chunk in chunks for frame in framer.feed(chunk)]


def _seq(frame: RawFrame) -> int:
    return frame.data[2] if frame.is_v1 else frame.data[4]


def _z(frame: RawFrame) -> bytes:
    return frame.payload.ljust(53, b"\0")[_Z]


def _for_the_other_end(sent: Sequence[RawFrame], other_sent: Sequence[RawFrame]) -> list[RawFrame]:
    asked = {ts1 for frame in other_sent if (times := _timesync(frame)) for tc1, ts1 in [times] if tc1 == 0}
    return [frame for frame in sent if not (times := _timesync(frame)) or times[0] == 0 or times[1] in asked]


def _timesync(frame: RawFrame) -> tuple[int, int] | None:
    """Return tc1 and ts1 of a TIMESYNC; tc1 is 0 in a question, ts1 is the asker's time in both."""
    if frame.message_id != TIMESYNC:
        return None
    tc1, ts1 = TIMESYNC_FIELDS.unpack(
        frame.payload.ljust(TIMESYNC_FIELDS.size, b"\0")[: TIMESYNC_FIELDS.size]
    )
    return tc1, ts1


def _match_setpoints(sent: Sequence[RawFrame], received: Sequence[RawFrame]) -> tuple[int, int]:
    """Walk both in order; a sequence number that does not come next was lost."""
    lost = z_changed = 0
    position = 0
    for frame in sent:
        if position < len(received) and _seq(received[position]) == _seq(frame):
            z_changed += _z(received[position]) != _z(frame)
            position += 1
        else:
            lost += 1
    # Received but never sent: none of them is the planner's.
    return lost, z_changed + len(received) - position


def _match_others(
    sent: Sequence[RawFrame], received: Sequence[RawFrame], unjudged: Counter[bytes]
) -> tuple[int, int, int]:
    """Return how many were sent, how many of them are missing, and how many arrived that nobody sent like that."""
    senders = {(frame.system_id, frame.component_id) for frame in sent}
    out = Counter(frame.data for frame in sent if frame.message_id != _SETPOINT)
    back = Counter(
        frame.data
        for frame in received
        if frame.message_id != _SETPOINT and (frame.system_id, frame.component_id) in senders
    )
    missing = sum((out - back).values())
    strange = sum((back - out - unjudged).values())
    return sum(out.values()), max(0, missing - strange), strange
