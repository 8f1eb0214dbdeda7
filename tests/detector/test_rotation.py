from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.camera_model import CameraModel
from detector.flow import Tracks, derotate
from detector.rotation import fit_rotation, parallax_px

CAMERA = CameraModel.from_hfov(640, 480, 80.0)
angle = st.floats(-0.15, 0.15)


def rotation_of(*vector_rad: float) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(np.array(vector_rad, np.float64))[0])


def rays(n: int = 200, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return CAMERA.pixel_to_ray(rng.uniform([20, 20], [620, 460], (n, 2)))


@settings(max_examples=40, deadline=None)
@given(x=angle, y=angle, z=angle, seed=st.integers(0, 20))
def test_a_rotation_is_found_exactly(x: float, y: float, z: float, seed: int) -> None:
    turn, start = rotation_of(x, y, z), rays(seed=seed)
    found = fit_rotation(start, start @ turn.T)
    np.testing.assert_allclose(found, turn, atol=1e-9)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_a_moving_fifth_of_the_rays_hardly_pulls() -> None:
    turn, start = rotation_of(0.02, -0.05, 0.03), rays()
    end = start @ turn.T
    end[:40] += [0.08, 0.03, 0.0]
    end /= np.linalg.norm(end, axis=1)[:, None]
    off = fit_rotation(start, end) @ turn.T
    assert np.degrees(np.arccos((np.trace(off) - 1.0) / 2.0)) < 0.05


def test_coplanar_points_never_give_a_mirror() -> None:
    start = rays(3)
    found = fit_rotation(start, start[[1, 0, 2]])
    assert np.linalg.det(found) == pytest.approx(1.0)


@settings(max_examples=40, deadline=None)
@given(x=angle, y=angle, z=angle)
def test_a_turn_leaves_no_parallax(x: float, y: float, z: float) -> None:
    start = np.random.default_rng(1).uniform([120, 100], [520, 380], (150, 2))
    end = derotate(start, CAMERA, rotation_of(x, y, z))
    assert parallax_px([CAMERA], Tracks(start, end)) < 1e-5


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.03, -0.06, 0.02)])
def test_moving_ahead_leaves_parallax_with_and_without_a_turn(turn: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(2)
    depth_m = rng.uniform(2.0, 8.0, 200)
    before = rays()
    points = before / before[:, 2:] * depth_m[:, None]
    start = CAMERA.ray_to_pixel(points)
    end = CAMERA.ray_to_pixel((points - [0.0, 0.0, 0.3]) @ rotation_of(*turn).T)
    left = parallax_px([CAMERA], Tracks(start, end))
    truth = np.linalg.norm(CAMERA.ray_to_pixel(points - [0.0, 0.0, 0.3]) - start, axis=1)
    assert left == pytest.approx(np.percentile(truth, 80), rel=0.25)
    assert parallax_px([CAMERA], Tracks(start, end), percentile=20.0) < left


def test_points_that_a_turn_takes_behind_the_camera_do_not_count() -> None:
    start = np.array([[320.0, 240.0], [0.0, 240.0], [639.0, 240.0], [320.0, 0.0]])
    assert np.isfinite(parallax_px([CAMERA], Tracks(start, start[::-1].copy())))
