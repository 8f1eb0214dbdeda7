"""Two-view structure from motion on a rendered corridor of which pose and depth are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.scene import corridor
from detector.camera_model import CameraModel
from detector.two_view import reconstruct

CAMERA = CameraModel.from_hfov(480, 360, 80.0)
LOOKING_NORTH = r_body_from_camera(0.0, 0.0, 0.0)
STEP_M = np.array([0.5, 0.1, 0.0])


def _moved():
    scene = corridor(seed=4)
    start = np.array([0.0, 0.0, -1.3])
    turned = r_from_euler(0.0, 0.0, math.radians(3.0)) @ LOOKING_NORTH
    earlier = scene.render(CAMERA, start, LOOKING_NORTH)
    later = scene.render(CAMERA, start + STEP_M, turned)
    return earlier, later, turned, scene.depth(CAMERA, start, LOOKING_NORTH)


def test_pose_and_depth_of_a_corridor_come_out_true() -> None:
    earlier, later, turned, depth_m = _moved()
    found = reconstruct(earlier, later, CAMERA)

    assert found.failure is None
    true_rotation = turned.T @ LOOKING_NORTH
    off_deg = math.degrees(
        math.acos(np.clip((np.trace(found.later_from_earlier.T @ true_rotation) - 1) / 2, -1, 1))
    )
    assert off_deg < 0.3
    moved = LOOKING_NORTH.T @ STEP_M / np.linalg.norm(STEP_M)
    assert math.degrees(math.acos(np.clip(found.translation_earlier @ moved, -1, 1))) < 3.0
    column, row = np.rint(found.matched_px).astype(int).T
    ratio = found.points_earlier[:, 2] * np.linalg.norm(STEP_M) / depth_m[row, column]
    assert len(ratio) > 100
    assert np.median(np.abs(np.log(ratio))) < 0.1
    assert set(found.seconds) == {"features", "matching", "essential", "triangulation"}


def test_frames_with_nothing_in_common_fail_with_a_reason() -> None:
    earlier, later, _, _ = _moved()
    for other in (np.full_like(later, 90), np.random.default_rng(1).integers(0, 255, later.shape, np.uint8)):
        found = reconstruct(earlier, other, CAMERA)
        assert found.failure is not None
        assert len(found.points_earlier) == 0


def test_frames_of_another_size_are_refused() -> None:
    earlier, later, _, _ = _moved()
    with pytest.raises(ValueError, match=r"later: expected \(360, 480\) uint8"):
        reconstruct(earlier, later[:, :-1], CAMERA)
