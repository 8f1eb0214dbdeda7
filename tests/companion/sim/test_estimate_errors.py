"""Errors of the estimate: of the stated size, repeatable, and flown by the vehicle itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.sim.estimate_errors import ErringEstimate, EstimateErrors
from companion.sim.flight_controller import FlightController
from companion.sim.px4_modes import FlightMode
from companion.sim.vehicle import Vehicle

SEC = 1_000_000_000


def flown(seed: int, errors: EstimateErrors, seconds: float = 20.0) -> FlightController:
    controller = FlightController(
        0,
        vehicle=Vehicle(position_ned_m=(0.0, 0.0, -2.0)),
        mode=FlightMode.HOLD,
        armed=True,
        erring=ErringEstimate(errors, seed),
    )
    controller.advance(int(seconds * SEC))
    return controller


def test_the_vehicle_holds_its_estimate_and_so_drifts_in_truth():
    flights = [flown(seed, EstimateErrors(position_drift_m_per_sqrt_s=0.1), 60.0) for seed in range(4)]
    believed = [math.dist(f.estimate.position_ned_m, (0.0, 0.0, -2.0)) for f in flights]
    really = [math.dist(f.true_state.position_ned_m, (0.0, 0.0, -2.0)) for f in flights]
    assert np.mean(believed) < 0.4 < np.mean(really)


def test_the_same_seed_gives_the_same_flight_another_seed_another():
    errors = EstimateErrors(0.05, 0.05, 3.0)
    first, again, other = (flown(seed, errors, 3.0) for seed in (1, 1, 2))
    assert first.true_state == again.true_state
    assert first.estimate == again.estimate
    assert first.true_state != other.true_state


def test_no_errors_is_the_truth():
    controller = flown(1, EstimateErrors(), 3.0)
    assert controller.estimate == controller.true_state


def test_sizes_are_as_stated():
    errors = EstimateErrors(position_drift_m_per_sqrt_s=0.1, position_noise_m=0.0, heading_noise_deg=2.0)
    ends, headings = [], []
    for seed in range(200):
        erring = ErringEstimate(errors, seed)
        for _ in range(40):
            erring.step(0.5)
        ends.append(erring.position_error_ned_m[:2])
        headings.append(erring.heading_error_rad)
    assert np.std(ends) == pytest.approx(0.1 * math.sqrt(20.0), rel=0.1)
    assert np.degrees(np.std(headings)) == pytest.approx(2.0, rel=0.15)


def test_noise_does_not_grow():
    erring = ErringEstimate(EstimateErrors(position_noise_m=0.1), 5)
    seen = []
    for _ in range(4000):
        erring.step(0.5)
        seen.append(erring.position_error_ned_m)
    assert np.std([s[:2] for s in seen]) == pytest.approx(0.1, rel=0.1)
    assert np.std([s[2] for s in seen]) < 0.05


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_sizes_that_cannot_be_are_refused(value: float):
    with pytest.raises(ValueError, match="position_noise_m"):
        EstimateErrors(position_noise_m=value)
