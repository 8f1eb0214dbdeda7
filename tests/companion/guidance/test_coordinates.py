"""Frames: a pixel's ray must end up at the azimuth that a person would point to."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.coordinates import (
    azimuth_of_body_ray,
    heading_rad,
    quaternion_from_euler,
    r_body_from_camera,
    r_from_euler,
    r_ned_from_body,
    wrap_rad,
)

angles = st.floats(-3.1, 3.1)


def test_an_untilted_camera_looks_forward_with_right_to_the_right_and_down_down():
    r = r_body_from_camera(0, 0, 0)
    np.testing.assert_allclose(r @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(r @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(r @ [0, 1, 0], [0, 0, 1], atol=1e-12)


def test_positive_mount_pitch_looks_up_and_positive_mount_yaw_looks_right():
    up = r_body_from_camera(0, math.radians(30), 0) @ [0, 0, 1]
    assert up[2] == pytest.approx(-0.5)
    right = r_body_from_camera(0, 0, math.radians(30)) @ [0, 0, 1]
    assert right[1] == pytest.approx(0.5)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_quaternion_and_matrix_say_the_same(roll, pitch, yaw):
    q = quaternion_from_euler(roll, pitch, yaw)
    np.testing.assert_allclose(r_ned_from_body(q), r_from_euler(roll, pitch, yaw), atol=1e-9)
    np.testing.assert_allclose(r_ned_from_body(q) @ r_ned_from_body(q).T, np.eye(3), atol=1e-9)


@given(angles, st.floats(-1.4, 1.4))
def test_heading_is_the_yaw_whatever_the_pitch(yaw, pitch):
    assert heading_rad(quaternion_from_euler(0.0, pitch, yaw)) == pytest.approx(yaw, abs=1e-9)


def test_a_ray_to_the_right_of_a_vehicle_facing_east_points_south():
    q = quaternion_from_euler(0, 0, math.pi / 2)
    assert abs(azimuth_of_body_ray((0.0, 1.0, 0.0), q)) == pytest.approx(math.pi)


def test_roll_alone_does_not_move_the_forward_ray():
    q = quaternion_from_euler(0.4, 0.0, 0.7)
    assert azimuth_of_body_ray((1.0, 0.0, 0.0), q) == pytest.approx(0.7)


def test_a_ray_straight_down_has_no_azimuth():
    assert azimuth_of_body_ray((0.05, 0.0, 1.0), quaternion_from_euler(0, 0, 0)) is None


@given(st.floats(-1e4, 1e4))
def test_wrap_stays_in_half_open_range_and_keeps_the_direction(angle):
    wrapped = wrap_rad(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-6)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-6)
