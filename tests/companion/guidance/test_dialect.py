"""How PX4 and ArduPilot read the same setpoint: against the simulated autopilots, which are written apart."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.dialect import Ambiguous, Autopilot, Motion, NotUnderstood, Reading, understand
from companion.sim import ardupilot_input, offboard_input
from companion.sim.ardupilot_input import Guided
from companion.sim.offboard_input import Refusal
from companion.sim.vehicle import Target
from tests.fakes.wire_flight import glob, local

PX4, ARDUPILOT = Autopilot.PX4, Autopilot.ARDUPILOT
POSITION, VELOCITY, POSVEL = 3576, 3527, 3520
AT_PLACE = Reading(Motion.POSITION)
MOVING = Reading(Motion.VELOCITY)


@pytest.mark.parametrize(
    ("setpoint", "px4", "ardupilot"),
    [
        (local(POSITION), AT_PLACE, AT_PLACE),
        (local(POSVEL), AT_PLACE, AT_PLACE),
        (local(VELOCITY), MOVING, MOVING),
        (local(POSITION, 7), "coordinate_frame 7", Reading(Motion.OFFSET)),
        (local(POSITION, 8), "coordinate_frame 8", Reading(Motion.OFFSET, True, True)),
        (local(POSITION, 9), "coordinate_frame 9", Reading(Motion.OFFSET, True, True)),
        (local(VELOCITY, 7), "coordinate_frame 7", MOVING),
        (local(VELOCITY, 8), Reading(Motion.VELOCITY, True), Reading(Motion.VELOCITY, True, True)),
        (local(VELOCITY, 9), "coordinate_frame 9", Reading(Motion.VELOCITY, True, True)),
        (local(POSVEL, 8), Reading(Motion.VELOCITY, True), Reading(Motion.OFFSET, True, True)),
        (local(VELOCITY, 12), "coordinate_frame 12", "coordinate_frame 12"),
        (local(VELOCITY, 20), "coordinate_frame 20", "coordinate_frame 20"),
        (local(POSITION | 4), "partial position", "partial position"),  # neither height nor climb
        (local(POSITION | 4 & ~32), "partial position", "partial position"),
        (local((POSITION | 4) & ~32), AT_PLACE, "partial position"),  # x, y and a climb rate
        (local(3555), MOVING, "partial position"),  # vx, vy and a height
        (local(VELOCITY | 8), "partial velocity", "partial velocity"),
        (local(3135), "acceleration only", "acceleration only"),
        (local(POSITION & ~448), AT_PLACE, "position with acceleration"),
        (local(POSITION & ~448 | 512), "force", "force"),
        (local(4095 & ~512), "no position", "no position"),
        (glob(POSITION, 5), AT_PLACE, AT_PLACE),
        (glob(POSITION, 6), AT_PLACE, AT_PLACE),
        (glob(POSITION, 11), AT_PLACE, AT_PLACE),
        (glob(POSITION, 3), "coordinate_frame 3", AT_PLACE),
        (glob(POSITION, 1), "coordinate_frame 1", "coordinate_frame 1"),
        (glob(POSVEL, 11), AT_PLACE, "velocity above terrain"),
        (glob(VELOCITY, 6), MOVING, MOVING),
    ],
)
def test_each_kind_by_each_autopilot(setpoint, px4, ardupilot):
    for autopilot, expected in ((PX4, px4), (ARDUPILOT, ardupilot)):
        found = understand(setpoint, autopilot)
        assert found == (NotUnderstood(expected) if isinstance(expected, str) else expected), autopilot


def test_before_the_autopilot_is_known_only_what_both_read_alike_is_understood():
    assert understand(local(POSITION), Autopilot.UNKNOWN) == AT_PLACE
    assert understand(local(VELOCITY), Autopilot.UNKNOWN) == MOVING
    assert understand(local(POSITION, 9), Autopilot.UNKNOWN) == Ambiguous()
    assert understand(local(VELOCITY, 8), Autopilot.UNKNOWN) == Ambiguous()
    assert understand(local(VELOCITY, 20), Autopilot.UNKNOWN) == NotUnderstood("coordinate_frame 20")
    assert understand(local(POSITION, 9), Autopilot.OTHER) == NotUnderstood("depends on the autopilot")
    assert understand(local(POSITION), Autopilot.OTHER) == AT_PLACE


setpoints = st.one_of(
    st.builds(
        local,
        st.integers(0, 4095),
        st.integers(0, 21),
        p=st.just((3.0, 4.0, -5.0)),
        v=st.just((0.3, 0.4, 0.5)),
        a=st.just((0.1, 0.2, 0.3)),
        yaw=st.just(0.7),
    ),
    st.builds(
        glob,
        st.integers(0, 4095),
        st.integers(0, 21),
        at=st.just((473977690, 85456470)),
        v=st.just((0.3, 0.4, 0.5)),
    ),
)
HERE, HEADING = (1.0, 2.0, -3.0), 0.5


@given(setpoints)
def test_what_is_understood_is_what_px4_does(setpoint):
    reading = understand(setpoint, PX4)
    taken = offboard_input.interpret(setpoint, HEADING, system_id=1, component_id=1)
    if taken == Refusal("force is not supported"):
        return  # FORCE_SET without a force is read and judged all the same: what is refused flies nowhere
    if isinstance(reading, Reading):
        assert isinstance(taken, Target)
        north, east, _ = taken.position_ned_m
        assert (north is not None and east is not None) == (reading.motion is Motion.POSITION)
        if reading.motion is Motion.VELOCITY:
            turn = HEADING if reading.in_body_frame else 0.0
            expected = (
                0.3 * math.cos(turn) - 0.4 * math.sin(turn),
                0.3 * math.sin(turn) + 0.4 * math.cos(turn),
            )
            assert taken.velocity_ned_m_s[:2] == pytest.approx(expected)
            assert taken.position_ned_m[:2] == (None, None)
    elif isinstance(taken, Target) and reading.reason not in ("partial position", "partial velocity"):
        assert taken.velocity_ned_m_s == (0.0, 0.0, 0.0), "it moves, and was not understood"


@given(setpoints)
def test_what_is_understood_is_what_ardupilot_does(setpoint):
    reading = understand(setpoint, ARDUPILOT)
    taken = ardupilot_input.interpret(
        setpoint, position_ned_m=HERE, heading_rad=HEADING, home_down_m=0.0, system_id=1, component_id=1
    )
    if isinstance(reading, NotUnderstood):
        assert isinstance(taken, Refusal), "it moves, and was not understood"
        return
    assert isinstance(taken, Guided)
    north = taken.target.position_ned_m[0]
    assert (north is None) == (reading.motion is Motion.VELOCITY)
    if reading.motion is Motion.OFFSET:
        turn = HEADING if reading.in_body_frame else 0.0
        assert north == pytest.approx(1.0 + 3.0 * math.cos(turn) - 4.0 * math.sin(turn))
    if not setpoint.type_mask & 1024 and setpoint.yaw:
        assert taken.target.yaw_rad == pytest.approx(0.7 + (HEADING if reading.yaw_is_relative else 0.0))


def test_what_is_refused_by_the_simulated_ones_is_a_refusal():
    for setpoint in (local(POSITION, 12), local(3135), local(4095 & ~512)):
        assert isinstance(
            ardupilot_input.interpret(
                setpoint, position_ned_m=HERE, heading_rad=0.0, home_down_m=0.0, system_id=1, component_id=1
            ),
            Refusal,
        )
