"""The comparison that the demo's "lost 0, altered 0" rests on must be able to say otherwise."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.setpoint import Rewrite
from companion.mavlink.codec import rewrite
from companion.mavlink.framing import Framer
from companion.sim.traffic import compare


def talk(count: int, system: int = 245) -> list[bytes]:
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
    frames = []
    for i in range(count):
        if i % 3:
            message = mavlink.MAVLink_ping_message(i, i, 0, 0)
        else:
            message = mavlink.MAVLink_set_position_target_local_ned_message(
                i, 1, 1, 1, 3576, 1.0, 2.0, -1.5 - i, 0, 0, 0, 0, 0, 0, 0, 0
            )
        sender.seq = i % 256
        frames.append(bytes(message.pack(sender)))
    return frames


def test_the_same_frames_at_both_ends_are_nothing_lost_and_nothing_altered():
    frames = talk(600)
    result = compare(frames, frames, [], [])
    assert (result.setpoints_sent, result.setpoints_received) == (200, 200)
    assert (result.setpoints_lost, result.z_changed, result.other_lost, result.other_altered) == (0, 0, 0, 0)
    assert result.other_sent == 400


def test_a_rewritten_setpoint_is_neither_lost_nor_altered_and_keeps_z():
    frames = talk(3)
    raw = Framer().feed(frames[0])[0]
    changed = rewrite(raw, Rewrite(9.0, 8.0, 0.5, "substituted"))
    result = compare(frames, [changed, *frames[1:]], [], [])
    assert changed != frames[0]
    assert (result.setpoints_lost, result.z_changed, result.other_altered) == (0, 0, 0)


def test_what_is_missing_and_what_is_changed_is_counted():
    frames = talk(9)
    sender = mavlink.MAVLink(None, srcSystem=245, srcComponent=190)
    sender.seq = 1
    other_ping = bytes(mavlink.MAVLink_ping_message(77, 1, 0, 0).pack(sender))
    sender.seq = 0
    other_z = bytes(
        mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, 1, 3576, 1.0, 2.0, -9.0, 0, 0, 0, 0, 0, 0, 0, 0
        ).pack(sender)
    )
    received = [other_z, other_ping, *frames[2:3], *frames[4:]]  # frame 3, a setpoint, is missing
    result = compare(frames, received, [], [])
    assert (result.setpoints_lost, result.z_changed) == (1, 1)
    assert (result.other_lost, result.other_altered) == (0, 1)
    assert compare(frames, frames[:-1], [], []).other_lost == 1


def test_frames_of_third_parties_and_frames_not_judged_are_left_out():
    frames = talk(6)
    own = talk(2, system=1)
    result = compare(frames[:3], [*frames, *own], [], [], not_judged=frames[3:])
    assert (result.other_lost, result.other_altered) == (0, 0)


def timesync(system: int, tc1: int, ts1: int) -> bytes:
    return bytes(mavlink.MAVLink_timesync_message(tc1, ts1).pack(mavlink.MAVLink(None, system, 1)))


def test_answers_to_what_the_companion_asked_are_not_lost_and_those_to_the_planner_are():
    question, answer, for_companion = timesync(245, 0, 11), timesync(1, 900, 11), timesync(1, 901, 12)
    result = compare([question], [question], [answer, for_companion], [answer])
    assert (result.other_sent, result.other_lost, result.other_altered) == (2, 0, 0)
    assert compare([question], [question], [answer, for_companion], []).other_lost == 1
