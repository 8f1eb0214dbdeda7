from __future__ import annotations

import pytest

from companion.sim.commander import Commander, Result
from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode, mode_from_custom, mode_from_numbers

SECOND = 1_000_000_000
TICK = 5_000_000


def offboard(action: int = 5, loss_s: float = 1.0) -> Commander:
    commander = Commander(ParameterTable({"COM_OBL_RC_ACT": action, "COM_OF_LOSS_T": loss_s}), armed=True)
    commander.setpoint_taken(0)
    assert commander.request_mode(FlightMode.OFFBOARD, 0).result is Result.ACCEPTED
    return commander


def run(commander: Commander, start_ns: int, end_ns: int) -> int | None:
    """Return when the mode first changed."""
    mode = commander.mode
    for now_ns in range(start_ns, end_ns, TICK):
        commander.update(now_ns, on_ground=False, climbing=False)
        if commander.mode is not mode:
            return now_ns
    return None


def test_modes_have_the_numbers_of_px4() -> None:
    assert FlightMode.OFFBOARD.custom_mode == 6 << 16
    assert FlightMode.HOLD.custom_mode == 50593792
    assert FlightMode.OFFBOARD.base_mode | 128 == 145
    assert FlightMode.LAND.base_mode | 128 == 157
    assert all(mode_from_custom(mode.custom_mode) is mode for mode in FlightMode)
    assert mode_from_numbers(4, 9) is None


def test_offboard_needs_a_setpoint_younger_than_the_timeout() -> None:
    commander = Commander(ParameterTable())
    assert commander.request_mode(FlightMode.OFFBOARD, 0).result is Result.TEMPORARILY_REJECTED
    commander.setpoint_taken(0)
    assert commander.request_mode(FlightMode.OFFBOARD, SECOND).result is Result.TEMPORARILY_REJECTED
    assert commander.mode is FlightMode.HOLD
    assert commander.request_mode(FlightMode.OFFBOARD, SECOND - 1).result is Result.ACCEPTED


@pytest.mark.parametrize("loss_s", [0.5, 1.0, 2.0])
def test_silence_leaves_offboard_just_after_the_timeout(loss_s: float) -> None:
    changed_ns = run(offboard(loss_s=loss_s), 0, 4 * SECOND)
    assert changed_ns is not None
    assert loss_s < changed_ns / SECOND < loss_s + 0.15


@pytest.mark.parametrize(
    ("action", "mode"),
    [(0, FlightMode.POSCTL), (3, FlightMode.RTL), (4, FlightMode.LAND), (5, FlightMode.HOLD)],
)
def test_the_parameter_chooses_what_follows_silence(action: int, mode: FlightMode) -> None:
    commander = offboard(action)
    run(commander, 0, 2 * SECOND)
    assert commander.mode is mode


@pytest.mark.parametrize(("rate_hz", "stays"), [(0.95, False), (1.0, True), (10.0, True)])
def test_the_slowest_stream_that_keeps_offboard(rate_hz: float, stays: bool) -> None:
    commander = offboard()
    period_ns = round(SECOND / rate_hz)
    left = False
    for now_ns in range(0, 8 * SECOND, TICK):
        if now_ns % period_ns < TICK:
            commander.setpoint_taken(now_ns)
        commander.update(now_ns, on_ground=False, climbing=False)
        left |= commander.mode is not FlightMode.OFFBOARD
    assert left is not stays


def test_a_resumed_stream_leads_back_without_a_command() -> None:
    commander = offboard()
    run(commander, 0, 3 * SECOND)
    assert commander.mode is FlightMode.HOLD
    commander.setpoint_taken(3 * SECOND)
    commander.update(3 * SECOND + TICK, on_ground=False, climbing=False)
    assert commander.mode is FlightMode.OFFBOARD


def test_a_mode_chosen_by_the_pilot_sticks_while_the_stream_goes_on() -> None:
    commander = offboard()
    commander.request_mode(FlightMode.POSCTL, 0)
    for now_ns in range(0, 3 * SECOND, TICK):
        commander.setpoint_taken(now_ns)
        commander.update(now_ns, on_ground=False, climbing=False)
    assert commander.mode is FlightMode.POSCTL


def test_after_landing_it_disarms_returns_to_offboard_and_denies_arming() -> None:
    commander = offboard()
    commander.request_mode(FlightMode.LAND, SECOND)
    commander.update(SECOND, on_ground=False, climbing=False)
    for now_ns in range(2 * SECOND, 5 * SECOND, TICK):
        commander.update(now_ns, on_ground=True, climbing=False)
    assert not commander.armed
    assert commander.mode is FlightMode.OFFBOARD
    assert commander.request_arm(5 * SECOND).result is Result.TEMPORARILY_REJECTED
    commander.request_mode(FlightMode.HOLD, 5 * SECOND)
    assert commander.request_arm(5 * SECOND).result is Result.ACCEPTED


def test_a_landing_by_failsafe_does_not_lock_the_mode() -> None:
    commander = offboard(action=4)
    for now_ns in range(0, 6 * SECOND, TICK):
        commander.update(now_ns, on_ground=now_ns > 2 * SECOND, climbing=False)
    assert not commander.armed
    assert commander.mode is FlightMode.OFFBOARD


def test_armed_on_the_ground_for_ten_seconds_it_disarms() -> None:
    commander = Commander(ParameterTable())
    commander.request_arm(0)
    for now_ns in range(0, 9 * SECOND, TICK):
        commander.update(now_ns, on_ground=True, climbing=False)
    assert commander.armed
    commander.update(10 * SECOND, on_ground=True, climbing=False)
    assert not commander.armed


def test_disarming_in_the_air_needs_force() -> None:
    commander = offboard()
    assert commander.request_disarm(on_ground=False, force=False).result is Result.TEMPORARILY_REJECTED
    assert commander.armed
    assert commander.request_disarm(on_ground=False, force=True).result is Result.ACCEPTED
    assert not commander.armed
