"""Who decides about protection, and what must be there first."""

from __future__ import annotations

import dataclasses
import itertools

import pytest

from companion.config import EngagementConfig
from companion.guidance.engagement import Engagement, Inputs, RcSwitch, estimator_fault, missing

GOOD = Inputs(heartbeat_ok=True, pose=None, estimator_flags=831, frames=None, worker=None, camera_model=True)


def given(**changes) -> Inputs:
    return dataclasses.replace(GOOD, **changes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"heartbeat_ok": False}, "no heartbeat from the autopilot"),
        ({"pose": "pose too old"}, "pose too old"),
        ({"estimator_flags": 1}, "estimator has no velocity and position"),
        ({"frames": "frame rate below the floor"}, "frame rate below the floor"),
        ({"worker": "vision worker restarting"}, "vision worker restarting"),
        ({"camera_model": False}, "no camera model (camera.file or camera.hfov_deg)"),
    ],
)
def test_each_missing_input_is_named_and_keeps_from_engaging(changes, named):
    assert missing(GOOD) == ()
    assert missing(given(**changes)) == (named,)
    engagement = Engagement(EngagementConfig(by="command", engaged_at_start=False))
    answer = engagement.command(True, given(**changes), "parameter")
    assert (answer.engaged, answer.accepted, answer.why_not) == (False, False, (named,))
    assert engagement.off is not None
    assert engagement.command(True, GOOD, "parameter").accepted
    assert engagement.off is None


def test_all_that_is_missing_is_named():
    assert len(missing(Inputs(False, "pose too old", 0, "no frames", "dead", False))) == 6


def test_what_the_estimator_says():
    assert estimator_fault(None) is None
    assert estimator_fault(1 | 2 | 8) is None
    assert estimator_fault(1 | 2 | 16) is None
    assert estimator_fault(2 | 16) == "estimator has no attitude"


def test_what_fails_later_does_not_let_the_planner_through():
    engagement = Engagement(EngagementConfig(by="command"))
    engagement.command(True, GOOD, "parameter")
    assert engagement.command(True, given(frames="dead"), "parameter").accepted
    assert engagement.off is None


def test_letting_go_needs_nothing():
    engagement = Engagement(EngagementConfig(by="command"))
    assert engagement.command(False, Inputs(False, "x", 0, "x", "x", False), "command of 255/190").accepted
    assert engagement.off == "not engaged (command of 255/190)"


def test_always_cannot_be_let_go():
    engagement = Engagement(EngagementConfig(engaged_at_start=False))
    assert engagement.off is None
    answer = engagement.command(False, GOOD, "parameter")
    assert (answer.engaged, answer.accepted, answer.why_not) == (True, False, ("engagement.by is always",))
    assert engagement.rc_channels((1000,) * 18, GOOD) is None
    assert engagement.off is None


def turned(engagement: Engagement, pulse_us: int, inputs: Inputs = GOOD, times: int = 3):
    answers = [engagement.rc_channels((1500,) * 6 + (pulse_us, 1500), inputs) for _ in range(times)]
    return next((answer for answer in answers if answer is not None), None)


def test_the_switch_on_the_remote_control_decides():
    engagement = Engagement(EngagementConfig(by="rc"))
    assert engagement.off is None  # before it is known, it is protected
    assert turned(engagement, 1100).engaged is False
    assert engagement.off == "not engaged (RC channel 7)"
    assert turned(engagement, 1900).engaged is True
    assert engagement.off is None
    refused = engagement.command(False, GOOD, "parameter")
    assert refused.why_not == ("RC channel 7 decides (engagement.by)",)
    assert engagement.off is None


def test_a_switch_that_is_up_engages_when_what_was_missing_is_there():
    engagement = Engagement(EngagementConfig(by="rc", engaged_at_start=False))
    assert turned(engagement, 1900, given(worker="dead")).why_not == ("dead",)
    assert turned(engagement, 1900, GOOD, times=1).engaged


def test_one_glitch_moves_nothing():
    engagement = Engagement(EngagementConfig(by="rc"))
    assert turned(engagement, 1900) is None
    assert turned(engagement, 1000, times=2) is None
    assert turned(engagement, 1900, times=1) is None
    assert turned(engagement, 1000, times=2) is None
    assert engagement.off is None


@pytest.mark.parametrize("pulse_us", [0, 65535, 700, 2300])
def test_a_lost_remote_control_moves_nothing(pulse_us):
    engagement = Engagement(EngagementConfig(by="rc"))
    turned(engagement, 1900)
    assert turned(engagement, pulse_us, times=20) is None
    assert engagement.off is None
    short = Engagement(EngagementConfig(by="rc", rc_channel=16))
    assert turned(short, 1000, times=20) is None


def test_a_knob_at_the_threshold_does_not_flutter():
    switch = RcSwitch(1500)
    pulses_us = [1510, 1490] * 3 + [1600] * 3 + [1460, 1540] * 10 + [1440] * 3 + [1540, 1460] * 10
    positions = [switch.take(pulse_us) for pulse_us in pulses_us]
    changes = [b for a, b in itertools.pairwise(positions) if a != b]
    assert changes == [True, False]
