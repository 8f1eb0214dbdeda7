from __future__ import annotations

import dataclasses
import math

import pytest

from companion.guidance.setpoint import GlobalSetpoint, LocalSetpoint
from companion.sim.offboard_input import Refusal, interpret
from companion.sim.vehicle import Target

NAN = math.nan
BASE = LocalSetpoint(
    time_boot_ms=0,
    x=1.0,
    y=2.0,
    z=-3.0,
    vx=0.4,
    vy=0.5,
    vz=0.6,
    afx=0.0,
    afy=0.0,
    afz=0.0,
    yaw=0.7,
    yaw_rate=0.8,
    type_mask=3576,
    target_system=1,
    target_component=1,
    coordinate_frame=1,
)
HOLD_STILL = Target((None, None, None), (0.0, 0.0, 0.0), None, None)


def taken(heading_rad: float = 0.0, **changes: float) -> Target | Refusal:
    setpoint = dataclasses.replace(BASE, **changes)
    return interpret(setpoint, heading_rad, system_id=1, component_id=1)


@pytest.mark.parametrize(
    ("type_mask", "expected"),
    [
        (3576, Target((1.0, 2.0, -3.0))),
        (2552, Target((1.0, 2.0, -3.0), yaw_rad=0.7)),
        (1528, Target((1.0, 2.0, -3.0), yaw_rate_rad_s=0.8)),
        (504, Target((1.0, 2.0, -3.0), yaw_rad=0.7, yaw_rate_rad_s=0.8)),
        (3520, Target((1.0, 2.0, -3.0), (0.4, 0.5, 0.6))),
        (3527, Target((None, None, None), (0.4, 0.5, 0.6))),
        (3555, Target((None, None, -3.0), (0.4, 0.5, 0.0))),
    ],
)
def test_what_each_mask_asks_for(type_mask: int, expected: Target) -> None:
    assert taken(type_mask=type_mask) == expected


@pytest.mark.parametrize("frame", [7, 9, 12, 20, 0, 8])
def test_a_position_is_refused_in_every_frame_but_local_ned(frame: int) -> None:
    answer = taken(coordinate_frame=frame)
    assert isinstance(answer, Refusal)
    assert str(frame) in answer.reason


def test_a_position_beside_a_body_velocity_is_not_read() -> None:
    answer = taken(coordinate_frame=8, type_mask=3520)
    assert answer == Target((None, None, None), (0.4, 0.5, 0.6))
    assert isinstance(taken(coordinate_frame=8, type_mask=3527 | 8), Refusal)


@pytest.mark.parametrize(("frame", "alt", "down_m"), [(5, 491.0, -3.0), (6, 3.0, -2.0), (11, 3.0, -2.0)])
def test_a_global_position_is_one_in_local_ned(frame: int, alt: float, down_m: float) -> None:
    lat, lon = 473977420, 85455940
    setpoint = GlobalSetpoint(0, lat + 898, lon, alt, 9, 9, 9, 0, 0, 0, 0.7, 0, 2552, 1, 1, frame)
    answer = interpret(setpoint, 0.0, system_id=1, component_id=1, home_down_m=1.0)
    assert isinstance(answer, Target)
    assert answer.position_ned_m == pytest.approx((10.0, 0.0, down_m), abs=0.01)
    assert answer.velocity_ned_m_s == (0.0, 0.0, 0.0)


def test_a_part_of_a_global_position_is_none_and_its_velocity_counts() -> None:
    setpoint = GlobalSetpoint(0, 1, 2, 3.0, 0.4, 0.5, 0.6, 0, 0, 0, 0, 0, 3520 | 4, 1, 1, 6)
    assert interpret(setpoint, 0.9, system_id=1, component_id=1) == Target(
        (None, None, None), (0.4, 0.5, 0.6)
    )
    other = dataclasses.replace(setpoint, type_mask=3576, coordinate_frame=3)
    assert isinstance(interpret(other, 0.0, system_id=1, component_id=1), Refusal)


def test_a_body_velocity_is_turned_by_the_heading() -> None:
    answer = taken(heading_rad=math.pi / 2, coordinate_frame=8, type_mask=3527)
    assert isinstance(answer, Target)
    assert answer.velocity_ned_m_s == pytest.approx((-0.5, 0.4, 0.6))


@pytest.mark.parametrize(
    "changes", [{"x": NAN}, {"type_mask": 3576 | 3}, {"y": NAN, "x": NAN}, {"z": math.inf}]
)
def test_a_position_with_a_hole_stops_the_vehicle_and_does_not_follow_z(changes: dict[str, float]) -> None:
    assert taken(**changes) == HOLD_STILL


@pytest.mark.parametrize("changes", [{"x": NAN, "y": NAN, "z": NAN}, {"type_mask": 4095 & ~512}])
def test_a_setpoint_of_nothing_is_refused(changes: dict[str, float]) -> None:
    assert isinstance(taken(**changes), Refusal)


def test_a_nan_yaw_counts_as_not_given() -> None:
    assert taken(type_mask=2552, yaw=NAN) == Target((1.0, 2.0, -3.0))


@pytest.mark.parametrize(
    ("system", "component", "accepted"),
    [(0, 0, True), (1, 0, True), (1, 1, True), (2, 1, False), (1, 2, False), (1, 191, False)],
)
def test_which_targets_are_ours(system: int, component: int, accepted: bool) -> None:
    answer = taken(target_system=system, target_component=component)
    assert isinstance(answer, Target) is accepted


def test_forces_are_refused() -> None:
    assert isinstance(taken(type_mask=3576 | 512), Refusal)
