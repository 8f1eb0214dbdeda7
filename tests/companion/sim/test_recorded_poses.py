from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from companion.guidance.coordinates import quaternion_from_euler
from companion.sim.recorded_poses import RecordedPoses


def turning_walk() -> RecordedPoses:
    times_s = np.array([5.0, 6.0, 8.0])
    positions = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 4.0, -2.0]])
    yaws = (math.radians(170.0), math.radians(-170.0), math.radians(-90.0))
    attitudes = np.array([quaternion_from_euler(0.0, 0.1, yaw) for yaw in yaws])
    attitudes[1] *= -1.0  # the same attitude with the other sign
    return RecordedPoses(times_s, positions, attitudes)


def test_between_two_poses_it_interpolates_the_short_way_round() -> None:
    state = turning_walk().state_at(0.25)
    assert state.position_ned_m == pytest.approx((0.25, 0.0, -1.0))
    assert math.degrees(state.yaw_rad) == pytest.approx(175.0, abs=0.1)
    assert state.pitch_rad == pytest.approx(0.1, abs=0.002)


def test_velocity_and_yaw_rate_are_the_differences() -> None:
    state = turning_walk().state_at(2.0)
    assert state.velocity_ned_m_s == pytest.approx((0.0, 2.0, -0.5))
    rate = math.radians(40.0)
    assert state.body_rates_rad_s == pytest.approx(
        (-rate * math.sin(0.1), 0.0, rate * math.cos(0.1)), abs=0.02 * rate
    )


@pytest.mark.parametrize(("elapsed_s", "expected"), [(-1.0, (0.0, 0.0, -1.0)), (9.0, (1.0, 4.0, -2.0))])
def test_outside_the_recording_it_stands(elapsed_s: float, expected: tuple[float, float, float]) -> None:
    state = turning_walk().state_at(elapsed_s)
    assert state.position_ned_m == pytest.approx(expected)
    assert state.velocity_ned_m_s == (0.0, 0.0, 0.0)
    assert state.body_rates_rad_s == (0.0, 0.0, 0.0)


def test_attitudes_stay_unit_quaternions_with_the_recorded_ones_at_their_times() -> None:
    poses = turning_walk()
    for elapsed_s in np.linspace(0.0, poses.duration_s, 50):
        assert np.linalg.norm(poses.pose_at(float(elapsed_s))[1]) == pytest.approx(1.0)
    _, attitude = poses.pose_at(1.0)
    assert abs(np.dot(attitude, poses.q_ned_from_body[1])) == pytest.approx(1.0)


def test_a_file_is_read_and_a_bad_one_named(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("time_s,n,e,d,qw,qx,qy,qz\n0.0,1,2,-3,1,0,0,0\n0.5,2,2,-3,0,0,0,1\n")
    poses = RecordedPoses.load(path)
    assert poses.duration_s == 0.5
    assert poses.state_at(0.0).position_ned_m == (1.0, 2.0, -3.0)

    for text, complaint in (
        ("time_s,n,e\n0,1,2\n", "no column d, qw, qx, qy, qz"),
        ("time_s,n,e,d,qw,qx,qy,qz\n0,1,2,x,1,0,0,0\n", "could not convert"),
        ("time_s,n,e,d,qw,qx,qy,qz\n", "no rows"),
        ("time_s,n,e,d,qw,qx,qy,qz\n1,0,0,0,1,0,0,0\n0,0,0,0,1,0,0,0\n", "increase"),
        ("time_s,n,e,d,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0,0,9,0,0,0\n", "unit quaternions"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=complaint) as caught:
            RecordedPoses.load(path)
        assert str(path) in str(caught.value)
