from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from companion.guidance.coordinates import r_ned_from_body, wrap_rad
from companion.sim.vehicle import Target, Vehicle, VehicleLimits, VehicleState

DT_S = 0.005


def fly(vehicle: Vehicle, target: Target | None, seconds: float) -> list[VehicleState]:
    states = []
    for _ in range(round(seconds / DT_S)):
        vehicle.step(DT_S, target)
        states.append(vehicle.state)
    return states


def hovering(limits: VehicleLimits | None = None, yaw_rad: float = 0.0) -> Vehicle:
    return Vehicle(limits, position_ned_m=(0.0, 0.0, -2.0), yaw_rad=yaw_rad)


def horizontal_speed(state: VehicleState) -> float:
    return math.hypot(*state.velocity_ned_m_s[:2])


def test_a_ten_metre_step_is_the_one_measured_on_px4() -> None:
    states = fly(hovering(), Target((10.0, 0.0, -2.0)), 10.0)
    assert max(map(horizontal_speed, states)) == pytest.approx(4.9, abs=0.1)
    assert max(s.position_ned_m[0] for s in states) - 10.0 == pytest.approx(0.5, abs=0.06)
    assert states[-1].position_ned_m == pytest.approx((10.0, 0.0, -2.0), abs=0.02)
    assert horizontal_speed(states[-1]) < 0.02


def test_a_ninety_degree_yaw_step_is_the_one_measured_on_px4() -> None:
    states = fly(hovering(), Target((0.0, 0.0, -2.0), yaw_rad=math.pi / 2), 3.0)
    peak = max(s.body_rates_rad_s[2] for s in states)
    assert math.degrees(peak) == pytest.approx(138.0, abs=4.0)
    assert abs(math.degrees(states[round(1.0 / DT_S)].yaw_rad) - 90.0) < 3.0
    assert states[-1].yaw_rad == pytest.approx(math.pi / 2, abs=0.01)


def test_the_indoor_profile_keeps_all_its_limits() -> None:
    limits = VehicleLimits.indoor()
    states = fly(hovering(limits), Target((3.0, -4.0, -4.0), yaw_rad=math.pi), 12.0)
    assert max(map(horizontal_speed, states)) <= limits.max_speed_m_s * 1.02
    assert max(math.hypot(*s.acceleration_ned_m_s2[:2]) for s in states) <= limits.max_acceleration_m_s2
    assert max(-s.velocity_ned_m_s[2] for s in states) <= limits.max_climb_m_s * 1.02
    tilts = [math.acos(r_ned_from_body(s.q_ned_from_body)[2, 2]) for s in states[::20]]
    assert max(math.degrees(t) for t in tilts) <= limits.max_tilt_deg
    turned = np.abs([wrap_rad(b.yaw_rad - a.yaw_rad) for a, b in itertools.pairwise(states)])
    assert math.degrees(turned.max()) / DT_S <= limits.max_yaw_rate_deg_s * 1.001
    assert states[-1].position_ned_m == pytest.approx((3.0, -4.0, -4.0), abs=0.03)
    assert abs(wrap_rad(states[-1].yaw_rad - math.pi)) < 0.02


@pytest.mark.parametrize("yaw_deg", [0.0, 50.0, -130.0])
def test_the_thrust_axis_points_along_acceleration_less_gravity(yaw_deg: float) -> None:
    vehicle = hovering(yaw_rad=math.radians(yaw_deg))
    state = fly(vehicle, Target((4.0, 3.0, -3.0)), 0.3)[-1]
    force = np.array(state.acceleration_ned_m_s2) - (0.0, 0.0, 9.80665)
    thrust_axis = -r_ned_from_body(state.q_ned_from_body)[:, 2]
    assert np.linalg.norm(force[:2]) > 1.0
    np.testing.assert_allclose(thrust_axis, force / np.linalg.norm(force), atol=1e-9)


def test_body_rates_are_the_derivative_of_the_attitude() -> None:
    vehicle = hovering()
    states = fly(vehicle, Target((5.0, 5.0, -2.0), yaw_rad=2.0), 0.5)
    before, after = states[-2], states[-1]
    turn = r_ned_from_body(before.q_ned_from_body).T @ r_ned_from_body(after.q_ned_from_body)
    rates = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (2 * DT_S)
    assert np.linalg.norm(rates) > 0.5
    np.testing.assert_allclose(after.body_rates_rad_s, rates, atol=0.03 * np.linalg.norm(rates))


def test_without_a_yaw_the_heading_is_held_and_a_yaw_rate_turns_it() -> None:
    vehicle = hovering(yaw_rad=0.7)
    assert fly(vehicle, Target((5.0, 0.0, -2.0)), 2.0)[-1].yaw_rad == pytest.approx(0.7)
    fly(vehicle, Target((5.0, 0.0, -2.0), yaw_rate_rad_s=0.3), 1.0)
    assert vehicle.state.body_rates_rad_s[2] == pytest.approx(0.3, abs=0.02)
    turned = vehicle.state.yaw_rad
    fly(vehicle, Target((5.0, 0.0, -2.0)), 2.0)
    assert vehicle.state.yaw_rad == pytest.approx(turned, abs=0.01)


def test_yaw_wins_over_yaw_rate_with_an_offset() -> None:
    state = fly(hovering(), Target((0.0, 0.0, -2.0), yaw_rad=0.5, yaw_rate_rad_s=0.2), 4.0)[-1]
    assert state.body_rates_rad_s[2] == pytest.approx(0.0, abs=0.01)
    assert 0.02 < state.yaw_rad - 0.5 < 0.2


def test_an_axis_without_position_follows_its_velocity() -> None:
    state = fly(hovering(), Target((None, None, -2.0), (1.0, -0.5, 0.0)), 4.0)[-1]
    assert state.velocity_ned_m_s == pytest.approx((1.0, -0.5, 0.0), abs=0.01)
    assert state.position_ned_m[2] == pytest.approx(-2.0)


def test_it_takes_off_lands_and_stays_on_the_floor() -> None:
    vehicle = Vehicle(VehicleLimits.indoor())
    assert vehicle.on_ground
    fly(vehicle, Target((2.0, 0.0, 1.0)), 1.0)
    assert vehicle.state.position_ned_m == (0.0, 0.0, 0.0)
    climbing = fly(vehicle, Target((0.0, 0.0, -1.5)), 6.0)
    assert climbing[-1].position_ned_m[2] == pytest.approx(-1.5, abs=0.02)
    assert not vehicle.on_ground
    landing = fly(vehicle, Target((0.0, 0.0, None), (0.0, 0.0, 0.5)), 5.0)
    assert vehicle.on_ground
    assert max(s.position_ned_m[2] for s in landing) == 0.0
    assert landing[-1].velocity_ned_m_s == (0.0, 0.0, 0.0)


def test_without_power_it_falls_to_the_floor() -> None:
    vehicle = hovering()
    fly(vehicle, None, 0.3)
    assert vehicle.state.velocity_ned_m_s[2] == pytest.approx(9.80665 * 0.3, rel=0.02)
    fly(vehicle, None, 1.0)
    assert vehicle.on_ground
    assert vehicle.state.velocity_ned_m_s == (0.0, 0.0, 0.0)


def test_a_late_caller_gets_the_same_flight_within_centimetres() -> None:
    smooth, coarse = hovering(), hovering()
    target = Target((5.0, 0.0, -2.0))
    fly(smooth, target, 2.0)
    coarse.step(2.0, target)
    assert coarse.state.position_ned_m == pytest.approx(smooth.state.position_ned_m, abs=0.05)


def test_limits_and_steps_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="max_speed_m_s must be finite and above 0, got 0"):
        VehicleLimits(max_speed_m_s=0.0)
    with pytest.raises(ValueError, match="below 90"):
        VehicleLimits(max_tilt_deg=90.0)
    with pytest.raises(ValueError, match="dt_s"):
        hovering().step(math.nan, None)
