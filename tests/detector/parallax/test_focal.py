"""The focal length from several pairs, and when it is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.parallax.flow_field import FlowField
from detector.parallax.focal import FocalEstimate, FocalEstimator
from detector.parallax.params import ParallaxParams
from tests.fakes.pair_views import rotation_deg

PARAMS = ParallaxParams()
WRONG = CameraModel.from_hfov(320, 240, 70.0)


def fields(true: CameraModel, turn_deg: float, *, pairs: int = 10, sigma_px: float = 0.2) -> list[FlowField]:
    """Flow of cameras that turn and move among points one to eight metres away, as an assumed camera measures it."""
    rng = np.random.default_rng(7)
    made = []
    for index in range(pairs):
        later_px = rng.uniform([4, 4], [316, 236], (400, 2))
        turn = rotation_deg(0.3, turn_deg * (-1) ** index, 0.4 * turn_deg)
        moved_m = np.array([0.05, 0.0, 0.2])
        points_m = true.pixel_to_ray(later_px) * rng.uniform(1.0, 8.0, (400, 1)) + moved_m
        earlier_px = true.ray_to_pixel(points_m @ turn) + rng.normal(0.0, sigma_px, (400, 2))
        # What measure_flow does with the assumed camera: turn the earlier frame by a rotation in that camera's terms.
        guess = rotation_deg(0.0, 0.8 * turn_deg * (-1) ** index, 0.0)
        turned_px = WRONG.ray_to_pixel(WRONG.pixel_to_ray(earlier_px) @ guess.T)
        everywhere = np.ones(400, np.bool_)
        information = np.tile(np.eye(2) / 0.3**2, (400, 1, 1))
        made.append(FlowField(later_px, turned_px, information, guess, everywhere, everywhere, WRONG))
    return made


def estimated(true: CameraModel, turn_deg: float, **more: int) -> FocalEstimate:
    estimator = FocalEstimator(PARAMS)
    for field in fields(true, turn_deg, **more):
        estimator.add(field)
    return estimator.estimate()


@pytest.mark.parametrize("hfov_deg", [55.0, 70.0, 85.0])
def test_turning_tells_the_focal_length(hfov_deg: float) -> None:
    true = CameraModel.from_hfov(320, 240, hfov_deg)
    found = estimated(true, 6.0)
    assert found.refused is None
    assert found.share == pytest.approx(true.fx_px / 320, rel=0.08)
    assert abs(found.share - true.fx_px / 320) < 4.0 * found.sigma
    camera = found.camera(320, 240)
    assert camera.fx_px == pytest.approx(found.share * 320)


def test_too_few_pairs_are_refused() -> None:
    found = estimated(WRONG, 6.0, pairs=PARAMS.focal_least_pairs - 1)
    assert found.refused is not None
    assert "pairs" in found.refused
    assert math.isinf(found.sigma)


def test_a_camera_that_hardly_turns_is_refused() -> None:
    found = estimated(WRONG, 0.05)
    assert found.refused is not None
