"""The two ends of a right match look alike; on even texture those of a wrong one do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.parallax.flow_field import FlowField
from detector.parallax.likeness import alike

CAMERA = CameraModel.from_hfov(160, 120, 75.0)
POINTS = np.array([[40.0, 40.0], [80.0, 60.0], [120.0, 70.0]])


def even_texture(seed: int = 4) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(128.0, 60.0, (120, 200)).astype(np.float32)
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 1.2) * 3.0 - 256.0, 0, 255).astype(np.uint8)


def field(moved_px: float, believed: bool = True) -> FlowField:
    n = len(POINTS)
    return FlowField(
        POINTS,
        POINTS + np.array([moved_px, 0.0]),
        np.tile(np.eye(2), (n, 1, 1)),
        np.eye(3),
        np.ones(n, np.bool_),
        np.full(n, believed),
        CAMERA,
    )


@pytest.mark.parametrize(("claimed_px", "is_alike"), [(20.0, True), (0.0, False), (11.0, False)])
def test_only_the_true_shift_looks_alike(claimed_px: float, is_alike: bool) -> None:
    wall = even_texture()
    earlier, later = np.ascontiguousarray(wall[:, :160]), np.ascontiguousarray(wall[:, 20:180])
    found = alike(earlier, later, field(claimed_px), POINTS)
    assert ((found > 0.9) == is_alike).all()
    assert is_alike or (found < 0.5).all()


def test_what_flow_does_not_say_is_not_judged_by_it() -> None:
    wall = np.ascontiguousarray(even_texture()[:, :160])
    np.testing.assert_array_equal(alike(wall, wall[::-1].copy(), field(0.0, believed=False), POINTS), 1.0)


def test_a_plain_wall_is_not_alike() -> None:
    plain = np.full((120, 160), 90, np.uint8)
    np.testing.assert_array_equal(alike(plain, plain, field(0.0), POINTS), 0.0)


def test_only_the_points_asked_for_are_told() -> None:
    wall = even_texture()
    image = np.ascontiguousarray(wall[:, :160])
    assert alike(image, image, field(0.0), POINTS[1:2]) == pytest.approx([1.0])
    assert len(alike(image, image, field(0.0), np.zeros((0, 2)))) == 0
