"""Flights without the service: how they end, what is recorded, and that simulated time repeats them to the bit."""

from __future__ import annotations

import dataclasses
import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from companion.errors import CompanionError
from companion.sim.estimate_errors import EstimateErrors
from companion.sim.flight import FlightError, FlightResult, FlightSpec, fly, free_ratios, judged, run_flight
from companion.sim.flight_record import FlightRecord
from companion.sim.flight_referee import Referee, Rules
from companion.sim.scene import empty_room, room_with_wall
from tests.fakes.ray_cast_place import RADIUS_M, ray_cast_place

ROOM = ray_cast_place("room", partial(empty_room, 14.0, 9.0, 3.0, behind_m=3.0), 6.0)
WALLED = ray_cast_place("walled", partial(room_with_wall, 12.0, 8.0, wall_north_m=4.5, gap_m=0.0), 8.0)
OFF = FlightSpec(method="off")
NOISY = EstimateErrors(position_drift_m_per_sqrt_s=0.05, position_noise_m=0.05, heading_noise_deg=2.0)


# ---- the referee


def rules() -> Rules:
    return Rules(time_limit_s=100.0, arrive_radius_m=0.5, stuck_s=10.0, stuck_radius_m=0.5)


def outcome_of(track: list[tuple[float, float]], clearance_m: float = 1.0) -> tuple[str | None, float]:
    """What the referee says of a flight along north that begins at 0 and whose goal is at 20 m."""
    referee = Referee((20.0, 0.0, -1.0), rules())
    for time_s, north_m in track:
        outcome = referee.judge(time_s, (north_m, 0.0, -1.0), clearance_m)
        if outcome is not None:
            return outcome, time_s
    return None, math.inf


def test_near_the_goal_is_reached():
    assert outcome_of([(t, 1.0 * t) for t in range(30)]) == ("reached", 20)


def test_a_touch_comes_before_everything():
    assert outcome_of([(0.0, 20.0)], clearance_m=0.0) == ("collided", 0.0)


def test_a_vehicle_that_stays_within_the_radius_is_stuck_after_the_time():
    track = [(t / 2, 0.4 * (t % 2)) for t in range(100)]
    assert outcome_of(track) == ("stuck", 10.0)


def test_slow_progress_is_not_stuck_and_time_runs_out():
    assert outcome_of([(float(t), 0.06 * t) for t in range(200)]) == ("timeout", 100.0)


def test_there_and_back_is_not_stuck():
    assert outcome_of([(float(t), 2.0 * math.sin(t / 4)) for t in range(90)])[0] is None


# ---- flights


def test_a_straight_way_is_flown_and_its_figures_fit_together():
    flown = fly(OFF, ROOM)
    result = judged(OFF, ROOM, flown)
    assert (result.outcome, result.collisions, result.decisions, result.states) == ("reached", 0, 0, {})
    assert result.goal_distance_m <= 0.5
    assert 5.0 < result.path_m < 6.2
    assert result.max_setpoint_gap_s == pytest.approx(0.05, abs=0.001)
    record = flown.record
    assert np.abs(record.position_ned_m[:, 2] - -1.2).max() < 0.3, "it flies at the height of the flight"
    assert np.diff(record.time_s) == pytest.approx(0.05)
    assert (record.planned_ned_m == (6.0, 0.0, -1.2)).all()
    assert record.sent_ned_m[-1] == pytest.approx((6.0, 0.0, -1.2))
    assert np.degrees(np.abs(record.heading_rad)).max() < 1.0


def test_without_the_service_it_flies_into_the_wall_and_the_flight_ends_there():
    flown = fly(OFF, WALLED)
    result = judged(OFF, WALLED, flown)
    assert (result.outcome, result.collisions) == ("collided", 1)
    assert result.min_clearance_m <= 0.0
    assert flown.record.position_ned_m[-1, 0] == pytest.approx(4.5 - RADIUS_M, abs=0.1)


def test_a_flight_that_takes_too_long_is_a_timeout():
    short = dataclasses.replace(OFF, time_limit_s=2.0)
    result = run_flight(short, ROOM)
    assert (result.outcome, result.time_s) == ("timeout", 2.0)


def test_the_same_specification_gives_the_same_flight_and_another_seed_another():
    noisy = dataclasses.replace(OFF, estimate=NOISY, seed=4)
    first, again = fly(noisy, ROOM), fly(noisy, ROOM)
    other = fly(dataclasses.replace(noisy, seed=5), ROOM)
    assert first.record.equals(again.record)
    assert not first.record.equals(other.record)
    assert len(first.record.setpoint_bytes) > 1000
    assert not np.array_equal(first.record.position_ned_m[:50], other.record.position_ned_m[:50])


def test_a_drifting_estimate_takes_the_vehicle_off_its_way():
    drifting = dataclasses.replace(OFF, estimate=EstimateErrors(position_drift_m_per_sqrt_s=0.3), seed=2)
    off_way_m = np.abs(fly(drifting, ROOM).record.position_ned_m[:, 1]).max()
    assert off_way_m > 0.2 > np.abs(fly(OFF, ROOM).record.position_ned_m[:, 1]).max()


# ---- record and figures


def test_a_record_comes_back_from_its_file_to_the_bit(tmp_path: Path):
    path = tmp_path / "flight.npz"
    result = run_flight(OFF, ROOM, record=path)
    record = FlightRecord.load(path)
    assert record.equals(fly(OFF, ROOM).record)
    assert FlightSpec.from_dict(record.about["spec"]) == OFF
    assert FlightResult(**record.about["result"]) == result
    assert json.loads(json.dumps(result.as_dict()))["outcome"] == "reached"


def test_what_is_no_record_is_one_clear_error(tmp_path: Path):
    for content in (b"", b"nonsense", b"PK\x03\x04 broken"):
        (tmp_path / "x.npz").write_bytes(content)
        with pytest.raises(CompanionError, match="not a flight record"):
            FlightRecord.load(tmp_path / "x.npz")
    with pytest.raises(CompanionError, match="cannot be written"):
        fly(OFF, ROOM).record.save(tmp_path / "absent" / "x.npz")


def test_free_ratio_is_one_along_the_free_way_and_small_toward_a_wall():
    """A camera at the start of the walled room; the free way is wherever the truth says it is longest."""
    spec = FlightSpec(width_px=320, hfov_deg=75.0)
    flown = fly(OFF, WALLED)
    answers = {
        "answer_time_s": np.array([0.1, 0.2]),
        "answer_frame_time_s": np.array([0.0, 0.0]),
        "answer_kind": np.array(["lowest_flow", "vanishing_point"]),
        "answer_reason": np.array(["", ""]),
        "answer_distance_m": np.full(2, np.nan),
    }
    offsets = np.radians(np.arange(-36, 37, 3))
    free_m = WALLED.free_distances_m(WALLED.start_ned_m, offsets)
    focal_px = 160.0 / math.tan(math.radians(37.5))
    best_px = 159.5 + focal_px * math.tan(offsets[int(np.argmax(free_m))])
    worst_px = 159.5 + focal_px * math.tan(offsets[int(np.argmin(free_m))])
    record = dataclasses.replace(
        flown.record, **answers, answer_px=np.array([[best_px, 100.0], [worst_px, 100.0]])
    )
    ratios = free_ratios(spec, WALLED, record)
    assert ratios[0] == pytest.approx(1.0)
    assert ratios[1] == pytest.approx(min(free_m) / max(free_m), abs=0.02)


def test_time_in_states_is_from_change_to_change():
    record = fly(OFF, ROOM).record
    changed = dataclasses.replace(
        record,
        time_s=np.linspace(0.0, 10.0, len(record.time_s)),
        state_time_s=np.array([0.0, 2.0, 3.0]),
        state=np.array(["FOLLOW", "TURN", "FOLLOW"]),
        state_reason=np.array(["", "", ""]),
    )
    assert changed.seconds_in_states() == {"FOLLOW": 9.0, "TURN": 1.0}
    assert [changed.state_at(t) for t in (1.0, 2.5, 9.0)] == ["FOLLOW", "TURN", "FOLLOW"]
    assert record.state_at(1.0) == ""


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"method": "magic"}, "method"),
        ({"planner": "human"}, "planner"),
        ({"planner": "mavsdk"}, "real time"),
        ({"seed": -1}, "seed"),
        ({"width_px": 10}, "width_px"),
        ({"frame_rate_hz": math.nan}, "frame_rate_hz"),
        ({"time_limit_s": 0.0}, "time_limit_s"),
    ],
)
def test_a_specification_that_cannot_be_flown_names_what_is_wrong(values, named: str):
    with pytest.raises(FlightError, match=named):
        FlightSpec(**values)
