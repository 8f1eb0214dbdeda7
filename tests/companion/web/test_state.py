from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from companion.config import CameraConfig
from companion.guidance.coordinates import quaternion_from_euler
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.io.messages import Kind, Message, pack_arrays
from companion.web.overlay import Projection
from companion.web.state import KEPT, LiveState

LEVEL = quaternion_from_euler(0.0, 0.0, 0.0)


def message(kind: Kind, fields: dict[str, Any], time_ns: int = 10**9, data: bytes = b"") -> Message:
    return Message(kind, time_ns, 1, fields, data)


def pose(north_m: float = 0.0, east_m: float = 0.0, time_ns: int = 10**9) -> Message:
    fields = {
        "north_m": north_m,
        "east_m": east_m,
        "down_m": -1.0,
        "q_ned_from_body": list(LEVEL),
        "speed_m_s": 0.5,
    }
    return message(Kind.POSE, fields, time_ns)


FRAME = {"seq": 1, "width_px": 640, "height_px": 480, "taken_ns": 5}


@pytest.fixture
def state() -> LiveState:
    return LiveState(Projection(CameraConfig(hfov_deg=90.0)))


def test_a_snapshot_has_all_and_an_increment_only_what_is_new(state: LiveState) -> None:
    state.take(pose())
    state.take(message(Kind.STATE, {"previous": "FOLLOW", "state": "HOLD", "reason": "no pose"}))
    first = state.increment()
    assert set(first.latest) == {"pose", "switch"}
    assert not state.increment()
    state.take(pose(0.01))
    assert set(state.increment().latest) == {"pose"}
    assert set(state.snapshot().latest) == {"pose", "switch"}
    assert state.state == "HOLD"


def test_lists_are_bounded_in_the_snapshot_and_in_an_increment_that_nobody_takes(state: LiveState) -> None:
    for number in range(3 * KEPT["log"]):
        state.take(message(Kind.LOG, {"event": f"event {number}", "level": "info", "detail": "x" * 5000}))
        state.take(pose(0.1 * number))
    for found in (state.snapshot(), state.increment()):
        assert [line["event"] for line in found.appended["log"]][-1] == f"event {3 * KEPT['log'] - 1}"
        assert len(found.appended["log"]) == KEPT["log"]
        assert len(found.appended["trail"]) <= KEPT["trail"]
        assert max(len(line["text"]) for line in found.appended["log"]) < 700


def test_the_path_gains_a_point_only_when_the_vehicle_has_moved(state: LiveState) -> None:
    for north_m in (0.0, 0.01, 0.02, 0.03, 0.2, 0.21):
        state.take(pose(north_m))
    assert state.increment().appended["trail"] == [[0.0, 0.0], [0.2, 0.0]]


def test_bearings_and_the_goal_lie_where_the_camera_sees_them(state: LiveState) -> None:
    state.take(message(Kind.FRAME, FRAME))
    state.take(pose())
    report = DetectionReport(
        frame_seq=7,
        frame_ns=2 * 10**9,
        kind="gap",
        pose=Pose(10**9, 1.0, 2.0, -1.0, LEVEL),
        bearings=(
            BearingRange(0.0, 4.0, 0.2, 9),
            BearingRange(math.radians(30.0), 2.0, 0.1, 9),
            BearingRange(math.pi, 1.0, 0.1, 3),
        ),
    )
    state.take(message(Kind.DETECTION, asdict(report)))
    setpoint = {"planner": "255/190", "action": "substituted", "goal_ned": [5.0, 5.0], "decided_ned": None}
    state.take(message(Kind.SETPOINT, setpoint))
    new = state.increment().latest
    ahead, right, behind = new["detection"]["bearings"]
    assert ahead == [0.0, 4.0, 0.2, 319.5, 239.5]
    # 90 degrees across 640 px: f = 320, so 30 degrees are 185 px off the middle.
    assert right[3] == pytest.approx(319.5 + 320 * math.tan(math.radians(30.0)), abs=0.2)
    assert behind == [180.0, 1.0, 0.1]
    assert new["detection"]["position_m"] == [1.0, 2.0]
    assert new["setpoint"]["goal_px"][0] == pytest.approx(639.5, abs=0.2)


def test_details_are_thinned_and_drawn_with_the_attitude_of_their_own_frame(state: LiveState) -> None:
    state.take(message(Kind.FRAME, FRAME))
    report = DetectionReport(
        frame_seq=7, frame_ns=2 * 10**9, kind="gap", pose=Pose(10**9, 0.0, 0.0, 0.0, LEVEL)
    )
    state.take(message(Kind.DETECTION, asdict(report)))
    azimuths = np.radians(np.arange(360) - 180.0)
    known = np.where(np.abs(azimuths) < 0.5, 3.0, -1.0)
    layout, data = pack_arrays(
        {
            "flow": np.ones((1500, 4), np.float32),
            "remembered": np.column_stack([azimuths, known, known]).astype(np.float32),
        }
    )
    for seq in (7, 8):
        fields = {"frame_seq": seq, "frame_ns": 2 * 10**9, "method": "parallax", "arrays": layout}
        state.take(message(Kind.DETAILS, fields, data=data))
        details = state.increment().latest["details"]
        assert 300 <= len(details["flow"]) <= 600
        assert all(row[1] == 3.0 for row in details["map"])
        assert all(len(row) == (5 if seq == 7 else 3) for row in details["map"])


def test_a_state_that_was_never_announced_is_taken_from_the_status(state: LiveState) -> None:
    state.take(
        message(Kind.STATUS, {"state": "HOLD", "reason": "no pose", "frames_hz": 10.0, "report": None})
    )
    assert state.state == "HOLD"
    assert state.snapshot().appended["series"][0]["frames_hz"] == 10.0
